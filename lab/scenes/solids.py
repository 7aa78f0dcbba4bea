"""Boxes, spheres, cylinders and foliage in an enclosed room: intersections with rays, and coordinates on faces.

Room frame: metres, x right, y up, z towards the cameras; the back wall is z = 0.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lab.scenes.compiled import kernel
from lab.scenes.thicket import first_leaf, leaf_normal

ROOM, BOX, SPHERE, CYLINDER, THICKET = 0, 1, 2, 3, 4
EPSILON = 1e-4  # metres


class Solids(NamedTuple):
    """Arrays of n solids; solid 0 is the room, seen from inside.

    The faces of all solids are numbered consecutively. A box has the faces +x, -x, +y, -y, +z, -z; a sphere has one
    face; an upright cylinder has the faces side, top, bottom. A thicket is a box full of leaves (`thicket.py`) that
    share one face: the top of the box if the leaves make one layer (a lawn), else its +z side (a hedge).

    Attributes:
        kind: [n] ROOM, BOX, SPHERE, CYLINDER or THICKET.
        center: [n, 3] metres.
        half: [n, 3] half extents of a box, metres; radius and half height in the first two places of a cylinder, and
            the radius in the first place of a sphere.
        turn: [n, 2] cosine and sine of the yaw, the rotation about the vertical axis.
        first_face: [n] number of the solid's first face.
        removable: [n] bool, True for the solids of the object that the scene asks to remove or to insert.
        reach: [n] radius of the bounding sphere, metres.
        leaves: [n, 8] for a thicket: the numbers of cells along x, y, z; half a leaf's width, length and thickness in
            metres; the largest lean of a leaf in radians; the seed of the leaves. Zeros for other solids. All of these
            are in one array, because a second array makes every kernel half as slow again.
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
    """Arrays of f faces of solids, with the materials.

    A point of a face has coordinates (u, v) in metres, from 0 to `size`. On upright faces v points down.

    Attributes:
        texture: [f] index of the texture.
        mapping: [f, 4] tiles of the texture per metre along u and along v, then the offsets of both in tiles.
        swap: [f] bool, True if u and v are exchanged before the mapping.
        tint: [f, 3] factor on the linear color of the texture.
        size: [f, 2] extent along u and v, metres.
        grid: [f, 3] the face's light map: index of its first node among the nodes of all faces, number of columns, and
            number of rows.
    """

    texture: np.ndarray
    mapping: np.ndarray
    swap: np.ndarray
    tint: np.ndarray
    size: np.ndarray
    grid: np.ndarray


@kernel(inline="always")
def _slab(o, d, h):
    """Return the interval (near, far) of the ray parameter t in which |o + t d| <= h; near > far if it is empty."""
    if abs(d) < 1e-12:
        return (1e30, -1e30) if abs(o) > h else (-1e30, 1e30)
    a, b = (-h - o) / d, (h - o) / d
    return min(a, b), max(a, b)


@kernel(inline="always")
def _in_box(ox, oy, oz, dx, dy, dz, hx, hy, hz):
    """Return the interval (near, far) of a ray in an axis-aligned box around 0; near > far if the ray misses."""
    near, far = _slab(ox, dx, hx)
    for o, d, h in ((oy, dy, hy), (oz, dz, hz)):
        enters, leaves = _slab(o, d, h)
        near, far = max(near, enters), min(far, leaves)
    return near, far


@kernel(inline="always")
def _in_cylinder(ox, oy, oz, dx, dy, dz, radius, half):
    """Return the interval (near, far) of a ray in an upright cylinder around 0; near > far if the ray misses."""
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
    """Return the distance to solid i along the ray from o in the unit direction d, or 1e30 if the ray misses it.

    For a ray that starts inside the solid, this is the distance to the solid's far side. For a thicket, it is the
    distance to the first leaf. Surfaces nearer than `EPSILON` are ignored.
    """
    if solids.kind[i] == THICKET:  # a separate function, because in one function all solids would take twice the time
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
    """Return (distance, index of the solid) of the first surface on the ray, or (1e30, -1) if there is none.

    Args:
        with_object: False ignores the removable solids.
    """
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
    """Return True if a solid is on the ray nearer than `limit`. The room, solid 0, is ignored.

    Args:
        with_object: False ignores the removable solids.
    """
    for i in range(1, solids.kind.shape[0]):
        if solids.removable[i] and not with_object:
            continue
        if distance(solids, i, ox, oy, oz, dx, dy, dz) < limit:
            return True
    return False


@kernel()
def surface(solids, i, px, py, pz):
    """Return (face, u, v, normal x, normal y, normal z) of a room point on the surface of solid i; u, v in metres.

    `face` is the number of the face among the faces of all solids. The unit normal points outward; that of the room
    points into the room, and that of a thicket is the normal of the leaf.
    """
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
    """Return the room point and the unit outward normal at (u, v) of a face of solid i, as six numbers.

    This is the inverse of `surface`, except that the point of a thicket is on the face of its box, not on a leaf. The
    normal of the room points into the room.

    Args:
        local: number of the face within the solid.
        u: metres.
        v: metres.
    """
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
