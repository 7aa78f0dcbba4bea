"""How surfaces lie in space: what tells a tree's bark from the ground of its colour."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from reffusion import geometry
from reffusion.morphology import to_pixels
from reffusion.types import Camera

ARM = 0.01  # of the image's width: between points of half this distance and more a slope is measured
EVEN = 0.02  # of it: over so much around slopes are averaged; where they differ the mean is short
TOLD = 0.3  # share of a window that must be known


def slopes(depth: np.ndarray, known: np.ndarray, camera: Camera) -> np.ndarray:
    """[H, W, 3] float32: the mean normal around each pixel, towards the camera, in the world; short where normals
    differ, as in leaves. That of the nearest known pixel where it is not `known`, bool [H, W]."""
    step = to_pixels(ARM, depth.shape[1]) + 1
    window = (2 * step - 1,) * 2
    points = geometry.unproject(cv2.medianBlur(depth.astype(np.float32), 5), camera)
    share = cv2.blur(known.astype(np.float64), window)
    middles = cv2.blur(np.where(known[..., None], points, 0.0), window) / np.maximum(share, 1e-9)[..., None]
    told, (down, along) = np.zeros_like(known), np.zeros((2, *points.shape))
    inner = (slice(step, -step),) * 2
    shifted = lambda a, rows, columns: np.roll(a, (-rows, -columns), (0, 1))[inner]
    down[inner] = shifted(middles, step, 0) - shifted(middles, -step, 0)
    along[inner] = shifted(middles, 0, step) - shifted(middles, 0, -step)
    sides = ((step, 0), (-step, 0), (0, step), (0, -step))
    told[inner] = np.all([shifted(share, *side) > TOLD for side in sides], axis=0)
    if not told.any():
        return np.zeros(points.shape, np.float32)
    normal = np.cross(along, down)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    rays = geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3]
    normal *= -np.sign((normal * rays).sum(-1, keepdims=True))
    nearest = ndimage.distance_transform_edt(~told, return_distances=False, return_indices=True)
    around = (2 * to_pixels(EVEN, depth.shape[1]) + 1,) * 2
    return cv2.blur(normal[tuple(nearest)].astype(np.float32), around)
