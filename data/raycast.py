"""A small ray caster: boxes, spheres and cylinders in an enclosed room, baked light, mip-mapped textures.

Room frame: metres, x right, y up, z towards the cameras; the back wall is z = 0. A camera is one row of 16 numbers:
f, cx, cy [pixels], k1, camera-to-room rotation (9, row by row; the camera looks along +z, x right, y down), centre (3).
The lens is COLMAP's SIMPLE_RADIAL: a ray (x, y, 1) lands at f (1 + k1 r^2) (x, y) + (cx, cy), r^2 = x^2 + y^2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

ROOM, BOX, SPHERE, CYLINDER = 0, 1, 2, 3
EPSILON = 1e-4  # metres


class Solids(NamedTuple):
    """n solids; the first is the room, seen from inside. Their faces are numbered from first_face on.

    Faces of a box: +x, -x, +y, -y, +z, -z; of a sphere: one; of a cylinder (upright): side, top, bottom.

    Attributes:
        kind: [n] ROOM, BOX, SPHERE or CYLINDER.
        center: [n, 3]; half: [n, 3] half extents (radius, half height, - for round ones); turn: [n, 2] cos, sin of yaw.
        first_face: [n]; removable: [n] bool, True for the object.
        reach: [n] radius of the bounding sphere.
    """

    kind: np.ndarray
    center: np.ndarray
    half: np.ndarray
    turn: np.ndarray
    first_face: np.ndarray
    removable: np.ndarray
    reach: np.ndarray


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


class Textures(NamedTuple):
    """Square tileable pictures with all their mip levels, sRGB bytes in one array.

    Attributes:
        texels: [total, 3] uint8; start: [k, levels] first texel of each level; side: [k] pixels at level 0.
        mean: [k, 3] linear mean colour; linear: [256] sRGB byte -> linear.
    """

    texels: np.ndarray
    start: np.ndarray
    side: np.ndarray
    mean: np.ndarray
    linear: np.ndarray


@njit(cache=True, inline="always")
def _slabs(ox, oy, oz, dx, dy, dz, hx, hy, hz):
    near, far = -1e30, 1e30
    for o, d, h in ((ox, dx, hx), (oy, dy, hy), (oz, dz, hz)):
        if abs(d) < 1e-12:
            if abs(o) > h:
                return 1e30, -1e30
            continue
        a, b = (-h - o) / d, (h - o) / d
        near, far = max(near, min(a, b)), min(far, max(a, b))
    return near, far


@njit(cache=True)
def _distance(solids, i, ox, oy, oz, dx, dy, dz):
    """Along the ray to solid i, 1e30 if missed. From inside a solid: to its far side."""
    ax, ay, az = ox - solids.center[i, 0], oy - solids.center[i, 1], oz - solids.center[i, 2]
    kind = solids.kind[i]
    b = ax * dx + ay * dy + az * dz
    root = b * b - (ax * ax + ay * ay + az * az - solids.reach[i] ** 2)
    if root <= 0.0:
        return 1e30
    if kind == SPHERE:
        root = math.sqrt(root)
        t = -b - root
        if t < EPSILON:
            t = -b + root
        return t if t > EPSILON else 1e30
    if kind == CYLINDER:
        a = dx * dx + dz * dz
        near, far = -1e30, 1e30
        if a > 1e-12:
            b = ax * dx + az * dz
            root = b * b - a * (ax * ax + az * az - solids.half[i, 0] ** 2)
            if root <= 0.0:
                return 1e30
            root = math.sqrt(root)
            near, far = (-b - root) / a, (-b + root) / a
        elif ax * ax + az * az > solids.half[i, 0] ** 2:
            return 1e30
        if abs(dy) > 1e-12:
            lo, hi = (-solids.half[i, 1] - ay) / dy, (solids.half[i, 1] - ay) / dy
            near, far = max(near, min(lo, hi)), min(far, max(lo, hi))
        elif abs(ay) > solids.half[i, 1]:
            return 1e30
    else:
        c, s = solids.turn[i, 0], solids.turn[i, 1]
        near, far = _slabs(
            c * ax - s * az, ay, s * ax + c * az, c * dx - s * dz, dy, s * dx + c * dz,
            solids.half[i, 0], solids.half[i, 1], solids.half[i, 2],
        )  # fmt: skip
    if near > far or far < EPSILON:
        return 1e30
    return near if near > EPSILON else far


@njit(cache=True)
def _nearest(solids, with_object, ox, oy, oz, dx, dy, dz):
    """(distance, solid) of the first surface on the ray."""
    best, which = 1e30, -1
    for i in range(solids.kind.shape[0]):
        if solids.removable[i] and not with_object:
            continue
        t = _distance(solids, i, ox, oy, oz, dx, dy, dz)
        if t < best:
            best, which = t, i
    return best, which


@njit(cache=True)
def _blocked(solids, with_object, ox, oy, oz, dx, dy, dz, limit):
    """Is there a solid nearer than `limit`? The room itself hides nothing inside it."""
    for i in range(1, solids.kind.shape[0]):
        if solids.removable[i] and not with_object:
            continue
        if _distance(solids, i, ox, oy, oz, dx, dy, dz) < limit:
            return True
    return False


@njit(cache=True)
def _surface(solids, i, px, py, pz):
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
    sign = -1.0 if kind == ROOM else 1.0
    fx, fy, fz = abs(x) / hx, abs(y) / hy, abs(z) / hz
    if fx >= fy and fx >= fz:
        e = sign if x > 0 else -sign
        return face + (0 if x > 0 else 1), z + hz, hy - y, e * c, 0.0, -e * s
    if fy >= fz:
        return face + (2 if y > 0 else 3), x + hx, z + hz, 0.0, sign if y > 0 else -sign, 0.0
    e = sign if z > 0 else -sign
    return face + (4 if z > 0 else 5), x + hx, hy - y, e * s, 0.0, e * c


@njit(cache=True)
def _on_face(solids, i, local, u, v):
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


@njit(cache=True)
def _texel(textures, k, level, a, b, out, weight):
    """Add the bilinear sample at (a, b) in tiles, times weight, to out."""
    side = max(textures.side[k] >> level, 1)
    x, y = (a - math.floor(a)) * side - 0.5, (b - math.floor(b)) * side - 0.5
    i, j = math.floor(x), math.floor(y)
    fx, fy = x - i, y - j
    start = textures.start[k, level]
    for dj in range(2):
        row = start + ((j + dj) & (side - 1)) * side
        wy = weight * (fy if dj else 1.0 - fy)
        for di in range(2):
            n = row + ((i + di) & (side - 1))
            w = wy * (fx if di else 1.0 - fx)
            for ch in range(3):
                out[ch] += w * textures.linear[textures.texels[n, ch]]


@njit(cache=True)
def _albedo(faces, textures, face, u, v, footprint, out):
    """Linear colour of a face, averaged over about `footprint` metres."""
    if faces.swap[face]:
        u, v = v, u
    k = faces.texture[face]
    su, sv = faces.mapping[face, 0], faces.mapping[face, 1]
    level = math.log2(max(footprint * max(su, sv) * textures.side[k], 1.0))
    last = textures.start.shape[1] - 1
    low = min(int(level), last)
    rest = min(level - low, 1.0) if low < last else 0.0
    out[:] = 0.0
    a, b = u * su + faces.mapping[face, 2], v * sv + faces.mapping[face, 3]
    _texel(textures, k, low, a, b, out, 1.0 - rest)
    if rest > 0.0:
        _texel(textures, k, low + 1, a, b, out, rest)
    for ch in range(3):
        out[ch] *= faces.tint[face, ch]


@njit(cache=True)
def _irradiance(faces, light, face, u, v, out):
    """Bilinear lookup in the face's light map."""
    start, columns, rows = faces.grid[face, 0], faces.grid[face, 1], faces.grid[face, 2]
    x = min(max(u / faces.size[face, 0], 0.0), 1.0) * (columns - 1)
    y = min(max(v / faces.size[face, 1], 0.0), 1.0) * (rows - 1)
    i, j = min(int(x), columns - 2), min(int(y), rows - 2)
    fx, fy = x - i, y - j
    n = start + j * columns + i
    for ch in range(3):
        top = light[n, ch] * (1 - fx) + light[n + 1, ch] * fx
        out[ch] = top * (1 - fy) + (light[n + columns, ch] * (1 - fx) + light[n + columns + 1, ch] * fx) * fy


