"""Synthetic scenes with known truth: `python data/generate.py --out data/demo --seed 0 --kind demo`.

A furnished room is ray-cast with and without one object. Kinds:
  demo    100 views in SPIn-NeRF's layout: 40 test views without the object, 60 training views with it
  mini    the same, 3 + 8 views of 64 x 48 px, for tests
  wide    demo with cameras +-50 degrees around the object
  360     demo with cameras all around an object that lies on the floor
  photos  26 larger photographs and masks without poses, for structure from motion

Poses are written in a scene frame of arbitrary scale, rotation and origin, as SfM leaves it. As in SPIn-NeRF the
COLMAP model and poses_bounds.npy are those of the full resolution, 4 times `images_4`; the model names `<view>.jpg`.
`truth/` holds what the pipeline must not read, every picture in the photo's own lens. Nothing outside the masks
differs between a view with and one without the object: it casts no shadow, and masks hold every pixel it touches.
"""

from __future__ import annotations

import argparse
import json
import shutil
import struct
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import raycast
import textures as paint


@dataclass(frozen=True)
class Kind:
    """What differs between kinds.

    Attributes:
        width, height: pixels of the written images; samples: rays a side of a pixel.
        train, test: numbers of views; photos: write photographs and masks only.
        spread: degrees the cameras reach to either side of the object; from 180 on they circle it.
        texture: pixels a side of the largest textures; node: metres between nodes of the light map.
        bend: SIMPLE_RADIAL's k1 at its largest; points: sparse points wanted.
    """

    width: int = 320
    height: int = 240
    samples: int = 3
    train: int = 60
    test: int = 40
    photos: bool = False
    spread: float = 22.0
    texture: int = 1024
    node: float = 0.03
    bend: float = 0.045
    points: int = 3000


KINDS = {
    "demo": Kind(),
    "mini": Kind(width=64, height=48, train=8, test=3, texture=256, node=0.1, points=400),
    "wide": Kind(spread=50.0),
    "360": Kind(spread=180.0),
    "photos": Kind(width=480, height=360, train=26, test=0, photos=True, texture=2048, node=0.025),
}
FULL = 4  # full resolution over that of images_4
LEAST_NEVER_SEEN = 0.4


@dataclass(frozen=True)
class Material:
    """A texture on a face: metres a tile (0: fitted to the face), factor on its colour, turned by 90 degrees."""

    texture: str
    tile: float = 0.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    turned: bool = False


@dataclass(frozen=True)
class World:
    """All that `raycast` needs: geometry, materials, baked light [M, 3], and the exposure."""

    solids: raycast.Solids
    faces: raycast.Faces
    textures: raycast.Textures
    light: np.ndarray
    exposure: float


def randomness(seed: int, label: str) -> np.random.Generator:
    """A generator of its own for each part, so that changing one part leaves the others as they were."""
    return np.random.default_rng([seed, zlib.crc32(label.encode())])


