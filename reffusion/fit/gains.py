"""How much brighter each photograph is than the others, told by the points that they share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from reffusion.capture.image_detail import sample_visible
from reffusion.types import Camera

POINTS = 5000  # at most, at which photographs are compared
BLUR = 0.004  # of the width: a point is compared by what is so near around it
DARK, BRIGHT = 8, 247  # levels of 255 beyond which a photograph is too dark, or clipped, to tell
ROUNDS = 10  # of reweighting
OFF = 0.1  # log difference from which on a point counts less: it is hidden, or shines
TIE = 1e-3  # weight, in points, that ties a view to the mean where it shares none with the others


def gains(points: np.ndarray, cameras: Sequence[Camera], photos: Mapping[str, np.ndarray]) -> np.ndarray:
    """[V, 3]: by how much each view's red, green and blue are brighter than the views' geometric mean; 1 where nothing
    is known.

    The least squares of log colours, one unknown for each view and one for each point, robust.

    Args:
        points: [P, 3] of the scene's surfaces. photos: view name -> uint8 [H, W, 3].
    """
    points = points[:: max(1, -(-len(points) // POINTS))]
    found = np.ones((len(cameras), 3))
    if not len(points):
        return found
    seen = np.stack([sample_visible(camera, points, _evened(photos[camera.name])) for camera in cameras])  # [V, P, 3]
    told = (seen > DARK).all(-1) & (seen < BRIGHT).all(-1)  # NaN is neither
    for channel in range(3):
        found[:, channel] = np.exp(_offsets(np.log(np.where(told, seen[..., channel], 1.0)), told))
    return found


def uneven(found: np.ndarray) -> float:
    """How much the views' brightness differs: the standard deviation of the log of their gains [V, 3]."""
    return float(np.log(found).mean(1).std()) if len(found) else 0.0


def _evened(photo: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(photo.astype(np.float32), (0, 0), max(0.5, BLUR * photo.shape[1]))


def _offsets(values: np.ndarray, told: np.ndarray) -> np.ndarray:
    """[V], zero on average: what of values [V, P] belongs to the views, where told, bool [V, P]; the rest belongs to
    the points."""
    own, weight = np.zeros(len(values)), told.astype(np.float64)
    for _ in range(ROUNDS):
        total = np.maximum(weight.sum(0), 1e-12)
        left = values - (weight * values).sum(0) / total
        # The points' unknowns are eliminated: what is left of each view's is a system of the size of the views.
        system = np.diag(weight.sum(1) + TIE) - (weight / total) @ weight.T
        own = np.linalg.solve(system, (weight * left).sum(1))
        apart = values - own[:, None]
        apart -= (weight * apart).sum(0) / total
        weight = told / np.maximum(np.abs(apart) / OFF, 1.0)
    return own - own.mean()