@njit(cache=True, inline="always")
def _ray(camera, x, y):
    """Unit direction in the room through image point (x, y), the lens undone by Newton's method."""
    f, k = camera[0], camera[3]
    x, y = (x - camera[1]) / f, (y - camera[2]) / f
    bent = math.hypot(x, y)
    r = bent
    for _ in range(4):
        r -= (r + k * r * r * r - bent) / (1.0 + 3.0 * k * r * r)
    if bent > 0.0:
        x, y = x * r / bent, y * r / bent
    n = 1.0 / math.sqrt(x * x + y * y + 1.0)
    return (
        (camera[4] * x + camera[5] * y + camera[6]) * n,
        (camera[7] * x + camera[8] * y + camera[9]) * n,
        (camera[10] * x + camera[11] * y + camera[12]) * n,
    )


@njit(cache=True)
def _project(camera, px, py, pz):
    """(x, y, z): image point through the lens, and the camera z of a room point."""
    ax, ay, az = px - camera[13], py - camera[14], pz - camera[15]
    x = camera[4] * ax + camera[7] * ay + camera[10] * az
    y = camera[5] * ax + camera[8] * ay + camera[11] * az
    z = camera[6] * ax + camera[9] * ay + camera[12] * az
    if z <= 1e-6:
        return 0.0, 0.0, z
    x, y = x / z, y / z
    scale = camera[0] * (1.0 + camera[3] * (x * x + y * y))
    return x * scale + camera[1], y * scale + camera[2], z


