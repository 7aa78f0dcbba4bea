"""Relative brightness of the photographs, estimated from the points they share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from reffusion.capture.image_detail import sample_visible
from reffusion.types import Camera

MAX_POINTS = 5000  # at which photographs are compared
BLUR = 0.004  # of the width: sigma of the blur before colours are sampled
DARK, BRIGHT = 8, 247  # levels of 255: colours outside are too dark, or clipped
REWEIGHTINGS = 10  # of reweighting
ERROR_SCALE = 0.1  # log difference above which a point gets a lower weight: it is occluded, or specular
PRIOR_WEIGHT = 1e-3  # weight, in points, that pulls a view towards the mean where it shares no points


def estimate_gains(points: np.ndarray, cameras: Sequence[Camera], photos: Mapping[str, np.ndarray]) -> np.ndarray:
    """[V, 3]: brightness of each view's red, green and blue relative to the geometric mean of all views.

    Robust least squares on log colours, with one unknown per view and one per point. 1 where a view shares no points.

    Args:
        points: [P, 3] on the scene's surfaces.
        photos: view name -> uint8 [H, W, 3].
    """
    points = points[:: max(1, -(-len(points) // MAX_POINTS))]
    result = np.ones((len(cameras), 3))
    if not len(points):
        return result
    sampled = np.stack([sample_visible(camera, points, _blur(photos[camera.name])) for camera in cameras])  # [V, P, 3]
    usable = np.all(sampled > DARK, -1) & np.all(sampled < BRIGHT, -1)  # NaN fails both
    for channel in range(3):
        result[:, channel] = np.exp(_view_offsets(np.log(np.where(usable, sampled[..., channel], 1.0)), usable))
    return result


def brightness_deviation(gains: np.ndarray) -> float:
    """Standard deviation of the views' log brightness, from their gains [V, 3]."""
    return float(np.log(gains).mean(1).std()) if len(gains) else 0.0


def _blur(photo: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(photo.astype(np.float32), (0, 0), max(0.5, BLUR * photo.shape[1]))


def _view_offsets(values: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """[V], zero on average: the views' part of log colours [V, P], read where `usable`, bool [V, P].

    The model is value = offset of the view + colour of the point.
    """
    offsets, weight = np.zeros(len(values)), usable.astype(np.float64)
    for _ in range(REWEIGHTINGS):
        total = np.maximum(weight.sum(0), 1e-12)
        centered = values - (weight * values).sum(0) / total
        # The unknowns of the points are eliminated, which leaves a system of the size of the views.
        system = np.diag(weight.sum(1) + PRIOR_WEIGHT) - (weight / total) @ weight.T
        offsets = np.linalg.solve(system, (weight * centered).sum(1))
        residual = values - offsets[:, None]
        residual -= (weight * residual).sum(0) / total
        weight = usable / np.maximum(np.abs(residual) / ERROR_SCALE, 1.0)
    return offsets - offsets.mean()
