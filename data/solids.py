"""Boxes, spheres, cylinders and foliage in an enclosed room: intersections with rays, and coordinates on faces.

Room frame: metres, x right, y up, z towards the cameras; the back wall is z = 0.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from compiled import kernel
from thicket import first_leaf, leaf_normal

ROOM, BOX, SPHERE, CYLINDER, THICKET = 0, 1, 2, 3, 4
EPSILON = 1e-4  # metres


class Solids(NamedTuple):
    """n solids; the first is the room, seen from inside. Their faces are numbered from first_face on.

    Faces of a box: +x, -x, +y, -y, +z, -z; of a sphere: one; of a cylinder (upright): side, top, bottom.
    A thicket is a box full of leaves (`thicket.py`), which all share one face: its top where the leaves make one layer
    (a lawn), else its +z side (a hedge).

    Attributes:
        kind: [n] ROOM, BOX, SPHERE, CYLINDER or THICKET.
        center: [n, 3]; half: [n, 3] half extents (radius, half height, - for round ones); turn: [n, 2] cos, sin of yaw.
        first_face: [n]; removable: [n] bool, True for the object.
        reach: [n] radius of the bounding sphere.
        leaves: [n, 8] of a thicket: its cells along x, y, z; half a leaf's width, length and thickness, metres; how far
            it leans at most, radians; a number that its leaves are drawn from. Otherwise 0. (One array: a second one
            makes every kernel half as slow again.)
    """

    kind: np.ndarray
    center: np.ndarray
    half: np.ndarray
    turn: np.ndarray
    first_face: np.ndarray
    removable: np.ndarray
    reach: np.ndarray
    leaves: np.ndarray


class Faces(NamedTuple):
    """f faces with metric coordinates (u, v), v downwards on upright ones.

    Attributes:
        texture: [f] index; mapping: [f, 4] tiles per metre along u and v, offsets.
        swap: [f] bool, u and v change place before the mapping.
        tint: [f, 3] factor on the linear texture; size: [f, 2] extent in metres.
        grid: [f, 3] first node, columns, rows of the light map.
    """

    texture: np.ndarray
    mapping: np.ndarray
    swap: np.ndarray
    tint: np.ndarray
    size: np.ndarray
    grid: np.ndarray


@kernel(inline="always")
def _slab(o, d, h):
    """(near, far) along a ray of the stretch in which |o + t d| <= h; near > far where there is none."""
    if abs(d) < 1e-12:
        return (1e30, -1e30) if abs(o) > h else (-1e30, 1e30)
    a, b = (-h - o) / d, (h - o) / d
    return min(a, b), max(a, b)


@kernel(inline="always")
def _in_box(ox, oy, oz, dx, dy, dz, hx, hy, hz):
    near, far = _slab(ox, dx, hx)
    for o, d, h in ((oy, dy, hy), (oz, dz, hz)):
        enters, leaves = _slab(o, d, h)
        near, far = max(near, enters), min(far, leaves)
    return near, far


@kernel(inline="always")
def _in_cylinder(ox, oy, oz, dx, dy, dz, radius, half):
    near, far = _slab(oy, dy, half)
    a = dx * dx + dz * dz
    if a <= 1e-12:
        return (1e30, -1e30) if ox * ox + oz * oz > radius**2 else (near, far)
    b = ox * dx + oz * dz
    root = b * b - a * (ox * ox + oz * oz - radius**2)
    if root <= 0.0:
        return 1e30, -1e30
    root = math.sqrt(root)
    return max(near, (-b - root) / a), min(far, (-b + root) / a)


@kernel(inline="always")
def distance(solids, i, ox, oy, oz, dx, dy, dz):
    """Distance along the ray to solid i, 1e30 if missed. From inside a solid: to its far side."""
    if solids.kind[i] == THICKET:  # a function of its own: in one function all solids would take twice the time
        return _to_thicket(solids, i, ox, oy, oz, dx, dy, dz)
    return _to_solid(solids, i, ox, oy, oz, dx, dy, dz)


@kernel()
def _to_thicket(solids, i, ox, oy, oz, dx, dy, dz):
    ax, oy, az = ox - solids.center[i, 0], oy - solids.center[i, 1], oz - solids.center[i, 2]
    c, s = solids.turn[i, 0], solids.turn[i, 1]
    ox, oz, dx, dz = c * ax - s * az, s * ax + c * az, c * dx - s * dz, s * dx + c * dz
    near, far = _in_box(ox, oy, oz, dx, dy, dz, solids.half[i, 0], solids.half[i, 1], solids.half[i, 2])
    if near > far or far < EPSILON:
        return 1e30
    return first_leaf(solids, i, ox, oy, oz, dx, dy, dz, near, far, EPSILON)


@kernel()
def _to_solid(solids, i, ox, oy, oz, dx, dy, dz):
    ax, ay, az = ox - solids.center[i, 0], oy - solids.center[i, 1], oz - solids.center[i, 2]
    b = ax * dx + ay * dy + az * dz
    root = b * b - (ax * ax + ay * ay + az * az - solids.reach[i] ** 2)
    if root <= 0.0:
        return 1e30
    if solids.kind[i] == SPHERE:
        root = math.sqrt(root)
        near, far = -b - root, -b + root
    elif solids.kind[i] == CYLINDER:
        near, far = _in_cylinder(ax, ay, az, dx, dy, dz, solids.half[i, 0], solids.half[i, 1])
    else:
        c, s = solids.turn[i, 0], solids.turn[i, 1]
        near, far = _in_box(
            c * ax - s * az, ay, s * ax + c * az, c * dx - s * dz, dy, s * dx + c * dz,
            solids.half[i, 0], solids.half[i, 1], solids.half[i, 2],
        )  # fmt: skip
    if near > far or far < EPSILON:
        return 1e30
    return near if near > EPSILON else far


@kernel()
def nearest(solids, with_object, ox, oy, oz, dx, dy, dz):
    """(distance, solid) of the first surface on the ray."""
    best, which = 1e30, -1
    for i in range(solids.kind.shape[0]):
        if solids.removable[i] and not with_object:
            continue
        t = distance(solids, i, ox, oy, oz, dx, dy, dz)
        if t < best:
            best, which = t, i
    return best, which


@kernel()
def is_blocked(solids, with_object, ox, oy, oz, dx, dy, dz, limit):
    """Is a solid nearer than `limit`? The room itself hides nothing inside it."""
    for i in range(1, solids.kind.shape[0]):
        if solids.removable[i] and not with_object:
            continue
        if distance(solids, i, ox, oy, oz, dx, dy, dz) < limit:
            return True
    return False


@kernel()
def surface(solids, i, px, py, pz):
    """(face, u, v, normal x, y, z) of a point on solid i; u, v in metres."""
    ax, ay, az = px - solids.center[i, 0], py - solids.center[i, 1], pz - solids.center[i, 2]
    c, s = solids.turn[i, 0], solids.turn[i, 1]
    x, y, z = c * ax - s * az, ay, s * ax + c * az
    hx, hy, hz = solids.half[i, 0], solids.half[i, 1], solids.half[i, 2]
    kind, face = solids.kind[i], solids.first_face[i]
    if kind == SPHERE:
        v = math.acos(min(1.0, max(-1.0, y / hx))) * hx
        return face, (math.atan2(z, x) + math.pi) * hx, v, ax / hx, ay / hx, az / hx
    if kind == CYLINDER:
        if abs(y) / hy > math.hypot(x, z) / hx:
            return face + (1 if y > 0 else 2), x + hx, z + hx, 0.0, 1.0 if y > 0 else -1.0, 0.0
        return face, (math.atan2(z, x) + math.pi) * hx, hy - y, ax / hx, 0.0, az / hx
    if kind == THICKET:
        nx, ny, nz = leaf_normal(solids, i, x, y, z)
        down = z + hz if solids.leaves[i, 1] == 1.0 else hy - y
        return face, x + hx, down, c * nx + s * nz, ny, c * nz - s * nx
    sign = -1.0 if kind == ROOM else 1.0
    fx, fy, fz = abs(x) / hx, abs(y) / hy, abs(z) / hz
    if fx >= fy and fx >= fz:
        e = sign if x > 0 else -sign
        return face + (0 if x > 0 else 1), z + hz, hy - y, e * c, 0.0, -e * s
    if fy >= fz:
        return face + (2 if y > 0 else 3), x + hx, z + hz, 0.0, sign if y > 0 else -sign, 0.0
    e = sign if z > 0 else -sign
    return face + (4 if z > 0 else 5), x + hx, hy - y, e * s, 0.0, e * c


@kernel()
def on_face(solids, i, local, u, v):
    """The inverse of `_surface`: room point and outward normal of (u, v) on face `local` of solid i."""
    hx, hy, hz = solids.half[i, 0], solids.half[i, 1], solids.half[i, 2]
    kind = solids.kind[i]
    if kind == SPHERE:
        a, b = u / hx - math.pi, v / hx
        nx, ny, nz = math.sin(b) * math.cos(a), math.cos(b), math.sin(b) * math.sin(a)
        x, y, z = nx * hx, ny * hx, nz * hx
    elif kind == CYLINDER:
        if local == 0:
            nx, ny, nz = math.cos(u / hx - math.pi), 0.0, math.sin(u / hx - math.pi)
            x, y, z = nx * hx, hy - v, nz * hx
        else:
            nx, ny, nz = 0.0, 1.0 if local == 1 else -1.0, 0.0
            x, y, z = u - hx, ny * hy, v - hx
    else:
        if kind == THICKET:
            local = 2 if solids.leaves[i, 1] == 1.0 else 4
        e = 1.0 if local % 2 == 0 else -1.0
        if local < 2:
            x, y, z, nx, ny, nz = e * hx, hy - v, u - hz, e, 0.0, 0.0
        elif local < 4:
            x, y, z, nx, ny, nz = u - hx, e * hy, v - hz, 0.0, e, 0.0
        else:
            x, y, z, nx, ny, nz = u - hx, hy - v, e * hz, 0.0, 0.0, e
        if kind == ROOM:
            nx, ny, nz = -nx, -ny, -nz
    c, s = solids.turn[i, 0], solids.turn[i, 1]
    return (
        c * x + s * z + solids.center[i, 0], y + solids.center[i, 1], -s * x + c * z + solids.center[i, 2],
        c * nx + s * nz, ny, -s * nx + c * nz,
    )  # fmt: skip