TILE = 16  # pixels


@njit(cache=True)
def _in_tile(solids, camera, left, top, listed):
    """Number the solids that may show in a tile of the picture, the room first, into `listed`; return how many."""
    ax, ay, az = _ray(camera, left + 0.5 * TILE, top + 0.5 * TILE)
    widest = 1.0
    for corner in range(4):
        bx, by, bz = _ray(camera, left + TILE * (corner % 2), top + TILE * (corner // 2))
        widest = min(widest, ax * bx + ay * by + az * bz)
    half_angle = math.acos(widest) + 1e-3
    count = 0
    for i in range(solids.kind.shape[0]):
        bx, by, bz = (
            solids.center[i, 0] - camera[13], solids.center[i, 1] - camera[14], solids.center[i, 2] - camera[15]
        )  # fmt: skip
        far = math.sqrt(bx * bx + by * by + bz * bz)
        if far > solids.reach[i]:
            off_axis = math.acos(min(1.0, max(-1.0, (ax * bx + ay * by + az * bz) / far)))
            if off_axis > half_angle + math.asin(solids.reach[i] / far):
                continue
        listed[count] = i
        count += 1
    return count


@njit(cache=True, parallel=True)
def render(solids, faces, textures, light, camera, width, height, with_object, samples):
    """Linear radiance [H, W, 3] box-filtered over samples x samples rays a pixel, with the object or without it,
    and bool [H, W]: where any of those rays would meet the object first.
    """
    color = np.zeros((height, width, 3))
    mask = np.zeros((height, width), np.bool_)
    wide = (width + TILE - 1) // TILE
    for tile in prange(wide * ((height + TILE - 1) // TILE)):
        albedo, irradiance = np.empty(3), np.empty(3)
        listed = np.empty(solids.kind.shape[0], np.int32)
        left, top = tile % wide * TILE, tile // wide * TILE
        count = _in_tile(solids, camera, left, top, listed)
        for pixel in range(TILE * TILE):
            column, row = left + pixel % TILE, top + pixel // TILE
            if column >= width or row >= height:
                continue
            for sample in range(samples * samples):
                x = column + (sample % samples + 0.5) / samples
                y = row + (sample // samples + 0.5) / samples
                dx, dy, dz = _ray(camera, x, y)
                t, i, first, on = 1e30, -1, 1e30, False
                for k in range(count):
                    distance = _distance(solids, listed[k], camera[13], camera[14], camera[15], dx, dy, dz)
                    if distance < first:
                        first, on = distance, solids.removable[listed[k]]
                    if distance < t and (with_object or not solids.removable[listed[k]]):
                        t, i = distance, listed[k]
                mask[row, column] |= on
                face, u, v, nx, ny, nz = _surface(
                    solids, i, camera[13] + t * dx, camera[14] + t * dy, camera[15] + t * dz
                )
                # The footprint of one ray on the surface; its long side is shared between blur and supersampling.
                cosine = max(abs(nx * dx + ny * dy + nz * dz), 0.05)
                _albedo(faces, textures, face, u, v, t / (camera[0] * samples * math.sqrt(cosine)), albedo)
                _irradiance(faces, light, face, u, v, irradiance)
                for ch in range(3):
                    color[row, column, ch] += albedo[ch] * irradiance[ch]
            for ch in range(3):
                color[row, column, ch] /= samples * samples
    return color, mask


@njit(cache=True, parallel=True)
def surface_points(solids, camera, pixels, with_object):
    """Where the rays through image points [P, 2] first meet a surface: points [P, 3] in the room, solid [P]."""
    points, which = np.empty((pixels.shape[0], 3)), np.empty(pixels.shape[0], np.int32)
    for n in prange(pixels.shape[0]):
        dx, dy, dz = _ray(camera, pixels[n, 0], pixels[n, 1])
        t, i = _nearest(solids, with_object, camera[13], camera[14], camera[15], dx, dy, dz)
        points[n, 0], points[n, 1], points[n, 2] = camera[13] + t * dx, camera[14] + t * dy, camera[15] + t * dz
        which[n] = i
    return points, which


@njit(cache=True)
def _reaches(solids, camera, with_object, px, py, pz):
    ax, ay, az = px - camera[13], py - camera[14], pz - camera[15]
    far = math.sqrt(ax * ax + ay * ay + az * az)
    return not _blocked(
        solids, with_object, camera[13], camera[14], camera[15], ax / far, ay / far, az / far, far - 10 * EPSILON
    )


@njit(cache=True, parallel=True)
def observations(solids, cameras, width, height, points):
    """Image points [P, V, 2] of room points in V views with the object, NaN where hidden or outside the frame."""
    found = np.full((points.shape[0], cameras.shape[0], 2), np.nan)
    for n in prange(points.shape[0]):
        for v in range(cameras.shape[0]):
            x, y, z = _project(cameras[v], points[n, 0], points[n, 1], points[n, 2])
            if z <= 0.0 or x < 0.0 or y < 0.0 or x >= width or y >= height:
                continue
            if _reaches(solids, cameras[v], True, points[n, 0], points[n, 1], points[n, 2]):
                found[n, v, 0], found[n, v, 1] = x, y
    return found


@njit(cache=True, parallel=True)
def never_seen(solids, cameras, masks, points):
    """Which background points [P, 3] no training view shows outside its mask. masks: bool [V, H, W] of those views."""
    unseen = np.ones(points.shape[0], np.bool_)
    for n in prange(points.shape[0]):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        for v in range(cameras.shape[0]):
            x, y, z = _project(cameras[v], px, py, pz)
            if z <= 0.0 or x < 0.0 or y < 0.0 or x >= masks.shape[2] or y >= masks.shape[1]:
                continue
            if not masks[v, int(y), int(x)] and _reaches(solids, cameras[v], True, px, py, pz):
                unseen[n] = False
                break
    return unseen


@njit(cache=True, parallel=True)
def light_nodes(solids, faces):
    """The light map's nodes: room points [M, 3] just off the surface, normals [M, 3], solid [M]."""
    total = 0
    for f in range(faces.grid.shape[0]):
        total += faces.grid[f, 1] * faces.grid[f, 2]
    points, normals, owner = np.empty((total, 3)), np.empty((total, 3)), np.empty(total, np.int32)
    for i in prange(solids.kind.shape[0]):
        end = solids.first_face[i + 1] if i + 1 < solids.kind.shape[0] else faces.grid.shape[0]
        for f in range(solids.first_face[i], end):
            start, columns, rows = faces.grid[f, 0], faces.grid[f, 1], faces.grid[f, 2]
            for j in range(rows):
                for k in range(columns):
                    # Nodes on an edge are drawn inwards a little, or they would sit inside the neighbouring face.
                    a = 0.004 + 0.992 * k / (columns - 1)
                    b = 0.004 + 0.992 * j / (rows - 1)
                    px, py, pz, nx, ny, nz = _on_face(
                        solids, i, f - solids.first_face[i], a * faces.size[f, 0], b * faces.size[f, 1]
                    )
                    n = start + j * columns + k
                    points[n, 0], points[n, 1], points[n, 2] = px + 1e-3 * nx, py + 1e-3 * ny, pz + 1e-3 * nz
                    normals[n, 0], normals[n, 1], normals[n, 2] = nx, ny, nz
                    owner[n] = i
    return points, normals, owner


@njit(cache=True, parallel=True)
def direct_light(solids, points, normals, owner, lamps, side):
    """Irradiance / pi [M, 3] at the nodes from rectangular lamps, side x side shadow rays each.

    lamps: [L, 15] centre, half edge a, half edge b, direction it shines in, radiance. The object shades only itself:
    nothing else in the room may change when it goes.
    """
    light = np.zeros((points.shape[0], 3))
    for n in prange(points.shape[0]):
        with_object = solids.removable[owner[n]]
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        for lamp in lamps:
            area = 4.0 * math.sqrt(lamp[3] ** 2 + lamp[4] ** 2 + lamp[5] ** 2)
            area *= math.sqrt(lamp[6] ** 2 + lamp[7] ** 2 + lamp[8] ** 2)
            total = 0.0
            for s in range(side * side):
                a, b = 2.0 * (s % side + 0.5) / side - 1.0, 2.0 * (s // side + 0.5) / side - 1.0
                dx = lamp[0] + a * lamp[3] + b * lamp[6] - px
                dy = lamp[1] + a * lamp[4] + b * lamp[7] - py
                dz = lamp[2] + a * lamp[5] + b * lamp[8] - pz
                far = math.sqrt(dx * dx + dy * dy + dz * dz)
                dx, dy, dz = dx / far, dy / far, dz / far
                here = dx * normals[n, 0] + dy * normals[n, 1] + dz * normals[n, 2]
                there = -(dx * lamp[9] + dy * lamp[10] + dz * lamp[11])
                if here <= 0.0 or there <= 0.0:
                    continue
                if not _blocked(solids, with_object, px, py, pz, dx, dy, dz, far):
                    total += here * there / max(far * far, 0.04)
            for ch in range(3):
                light[n, ch] += total / (side * side) * area / math.pi * lamp[12 + ch]
    return light


@njit(cache=True, parallel=True)
def bounced_light(solids, faces, textures, points, normals, owner, light, ambient, rays):
    """One bounce [M, 3]: the mean over a cosine-weighted hemisphere of what the surfaces seen there send back.

    Every node uses the same low-discrepancy directions, so neighbours agree and nothing is noisy.
    """
    bounce = np.zeros((points.shape[0], 3))
    for n in prange(points.shape[0]):
        with_object = solids.removable[owner[n]]
        nx, ny, nz = normals[n, 0], normals[n, 1], normals[n, 2]
        ax, ay, az = (0.0, nz, -ny) if abs(nx) < 0.7 else (-nz, 0.0, nx)
        length = math.sqrt(ax * ax + ay * ay + az * az)
        ax, ay, az = ax / length, ay / length, az / length
        bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
        found = np.empty(3)
        for s in range(rays):
            radius, angle = math.sqrt((s + 0.5) / rays), 2.399963229728653 * s
            a, b, c = radius * math.cos(angle), radius * math.sin(angle), math.sqrt(1.0 - (s + 0.5) / rays)
            dx, dy, dz = a * ax + b * bx + c * nx, a * ay + b * by + c * ny, a * az + b * bz + c * nz
            t, i = _nearest(solids, with_object, points[n, 0], points[n, 1], points[n, 2], dx, dy, dz)
            if i < 0:
                continue
            px, py, pz = points[n, 0] + t * dx, points[n, 1] + t * dy, points[n, 2] + t * dz
            face, u, v, _, _, _ = _surface(solids, i, px, py, pz)
            _irradiance(faces, light, face, u, v, found)
            k = faces.texture[face]
            for ch in range(3):
                albedo = textures.mean[k, ch] * faces.tint[face, ch]
                bounce[n, ch] += (found[ch] + ambient) * albedo / rays
    return bounce
