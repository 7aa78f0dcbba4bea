"""Makes points from the depth maps that a capture names for its frames, where it brings no points."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from reffusion.capture.layouts.capture import NO_POINTS, PointCloud
from reffusion.capture.lens import Lens, to_directions
from reffusion.io.depth_maps import load_depth
from reffusion.io.images import load_thumbnail

FRAMES = 16  # depth maps that are read, spread evenly
POINTS = 10_000  # at most, that are made from them


def points_from_depth(
    depths: Mapping[str, Path],
    scale: float,
    pictures: Mapping[str, Path],
    lenses: Mapping[str, Lens],
    world_to_camera: Mapping[str, np.ndarray],
) -> PointCloud:
    """Unproject a grid of pixels and colour them by their pictures: positions [P, 3] and colours [P, 3].

    Args:
        depths: view name -> depth map, depth along the camera's axis.
        scale: units of the scene per 1 in a map of integers; maps of floats are in the scene's units.
    """
    names = sorted(depths)[:: -(-len(depths) // FRAMES)] if depths else []
    positions, colors = [NO_POINTS[0]], [NO_POINTS[1]]
    for name in names:
        depth = load_depth(depths[name]) * (scale if depths[name].suffix.lower() not in (".npy", ".exr") else 1.0)
        step = max(1, int(np.sqrt(depth.size * len(names) / POINTS)))
        rows, columns = np.meshgrid(*(np.arange(step // 2, extent, step) for extent in depth.shape), indexing="ij")
        rows, columns = rows.ravel(), columns.ravel()
        z, lens = depth[rows, columns], lenses[name].resized(depth.shape[1], depth.shape[0])
        directions = to_directions(np.stack([columns, rows], -1) + 0.5, lens)
        known = np.isfinite(z) & (z > 0) & np.isfinite(directions).all(1)
        local = np.concatenate([directions, np.ones((len(z), 1))], 1)[known] * z[known, None]
        pose = world_to_camera[name]
        positions.append((local - pose[:3, 3]) @ pose[:3, :3])
        picture = load_thumbnail(pictures[name], max(depth.shape))
        at = (rows * picture.shape[0] // depth.shape[0], columns * picture.shape[1] // depth.shape[1])
        colors.append(picture[at][known])
    return np.concatenate(positions), np.concatenate(colors)