class Furniture:
    """Solids and their materials while the room is being furnished."""

    def __init__(self) -> None:
        self.solids: list[tuple] = []
        self.materials: list[Material] = []

    def _add(self, kind, center, half, yaw, materials, removable):
        turn = (np.cos(np.radians(yaw)), np.sin(np.radians(yaw)))
        self.solids.append((kind, center, half, turn, len(self.materials), removable))
        self.materials += materials

    def room(self, center, half, right, left, ceiling, floor, front, back):
        self._add(raycast.ROOM, center, half, 0.0, [right, left, ceiling, floor, front, back], False)

    def box(self, x, bottom, z, size, sides, front=None, top=None, yaw=0.0, removable=False):
        """An upright box of size (wide, high, deep) that stands on `bottom`; `front` faces +z before the yaw."""
        half = np.array(size) / 2
        faces = [sides, sides, top or sides, sides, front or sides, sides]
        self._add(raycast.BOX, (x, bottom + half[1], z), half, yaw, faces, removable)

    def sphere(self, x, bottom, z, radius, material, yaw=0.0, removable=False):
        self._add(raycast.SPHERE, (x, bottom + radius, z), (radius,) * 3, yaw, [material], removable)

    def cylinder(self, x, bottom, z, radius, high, side, top=None, removable=False):
        half = (radius, high / 2, radius)
        self._add(raycast.CYLINDER, (x, bottom + high / 2, z), half, 0.0, [side, top or side, side], removable)

    def arrays(self, index: dict[str, int], node: float) -> tuple[raycast.Solids, raycast.Faces]:
        """Everything as the arrays `raycast` reads; `index`: texture name -> number, `node`: metres."""
        kind, center, half, turn, first, removable = zip(*self.solids, strict=True)
        solids = raycast.Solids(
            np.array(kind, np.int32), np.array(center, float), np.array(half, float),
            np.array(turn, float), np.array(first, np.int32), np.array(removable, bool),
            np.array([h[0] if k == raycast.SPHERE else np.hypot(h[0], h[1]) if k == raycast.CYLINDER
                      else np.linalg.norm(h) for k, h in zip(kind, half, strict=True)]),
        )  # fmt: skip
        sizes = np.array([size for solid in self.solids for size in _face_sizes(solid[0], solid[2])])
        spacing = np.full((len(sizes), 1), node)
        spacing[[2, 4]] *= 4  # ceiling and front wall: hardly ever in a picture
        nodes = np.clip(np.ceil(sizes / spacing).astype(int) + 1, 5, 256)
        start = np.cumsum([0, *nodes.prod(1)])[:-1]
        mapping = np.zeros((len(sizes), 4))
        for face, (size, material) in enumerate(zip(sizes, self.materials, strict=True)):
            fitted = 1 / (size[::-1] if material.turned else size)
            mapping[face, :2] = 1 / material.tile if material.tile else fitted
            if material.tile:
                mapping[face, 2:] = face * 0.377 % 1, face * 0.619 % 1  # no two faces show the same stretch
        faces = raycast.Faces(
            np.array([index[m.texture] for m in self.materials]), mapping,
            np.array([m.turned for m in self.materials]), np.array([m.tint for m in self.materials], float),
            sizes, np.column_stack([start, nodes]).astype(np.int64),
        )  # fmt: skip
        return solids, faces


def _face_sizes(kind: int, half) -> list[tuple[float, float]]:
    a, b, c = (2 * h for h in half)
    if kind == raycast.SPHERE:
        return [(np.pi * a, np.pi * a / 2)]
    if kind == raycast.CYLINDER:
        return [(np.pi * a, b), (a, a), (a, a)]
    return [(c, b), (c, b), (a, c), (a, c), (a, b), (a, b)]


