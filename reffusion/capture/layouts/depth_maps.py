"""Makes points from depth maps of a capture's views, for captures without sparse points."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from reffusion.capture.layouts.capture import NO_POINTS, PointCloud
from reffusion.capture.lens import Lens, to_directions
from reffusion.io.depth_maps import load_depth
from reffusion.io.images import load_thumbnail

FRAMES = 16  # largest number of depth maps that are read, spread evenly over the views
POINTS = 10_000  # points for which the grid is chosen; rounding its spacing gives up to about four times as many


def points_from_depth(
    depths: Mapping[str, Path],
    scale: float,
    pictures: Mapping[str, Path],
    lenses: Mapping[str, Lens],
    world_to_camera: Mapping[str, np.ndarray],
) -> PointCloud:
    """Unproject a grid of pixels of up to `FRAMES` depth maps, and color the points by the views' pictures.

    Pixels whose depth is unknown or not positive give no point.

    Args:
        depths: view name -> file of its depth map (camera z, not disparity), at any size. Without files there are no
            points.
        scale: length in the scene's units of the number 1 in a depth map that is a picture of integers. The scale does
            not apply to .npy and .exr, which are in the scene's units.
        pictures: view name -> picture file.
        lenses: view name -> lens, at any size.
        world_to_camera: view name -> pose [4, 4].

    Returns:
        Positions [P, 3] in the scene's frame and colors uint8 [P, 3].
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
