"""Grass and foliage: a box divided into cells, with one leaf in most cells. A ray is traced from cell to cell.

No leaf is stored: the number of a cell determines the shape of its leaf. So a lawn of a hundred thousand blades costs
as much as its box and a few steps per ray. A leaf is always inside its cell, so the first leaf that a ray hits is the
nearest one. Coordinates are those of the box: the origin is its center, the axes are parallel to its edges.
"""

from __future__ import annotations

import math

import numpy as np

from lab.scenes.compiled import kernel

BARE = 0.12  # share of the cells that have no leaf
SKY = (0.36, 0.8, 0.48)  # unit direction from which most of the light comes
SHADE = 0.3  # share of the light that a leaf parallel to this direction still receives


@kernel(inline="always")
def _mix_bits(state):
    """Return the pseudo-random 32-bit number that follows `state` (xorshift and multiplication)."""
    state = ((state >> 16) ^ state) * 0x45D9F3B & 0xFFFFFFFF
    state = ((state >> 15) ^ state) * 0x2C1B3C6D & 0xFFFFFFFF
    return (state >> 16) ^ state


@kernel()
def _leaf(solids, n, i, j, k, leaf):
    """Write the leaf in cell (i, j, k) of solid n to `leaf` [4, 3], center and axes; return False if there is none."""
    columns, layers = int(solids.leaves[n, 0]), int(solids.leaves[n, 1])
    state = _mix_bits(((k * layers + j) * columns + i + 1) * 7919 + int(solids.leaves[n, 7]))
    if state < BARE * 4294967296.0:
        return False
    state = _mix_bits(state + 1)
    turn = 2.0 * math.pi * state / 4294967296.0
    state = _mix_bits(state + 2)
    lean = solids.leaves[n, 6] * (2.0 * state / 4294967296.0 - 1.0)
    c, s, up, down = math.cos(turn), math.sin(turn), math.cos(lean), math.sin(lean)
    leaf[1, 0], leaf[1, 1], leaf[1, 2] = c, 0.0, -s
    leaf[2, 0], leaf[2, 1], leaf[2, 2] = down * s, up, down * c
    leaf[3, 0], leaf[3, 1], leaf[3, 2] = up * s, -down, up * c
    # A leaf that would extend beyond its cell is shrunk to fit. Its position within the cell is random.
    smaller = 1.0
    for axis in range(3):
        half = solids.half[n, axis] / solids.leaves[n, axis]
        leaf[0, axis] = _extent(solids, n, leaf, axis)
        smaller = min(smaller, half / leaf[0, axis])
    for axis, cell in enumerate((i, j, k)):
        half = solids.half[n, axis] / solids.leaves[n, axis]
        state = _mix_bits(state + 3)
        room = half - smaller * leaf[0, axis]
        leaf[0, axis] = (2 * cell + 1) * half - solids.half[n, axis] + room * (2.0 * state / 4294967296.0 - 1.0)
    # The axes along the ellipsoid's width, length and thickness get the length 1 / half extent.
    for side in range(3):
        for axis in range(3):
            leaf[1 + side, axis] /= smaller * solids.leaves[n, 3 + side]
    return True


@kernel()
def _extent(solids, n, leaf, axis):
    """Return half a leaf's extent along a box axis, before it is shrunk to its cell; leaf[1:] must have unit length."""
    total = 0.0
    for side in range(3):
        total += (leaf[1 + side, axis] * solids.leaves[n, 3 + side]) ** 2
    return math.sqrt(total)


@kernel()
def _in_leaf(leaf, ox, oy, oz, dx, dy, dz):
    """Return the interval (near, far) of the ray parameter inside a leaf; near > far if the ray misses the leaf."""
    a, b, c = 0.0, 0.0, -1.0
    for side in range(1, 4):
        p = (ox - leaf[0, 0]) * leaf[side, 0] + (oy - leaf[0, 1]) * leaf[side, 1] + (oz - leaf[0, 2]) * leaf[side, 2]
        q = dx * leaf[side, 0] + dy * leaf[side, 1] + dz * leaf[side, 2]
        a, b, c = a + q * q, b + p * q, c + p * p
    root = b * b - a * c
    if root <= 0.0:
        return 1e30, -1e30
    root = math.sqrt(root)
    return (-b - root) / a, (-b + root) / a


