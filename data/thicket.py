"""Grass and foliage: a box divided into cells with a leaf each. A ray walks from cell to cell.

No leaf is stored: its shape follows from the number of its cell, so a lawn of a hundred thousand blades costs only its
box and a few steps per ray. A leaf never sticks out of its cell, so the first one that a ray hits is the nearest.
Coordinates are those of the box: its centre is the origin, its edges lie along the axes.
"""

from __future__ import annotations

import math

import numpy as np
from compiled import kernel

BARE = 0.12  # share of the cells that hold no leaf
SKY = (0.36, 0.8, 0.48)  # unit direction of most of the light
SHADE = 0.3  # share of the light on a leaf that is edge-on to it


@kernel(inline="always")
def _mix_bits(state):
    """The next of a sequence of pseudo-random 32-bit numbers (xorshift and multiplication)."""
    state = ((state >> 16) ^ state) * 0x45D9F3B & 0xFFFFFFFF
    state = ((state >> 15) ^ state) * 0x2C1B3C6D & 0xFFFFFFFF
    return (state >> 16) ^ state


@kernel()
def _leaf(solids, n, i, j, k, leaf):
    """Write cell (i, j, k)'s leaf of solid n to `leaf` [4, 3]: its centre, and the three axes of its ellipsoid, wide,
    long and thin, each of the length 1 / half extent. False for a bare cell."""
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
    # A leaf that would stick out of its cell shrinks; its place in the cell is random.
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
    for side in range(3):
        for axis in range(3):
            leaf[1 + side, axis] /= smaller * solids.leaves[n, 3 + side]
    return True


@kernel()
def _extent(solids, n, leaf, axis):
    """Half the width of the unshrunk leaf along an axis; leaf[1:] are still of unit length."""
    total = 0.0
    for side in range(3):
        total += (leaf[1 + side, axis] * solids.leaves[n, 3 + side]) ** 2
    return math.sqrt(total)


@kernel()
def _in_leaf(leaf, ox, oy, oz, dx, dy, dz):
    """(near, far) along the ray of its stretch in the leaf; near > far where there is none."""
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
    """(the cell that x lies in, its width); the outermost ones hold what lies outside."""
    cells = int(solids.leaves[n, axis])
    wide = 2.0 * solids.half[n, axis] / cells
    return min(max(math.floor((x + solids.half[n, axis]) / wide), 0), cells - 1), wide


@kernel(inline="always")
def _crossings(solids, n, axis, cell, wide, o, d):
    """(step, distance to the next wall, distance between walls) of a ray along one axis."""
    if abs(d) < 1e-12:
        return 0, 1e30, 1e30
    step = 1 if d > 0.0 else -1
    wall = (cell + (step + 1) // 2) * wide - solids.half[n, axis]
    return step, (wall - o) / d, wide / abs(d)


@kernel()
def first_leaf(solids, n, ox, oy, oz, dx, dy, dz, near, far, min_distance):
    """Distance along the ray to the first leaf of solid n that is more than `min_distance` away, 1e30 if it meets
    none; the ray is within the box from `near` to `far`."""
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
    """Share of the light on a leaf with this normal; light shines through leaves, so the side does not matter."""
    return SHADE + (1.0 - SHADE) * abs(nx * SKY[0] + ny * SKY[1] + nz * SKY[2])


@kernel()
def leaf_normal(solids, n, x, y, z):
    """Unit outward normal (3) of the leaf on which a point lies."""
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