def paint_textures(seed: int, size: int) -> dict[str, np.ndarray]:
    """Every texture of the scene, its style drawn from the seed; large for floor and walls, half for the rest."""
    small = max(size // 2, 128)
    draw = randomness(seed, "styles")
    floors = (paint.wood_planks, paint.wood_planks, paint.stone_tiles, paint.herringbone)
    walls = (paint.bricks, paint.wallpaper)
    plain = [(206, 198, 182), (186, 200, 204), (204, 188, 176), (190, 202, 184), (214, 210, 200)]
    hues = [
        ((196, 62, 44), (240, 228, 200)),
        ((26, 116, 122), (244, 190, 92)),
        ((226, 148, 36), (60, 66, 120)),
        ((70, 76, 160), (238, 206, 120)),
        ((60, 132, 72), (240, 226, 196)),
        ((150, 48, 96), (236, 214, 180)),
    ]
    first, second = draw.permutation(len(hues))[:2]
    made = {
        "floor": (floors[draw.integers(len(floors))], size, {}),
        "wall": (walls[draw.integers(len(walls))], size, {}),
        "side": (paint.plaster, size, {"color": plain[draw.integers(len(plain))]}),
        "wood": (paint.wood_planks, small, {"rows": 8, "pieces": 1, "palette": paint.WOODS[draw.integers(4)]}),
        "rug": (paint.rug, size, {}),
        "books": (paint.books, small, {}),
        "books2": (paint.books, small, {"thick": 3.0}),
        "picture": (paint.picture, small, {}),
        "picture2": (paint.picture, small, {}),
        "leaves": (paint.leaves, small, {}),
        "wicker": (paint.wicker, small, {}),
        "pot": (paint.glazed, small, {"color": (170, 92, 60), "bands": (222, 176, 138)}),
        "vase": (paint.glazed, small, {"color": (44, 78, 128)}),
        "crate": (paint.wood_planks, small, {"rows": 4, "pieces": 1, "palette": paint.WOODS[draw.integers(4)]}),
        "globe": (paint.ball, small, {"first": (64, 104, 92), "second": (224, 212, 180)}),
        "front": (paint.painted_front, small, {"color": hues[first][0]}),
        "paint": (paint.painted, small, {"color": hues[first][0]}),
        "ball": (paint.ball, small, {"first": hues[second][0], "second": hues[second][1]}),
        "quilt": (paint.quilt, small, {"first": hues[first][0], "second": hues[second][1]}),
        "jar": (paint.glazed, small, {"color": hues[first][1], "bands": hues[second][0]}),
        "white": (paint.plaster, small, {"color": (236, 234, 228)}),
    }
    return {name: maker(randomness(seed, name), n, **how) for name, (maker, n, how) in made.items()}


WHITE = Material("white", 2.0)
WOOD = Material("wood", 0.9)


def plant(f: Furniture, draw, x: float, z: float, high: float) -> None:
    f.cylinder(x, 0, z, 0.17, 0.3, Material("pot"), Material("wicker", 0.6, (0.3, 0.22, 0.16)))
    f.cylinder(x, 0.3, z, 0.025, high - 0.6, WOOD)
    for k in range(7):
        a = 2.4 * k + draw.random()
        r = draw.uniform(0.13, 0.2)
        y = high - 0.85 + 0.09 * k
        f.sphere(x + 0.15 * np.cos(a), y, z + 0.15 * np.sin(a), r, Material("leaves", 0.5), 40 * k)


def shelf(f: Furniture, draw, x: float, z: float, wide: float, yaw: float = 0.0) -> None:
    """A low bookshelf with things on it; its back towards -z before the yaw."""
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
    """The object of demo: a cabinet against the wall, a ball and a jar on it. z is its back."""
    body = Material("paint", 1.3)
    f.box(x, 0, z + deep / 2, (wide, high, deep), body, Material("front"), removable=True)
    f.box(x, high, z + deep / 2, (wide + 0.04, 0.025, deep + 0.02), WOOD, removable=True)
    side = draw.choice((-1, 1))
    radius = min(draw.uniform(0.12, 0.16), deep * 0.48)
    top = high + 0.025
    f.sphere(x + side * wide * 0.26, top, z + deep / 2, radius, Material("ball"), draw.uniform(0, 360), removable=True)
    f.cylinder(x - side * wide * 0.2, top, z + deep / 2, min(0.1, deep / 3), draw.uniform(0.16, 0.26), Material("jar"),
               removable=True)  # fmt: skip


def daybed(f: Furniture, draw, x: float, z: float) -> None:
    """The object of 360: a low daybed with a ball and a jar on it; all around, only the floor below is hidden."""
    wide, deep, high = draw.uniform(1.1, 1.3), draw.uniform(0.8, 0.95), draw.uniform(0.14, 0.18)
    yaw = draw.uniform(-20, 20)
    f.box(x, 0.008, z, (wide, high - 0.008, deep), Material("paint", 1.3), yaw=yaw, removable=True)
    f.box(x, high, z, (wide + 0.04, 0.025, deep + 0.04), WOOD, yaw=yaw, top=Material("quilt"), removable=True)
    f.sphere(x + 0.2, high + 0.025, z - 0.1, 0.11, Material("ball"), removable=True)
    f.cylinder(x - 0.25, high + 0.025, z + 0.1, 0.08, 0.13, Material("jar"), removable=True)


def furnish(seed: int, kind: Kind) -> tuple[Furniture, np.ndarray]:
    """The room and what stands in it; the point the cameras look at."""
    f, draw = Furniture(), randomness(seed, "layout")
    planks = Material("floor", 3.0, turned=bool(draw.integers(2)))
    wall, plain = Material("wall", 1.8), Material("side", 2.6)
    if kind.spread >= 180:
        return f, _round_room(f, draw, planks, wall, plain)
    side = draw.choice((-1, 1))  # where the corner is
    # The corner stands clear of the outermost camera.
    corner = 1.45 + max(0.0, 2.6 * np.sin(np.radians(kind.spread)) - 0.97)
    left, right = (-corner, 4.0) if side < 0 else (-4.0, corner)
    f.room(((left + right) / 2, 1.35, 3.2), ((right - left) / 2, 1.35, 3.2), plain, plain, WHITE, planks, plain, wall)
    skirt = Material("white", 2.0) if draw.random() < 0.6 else Material("wood", 0.9)
    f.box((left + right) / 2, 0, 0.008, (right - left, 0.1, 0.016), skirt)
    f.box(side * (corner - 0.008), 0, 3.2, (0.016, 0.1, 6.4), skirt)
    flat = kind.spread > 30
    cabinet(f, draw, 0.0, 0.026 if flat else draw.uniform(0.06, 0.14), draw.uniform(0.98, 1.12), draw.uniform(0.6, 0.7),
            draw.uniform(0.19, 0.22) if flat else draw.uniform(0.4, 0.46))  # fmt: skip
    plant(f, draw, side * (corner - 0.42), 0.36, draw.uniform(1.35, 1.6))
    shelf(f, draw, -side * draw.uniform(1.08, 1.2), 0.2, draw.uniform(0.7, 0.8))
    x, y = -side * draw.uniform(0.95, 1.1), draw.uniform(0.95, 1.05)
    f.box(x, y, 0.012, (0.52, 0.4, 0.024), WOOD, Material("picture"))
    x, y = side * draw.uniform(0.5, 0.75), draw.uniform(1.1, 1.2)
    f.box(x, y, 0.012, (0.4, 0.5, 0.024), WOOD, Material("picture2"))
    f.box(draw.uniform(-0.15, 0.15), 0, draw.uniform(1.3, 1.4), (1.5, 0.008, 1.1), Material("rug"), top=Material("rug"),
          yaw=draw.uniform(-6, 6))  # fmt: skip
    f.cylinder(-side * draw.uniform(0.85, 0.95), 0, draw.uniform(0.75, 0.85), 0.15, 0.24, Material("wicker", 0.5),
               Material("wicker", 0.5, (0.25, 0.2, 0.15)))  # fmt: skip
    f.box(side * draw.uniform(0.82, 0.92), 0, draw.uniform(0.72, 0.85), (0.26, 0.2, 0.2), Material("crate"),
          yaw=draw.uniform(10, 60))  # fmt: skip
    return f, np.array([0.0, 0.5, 0.1])


def _round_room(f: Furniture, draw, planks: Material, wall: Material, plain: Material) -> np.ndarray:
    f.room((0, 1.35, 3.2), (3.2, 1.35, 3.2), plain, wall, WHITE, planks, wall, wall)
    f.box(0.1, 0, 3.15, (2.3, 0.008, 1.6), Material("rug"), top=Material("rug"), yaw=draw.uniform(-30, 30))
    daybed(f, draw, 0.0, 3.2)
    for x, z, wide, deep in ((0, 0.008, 6.4, 0.016), (0, 6.392, 6.4, 0.016), (-3.192, 3.2, 0.016, 6.4),
                             (3.192, 3.2, 0.016, 6.4)):  # fmt: skip
        f.box(x, 0, z, (wide, 0.1, deep), WHITE)
    for x, z in ((-2.75, 0.45), (2.75, 5.95), (2.7, 0.5), (-2.7, 5.9)):
        plant(f, draw, x, z, draw.uniform(1.4, 1.7))
    for x, z, yaw in ((0.4, 0.2, 0), (-0.5, 6.2, 180), (-3.0, 3.6, 90), (3.0, 2.8, -90)):
        shelf(f, draw, x, z, draw.uniform(1.0, 1.3), yaw)
    f.box(1.6, 1.1, 0.012, (0.8, 0.6, 0.024), WOOD, Material("picture"))
    f.box(-1.7, 1.0, 0.012, (0.6, 0.8, 0.024), WOOD, Material("picture2"))
    f.box(-3.188, 1.1, 1.8, (0.024, 0.7, 0.9), Material("picture2"))
    f.box(3.188, 1.1, 4.4, (0.024, 0.7, 0.9), Material("picture"))
    for k, name in enumerate(("crate", "wicker", "globe", "vase")):
        a = np.radians(90 * k + draw.uniform(20, 70))
        x, z = 1.25 * np.cos(a), 3.2 + 1.25 * np.sin(a)
        if name == "crate":
            f.box(x, 0, z, (0.24, 0.18, 0.2), Material(name), yaw=draw.uniform(0, 90))
        elif name == "globe":
            f.sphere(x, 0, z, 0.11, Material(name))
        else:
            f.cylinder(x, 0, z, 0.1, 0.16, Material(name))
    return np.array([0.0, 0.3, 3.2])


def bake(furniture: Furniture, seed: int, kind: Kind) -> World:
    """Textures and light: a ceiling lamp, a window, two bounces."""
    pictures, index = paint.baked(paint_textures(seed, kind.texture))
    solids, faces = furniture.arrays(index, kind.node)
    draw = randomness(seed, "light")
    room, width = solids.center[0], solids.half[0, 0]
    far = np.sign(room[0] or 1.0)  # the side wall away from the corner has the window
    warm, cool = np.array([1.0, 0.86, 0.68]), np.array([0.78, 0.9, 1.0])
    lamps = np.array([
        [draw.uniform(-0.8, 0.8), 2.66, room[2] - 1.0, 0.5, 0, 0, 0, 0, 0.4, 0, -1, 0, *(9 * warm)],
        [room[0] + far * (width - 0.02), 1.55, 2.2, 0, 0, 0.9, 0, 0.6, 0, -far, 0, 0, *(8 * cool)],
    ])  # fmt: skip
    nodes = raycast.light_nodes(solids, faces)
    direct = raycast.direct_light(solids, *nodes, lamps, 8)
    light = direct
    for rays in (32, 96):
        light = direct + raycast.bounced_light(solids, faces, pictures, *nodes, light, 0.03, rays)
    return World(solids, faces, pictures, light, 1.0)


def path(seed: int, kind: Kind, target: np.ndarray, count: int, label: str) -> np.ndarray:
    """Cameras [count, 16] of a walk around the target with an unsteady hand; `label` names the walk."""
    draw = randomness(seed, f"path {label}")
    s = (np.arange(count) + 0.5) / max(count, 1)
    reach = 1.0 if label == "train" else 0.88
    phase = draw.random(4) * 6.28
    around = kind.spread >= 180
    if around:
        azimuth = 360 * (2 * s + draw.random())
        height = 1.15 + 0.12 * np.sin(6.28 * 3 * s + phase[1]) + np.where(s < 0.5, 0.2, -0.1)
        radius = 2.25 + 0.1 * np.sin(6.28 * 5 * s + phase[2])
    else:
        # Few views walk one arc and back; many go to and fro, so that heights and sides mix.
        azimuth = reach * kind.spread * np.sin(6.28 * 2.5 * s + phase[0])
        height = 1.22 + 0.2 * np.sin(6.28 * 1.5 * s + phase[1])
        radius = 2.45 + 0.08 * np.sin(6.28 * 4 * s + phase[2])
    angle = np.radians(azimuth + draw.normal(0, 0.6, count))
    center = target + np.stack([radius * np.sin(angle), height - target[1], radius * np.cos(angle)], 1)
    center += draw.normal(0, 0.015, (count, 3))
    aim = target + draw.normal(0, 0.04, (count, 3))
    roll = np.radians(draw.normal(0, 1.2, count))
    focal = kind.width * (0.82 if around else 0.85)
    bend = kind.bend * randomness(seed, "lens").uniform(0.7, 1.0)
    cameras = np.empty((count, 16))
    for k in range(count):
        forward = (aim[k] - center[k]) / np.linalg.norm(aim[k] - center[k])
        right = np.cross(forward, (0, 1, 0))
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        c, s_ = np.cos(roll[k]), np.sin(roll[k])
        turn = np.stack([c * right + s_ * down, c * down - s_ * right, forward], 1)
        cameras[k] = focal, kind.width / 2, kind.height / 2, bend, *turn.ravel(), *center[k]
    return cameras


def develop(color: np.ndarray, exposure: float) -> np.ndarray:
    """Linear radiance -> sRGB bytes, with a shoulder instead of clipped highlights."""
    tone = 1 - np.exp(-exposure * color)
    return np.round(255 * tone ** (1 / 2.2)).astype(np.uint8)


def shoot(world: World, camera: np.ndarray, kind: Kind, with_object: bool) -> tuple[np.ndarray, np.ndarray]:
    """(photograph uint8 [H, W, 3], pixels that the object touches, in it or not: bool [H, W])."""
    w, size = world, (kind.width, kind.height)
    color, mask = raycast.render(w.solids, w.faces, w.textures, w.light, camera, *size, with_object, kind.samples)
    return develop(color, world.exposure), mask


def exposed(world: World, camera: np.ndarray, kind: Kind) -> World:
    """The world with the exposure that puts this view's mean, object left out, at a comfortable grey."""
    size = (kind.width, kind.height)
    color, _ = raycast.render(world.solids, world.faces, world.textures, world.light, camera, *size, False, 1)
    low, high = 0.01, 1000.0
    for _ in range(40):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if develop(color, middle).mean() < 128 else (low, middle)
    return replace(world, exposure=float(middle))


def pixel_centers(mask: np.ndarray) -> np.ndarray:
    """[P, 2] image points of a mask's pixels."""
    return np.argwhere(mask)[:, ::-1] + 0.5


def never_seen(world: World, camera, mask, train_cameras, train_masks) -> np.ndarray:
    """Bool [H, W]: pixels of the mask whose background no training view shows outside its own mask."""
    points, _ = raycast.surface_points(world.solids, camera, pixel_centers(mask), False)
    result = np.zeros(mask.shape, bool)
    result[mask] = raycast.never_seen(world.solids, train_cameras, train_masks, points)
    return result


@dataclass(frozen=True)
class Frame:
    """x_scene = scale * rotation @ x_room + offset: the arbitrary frame of an SfM model."""

    scale: float
    rotation: np.ndarray
    offset: np.ndarray

    def points(self, points: np.ndarray) -> np.ndarray:
        return self.scale * points @ self.rotation.T + self.offset

    def world_to_camera(self, camera: np.ndarray) -> np.ndarray:
        """[4, 4] of a camera row."""
        turn = self.rotation @ camera[4:13].reshape(3, 3)
        result = np.eye(4)
        result[:3, :3] = turn.T
        result[:3, 3] = -turn.T @ self.points(camera[13:])
        return result


def scene_frame(seed: int) -> Frame:
    draw = randomness(seed, "frame")
    rotation, _ = np.linalg.qr(draw.normal(size=(3, 3)))
    return Frame(draw.uniform(0.7, 3.0), rotation * np.sign(np.linalg.det(rotation)), draw.normal(0, 2, 3))


@dataclass(frozen=True)
class SparsePoints:
    """COLMAP's points: room positions [P, 3], colours [P, 3], image points [P, V, 2] at full resolution or NaN."""

    positions: np.ndarray
    colors: np.ndarray
    tracks: np.ndarray


def sparse_points(seed: int, kind: Kind, world: World, cameras: np.ndarray, photos: np.ndarray) -> SparsePoints:
    """Surface points where the training views have texture, seen by at least 3 of them, with SfM's inaccuracy."""
    draw = randomness(seed, "points")
    per_view = -(-kind.points * 3 // (2 * len(cameras)))
    positions, colors = [], []
    for camera, photo in zip(cameras, photos, strict=True):
        grey = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY).astype(np.float32)
        edges = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)).ravel() + 4
        chosen = draw.choice(edges.size, per_view, replace=False, p=edges / edges.sum())
        row, column = np.divmod(chosen, kind.width)
        pixels = np.stack([column, row], 1) + 0.5
        positions.append(raycast.surface_points(world.solids, camera, pixels, True)[0])
        colors.append(photo[row, column])
    positions, colors = np.concatenate(positions), np.concatenate(colors)
    tracks = raycast.observations(world.solids, cameras, kind.width, kind.height, positions) * FULL
    # A feature is matched in some of the views that show it only.
    tracks[draw.random(tracks.shape[:2]) > max(0.2, 4 / len(cameras))] = np.nan
    good = np.flatnonzero(np.isfinite(tracks[..., 0]).sum(1) >= 3)
    good = np.sort(draw.permutation(good)[: kind.points])
    tracks = tracks[good] + draw.normal(0, 0.4, (len(good), len(cameras), 2))
    return SparsePoints(positions[good] + draw.normal(0, 0.0015, (len(good), 3)), colors[good], tracks)