@kernel(inline="always")
def _cell(solids, n, axis, x):
    """Return (index of the cell that contains x along an axis, width of the cells); clamped to the outermost cells."""
    cells = int(solids.leaves[n, axis])
    wide = 2.0 * solids.half[n, axis] / cells
    return min(max(math.floor((x + solids.half[n, axis]) / wide), 0), cells - 1), wide


@kernel(inline="always")
def _crossings(solids, n, axis, cell, wide, o, d):
    """Return the cell step (1, -1, 0), the ray parameter at the next wall and its increase per wall (1e30 if none)."""
    # `o` and `d` are the coordinates of the ray's origin and direction along the axis.
    if abs(d) < 1e-12:
        return 0, 1e30, 1e30
    step = 1 if d > 0.0 else -1
    wall = (cell + (step + 1) // 2) * wide - solids.half[n, axis]
    return step, (wall - o) / d, wide / abs(d)


@kernel()
def first_leaf(solids, n, ox, oy, oz, dx, dy, dz, near, far, min_distance):
    """Return the distance along a ray to the first leaf of solid n, or 1e30 if the ray hits no leaf.

    The ray's origin o and unit direction d are in the coordinates of the box.

    Args:
        near: distance at which the ray enters the box.
        far: distance at which the ray leaves the box.
        min_distance: surfaces nearer than this are ignored.
    """
    near = max(near, 0.0)
    i, wide_x = _cell(solids, n, 0, ox + near * dx)
    j, wide_y = _cell(solids, n, 1, oy + near * dy)
    k, wide_z = _cell(solids, n, 2, oz + near * dz)
    step_x, to_x, every_x = _crossings(solids, n, 0, i, wide_x, ox, dx)
    step_y, to_y, every_y = _crossings(solids, n, 1, j, wide_y, oy, dy)
    step_z, to_z, every_z = _crossings(solids, n, 2, k, wide_z, oz, dz)
    leaf = np.empty((4, 3))
    while True:
        if _leaf(solids, n, i, j, k, leaf):
            enters, leaves = _in_leaf(leaf, ox, oy, oz, dx, dy, dz)
            if enters <= leaves and leaves > min_distance:
                return enters if enters > min_distance else leaves
        wall_distance = min(to_x, to_y, to_z)
        if wall_distance >= far:
            return 1e30
        if wall_distance == to_x:
            i, to_x = i + step_x, to_x + every_x
        elif wall_distance == to_y:
            j, to_y = j + step_y, to_y + every_y
        else:
            k, to_z = k + step_z, to_z + every_z
        if min(i, j, k) < 0 or i >= solids.leaves[n, 0] or j >= solids.leaves[n, 1] or k >= solids.leaves[n, 2]:
            return 1e30


@kernel(inline="always")
def leaf_light(nx, ny, nz):
    """Return the share of the light that a leaf with the given normal receives, in [`SHADE`, 1].

    The normal is a unit vector in the room frame. The sign of the normal has no effect, because light shines through
    leaves.
    """
    return SHADE + (1.0 - SHADE) * abs(nx * SKY[0] + ny * SKY[1] + nz * SKY[2])


@kernel()
def leaf_normal(solids, n, x, y, z):
    """Return the unit outward normal of the leaf on whose surface the point (x, y, z) lies, in the box's coordinates.

    If there is no leaf in the point's cell, the result is (0, 1, 0).
    """
    i, _ = _cell(solids, n, 0, x)
    j, _ = _cell(solids, n, 1, y)
    k, _ = _cell(solids, n, 2, z)
    leaf, normal = np.empty((4, 3)), np.zeros(3)
    if not _leaf(solids, n, i, j, k, leaf):
        return 0.0, 1.0, 0.0
    for side in range(1, 4):
        along = (x - leaf[0, 0]) * leaf[side, 0] + (y - leaf[0, 1]) * leaf[side, 1] + (z - leaf[0, 2]) * leaf[side, 2]
        for axis in range(3):
            normal[axis] += along * leaf[side, axis]
    length = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2) + 1e-12
    return normal[0] / length, normal[1] / length, normal[2] / length
