"""The ray caster: renders pictures of the room, finds surface points, and tests which points a camera sees.

A camera is one row of 16 numbers: f, cx, cy in px; k1; the camera-to-room rotation (9 numbers, row by row; the camera
looks along +z, x right, y down); the center (3 numbers). The lens is COLMAP's SIMPLE_RADIAL: a ray (x, y, 1) in the
camera's frame is projected to f (1 + k1 r^2) (x, y) + (cx, cy), r^2 = x^2 + y^2.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from lab.scenes.compiled import kernel
from lab.scenes.light import irradiance
from lab.scenes.mipmaps import albedo
from lab.scenes.solids import EPSILON, THICKET, distance, is_blocked, nearest, surface
from lab.scenes.thicket import leaf_light

TILE = 16  # side of the tiles in which pictures are rendered, px


@kernel(inline="always")
def ray(camera, x, y):
    """Return the unit direction, in the room, of the ray through the image point (x, y).

    The lens distortion is inverted by Newton's method.
    """
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
    """Project a room point: return (x, y, z), the distorted image point and camera z; (0, 0, z) if z is below 1e-6."""
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
    """List in `listed` [n] the solids that the tile at (left, top) may show, the room first; return their number."""
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
        if far > solids.reach[i]:  # bounding sphere against the tile's cone of rays
            off_axis = math.acos(min(1.0, max(-1.0, (ax * bx + ay * by + az * bz) / far)))
            if off_axis > half_angle + math.asin(solids.reach[i] / far):
                continue
        listed[count] = i
        count += 1
    return count


@kernel()
def _first(solids, listed, camera, with_object, dx, dy, dz):
    """Return distance (else 1e30) and solid (else -1) of a ray's first surface, and whether the object is hit first."""
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
    """Add the radiance of solid i at distance t on a ray to `out` [3]; `samples` is rays along a pixel's side."""
    face, u, v, nx, ny, nz = surface(solids, i, camera[13] + t * dx, camera[14] + t * dy, camera[15] + t * dz)
    # The footprint of a ray on a slanted surface is an ellipse with axes 1 and 1 / cosine. The geometric mean is a
    # compromise: the mip level blurs a part of the long axis, supersampling resolves the rest.
    cosine = max(abs(nx * dx + ny * dy + nz * dz), 0.05)
    color, falling = scratch[0], scratch[1]
    albedo(faces, textures, face, u, v, t / (camera[0] * samples * math.sqrt(cosine)), color)
    irradiance(faces, light, face, u, v, falling)
    share = leaf_light(nx, ny, nz) if solids.kind[i] == THICKET else 1.0
    for ch in range(3):
        out[ch] += color[ch] * falling[ch] * share


@kernel(parallel=True)
def render(solids, faces, textures, light, camera, width, height, with_object, samples):
    """Render a picture with or without the object.

    Args:
        light: [M, 3] irradiance / pi at the nodes of the light map.
        samples: rays along a side of a pixel; the picture is box-filtered over samples² rays per pixel.

    Returns:
        Linear radiance [H, W, 3], and the object's mask, bool [H, W], the same for each `with_object`: True where the
        object is the first thing that at least one ray of the pixel hits, or would hit if the object were there.
    """
    color = np.zeros((height, width, 3))
    mask = np.zeros((height, width), np.bool_)
    wide = (width + TILE - 1) // TILE
    for tile in prange(wide * ((height + TILE - 1) // TILE)):
        left, top, scratch = tile % wide * TILE, tile // wide * TILE, np.empty((2, 3))
        listed = np.empty(solids.kind.shape[0], np.int64)  # as in `nearest`: kernels are compiled for each type
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
    """Return the first surface points on the rays through image points.

    Args:
        pixels: image points [P, 2], (x, y).
        with_object: False ignores the removable solids.

    Returns:
        Room points [P, 3], and the index of the solid [P] on which each point lies.
    """
    points, which = np.empty((pixels.shape[0], 3)), np.empty(pixels.shape[0], np.int32)
    for n in prange(pixels.shape[0]):
        dx, dy, dz = ray(camera, pixels[n, 0], pixels[n, 1])
        t, i = nearest(solids, with_object, camera[13], camera[14], camera[15], dx, dy, dz)
        points[n, 0], points[n, 1], points[n, 2] = camera[13] + t * dx, camera[14] + t * dy, camera[15] + t * dz
        which[n] = i
    return points, which


@kernel()
def _reaches(solids, camera, with_object, px, py, pz):
    """Return True if no solid is between the camera's center and a room point."""
    ax, ay, az = px - camera[13], py - camera[14], pz - camera[15]
    far = math.sqrt(ax * ax + ay * ay + az * az)
    return not is_blocked(
        solids, with_object, camera[13], camera[14], camera[15], ax / far, ay / far, az / far, far - 10 * EPSILON
    )


@kernel(parallel=True)
def observations(solids, cameras, width, height, points):
    """Project room points [P, 3] into V views with the object.

    Args:
        cameras: [V, 16].
        width: image width, px.
        height: image height, px.
        points: [P, 3], room points on surfaces.

    Returns:
        Image points [P, V, 2], NaN where the point is occluded, also by the object, or outside the image.
    """
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
    """Return bool [P], True for the background points that no training view shows outside the view's own mask.

    The object and all other solids occlude points in the training views.

    Args:
        cameras: [V, 16], cameras of the training views.
        masks: bool [V, H, W], masks of the training views.
        points: [P, 3], room points.
    """
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