def write_model(folder: Path, kind: Kind, names: list[str], cameras: np.ndarray, frame: Frame, points: SparsePoints):
    """COLMAP's cameras.bin, images.bin, points3D.bin. Training views come last and alone have image points."""
    folder.mkdir(parents=True, exist_ok=True)
    f, cx, cy = FULL * cameras[0, :3]
    with open(folder / "cameras.bin", "wb") as file:  # one camera, model 2: SIMPLE_RADIAL
        file.write(struct.pack("<QiiQQ4d", 1, 1, 2, FULL * kind.width, FULL * kind.height, f, cx, cy, cameras[0, 3]))
    first = len(names) - points.tracks.shape[1]
    seen = [np.flatnonzero(np.isfinite(points.tracks[:, v, 0])) for v in range(points.tracks.shape[1])]
    with open(folder / "images.bin", "wb") as file:
        file.write(struct.pack("<Q", len(names)))
        for k, name in enumerate(names):
            pose = frame.world_to_camera(cameras[k])
            file.write(struct.pack("<i7di", k + 1, *quaternion(pose[:3, :3]), *pose[:3, 3], 1))
            file.write(name.encode() + b".jpg\0")
            ids = seen[k - first] if k >= first else []
            file.write(struct.pack("<Q", len(ids)))
            for p in ids:
                file.write(struct.pack("<ddq", *points.tracks[p, k - first], p + 1))
    order = [{p: n for n, p in enumerate(ids)} for ids in seen]
    positions = frame.points(points.positions)
    with open(folder / "points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", len(positions)))
        for p, (position, color) in enumerate(zip(positions, points.colors, strict=True)):
            views = np.flatnonzero(np.isfinite(points.tracks[p, :, 0]))
            file.write(struct.pack("<Q3d3BdQ", p + 1, *position, *color, 0.5, len(views)))
            for v in views:
                file.write(struct.pack("<ii", first + v + 1, order[v][p]))


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """wxyz of a rotation matrix, w >= 0: the eigenvector of Bar-Itzhack's symmetric matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    _, vectors = np.linalg.eigh(np.array([
        [a - e - i, d + b, g + c, h - f],
        [d + b, e - a - i, h + f, c - g],
        [g + c, h + f, i - a - e, d - b],
        [h - f, c - g, d - b, a + e + i],
    ]))  # fmt: skip
    x, y, z, w = vectors[:, -1]
    return np.array([w, x, y, z]) * (1 if w >= 0 else -1)


def write_poses_bounds(path: Path, kind: Kind, cameras: np.ndarray, frame: Frame, points: SparsePoints) -> None:
    """LLFF's [V, 17]: columns down, right, backwards, centre, (height, width, focal) row by row; near and far."""
    rows = []
    positions = frame.points(points.positions)
    for camera in cameras:
        pose = frame.world_to_camera(camera)
        right, down, forward = pose[:3, :3]
        center = -pose[:3, :3].T @ pose[:3, 3]
        intrinsics = FULL * np.array([kind.height, kind.width, camera[0]])
        depth = positions @ forward + pose[2, 3]
        bounds = np.percentile(depth[depth > 0], (0.1, 99.9))
        rows.append([*np.stack([down, right, -forward, center, intrinsics], 1).ravel(), *bounds])
    np.save(path, np.array(rows))


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image, [cv2.IMWRITE_PNG_COMPRESSION, 4])


