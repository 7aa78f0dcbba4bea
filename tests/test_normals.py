"""Averaged normals of depth maps."""

from __future__ import annotations

import cv2
import numpy as np

from reffusion import geometry
from reffusion.inpaint.normals import mean_normals
from reffusion.types import Camera

HEIGHT, WIDTH = 120, 200


def test_slopes_are_those_of_the_ground_and_short_among_leaves():
    tilt, pose = np.deg2rad(60.0), np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, -np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), -np.cos(tilt)]]
    pose[:3, 3] = -pose[:3, :3] @ np.array([0.0, 0.0, 1.0])
    view = Camera("a", WIDTH, HEIGHT, 150.0, 150.0, WIDTH / 2, HEIGHT / 2, pose)
    rays = geometry.pixel_rays(view) @ pose[:3, :3]
    depth = np.where(rays[..., 2] < -0.05, 1.0 / np.maximum(-rays[..., 2], 0.05), 0.0)
    known = (depth > 0) & (depth < 3)
    found = mean_normals(depth, known, view)
    middle = found[HEIGHT // 2 : -20, 40:-40].reshape(-1, 3)
    assert np.abs(middle - (0, 0, 1)).max() < 0.02
    rough = 1 + 2 * cv2.GaussianBlur(np.random.default_rng(0).normal(0, 1, depth.shape), (0, 0), 3)
    leaves = mean_normals(depth * rough, known, view)[HEIGHT // 2 : -20, 40:-40]
    assert np.linalg.norm(leaves, axis=-1).mean() < 0.8
    assert (mean_normals(depth, np.zeros_like(known), view) == 0).all()
