"""Relative brightness of the photographs (their *gains*), estimated from the points that several of them show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from reffusion.capture.image_detail import sample_visible
from reffusion.types import Camera

MAX_POINTS = 5000  # maximum number of points at which photographs are compared
BLUR = 0.004  # share of the image's width: standard deviation of the blur before colors are sampled
DARK, BRIGHT = 8, 247  # levels of 255: colors outside are too dark, or clipped
REWEIGHTINGS = 10  # iterations of reweighted least squares
ERROR_SCALE = 0.1  # residual of a log color above which it gets a lower weight: the point is occluded, or specular
PRIOR_WEIGHT = 1e-3  # pull of a view towards the mean, in points; it decides only for a view that shares no points


def estimate_gains(points: np.ndarray, cameras: Sequence[Camera], photos: Mapping[str, np.ndarray]) -> np.ndarray:
    """Estimate the brightness of each view's red, green and blue relative to the geometric mean of all views.

    Brightness is measured in sRGB values, which are not linearized. The estimate is a robust least-squares fit to the
    logarithms of colors, with one unknown per view (its brightness) and one per point (its color). Colors that are
    too dark or clipped are left out.

    Args:
        points: [P, 3] points on the scene's surfaces.
        cameras: the V views.
        photos: view name -> uint8 [H, W, 3].

    Returns:
        [V, 3] positive gains, in the order of `cameras`; 1 for a view that shares no points with another one, and for
        all views if P = 0.
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
    """Return the standard deviation over the views of their log brightness, from gains [V, 3]; 0 without views.

    The log brightness of a view is the mean of the natural logarithms of its three gains.
    """
    return float(np.log(gains).mean(1).std()) if len(gains) else 0.0


def _blur(photo: np.ndarray) -> np.ndarray:
    """Return a photograph [H, W, 3] blurred by `BLUR` of its width, float32 in [0, 255]."""
    return cv2.GaussianBlur(photo.astype(np.float32), (0, 0), max(0.5, BLUR * photo.shape[1]))


def _view_offsets(values: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Split log colors [V, P] into an offset per view and a color per point; return the offsets [V], of mean 0."""
    offsets, weight = np.zeros(len(values)), usable.astype(np.float64)
    # Values that are not `usable` [V, P] are ignored.
    for _ in range(REWEIGHTINGS):
        total = np.maximum(weight.sum(0), 1e-12)
        centered = values - (weight * values).sum(0) / total
        # The unknown colors of the points are eliminated, which leaves a linear system in the V offsets.
        system = np.diag(weight.sum(1) + PRIOR_WEIGHT) - (weight / total) @ weight.T
        offsets = np.linalg.solve(system, (weight * centered).sum(1))
        residual = values - offsets[:, None]
        residual -= (weight * residual).sum(0) / total
        weight = usable / np.maximum(np.abs(residual) / ERROR_SCALE, 1.0)
    return offsets - offsets.mean()
