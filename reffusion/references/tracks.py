"""Sparse optical flow between a photograph and a picture of the same view, and the affine map that explains most of it.

Both are low-passed first, so that texture redrawn by an autoencoder does not count; structure stays where it was.
Pictures are float32 [H, W], grey, in levels of 255. An affine map [2, 3] takes a pixel of the photograph
(docs/architecture.md#conventions) to the pixel that shows the same in the picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

LOW_PASS = 0.004  # of the longer side: standard deviation of the blur, 2 px of 512, a quarter of the resolution
LEAST_LOW_PASS = 1.0  # px: smallest standard deviation of the blur
TEXTURE = 0.5  # levels of 255 per px: smallest gradient, in every direction, of a point that can be located
SPACING = 0.014  # of the longer side: distance between points
WINDOW = 0.041  # of the longer side: window of the flow around a point
PYRAMID_LEVELS = 3  # of the pyramid, beside the full size
ROUND_TRIP = 1.0  # px: largest distance from the start of a point tracked forward and back
INLIER = 1.0  # px: largest residual of an inlier of the affine map
LEAST_PAIRS = 12  # needed to estimate an affine map


@dataclass(frozen=True)
class Tracks:
    """Points of a photograph and where a picture shows them.

    Attributes:
        points: [N, 2] px in the photograph.
        displacements: [N, 2] px, from there to where the picture shows the same; meaningless where not `tracked`.
        tracked: bool [N], forward and backward flow agree.
    """

    points: np.ndarray
    displacements: np.ndarray
    tracked: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """[N] px, length of the displacements; infinite where a point was lost."""
        return np.where(self.tracked, np.linalg.norm(self.displacements, axis=1), np.inf)

    def affine(self) -> np.ndarray | None:
        """[2, 3], the affine map that explains most displacements; None where too few points are tracked."""
        if self.tracked.sum() < LEAST_PAIRS:
            return None
        source = self.points[self.tracked]
        return estimate_affine(source, source + self.displacements[self.tracked], INLIER)


def estimate_affine(source: np.ndarray, target: np.ndarray, inlier: float) -> np.ndarray | None:
    """[2, 3], an affine map by RANSAC and least squares over its inliers.

    Args:
        source, target: [N, 2] px, corresponding points.
        inlier: px, largest residual of an inlier.

    Returns:
        None where fewer than `LEAST_PAIRS` points agree on a map.
    """
    cv2.setRNGSeed(0)
    found, agree = cv2.estimateAffine2D(source, target, ransacReprojThreshold=inlier)
    return found if found is not None and agree.sum() >= LEAST_PAIRS and np.isfinite(found).all() else None


def low_pass(grey: np.ndarray) -> np.ndarray:
    """float32 [H, W], the picture without what is finer than a quarter of its resolution; the size stays."""
    sigma = max(LOW_PASS * max(grey.shape), LEAST_LOW_PASS)
    return cv2.GaussianBlur(grey.astype(np.float32), (0, 0), sigma)


def find_points(grey: np.ndarray, known: np.ndarray) -> np.ndarray:
    """[N, 2] px: corners and blobs among the known pixels of a low-passed picture, spread over it."""
    textured = known & (_least_gradient(grey) > TEXTURE)
    if not textured.any():
        return np.zeros((0, 2))
    apart, block = max(2.0, SPACING * max(grey.shape)), _odd(WINDOW * max(grey.shape) / 2)
    found = cv2.goodFeaturesToTrack(grey, 0, 1e-4, apart, mask=textured.astype(np.uint8), blockSize=block)
    return np.zeros((0, 2)) if found is None else found[:, 0].astype(np.float64) + 0.5


def track(photo: np.ndarray, picture: np.ndarray, points: np.ndarray) -> Tracks:
    """Track points of the photograph to the picture by pyramidal Lucas-Kanade; both are low-passed."""
    low, high = np.percentile(photo, (1, 99))
    stretch = lambda image: np.clip((image - low) * (255 / max(high - low, 16)), 0, 255).round().astype(np.uint8)
    side = _odd(WINDOW * max(photo.shape))
    how = {"winSize": (side, side), "maxLevel": PYRAMID_LEVELS, "criteria": (3, 30, 0.01)}
    if not len(points):
        return Tracks(points, np.zeros((0, 2)), np.zeros(0, bool))
    first, second, start = stretch(photo), stretch(picture), (points - 0.5).astype(np.float32)[:, None]
    forward, found, _ = cv2.calcOpticalFlowPyrLK(first, second, start, None, **how)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, forward, None, **how)
    returned_px = np.linalg.norm((back - start)[:, 0], axis=1)
    tracked = (found[:, 0] > 0) & (returned[:, 0] > 0) & (returned_px < ROUND_TRIP)
    return Tracks(points, (forward - start)[:, 0].astype(np.float64), tracked)


def _least_gradient(grey: np.ndarray) -> np.ndarray:
    """[H, W] levels of 255 per px: root mean square gradient in a window, along the direction of least gradient."""
    side = _odd(WINDOW * max(grey.shape) / 2)
    across, down = (cv2.Sobel(grey, cv2.CV_32F, *order, scale=0.125) for order in ((1, 0), (0, 1)))
    xx, xy, yy = (cv2.blur(each, (side, side)) for each in (across * across, across * down, down * down))
    least = (xx + yy - np.sqrt((xx - yy) ** 2 + 4 * xy**2)) / 2
    return np.sqrt(np.maximum(least, 0))


def _odd(pixels: float) -> int:
    return max(5, round(pixels)) | 1
