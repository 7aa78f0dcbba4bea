"""Places where the removal of an object is harder than before a wall: a table's edge, a wall's corner, a garden.

`table_room`, `wall_corner` and `garden` add a room, everything in it and the removable object to an empty `Furniture`,
and return the point [3] that the cameras look at, in metres. Their other arguments are a random generator and the
material of the floor. Room frame: x right, y up, z towards the cameras; the back wall is z = 0.
"""

from __future__ import annotations

import numpy as np

from lab.scenes.furniture import WHITE, WOOD, Furniture, Material, cabinet, chest, hedge, lawn, plant, shelf, table

WALL = Material("wall", 1.8)
PLAIN = Material("side", 2.6)
RUG = Material("rug")


def shell(f: Furniture, draw, planks: Material, side: int, corner: float) -> None:
    """Add a room with skirting boards and nothing else.

    Args:
        f: furniture to add to; it must be empty.
        draw: random generator.
        planks: material of the floor.
        side: 1 if the near side wall is on the right, -1 if on the left.
        corner: distance of the near side wall from x = 0, metres; that of the other side wall is 4 m.
    """
    left, right = (-corner, 4.0) if side < 0 else (-4.0, corner)
    middle = (left + right) / 2
    f.room((middle, 1.35, 3.2), ((right - left) / 2, 1.35, 3.2), PLAIN, PLAIN, WHITE, planks, PLAIN, WALL)
    skirt = WHITE if draw.random() < 0.6 else WOOD
    f.box(middle, 0, 0.008, (right - left, 0.1, 0.016), skirt)
    f.box(side * (corner - 0.008), 0, 3.2, (0.016, 0.1, 6.4), skirt)


def table_room(f: Furniture, draw, planks: Material) -> np.ndarray:
    """Furnish a room in which the object stands on a table and projects a little over the table's edge.

    Things under and behind the table make visible that the space there is free.
    """
    side, high, deep = draw.choice((-1, 1)), draw.uniform(0.64, 0.7), draw.uniform(0.8, 0.9)
    shell(f, draw, planks, side, 2.2)
    edge = 1.5  # z of the table's edge
    table(f, 0.0, edge - deep / 2, (1.7, high, deep))
    chest(f, draw, draw.uniform(-0.15, 0.15), high, edge + draw.uniform(0.03, 0.06))
    f.cylinder(side * 0.68, high, edge - deep * draw.uniform(0.45, 0.65), 0.075, 0.26, Material("vase"))
    f.box(-side * 0.66, high, edge - deep * 0.5, (0.2, 0.16, 0.16), Material("books2"), yaw=draw.uniform(-20, 20))
    f.box(draw.uniform(-0.1, 0.1), 0, edge - deep / 2, (2.2, 0.008, 1.4), RUG, yaw=draw.uniform(-5, 5))
    f.box(side * draw.uniform(0.3, 0.45), 0.008, edge - deep * 0.6, (0.26, 0.2, 0.2), Material("crate"),
          yaw=draw.uniform(10, 60))  # fmt: skip
    f.sphere(-side * draw.uniform(0.3, 0.5), 0.008, edge - deep * 0.5, 0.11, Material("globe"), 70.0)
    plant(f, draw, side * 1.75, 0.4, draw.uniform(1.4, 1.6))
    shelf(f, draw, -side * draw.uniform(0.9, 1.1), 0.2, draw.uniform(0.8, 1.0))
    f.box(side * draw.uniform(0.2, 0.5), draw.uniform(0.95, 1.05), 0.012, (0.8, 0.6, 0.024), WOOD, Material("picture"))
    f.box(-side * 1.3, draw.uniform(1.0, 1.1), 0.012, (0.4, 0.5, 0.024), WOOD, Material("picture2"))
    return np.array([0.0, 0.72, edge - 0.2])


def wall_corner(f: Furniture, draw, planks: Material) -> np.ndarray:
    """Furnish a room in which a projecting wall ends behind the object.

    To the left and to the right of the wall's edge the depth behind the object differs.
    """
    side, deep = draw.choice((-1, 1)), draw.uniform(0.45, 0.8)
    shell(f, draw, planks, side, 1.55)
    edge, skirt = side * draw.uniform(-0.12, 0.12), WOOD
    middle, wide = (edge - side * 4.0) / 2, 4.0 + side * edge
    f.box(middle, 0, deep / 2, (wide, 2.7, deep), WALL, draw.choice([WALL, PLAIN]))
    f.box(middle + side * 0.008, 0, deep / 2 + 0.008, (wide + 0.016, 0.1, deep + 0.016), skirt)
    cabinet(f, draw, 0.0, deep + draw.uniform(0.03, 0.08), draw.uniform(0.98, 1.12), draw.uniform(0.6, 0.7),
            draw.uniform(0.34, 0.4))  # fmt: skip
    plant(f, draw, side * 1.15, 0.36, draw.uniform(1.35, 1.6))
    shelf(f, draw, -side * draw.uniform(1.12, 1.24), deep + 0.2, draw.uniform(0.7, 0.8))
    f.box(-side * draw.uniform(0.95, 1.1), draw.uniform(0.95, 1.05), deep + 0.012, (0.52, 0.4, 0.024), WOOD,
          Material("picture"))  # fmt: skip
    f.box(side * draw.uniform(0.55, 0.75), draw.uniform(1.0, 1.15), 0.012, (0.4, 0.5, 0.024), WOOD,
          Material("picture2"))  # fmt: skip
    f.box(draw.uniform(-0.1, 0.1), 0, deep + 1.35, (1.5, 0.008, 1.1), RUG, yaw=draw.uniform(-6, 6))
    f.box(side * draw.uniform(0.9, 1.0), 0, deep + 0.45, (0.26, 0.2, 0.2), Material("crate"), yaw=draw.uniform(10, 60))
    return np.array([0.0, 0.5, deep + 0.1])


def garden(f: Furniture, draw, planks: Material) -> np.ndarray:
    """Furnish a garden in which the object stands on a lawn before a hedge; `planks` is not used."""
    side, front = draw.choice((-1, 1)), 0.8  # z of the hedge's front
    soil = Material("foliage", 1.1, (0.3, 0.26, 0.2))
    f.room((0, 1.35, 3.2), (4.0, 1.35, 3.2), PLAIN, PLAIN, WHITE, soil, PLAIN, PLAIN)
    hedge(f, draw, front, 8.0, draw.uniform(1.7, 1.9))
    lawn(f, draw, 2.6, 8.0)
    cabinet(f, draw, 0.0, front + draw.uniform(0.06, 0.14), draw.uniform(0.95, 1.05), draw.uniform(0.58, 0.66),
            draw.uniform(0.38, 0.44))  # fmt: skip
    plant(f, draw, side * draw.uniform(1.05, 1.2), front + 0.5, draw.uniform(1.25, 1.4))
    f.sphere(-side * draw.uniform(0.85, 1.0), 0, front + draw.uniform(0.4, 0.6), 0.16, Material("globe"), 40.0)
    f.cylinder(-side * draw.uniform(1.3, 1.4), 0, front + 0.3, 0.16, 0.5, Material("vase"))
    f.box(side * draw.uniform(0.5, 0.7), 0, front + draw.uniform(0.9, 1.0), (0.26, 0.2, 0.2), Material("crate"),
          yaw=draw.uniform(10, 60))  # fmt: skip
    return np.array([0.0, 0.48, front + 0.1])
