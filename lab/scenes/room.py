"""Furnishing of the room: a corner of a room with the object, or a whole room around a daybed.

`places.py` has the places in which the removal of the object is harder.
"""

from __future__ import annotations

import numpy as np

from lab.scenes.furniture import (
    WHITE,
    WOOD,
    Furniture,
    Material,
    box_among_things,
    cabinet,
    chest,
    chest_with_neighbors,
    daybed,
    keepsake,
    lantern,
    pair,
    plant,
    shelf,
)
from lab.scenes.kinds import Kind, randomness
from lab.scenes.places import PLAIN, RUG, WALL, garden, shell, table_room, wall_corner


def furnish(seed: int, kind: Kind) -> tuple[Furniture, np.ndarray]:
    """Furnish the room of a scene; return the furniture and the point [3] that the cameras look at, metres."""
    f, draw = Furniture(), randomness(seed, "layout")
    planks = Material("floor", 3.0, turned=bool(draw.integers(2)))
    if kind.is_circle:
        objects = {"beside": chest_with_neighbors, "around": box_among_things}
        return f, _round_room(f, draw, planks, objects.get(kind.place, daybed))
    others = {"table": table_room, "corner": wall_corner, "grass": garden}
    if kind.place in others:
        return f, others[kind.place](f, draw, planks)
    side = draw.choice((-1, 1))  # the side of the near side wall, which makes a corner with the back wall
    # The distance of this wall is so large that no camera is behind it.
    corner = 1.45 + max(0.0, 2.6 * np.sin(np.radians(kind.spread)) - 0.97)
    shell(f, draw, planks, side, corner)
    if kind.place == "floor":
        chest(f, draw, draw.uniform(-0.1, 0.1), 0.0, draw.uniform(0.85, 0.95))
    elif kind.hangs:
        lantern(f, draw, 0.0, 1.15)
    elif kind.shown:
        keepsake(f, draw, draw.uniform(-0.3, 0.3), draw.uniform(0.4, 0.5))
    elif kind.place == "pair":
        pair(f, draw, side, draw.uniform(0.03, 0.06))
    else:
        _cabinet(f, draw, flat=kind.spread > 30)
    plant(f, draw, side * (corner - 0.42), 0.36, draw.uniform(1.35, 1.6))
    shelf(f, draw, -side * draw.uniform(1.08, 1.2), 0.2, draw.uniform(0.7, 0.8))
    _pictures_and_clutter(f, draw, side)
    if kind.place == "behind":
        keepsake(f, draw, draw.uniform(-0.15, 0.15), draw.uniform(0.58, 0.62))
    return f, np.array([0.0, 0.5, 0.1])


def _cabinet(f: Furniture, draw, flat: bool) -> None:
    cabinet(f, draw, 0.0, 0.026 if flat else draw.uniform(0.06, 0.14), draw.uniform(0.98, 1.12), draw.uniform(0.6, 0.7),
            draw.uniform(0.19, 0.22) if flat else draw.uniform(0.4, 0.46))  # fmt: skip


def _pictures_and_clutter(f: Furniture, draw, side: int) -> None:
    x, y = -side * draw.uniform(0.95, 1.1), draw.uniform(0.95, 1.05)
    f.box(x, y, 0.012, (0.52, 0.4, 0.024), WOOD, Material("picture"))
    x, y = side * draw.uniform(0.5, 0.75), draw.uniform(1.1, 1.2)
    f.box(x, y, 0.012, (0.4, 0.5, 0.024), WOOD, Material("picture2"))
    f.box(draw.uniform(-0.15, 0.15), 0, draw.uniform(1.3, 1.4), (1.5, 0.008, 1.1), RUG, yaw=draw.uniform(-6, 6))
    f.cylinder(-side * draw.uniform(0.85, 0.95), 0, draw.uniform(0.75, 0.85), 0.15, 0.24, Material("wicker", 0.5),
               Material("wicker", 0.5, (0.25, 0.2, 0.15)))  # fmt: skip
    f.box(side * draw.uniform(0.82, 0.92), 0, draw.uniform(0.72, 0.85), (0.26, 0.2, 0.2), Material("crate"),
          yaw=draw.uniform(10, 60))  # fmt: skip


def _round_room(f: Furniture, draw, planks: Material, add_object) -> np.ndarray:
    f.room((0, 1.35, 3.2), (3.2, 1.35, 3.2), PLAIN, WALL, WHITE, planks, WALL, WALL)
    f.box(0.1, 0, 3.15, (2.3, 0.008, 1.6), RUG, yaw=draw.uniform(-30, 30))
    add_object(f, draw, 0.0, 3.2)
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
