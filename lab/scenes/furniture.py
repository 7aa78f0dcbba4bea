"""Furniture: pieces composed of solids with materials on their faces.

The functions below the class add one piece each to a `Furniture`, here called `f`, with random details from the
generator `draw`. Room frame: metres, x right, y up, z towards the cameras; the back wall is z = 0. Angles are in
degrees. `x` and `z` are the center of a piece, unless its docstring says otherwise. A solid is *removable* if it
belongs to an object that the scene asks to remove or to insert.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lab.scenes.solids import BOX, CYLINDER, ROOM, SPHERE, THICKET, Faces, Solids


@dataclass(frozen=True)
class Material:
    """Texture on a face.

    Attributes:
        texture: name of the texture.
        tile: side of the repeated texture in metres; 0 stretches one texture over the whole face.
        tint: factor on the texture's linear color.
        turned: True exchanges the axes of the texture, so that its rows run along v of the face.
    """

    texture: str
    tile: float = 0.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    turned: bool = False


class Furniture:
    """List of solids and materials, to which furniture is added piece by piece.

    The argument `removable` of the methods is False for solids that stay, True for solids of the object, or the name
    of the object if there are several with masks of their own. `yaw` is a rotation about the vertical axis in degrees.
    """

    def __init__(self) -> None:
        self.solids: list[tuple] = []
        self.leaves: dict[int, tuple] = {}
        self.materials: list[Material] = []

    @property
    def objects(self) -> dict[str, np.ndarray]:
        """The named objects as {name: bool [n], True for the object's solids}."""
        of = [removable for *_, removable in self.solids]
        return {name: np.array([each == name for each in of]) for name in sorted({n for n in of if isinstance(n, str)})}

    def _add(self, kind, center, half, yaw, materials, removable):
        turn = (np.cos(np.radians(yaw)), np.sin(np.radians(yaw)))
        self.solids.append((kind, center, half, turn, len(self.materials), removable))
        self.materials += materials

    def room(self, center, half, right, left, ceiling, floor, front, back):
        """Add the room, which must come first.

        Args:
            center: (x, y, z), metres.
            half: half extents (x, y, z), metres.
            right, left, ceiling, floor, front, back: materials. The front wall is at +z, behind the cameras.
        """
        self._add(ROOM, center, half, 0.0, [right, left, ceiling, floor, front, back], False)

    def box(self, x, bottom, z, size, sides, front=None, top=None, yaw=0.0, removable=False):
        """Add an upright box.

        Args:
            x: center, metres.
            bottom: height of its lower face, metres.
            z: center, metres.
            size: (wide, high, deep) in metres.
            sides: material of all faces except those with a material of their own.
            front: material of the face that points to +z before the yaw; None for `sides`.
            top: material of the upper face; None for `sides`.
        """
        half = np.array(size) / 2
        faces = [sides, sides, top or sides, sides, front or sides, sides]
        self._add(BOX, (x, bottom + half[1], z), half, yaw, faces, removable)

    def sphere(self, x, bottom, z, radius, material, yaw=0.0, removable=False):
        """Add a sphere whose lowest point is at the height `bottom`; x and z are its center (all in metres)."""
        self._add(SPHERE, (x, bottom + radius, z), (radius,) * 3, yaw, [material], removable)

    def cylinder(self, x, bottom, z, radius, high, side, top=None, removable=False):
        """Add an upright cylinder.

        Args:
            x: center, metres.
            bottom: height of its lower face, metres.
            z: center, metres.
            radius: metres.
            high: metres.
            side: material of the side and of the lower face.
            top: material of the upper face; None for `side`.
        """
        half = (radius, high / 2, radius)
        self._add(CYLINDER, (x, bottom + high / 2, z), half, 0.0, [side, top or side, side], removable)

    def thicket(self, x, bottom, z, size, cell, leaf, material, seed, yaw=0.0):
        """Add a box full of leaves, see `thicket.py`, that is not removable. Its position is given as in `box`.

        Args:
            size: (wide, high, deep) of the box, metres.
            cell: approximate size of a cell with one leaf, metres; one number, or (wide, high, deep).
            leaf: (width, length, thickness) of a leaf in metres, and its largest lean in degrees.
            seed: seed of the leaves' shapes and positions.
        """
        half = np.array(size) / 2
        cells = np.maximum(np.round(np.array(size) / cell), 1).astype(int)
        *extents, lean = leaf
        self.leaves[len(self.solids)] = (*cells, *np.array(extents) / 2, np.radians(lean), seed)
        self._add(THICKET, (x, bottom + half[1], z), half, yaw, [material], False)

    def arrays(self, index: dict[str, int], node: float) -> tuple[Solids, Faces]:
        """Return all solids and faces as the arrays that the ray caster's kernels read.

        Args:
            index: name of a texture -> its index.
            node: approximate distance between nodes of the light map, metres; four times as much on the ceiling and the
                front wall. A face has 5 to 256 nodes along each side.
        """
        return self._solid_arrays(), self._face_arrays(index, node)

    def _solid_arrays(self) -> Solids:
        kind, center, half, turn, first, removable = zip(*self.solids, strict=True)
        leaves = [self.leaves.get(n, (0,) * 8) for n in range(len(self.solids))]
        return Solids(
            np.array(kind, np.int32), np.array(center, float), np.array(half, float),
            np.array(turn, float), np.array(first, np.int32), np.array([bool(name) for name in removable]),
            np.array([_reach(k, h) for k, h in zip(kind, half, strict=True)]),
            np.array(leaves, float),
        )  # fmt: skip

    def _face_arrays(self, index: dict[str, int], node: float) -> Faces:
        lawns = [n in self.leaves and self.leaves[n][1] == 1 for n in range(len(self.solids))]
        solids = zip(self.solids, lawns, strict=True)
        sizes = np.array([size for solid, lawn in solids for size in _face_sizes(solid[0], solid[2], lawn)])
        spacing = np.full((len(sizes), 1), node)
        spacing[[2, 4]] *= 4  # ceiling and front wall are hardly ever in a picture
        nodes = np.clip(np.ceil(sizes / spacing).astype(int) + 1, 5, 256)
        start = np.cumsum([0, *nodes.prod(1)])[:-1]
        mapping = np.zeros((len(sizes), 4))
        for face, (size, material) in enumerate(zip(sizes, self.materials, strict=True)):
            if material.tile:
                # The offsets differ from face to face, so that faces show different parts of the texture.
                mapping[face] = 1 / material.tile, 1 / material.tile, face * 0.377 % 1, face * 0.619 % 1
            else:
                mapping[face, :2] = 1 / (size[::-1] if material.turned else size)
        return Faces(
            np.array([index[m.texture] for m in self.materials]), mapping,
            np.array([m.turned for m in self.materials]), np.array([m.tint for m in self.materials], float),
            sizes, np.column_stack([start, nodes]).astype(np.int64),
        )  # fmt: skip


def _reach(kind: int, half) -> float:
    """Return the radius of a solid's bounding sphere."""
    if kind == SPHERE:
        return half[0]
    return np.hypot(half[0], half[1]) if kind == CYLINDER else np.linalg.norm(half)


def _face_sizes(kind: int, half, lawn: bool) -> list[tuple[float, float]]:
    """Return the extents (u, v) of a solid's faces in metres; `lawn` is True for a thicket of one layer of leaves."""
    a, b, c = (2 * h for h in half)
    if kind == THICKET:
        return [(a, c) if lawn else (a, b)]
    if kind == SPHERE:
        return [(np.pi * a, np.pi * a / 2)]
    if kind == CYLINDER:
        return [(np.pi * a, b), (a, a), (a, a)]
    return [(c, b), (c, b), (a, c), (a, c), (a, b), (a, b)]


WHITE = Material("white", 2.0)
WOOD = Material("wood", 0.9)


def plant(f: Furniture, draw, x: float, z: float, high: float) -> None:
    """Add a plant in a pot, about `high` metres high."""
    f.cylinder(x, 0, z, 0.17, 0.3, Material("pot"), Material("wicker", 0.6, (0.3, 0.22, 0.16)))
    f.cylinder(x, 0.3, z, 0.025, high - 0.6, WOOD)
    for k in range(7):
        a = 2.4 * k + draw.random()
        r = draw.uniform(0.13, 0.2)
        y = high - 0.85 + 0.09 * k
        f.sphere(x + 0.15 * np.cos(a), y, z + 0.15 * np.sin(a), r, Material("leaves", 0.5), 40 * k)


def shelf(f: Furniture, draw, x: float, z: float, wide: float, yaw: float = 0.0) -> None:
    """Add a low bookshelf of width `wide` with things on it. Its back points to -z before the yaw."""
    c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    f.box(x, 0, z, (wide, 0.44, 0.3), WOOD, Material("books"), yaw=yaw)
    f.box(x, 0.44, z, (wide + 0.06, 0.03, 0.34), WOOD, yaw=yaw)
    for offset, thing in zip((-0.3, 0.02, 0.3), draw.permutation(3), strict=True):
        px, pz = x + c * offset * wide, z - s * offset * wide
        if thing == 0:
            f.cylinder(px, 0.47, pz, 0.075, 0.26, Material("vase"))
        elif thing == 1:
            f.sphere(px, 0.47, pz, 0.11, Material("globe"), 70.0)
        else:
            f.box(px, 0.47, pz, (0.2, 0.2, 0.16), Material("books2"), yaw=yaw + 8, top=WHITE)


def cabinet(f: Furniture, draw, x: float, z: float, wide: float, high: float, deep: float) -> None:
    """Add the removable object of "demo" and most other kinds: a cabinet with a ball and a jar on it.

    x is the cabinet's center, and z its back.
    """
    body = Material("paint", 1.3)
    f.box(x, 0, z + deep / 2, (wide, high, deep), body, Material("front"), removable=True)
    f.box(x, high, z + deep / 2, (wide + 0.04, 0.025, deep + 0.02), WOOD, removable=True)
    side = draw.choice((-1, 1))
    radius = min(draw.uniform(0.12, 0.16), deep * 0.48)
    top = high + 0.025
    f.sphere(x + side * wide * 0.26, top, z + deep / 2, radius, Material("ball"), draw.uniform(0, 360), removable=True)
    f.cylinder(x - side * wide * 0.2, top, z + deep / 2, min(0.1, deep / 3), draw.uniform(0.16, 0.26), Material("jar"),
               removable=True)  # fmt: skip


def pair(f: Furniture, draw, side: int, z: float) -> None:
    """Add the two removable objects of the kind "pair" side by side: a box, and a ball on a foot.

    Args:
        side: 1 if the box is on the right, -1 if on the left.
        z: position of the objects' backs.
    """
    wide, deep, high = draw.uniform(0.5, 0.58), draw.uniform(0.2, 0.24), draw.uniform(0.62, 0.74)
    f.box(side * 0.44, 0, z + deep / 2, (wide, high, deep), Material("paint", 1.3), Material("front"), removable="box")
    f.box(side * 0.44, high, z + deep / 2, (wide + 0.03, 0.02, deep + 0.02), WOOD, removable="box")
    radius, foot = draw.uniform(0.19, 0.22), draw.uniform(0.2, 0.26)
    f.cylinder(-side * 0.42, 0, z + radius, 0.14, foot, Material("jar"), WOOD, removable="ball")
    f.sphere(-side * 0.42, foot, z + radius, radius, Material("ball"), draw.uniform(0, 360), removable="ball")


def lantern(f: Furniture, draw, x: float, z: float) -> None:
    """Add the removable object of the kind "seen": a lantern in mid-air, far from everything behind it."""
    low, radius = draw.uniform(0.72, 0.8), draw.uniform(0.11, 0.13)
    f.sphere(x, low, z, radius, Material("ball"), draw.uniform(0, 360), removable=True)
    f.cylinder(x, low + 1.8 * radius, z, 0.5 * radius, 0.07, Material("jar"), WOOD, removable=True)


def table(f: Furniture, x: float, z: float, size: tuple[float, float, float]) -> None:
    """Add a table of size (wide, high, deep) with a thin top on four legs."""
    wide, high, deep = size
    f.box(x, high - 0.04, z, (wide, 0.04, deep), WOOD)
    for a, b in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        f.box(x + a * (wide / 2 - 0.07), 0, z + b * (deep / 2 - 0.07), (0.06, high - 0.04, 0.06), WOOD)


def chest(f: Furniture, draw, x: float, bottom: float, z: float) -> None:
    """Add the object of the kinds "table" and "insert": a chest with a ball and a jar on its lid.

    The chest is parallel to the walls; z is its front.
    """
    wide, high, deep = draw.uniform(0.6, 0.7), draw.uniform(0.36, 0.42), draw.uniform(0.4, 0.46)
    z -= deep / 2
    f.box(x, bottom, z, (wide, high, deep), Material("paint", 1.3), Material("front"), removable=True)
    f.box(x, bottom + high, z, (wide + 0.03, 0.02, deep + 0.02), WOOD, removable=True)
    side, top = draw.choice((-1, 1)), bottom + high + 0.02
    f.sphere(x + side * wide * 0.24, top, z, draw.uniform(0.1, 0.13), Material("ball"), draw.uniform(0, 360),
             removable=True)  # fmt: skip
    f.cylinder(x - side * wide * 0.22, top, z, 0.08, draw.uniform(0.14, 0.2), Material("jar"), removable=True)


def keepsake(f: Furniture, draw, x: float, z: float) -> None:
    """Add an object that is not removed: a large ball, or a stool with a globe.

    In the kind "behind" it stands before the removable object. In the kind "sparse" it takes the place of this object.
    """
    if draw.random() < 0.5:
        f.sphere(x, 0, z, draw.uniform(0.24, 0.28), Material("globe"), draw.uniform(0, 360))
    else:
        high, radius = draw.uniform(0.24, 0.32), draw.uniform(0.17, 0.2)
        f.cylinder(x, 0, z, 0.16, high, Material("crate", 0.7), WOOD)
        f.sphere(x, high, z, radius, Material("globe"), draw.uniform(0, 360))


def hedge(f: Furniture, draw, z: float, wide: float, high: float) -> None:
    """Add a hedge of width `wide` and height `high`: three layers of leaves before a dark core; z is the hedge's front.

    The layers have cells of different sizes, so that the rows of cells are not visible.
    """
    f.box(0, 0, z - 0.4, (wide, high - 0.06, 0.2), Material("leaves", 0.6, (0.5, 0.6, 0.4)))
    for cell, back, tint in ((0.065, 0.05, 1.4), (0.08, 0.02, 2.0), (0.1, 0.0, 2.6)):
        leaf, material = (0.8 * cell, 1.1 * cell, 0.008, 80), Material("foliage", 0.8, (tint,) * 3)
        seed, yaw = int(draw.integers(1 << 20)), draw.uniform(-1.2, 1.2)
        f.thicket(0, 0, z - 0.15 - back, (wide, high - back, 0.3), cell, leaf, material, seed, yaw)


def lawn(f: Furniture, draw, z: float, wide: float) -> None:
    """Add a square lawn of side `wide` around z: a low dark layer of grass and a high light one.

    The two layers are turned against each other, so that the rows of cells are not visible.
    """
    for high, tint in ((0.07, 1.2), (0.12, 2.4)):
        blade, material = (0.014, high + 0.01, 0.006, 14), Material("foliage", 0.8, (tint,) * 3)
        seed, yaw = int(draw.integers(1 << 20)), draw.uniform(0, 90)
        cell = (0.04, high + 0.02, 0.04)
        f.thicket(0, -0.02, z, (wide, high + 0.02, wide), cell, blade, material, seed, yaw)


def daybed(f: Furniture, draw, x: float, z: float) -> None:
    """Add the removable object of the kind "360": a low daybed with a ball and a jar on it.

    For cameras all around it hides only the floor below.
    """
    wide, deep, high = draw.uniform(1.1, 1.3), draw.uniform(0.8, 0.95), draw.uniform(0.14, 0.18)
    yaw = draw.uniform(-20, 20)
    f.box(x, 0.008, z, (wide, high - 0.008, deep), Material("paint", 1.3), yaw=yaw, removable=True)
    f.box(x, high, z, (wide + 0.04, 0.025, deep + 0.04), WOOD, yaw=yaw, top=Material("quilt"), removable=True)
    f.sphere(x + 0.2, high + 0.025, z - 0.1, 0.11, Material("ball"), removable=True)
    f.cylinder(x - 0.25, high + 0.025, z + 0.1, 0.08, 0.13, Material("jar"), removable=True)


def chest_with_neighbors(f: Furniture, draw, x: float, z: float) -> None:
    """Add the removable object of the kind "beside", a chest with a ball and a jar, and four things that stay.

    The things stand around the chest, within half its radius, one on each side. So from every side the chest hides a
    part of one of them.
    """
    front = z + draw.uniform(0.2, 0.23)
    chest(f, draw, x, 0.008, front)
    turn, things = draw.uniform(-20, 20), draw.permutation(4)
    for k in range(4):
        angle = np.radians(90 * k + turn)
        reach = 0.47 if k % 2 == 0 else 0.38
        at = x + reach * np.sin(angle + np.pi / 2), z + reach * np.cos(angle + np.pi / 2)
        yaw = draw.uniform(0, 90)
        if things[k] == 0:
            f.box(at[0], 0.008, at[1], (0.22, 0.26, 0.2), Material("crate"), yaw=yaw)
        elif things[k] == 1:
            f.box(at[0], 0.008, at[1], (0.2, 0.34, 0.14), Material("books2"), yaw=yaw, top=WHITE)
        elif things[k] == 2:
            f.sphere(at[0], 0.008, at[1], 0.12, Material("globe"), draw.uniform(0, 360))
        else:
            f.cylinder(at[0], 0.008, at[1], 0.09, 0.3, Material("vase"))


def box_among_things(f: Furniture, draw, x: float, z: float) -> None:
    """Add the removable object of the kind "around", a low box, and five or six things that stay.

    The things stand anywhere around the box, and touch it or are 5 cm away from it.
    """
    wide, deep, high = draw.uniform(0.7, 1.0), draw.uniform(0.5, 0.7), draw.uniform(0.2, 0.32)
    f.box(x, 0.008, z, (wide, high, deep), Material("paint", 1.3), top=Material("quilt"), removable=True)
    count = int(draw.integers(5, 7))
    for k in range(count):
        angle, gap = 2 * np.pi * (k + draw.uniform(-0.25, 0.25)) / count, draw.choice((0.002, 0.05))
        across, along = np.cos(angle), np.sin(angle)
        at_end = abs(across) * deep > abs(along) * wide  # at a face that looks along x
        reach = (wide if at_end else deep) / 2
        shift = reach * (along / abs(across) if at_end else across / abs(along))
        kind, size = draw.choice(("box", "turned box", "ball", "plate", "vase")), draw.uniform(0.2, 0.3)
        out = reach + gap + size / 2 * (np.sqrt(2) if kind == "turned box" else 1)
        px, pz = (np.sign(across) * out, shift) if at_end else (shift, np.sign(along) * out)
        px, pz = x + px, z + pz
        if kind in ("box", "turned box"):
            yaw, material = 45.0 if kind == "turned box" else 0.0, Material(str(draw.choice(("crate", "books2"))))
            f.box(px, 0.008, pz, (size, draw.uniform(0.15, 0.4), size), material, yaw=yaw)
        elif kind == "ball":
            f.sphere(px, 0.008, pz, size / 2, Material("globe"), draw.uniform(0, 360))
        else:
            high = draw.uniform(0.03, 0.06) if kind == "plate" else draw.uniform(0.2, 0.35)
            f.cylinder(px, 0.008, pz, size / 2, high, Material("wicker" if kind == "plate" else "vase"), WOOD)
