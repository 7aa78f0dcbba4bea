"""Averaged surface normals from depth maps. They distinguish a tree's bark from ground of the same color."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from reffusion import geometry
from reffusion.morphology import to_pixels
from reffusion.types import Camera

ARM = 0.01  # of the image's width: half the distance of the points between which slope is measured, at least a pixel
AVERAGE = 0.02  # of the image's width: radius of the window over which normals are averaged
MIN_KNOWN = 0.3  # share of the window around each of the points of a slope whose depth must be known


def mean_normals(depth: np.ndarray, known: np.ndarray, camera: Camera) -> np.ndarray:
    """Return [H, W, 3] float32, the mean of the unit normals around each pixel, in world coordinates.

    Normals point towards the camera. Their mean is shorter than 1 where they differ, as in leaves. A pixel around which
    too little depth is known takes the normal of the nearest pixel that has one. If no pixel has one, the result is
    zero everywhere.

    Args:
        depth: [H, W], camera z.
        known: bool [H, W], the pixels whose depth is used.
        camera: the view.
    """
    step = to_pixels(ARM, depth.shape[1]) + 1
    window = (2 * step - 1,) * 2
    points = geometry.unproject(cv2.medianBlur(depth.astype(np.float32), 5), camera)
    share = cv2.blur(known.astype(np.float64), window)
    means = cv2.blur(np.where(known[..., None], points, 0.0), window) / np.maximum(share, 1e-9)[..., None]
    has_normal, (down, right) = np.zeros_like(known), np.zeros((2, *points.shape))
    inner = (slice(step, -step),) * 2
    shift = lambda a, rows, columns: np.roll(a, (-rows, -columns), (0, 1))[inner]
    down[inner] = shift(means, step, 0) - shift(means, -step, 0)
    right[inner] = shift(means, 0, step) - shift(means, 0, -step)
    sides = ((step, 0), (-step, 0), (0, step), (0, -step))
    has_normal[inner] = np.all([shift(share, *side) > MIN_KNOWN for side in sides], axis=0)
    if not has_normal.any():
        return np.zeros(points.shape, np.float32)
    normal = np.cross(right, down)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    rays = geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3]
    normal *= -np.sign((normal * rays).sum(-1, keepdims=True))
    nearest = ndimage.distance_transform_edt(~has_normal, return_distances=False, return_indices=True)
    average = (2 * to_pixels(AVERAGE, depth.shape[1]) + 1,) * 2
    return cv2.blur(normal[tuple(nearest)].astype(np.float32), average)
