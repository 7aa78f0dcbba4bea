"""Baking of the light map: nodes on every face, direct light of lamps, light reflected between faces.

The light map stores irradiance / pi, the radiance that a white diffuse surface would reflect.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from lab.scenes.compiled import kernel
from lab.scenes.solids import is_blocked, nearest, on_face, surface


@kernel()
def irradiance(faces, light, face, u, v, out):
    """Interpolate the light map of a face bilinearly, and write the result, irradiance / pi, to `out` [3].

    Args:
        light: [M, 3] light map of all faces.
        face: number of the face among the faces of all solids.
        u, v: point on the face, metres; clamped to the face.
    """
    start, columns, rows = faces.grid[face, 0], faces.grid[face, 1], faces.grid[face, 2]
    x = min(max(u / faces.size[face, 0], 0.0), 1.0) * (columns - 1)
    y = min(max(v / faces.size[face, 1], 0.0), 1.0) * (rows - 1)
    i, j = min(int(x), columns - 2), min(int(y), rows - 2)
    fx, fy = x - i, y - j
    n = start + j * columns + i
    for ch in range(3):
        top = light[n, ch] * (1 - fx) + light[n + 1, ch] * fx
        out[ch] = top * (1 - fy) + (light[n + columns, ch] * (1 - fx) + light[n + columns + 1, ch] * fx) * fy


@kernel()
def light_nodes(solids, faces):
    """Return the M nodes of the light map.

    Returns:
        points: [M, 3], room points 1 mm in front of the surface.
        normals: [M, 3].
        owner: [M], index of the solid.
    """
    total = 0
    for f in range(faces.grid.shape[0]):
        total += faces.grid[f, 1] * faces.grid[f, 2]
    points, normals, owner = np.empty((total, 3)), np.empty((total, 3)), np.empty(total, np.int32)
    for i in range(solids.kind.shape[0]):
        end = solids.first_face[i + 1] if i + 1 < solids.kind.shape[0] else faces.grid.shape[0]
        for f in range(solids.first_face[i], end):
            start, columns, rows = faces.grid[f, 0], faces.grid[f, 1], faces.grid[f, 2]
            for j in range(rows):
                for k in range(columns):
                    # Nodes on an edge are moved inwards a little, so that they are not inside another face.
                    a = 0.004 + 0.992 * k / (columns - 1)
                    b = 0.004 + 0.992 * j / (rows - 1)
                    px, py, pz, nx, ny, nz = on_face(
                        solids, i, f - solids.first_face[i], a * faces.size[f, 0], b * faces.size[f, 1]
                    )
                    n = start + j * columns + k
                    points[n, 0], points[n, 1], points[n, 2] = px + 1e-3 * nx, py + 1e-3 * ny, pz + 1e-3 * nz
                    normals[n, 0], normals[n, 1], normals[n, 2] = nx, ny, nz
                    owner[n] = i
    return points, normals, owner


@kernel(parallel=True)
def direct_light(solids, points, normals, owner, lamps, side):
    """Compute the light [M, 3] at the nodes that comes directly from rectangular lamps, as irradiance / pi.

    The object casts shadows only on itself, because nothing else in the room may change when the object is removed.

    Args:
        points: [M, 3] nodes.
        normals: [M, 3].
        owner: [M] index of the solid of each node.
        lamps: [L, 15]: center, half edge a, half edge b, direction of emission, radiance, three numbers each.
        side: side x side shadow rays per lamp.
    """
    light = np.zeros((points.shape[0], 3))
    for n in prange(points.shape[0]):
        with_object = solids.removable[owner[n]]
        for lamp in lamps:
            area = 4.0 * math.sqrt(lamp[3] ** 2 + lamp[4] ** 2 + lamp[5] ** 2)
            area *= math.sqrt(lamp[6] ** 2 + lamp[7] ** 2 + lamp[8] ** 2)
            total = _lamp_sum(solids, with_object, points[n], normals[n], lamp, side)
            for ch in range(3):
                light[n, ch] += total / (side * side) * area / math.pi * lamp[12 + ch]
    return light


@kernel()
def _lamp_sum(solids, with_object, point, normal, lamp, side):
    """Return a node's sum of cos(surface) cos(lamp) / distance² over side x side lamp points; unseen points add 0."""
    total = 0.0
    for s in range(side * side):
        a, b = 2.0 * (s % side + 0.5) / side - 1.0, 2.0 * (s // side + 0.5) / side - 1.0
        dx = lamp[0] + a * lamp[3] + b * lamp[6] - point[0]
        dy = lamp[1] + a * lamp[4] + b * lamp[7] - point[1]
        dz = lamp[2] + a * lamp[5] + b * lamp[8] - point[2]
        far = math.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx / far, dy / far, dz / far
        cosine_surface = dx * normal[0] + dy * normal[1] + dz * normal[2]
        cosine_lamp = -(dx * lamp[9] + dy * lamp[10] + dz * lamp[11])
        if cosine_surface <= 0.0 or cosine_lamp <= 0.0:
            continue
        if not is_blocked(solids, with_object, point[0], point[1], point[2], dx, dy, dz, far):
            total += cosine_surface * cosine_lamp / max(far * far, 0.04)
    return total


@kernel(parallel=True)
def bounced_light(solids, faces, textures, points, normals, owner, light, ambient, rays):
    """Compute the light [M, 3], as irradiance / pi, that reaches the nodes from other surfaces after one bounce.

    This is the mean radiance of the surfaces in a cosine-weighted hemisphere about the normal, without the light that
    reaches the nodes directly from lamps. All nodes use the same low-discrepancy directions, so that neighboring nodes
    do not differ by noise. As in `direct_light`, the object has an effect on its own nodes only.

    Args:
        light: [M, 3] light at the nodes before this bounce; the surfaces reflect this light.
        ambient: constant that is added to the light of all surfaces before they reflect it.
        rays: number of directions.
    """
    bounce = np.zeros((points.shape[0], 3))
    for n in prange(points.shape[0]):
        with_object = solids.removable[owner[n]]
        found = np.empty(3)
        for s in range(rays):
            dx, dy, dz = _direction(s, rays, normals[n, 0], normals[n, 1], normals[n, 2])
            t, i = nearest(solids, with_object, points[n, 0], points[n, 1], points[n, 2], dx, dy, dz)
            if i < 0:
                continue
            px, py, pz = points[n, 0] + t * dx, points[n, 1] + t * dy, points[n, 2] + t * dz
            face, u, v, _, _, _ = surface(solids, i, px, py, pz)
            irradiance(faces, light, face, u, v, found)
            k = faces.texture[face]
            for ch in range(3):
                albedo = textures.mean[k, ch] * faces.tint[face, ch]
                bounce[n, ch] += (found[ch] + ambient) * albedo / rays
    return bounce


@kernel()
def _direction(s, rays, nx, ny, nz):
    """Return direction number s of `rays` directions, cosine-weighted about the normal (nx, ny, nz)."""
    ax, ay, az = (0.0, nz, -ny) if abs(nx) < 0.7 else (-nz, 0.0, nx)
    length = math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / length, ay / length, az / length
    bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
    radius, angle = math.sqrt((s + 0.5) / rays), 2.399963229728653 * s
    a, b, c = radius * math.cos(angle), radius * math.sin(angle), math.sqrt(1.0 - (s + 0.5) / rays)
    return a * ax + b * bx + c * nx, a * ay + b * by + c * ny, a * az + b * bz + c * nz
