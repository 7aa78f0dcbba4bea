"""Renders the room: pictures, surface points, and which points are hidden from a camera.

A camera is one row of 16 numbers: f, cx, cy [pixels], k1, camera-to-room rotation (9, row by row; the camera looks
along +z, x right, y down), centre (3). The lens is COLMAP's SIMPLE_RADIAL: a ray (x, y, 1) lands at
f (1 + k1 r^2) (x, y) + (cx, cy), r^2 = x^2 + y^2.
"""

from __future__ import annotations

import math

import numpy as np
from compiled import kernel
from light import irradiance
from mipmaps import albedo
from numba import prange
from solids import EPSILON, THICKET, distance, is_blocked, nearest, surface
from thicket import leaf_light

TILE = 16  # pixels


@kernel(inline="always")
def ray(camera, x, y):
    """Unit direction in the room through image point (x, y); the distortion is inverted by Newton's method."""
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


@kernel()
def project(camera, px, py, pz):
    """(x, y, z): distorted image point and camera z of a room point."""
    ax, ay, az = px - camera[13], py - camera[14], pz - camera[15]
    x = camera[4] * ax + camera[7] * ay + camera[10] * az
    y = camera[5] * ax + camera[8] * ay + camera[11] * az
    z = camera[6] * ax + camera[9] * ay + camera[12] * az
    if z <= 1e-6:
        return 0.0, 0.0, z
    x, y = x / z, y / z
    scale = camera[0] * (1.0 + camera[3] * (x * x + y * y))
    return x * scale + camera[1], y * scale + camera[2], z


@kernel()
def _in_tile(solids, camera, left, top, listed):
    """Write the numbers of the solids that may be visible in a tile into `listed`, the room first; return how many."""
    ax, ay, az = ray(camera, left + 0.5 * TILE, top + 0.5 * TILE)
    widest = 1.0
    for corner in range(4):
        bx, by, bz = ray(camera, left + TILE * (corner % 2), top + TILE * (corner // 2))
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


@kernel()
def _first(solids, listed, camera, with_object, dx, dy, dz):
    """(distance, solid) that the ray hits, with or without the object; and whether it would hit the object first."""
    t, i, least, on_object = 1e30, -1, 1e30, False
    for solid in listed:
        far = distance(solids, solid, camera[13], camera[14], camera[15], dx, dy, dz)
        if far < least:
            least, on_object = far, solids.removable[solid]
        if far < t and (with_object or not solids.removable[solid]):
            t, i = far, solid
    return t, i, on_object


@kernel()
def _add_radiance(solids, faces, textures, light, camera, i, t, dx, dy, dz, samples, scratch, out):
    """Add the radiance along the ray, at distance t on solid i, to `out` [3]; `scratch` is [2, 3]."""
    face, u, v, nx, ny, nz = surface(solids, i, camera[13] + t * dx, camera[14] + t * dy, camera[15] + t * dz)
    # The footprint of one ray on the surface; its long side is shared between blur and supersampling.
    cosine = max(abs(nx * dx + ny * dy + nz * dz), 0.05)
    color, falling = scratch[0], scratch[1]
    albedo(faces, textures, face, u, v, t / (camera[0] * samples * math.sqrt(cosine)), color)
    irradiance(faces, light, face, u, v, falling)
    share = leaf_light(nx, ny, nz) if solids.kind[i] == THICKET else 1.0
    for ch in range(3):
        out[ch] += color[ch] * falling[ch] * share


@kernel(parallel=True)
def render(solids, faces, textures, light, camera, width, height, with_object, samples):
    """Linear radiance [H, W, 3] box-filtered over samples x samples rays a pixel, with the object or without it,
    and bool [H, W]: where any of those rays would meet the object first.
    """
    color = np.zeros((height, width, 3))
    mask = np.zeros((height, width), np.bool_)
    wide = (width + TILE - 1) // TILE
    for tile in prange(wide * ((height + TILE - 1) // TILE)):
        left, top, scratch = tile % wide * TILE, tile // wide * TILE, np.empty((2, 3))
        listed = np.empty(solids.kind.shape[0], np.int32)
        listed = listed[: _in_tile(solids, camera, left, top, listed)]
        for row in range(top, min(top + TILE, height)):
            for column in range(left, min(left + TILE, width)):
                for sample in range(samples * samples):
                    x = column + (sample % samples + 0.5) / samples
                    y = row + (sample // samples + 0.5) / samples
                    dx, dy, dz = ray(camera, x, y)
                    t, i, on_object = _first(solids, listed, camera, with_object, dx, dy, dz)
                    mask[row, column] |= on_object
                    _add_radiance(
                        solids, faces, textures, light, camera, i, t, dx, dy, dz, samples, scratch, color[row, column]
                    )
                for ch in range(3):
                    color[row, column, ch] /= samples * samples
    return color, mask


@kernel(parallel=True)
def surface_points(solids, camera, pixels, with_object):
    """Where the rays through image points [P, 2] first hit a surface: points [P, 3] in the room, solid [P]."""
    points, which = np.empty((pixels.shape[0], 3)), np.empty(pixels.shape[0], np.int32)
    for n in prange(pixels.shape[0]):
        dx, dy, dz = ray(camera, pixels[n, 0], pixels[n, 1])
        t, i = nearest(solids, with_object, camera[13], camera[14], camera[15], dx, dy, dz)
        points[n, 0], points[n, 1], points[n, 2] = camera[13] + t * dx, camera[14] + t * dy, camera[15] + t * dz
        which[n] = i
    return points, which


@kernel()
def _reaches(solids, camera, with_object, px, py, pz):
    ax, ay, az = px - camera[13], py - camera[14], pz - camera[15]
    far = math.sqrt(ax * ax + ay * ay + az * az)
    return not is_blocked(
        solids, with_object, camera[13], camera[14], camera[15], ax / far, ay / far, az / far, far - 10 * EPSILON
    )


@kernel(parallel=True)
def observations(solids, cameras, width, height, points):
    """Image points [P, V, 2] of room points in V views with the object, NaN where hidden or outside the frame."""
    pixels = np.full((points.shape[0], cameras.shape[0], 2), np.nan)
    for n in prange(points.shape[0]):
        for v in range(cameras.shape[0]):
            x, y, z = project(cameras[v], points[n, 0], points[n, 1], points[n, 2])
            if z <= 0.0 or x < 0.0 or y < 0.0 or x >= width or y >= height:
                continue
            if _reaches(solids, cameras[v], True, points[n, 0], points[n, 1], points[n, 2]):
                pixels[n, v, 0], pixels[n, v, 1] = x, y
    return pixels


@kernel(parallel=True)
def never_seen(solids, cameras, masks, points):
    """bool [P]: background points [P, 3] that no training view shows outside its mask, bool [V, H, W]."""
    unseen = np.ones(points.shape[0], np.bool_)
    for n in prange(points.shape[0]):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        for v in range(cameras.shape[0]):
            x, y, z = project(cameras[v], px, py, pz)
            if z <= 0.0 or x < 0.0 or y < 0.0 or x >= masks.shape[2] or y >= masks.shape[1]:
                continue
            if not masks[v, int(y), int(x)] and _reaches(solids, cameras[v], True, px, py, pz):
                unseen[n] = False
                break
    return unseen
