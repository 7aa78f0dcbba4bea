"""LDR-FLIP (Andersson et al., 2020): the difference that an eye sees that flips between two pictures.

The package flip-evaluator computes the same in 0.4 s for 512 x 512 px; here its Gaussians are run as rows and columns
by OpenCV, in a tenth of that. The tests hold one to the other.
"""

from __future__ import annotations

import functools
from math import ceil, pi, sqrt

import cv2
import numpy as np

PIXELS_PER_DEGREE = 67.0  # FLIP's own default: 0.7 m away from a 0.7 m wide 4K display
# The eye's contrast sensitivity: (weight, width in degrees^2) of the Gaussians of Y, Cx and Cz.
SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
EDGE_WIDTH = 0.082  # degrees, of what counts as an edge or a point
COLOR_POWER, FEATURE_POWER = 0.7, 0.5
KNEE = (0.4, 0.95)  # colour differences up to this share of the largest take this share of the range

TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)  # of linear sRGB
WHITE = TO_XYZ.sum(1)


def difference(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """[H, W] float32 in [0, 1], FLIP at each pixel of two [H, W, 3] sRGB pictures in [0, 1]."""
    pictures = [_opponent(np.asarray(picture, np.float32)) for picture in (truth, image)]
    labs = [_hunt(_lab(_filtered(picture))) for picture in pictures]
    color = _redistributed(_hyab(*labs) ** COLOR_POWER)
    features = [_features((picture[..., 0] + 16) / 116) for picture in pictures]
    apart = np.maximum(*(np.abs(first - second) for first, second in zip(*features, strict=True)))
    return color ** (1 - (apart / np.float32(sqrt(2))) ** FEATURE_POWER)


def _opponent(picture: np.ndarray) -> np.ndarray:
    """YCxCz of sRGB."""
    linear = np.where(picture <= 0.04045, picture / 12.92, ((picture + 0.055) / 1.055) ** 2.4).astype(np.float32)
    x, y, z = np.moveaxis(_multiplied(linear, TO_XYZ / WHITE[:, None]), 2, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], 2)


def _multiplied(picture: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    return picture @ matrix.T.astype(np.float32)


def _filtered(picture: np.ndarray) -> np.ndarray:
    """Linear sRGB in [0, 1], of YCxCz as far as the eye resolves it."""
    y, cx, cz = (_blurred(np.ascontiguousarray(picture[..., k]), SENSITIVITY[k]) for k in range(3))
    y = (y + 16) / 116
    relative = np.stack([y + cx / 500, y, y - cz / 200], 2)
    return _multiplied(relative, np.linalg.inv(TO_XYZ) * WHITE).clip(0, 1)


def _blurred(channel: np.ndarray, gaussians: tuple[tuple[float, float], ...]) -> np.ndarray:
    """A channel under a sum of Gaussians, each of which is a product of one along rows and one along columns."""
    parts = [(weight * sqrt(pi / width), _gaussian(width)) for weight, width in gaussians]
    total = sum(weight * kernel.sum() ** 2 for weight, kernel in parts)
    run = lambda kernel: cv2.sepFilter2D(channel, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
    return sum(np.float32(weight * kernel.sum() ** 2 / total) * run(kernel / kernel.sum()) for weight, kernel in parts)


def _gaussian(width: float) -> np.ndarray:
    """exp(-pi^2 x^2 / width), x in degrees, as far out as the widest Gaussian is looked at."""
    widest = max(each for channel in SENSITIVITY for _, each in channel)
    radius = ceil(3 * sqrt(widest / (2 * pi**2)) * PIXELS_PER_DEGREE)
    return np.exp(-((pi * np.arange(-radius, radius + 1) / PIXELS_PER_DEGREE) ** 2) / width)


def _lab(linear: np.ndarray) -> np.ndarray:
    relative, edge = _multiplied(linear, TO_XYZ / WHITE[:, None]), 6 / 29
    bent = np.where(relative > edge**3, np.cbrt(relative), relative / (3 * edge**2) + 4 / 29).astype(np.float32)
    x, y, z = np.moveaxis(bent, 2, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], 2)


def _hunt(lab: np.ndarray) -> np.ndarray:
    """Less colour is seen where it is dark."""
    return lab * np.concatenate([np.ones_like(lab[..., :1]), 0.01 * lab[..., :1], 0.01 * lab[..., :1]], 2)


def _hyab(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    apart = first - second
    return np.abs(apart[..., 0]) + np.hypot(apart[..., 1], apart[..., 2])


@functools.cache
def _largest() -> float:
    """The colour difference of green and blue."""
    green, blue = (_hunt(_lab(np.array([[color]], np.float32))) for color in ((0, 1, 0), (0, 0, 1)))
    return float(_hyab(green, blue)[0, 0] ** COLOR_POWER)


def _redistributed(error: np.ndarray) -> np.ndarray:
    largest, (knee, share) = _largest(), KNEE
    below = error * (share / (knee * largest))
    above = share + (error - knee * largest) / ((1 - knee) * largest) * (1 - share)
    return np.where(error < knee * largest, below, above)


def _features(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How much of an edge, and of a point, there is at each pixel of Y in [0, 1]."""
    sigma = 0.5 * EDGE_WIDTH * PIXELS_PER_DEGREE
    x = np.arange(-ceil(3 * sigma), ceil(3 * sigma) + 1)
    along = np.exp(-(x**2) / (2 * sigma**2))
    found = []
    for kernel in (-x * along, (x**2 / sigma**2 - 1) * along):
        # Positive weights add up to 1, negative ones to -1.
        even = np.where(kernel > 0, kernel / kernel.clip(0).sum(), kernel / -kernel.clip(None, 0).sum())
        blur, pairs = along / along.sum(), ((even, 0), (even, 1))
        run = lambda row, column: cv2.sepFilter2D(y, cv2.CV_32F, row, column, borderType=cv2.BORDER_REPLICATE)
        found.append(np.hypot(*(run(blur, each) if turned else run(each, blur) for each, turned in pairs)))
    return found[0], found[1]
