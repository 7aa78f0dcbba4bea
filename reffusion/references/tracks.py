"""Sparse optical flow between a photograph and a picture of the same view, and the affine map that explains most of it.

Both are low-passed first, because an autoencoder that redrew the picture changes fine texture; coarser structure stays
in place. Pictures are gray, float32 [H, W], in levels of 255. An affine map [2, 3] takes a pixel of the photograph to
the pixel of the picture that shows the same point (docs/architecture.md#conventions).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

LOW_PASS = 0.004  # of the longer side: standard deviation of the blur; 2 px for 512 px, a quarter of the resolution
LEAST_LOW_PASS = 1.0  # px: smallest standard deviation of the blur
TEXTURE = 0.5  # levels of 255 per px: smallest gradient, in every direction, of a point that can be located
SPACING = 0.014  # of the longer side: smallest distance between points
WINDOW = 0.041  # of the longer side: side of the window around a point in which flow is computed
PYRAMID_LEVELS = 3  # levels of the image pyramid besides the full size
ROUND_TRIP = 1.0  # px: a point that is tracked forward and back must return to within this distance of its start
INLIER = 1.0  # px: largest residual of an inlier of the affine map
LEAST_PAIRS = 12  # needed to estimate an affine map


@dataclass(frozen=True)
class Tracks:
    """Points of a photograph, and their displacements in a picture.

    Attributes:
        points: [N, 2], px (x, y) in the photograph.
        displacements: [N, 2] px, position in the picture minus position in the photograph; meaningless where `tracked`
            is False.
        tracked: bool [N], True where forward and backward flow agree.
    """

    points: np.ndarray
    displacements: np.ndarray
    tracked: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """[N] px, the lengths of the displacements; infinite where a point is not tracked."""
        return np.where(self.tracked, np.linalg.norm(self.displacements, axis=1), np.inf)

    def affine(self) -> np.ndarray | None:
        """Return [2, 3], the affine map that explains most displacements.

        None if fewer than `LEAST_PAIRS` points are tracked or agree on a map.
        """
        if self.tracked.sum() < LEAST_PAIRS:
            return None
        source = self.points[self.tracked]
        return estimate_affine(source, source + self.displacements[self.tracked], INLIER)


def estimate_affine(source: np.ndarray, target: np.ndarray, inlier: float) -> np.ndarray | None:
    """Estimate the affine map from source to target points by RANSAC, then least squares over the inliers.

    Args:
        source, target: [N, 2] px, corresponding points.
        inlier: px, the largest residual of an inlier.

    Returns:
        The map, [2, 3]; None if fewer than `LEAST_PAIRS` points agree on a map.
    """
    cv2.setRNGSeed(0)
    found, agree = cv2.estimateAffine2D(source, target, ransacReprojThreshold=inlier)
    return found if found is not None and agree.sum() >= LEAST_PAIRS and np.isfinite(found).all() else None


def low_pass(gray: np.ndarray) -> np.ndarray:
    """Return the picture, float32 [H, W], blurred by a Gaussian.

    The standard deviation is `LOW_PASS` times the longer side of the picture, at least `LEAST_LOW_PASS` px.
    """
    sigma = max(LOW_PASS * max(gray.shape), LEAST_LOW_PASS)
    return cv2.GaussianBlur(gray.astype(np.float32), (0, 0), sigma)


def find_points(gray: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return [N, 2], px (x, y), points of a low-passed picture with texture in every direction: corners and blobs.

    The points lie at least `SPACING` apart and so spread over the picture.

    Args:
        gray: float32 [H, W], the low-passed picture.
        known: bool [H, W], the pixels in which points are sought.
    """
    textured = known & (_least_gradient(gray) > TEXTURE)
    if not textured.any():
        return np.zeros((0, 2))
    apart, block = max(2.0, SPACING * max(gray.shape)), _odd(WINDOW * max(gray.shape) / 2)
    found = cv2.goodFeaturesToTrack(gray, 0, 1e-4, apart, mask=textured.astype(np.uint8), blockSize=block)
    return np.zeros((0, 2)) if found is None else found[:, 0].astype(np.float64) + 0.5


def track(photo: np.ndarray, picture: np.ndarray, points: np.ndarray) -> Tracks:
    """Track points of the photograph into the picture by pyramidal Lucas-Kanade.

    Args:
        photo, picture: float32 [H, W], both low-passed.
        points: [N, 2], px (x, y) in the photograph.
    """
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


def _least_gradient(gray: np.ndarray) -> np.ndarray:
    """Return [H, W], the gradient along the direction in which it is least, in levels of 255 per px."""
    side = _odd(WINDOW * max(gray.shape) / 2)
    # The gradient is the root mean square of the directional derivative in a window around each pixel. OpenCV's
    # derivative of a float picture is twice the gradient.
    return np.sqrt(np.maximum(cv2.cornerMinEigenVal(gray, side), 0)) / 2


def _odd(pixels: float) -> int:
    """Return the length, rounded to an odd number of pixels, at least 5."""
    return max(5, round(pixels)) | 1