def write_truth_cameras(path: Path, kind: Kind, names: list[str], cameras: np.ndarray, frame: Frame) -> None:
    """SIMPLE_RADIAL intrinsics at the size of the written images and each view's pose in the scene frame."""
    f, cx, cy, k1 = cameras[0, :4].tolist()
    views = {name: frame.world_to_camera(c).tolist() for name, c in zip(names, cameras, strict=True)}
    record = {"width": kind.width, "height": kind.height, "f": f, "cx": cx, "cy": cy, "k1": k1}
    record["world_to_camera"] = views
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=1))


def generate(out: Path, seed: int, kind: Kind) -> dict:
    """Write the scene to `out`, all of it or nothing, and return its facts.

    Raises:
        ValueError: where `out` holds something that this script did not write; where less than 40% of the masks
            hides background that no training view saw.
    """
    if out.exists() and any(out.iterdir()) and not (out / "truth/facts.json").exists():
        raise ValueError(f"{out} holds files that data/generate.py did not write; name another folder, or empty it")
    partial = out.with_name(out.name + ".writing")
    shutil.rmtree(partial, ignore_errors=True)
    facts = _write_scene(partial, seed, kind)
    shutil.rmtree(out, ignore_errors=True)
    partial.rename(out)
    return facts


def _write_scene(out: Path, seed: int, kind: Kind) -> dict:
    furniture, target = furnish(seed, kind)
    world = bake(furniture, seed, kind)
    train, test = (path(seed, kind, target, n, label) for n, label in ((kind.train, "train"), (kind.test, "test")))
    cameras = np.concatenate([test, train])
    names = [f"IMG_{k + 2000:04d}" for k in range(len(cameras))]
    # The reference view looks from the middle of the walk.
    middle = kind.test + int(np.argmin(np.linalg.norm(train[:, 13:] - train[:, 13:].mean(0), axis=1)))
    world = exposed(world, cameras[middle], kind)
    shots = [shoot(world, camera, kind, k >= kind.test) for k, camera in enumerate(cameras)]
    photos, masks = (np.stack(pictures) for pictures in zip(*shots, strict=True))
    in_training = train, masks[kind.test :]
    hidden = [never_seen(world, camera, mask, *in_training) for camera, mask in zip(cameras, masks, strict=True)]
    shares = [float(h.sum() / m.sum()) for h, m in zip(hidden, masks, strict=True)]
    facts = {
        "seed": seed,
        "reference": names[middle],
        "mask_share": _by_split(masks.mean((1, 2)), kind.test),
        "never_seen_share": _by_split(shares, kind.test),
        "lens_shift_px": float(corner_shift(cameras[0])),
    }
    if min(s for s in facts["never_seen_share"].values() if s is not None) < LEAST_NEVER_SEEN:
        raise ValueError(f"seed {seed}: only {facts['never_seen_share']} of the masks was never seen; 0.4 is the least")

    frame, truth = scene_frame(seed), out / "truth"
    write_truth_cameras(truth / "cameras.json", kind, names, cameras, frame)
    (truth / "facts.json").write_text(json.dumps(facts, indent=1))
    if kind.photos:
        for name, photo, mask in zip(names, photos, masks, strict=True):
            write_image(out / f"images/{name}.png", photo)
            write_image(out / f"masks/{name}.png", mask * np.uint8(255))
        return facts
    for k, name in enumerate(names):
        write_image(out / f"images_4/{name}.png", photos[k])
        write_image(truth / f"never_seen/{name}.png", hidden[k] * np.uint8(255))
        if k < kind.test:
            write_image(out / f"images_4/test_label/out_{k:05d}.png", masks[k] * np.uint8(255))
            write_image(truth / f"masks_test/{name}.png", masks[k] * np.uint8(255))
        else:
            write_image(out / f"images_4/label/{name}.png", masks[k] * np.uint8(1))
    write_image(out / "reference.png", shoot(world, cameras[middle], kind, False)[0])
    (out / "scene.yaml").write_text(f"reference: {{view: {names[middle]}, image: reference.png}}\n")
    points = sparse_points(seed, kind, world, train, photos[kind.test :])
    write_model(out / "sparse/0", kind, names, cameras, frame, points)
    write_poses_bounds(out / "poses_bounds.npy", kind, cameras, frame, points)
    return facts


def _by_split(values, test: int) -> dict[str, float | None]:
    return {"train": float(np.mean(values[test:])), "test": float(np.mean(values[:test])) if test else None}


def corner_shift(camera: np.ndarray) -> float:
    """Pixels by which the lens moves the image's corners."""
    radius = np.hypot(camera[1], camera[2]) / camera[0]
    undone = radius
    for _ in range(8):
        undone -= (undone + camera[3] * undone**3 - radius) / (1 + 3 * camera[3] * undone**2)
    return camera[0] * (radius - undone)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--seed", type=int, default=None, help="default 0; 7 for photos")
    parser.add_argument("--kind", choices=KINDS, default="demo")
    given = parser.parse_args()
    seed = given.seed if given.seed is not None else (7 if given.kind == "photos" else 0)
    facts = generate(given.out, seed, KINDS[given.kind])
    print(f"{given.out}: " + json.dumps(facts))


if __name__ == "__main__":
    main()
