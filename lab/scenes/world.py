"""A furnished room with procedural textures and baked light, the input of the ray caster."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lab.scenes import textures as paint
from lab.scenes.furniture import Furniture
from lab.scenes.greens import foliage
from lab.scenes.kinds import Kind, randomness
from lab.scenes.light import bounced_light, direct_light, light_nodes
from lab.scenes.mipmaps import Textures, build_mipmaps
from lab.scenes.solids import Faces, Solids


@dataclass(frozen=True)
class World:
    """Room with materials and light, ready to be rendered.

    Attributes:
        solids: the n solids.
        faces: the faces of the solids, with their materials.
        textures: all textures with their mip levels.
        light: [M, 3] baked irradiance / pi at the nodes of the light map.
        exposure: factor on the radiance in photographs.
        objects: name -> bool [n], True for the solids of this object; only objects that have masks of their own.
    """

    solids: Solids
    faces: Faces
    textures: Textures
    light: np.ndarray
    exposure: float
    objects: dict[str, np.ndarray]


def paint_textures(seed: int, size: int) -> dict[str, np.ndarray]:
    """Return all textures of a scene, {name: [N, N, 3] floats, sRGB from 0 to about 1}, in styles drawn from the seed.

    Textures of floor, walls and rug have N = `size`; all other textures have half of `size`, at least 128. `size` is a
    power of two.
    """
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
        "pot": (paint.glaze, small, {"color": (170, 92, 60), "bands": (222, 176, 138)}),
        "vase": (paint.glaze, small, {"color": (44, 78, 128)}),
        "crate": (paint.wood_planks, small, {"rows": 4, "pieces": 1, "palette": paint.WOODS[draw.integers(4)]}),
        "globe": (paint.ball, small, {"first": (64, 104, 92), "second": (224, 212, 180)}),
        "front": (paint.plain_paint_front, small, {"color": hues[first][0]}),
        "paint": (paint.plain_paint, small, {"color": hues[first][0]}),
        "ball": (paint.ball, small, {"first": hues[second][0], "second": hues[second][1]}),
        "quilt": (paint.quilt, small, {"first": hues[first][0], "second": hues[second][1]}),
        "jar": (paint.glaze, small, {"color": hues[first][1], "bands": hues[second][0]}),
        "white": (paint.plaster, small, {"color": (236, 234, 228)}),
        "foliage": (foliage, small, {}),
    }
    return {name: maker(randomness(seed, name), n, **how) for name, (maker, n, how) in made.items()}


def bake(furniture: Furniture, seed: int, kind: Kind) -> World:
    """Return the room with the given furniture, with textures and baked light, ready to be rendered.

    The light comes from a ceiling lamp and a window, and includes two bounces between surfaces. The exposure is 1. The
    furniture is not changed.
    """
    pictures, index = build_mipmaps(paint_textures(seed, kind.texture))
    solids, faces = furniture.arrays(index, kind.node)
    draw = randomness(seed, "light")
    room, width = solids.center[0], solids.half[0, 0]
    far = np.sign(room[0] or 1.0)  # the side wall away from the corner has the window
    warm, cool = np.array([1.0, 0.86, 0.68]), np.array([0.78, 0.9, 1.0])
    lamps = np.array([
        [draw.uniform(-0.8, 0.8), 2.66, room[2] - 1.0, 0.5, 0, 0, 0, 0, 0.4, 0, -1, 0, *(9 * warm)],
        [room[0] + far * (width - 0.02), 1.55, 2.2, 0, 0, 0.9, 0, 0.6, 0, -far, 0, 0, *(8 * cool)],
    ])  # fmt: skip
    nodes = light_nodes(solids, faces)
    direct = direct_light(solids, *nodes, lamps, 8)
    light = direct
    for rays in (32, 96):
        light = direct + bounced_light(solids, faces, pictures, *nodes, light, 0.03, rays)
    return World(solids, faces, pictures, light, 1.0, furniture.objects)
