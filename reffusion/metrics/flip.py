"""LDR-FLIP (Andersson et al., 2020): the difference that a viewer perceives when alternating between two images.

The package flip-evaluator takes 0.4 s for 512 x 512 px. This implementation runs the Gaussian filters of FLIP as
separable filters in OpenCV and takes a tenth of this time. The tests compare both implementations.
"""

from __future__ import annotations

import functools
from math import ceil, pi, sqrt

import cv2
import numpy as np

PIXELS_PER_DEGREE = 67.0  # FLIP's own default: 0.7 m away from a 0.7 m wide 4K display
# Contrast sensitivity of the eye: (weight, width in degrees^2) of each Gaussian, for the channels Y, Cx and Cz.
SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
EDGE_WIDTH = 0.082  # degrees, width of the edges and points that are detected
COLOR_POWER, FEATURE_POWER = 0.7, 0.5  # exponents q_c and q_f of the paper
# (p_c, p_t) of the paper: color differences up to the share p_c of the largest one are mapped to [0, p_t].
KNEE = (0.4, 0.95)

TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)  # from linear sRGB
WHITE = TO_XYZ.sum(1)


def flip_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the FLIP error at each pixel, float32 [H, W] in [0, 1]; 0 = no visible difference.

    Args:
        image, truth: sRGB images of one size, [H, W, 3] in [0, 1].
    """
    pictures = [_srgb_to_ycxcz(np.asarray(picture, np.float32)) for picture in (truth, image)]
    labs = [_apply_hunt_effect(_linear_to_lab(_filter_contrast(picture))) for picture in pictures]
    color = _redistribute(_hyab_distance(*labs) ** COLOR_POWER)
    features = [_edge_and_point_features((picture[..., 0] + 16) / 116) for picture in pictures]
    apart = np.maximum(*(np.abs(first - second) for first, second in zip(*features, strict=True)))
    return color ** (1 - (apart / np.float32(sqrt(2))) ** FEATURE_POWER)


def _srgb_to_ycxcz(picture: np.ndarray) -> np.ndarray:
    """Convert sRGB [H, W, 3] in [0, 1] to the opponent colors YCxCz, float32 [H, W, 3]."""
    linear = np.where(picture <= 0.04045, picture / 12.92, ((picture + 0.055) / 1.055) ** 2.4).astype(np.float32)
    x, y, z = np.moveaxis(_apply_matrix(linear, TO_XYZ / WHITE[:, None]), 2, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], 2)


def _apply_matrix(picture: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Multiply each color of a picture [H, W, 3] by a [3, 3] matrix, in float32."""
    return picture @ matrix.T.astype(np.float32)


def _filter_contrast(picture: np.ndarray) -> np.ndarray:
    """Blur a YCxCz image [H, W, 3] by the eye's contrast sensitivity, and convert it to linear sRGB in [0, 1]."""
    y, cx, cz = (_blur_channel(np.ascontiguousarray(picture[..., k]), SENSITIVITY[k]) for k in range(3))
    y = (y + 16) / 116
    relative = np.stack([y + cx / 500, y, y - cz / 200], 2)
    return _apply_matrix(relative, np.linalg.inv(TO_XYZ) * WHITE).clip(0, 1)


def _blur_channel(channel: np.ndarray, gaussians: tuple[tuple[float, float], ...]) -> np.ndarray:
    """Filter a channel [H, W] by a normalized sum of Gaussians, given by (weight, width in degrees^2)."""
    parts = [(weight * sqrt(pi / width), _gaussian_kernel(width)) for weight, width in gaussians]
    total = sum(weight * kernel.sum() ** 2 for weight, kernel in parts)
    # Each Gaussian is separable into rows and columns.
    run = lambda kernel: cv2.sepFilter2D(channel, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
    return sum(np.float32(weight * kernel.sum() ** 2 / total) * run(kernel / kernel.sum()) for weight, kernel in parts)


def _gaussian_kernel(width: float) -> np.ndarray:
    """Sample the 1D kernel exp(-pi^2 x^2 / width) at pixels, x in degrees, width in degrees^2; it is not normalized."""
    widest = max(each for channel in SENSITIVITY for _, each in channel)
    # Three standard deviations of the widest Gaussian in `SENSITIVITY`.
    radius = ceil(3 * sqrt(widest / (2 * pi**2)) * PIXELS_PER_DEGREE)
    return np.exp(-((pi * np.arange(-radius, radius + 1) / PIXELS_PER_DEGREE) ** 2) / width)


def _linear_to_lab(linear: np.ndarray) -> np.ndarray:
    """Convert linear sRGB [H, W, 3] to CIELAB [H, W, 3]."""
    relative, edge = _apply_matrix(linear, TO_XYZ / WHITE[:, None]), 6 / 29
    bent = np.where(relative > edge**3, np.cbrt(relative), relative / (3 * edge**2) + 4 / 29).astype(np.float32)
    x, y, z = np.moveaxis(bent, 2, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], 2)


def _apply_hunt_effect(lab: np.ndarray) -> np.ndarray:
    """Scale the chroma of CIELAB colors [H, W, 3] by the lightness, because the eye sees less color in the dark."""
    return lab * np.concatenate([np.ones_like(lab[..., :1]), 0.01 * lab[..., :1], 0.01 * lab[..., :1]], 2)


def _hyab_distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the HyAB distance [H, W] of CIELAB colors: |lightness difference| + Euclidean distance in chroma."""
    apart = first - second
    return np.abs(apart[..., 0]) + np.hypot(apart[..., 1], apart[..., 2])


@functools.cache
def _max_color_difference() -> float:
    """Return the largest color difference, that between pure green and pure blue, raised to `COLOR_POWER`."""
    green, blue = (
        _apply_hunt_effect(_linear_to_lab(np.array([[color]], np.float32))) for color in ((0, 1, 0), (0, 0, 1))
    )
    return float(_hyab_distance(green, blue)[0, 0] ** COLOR_POWER)


def _redistribute(power: np.ndarray) -> np.ndarray:
    """Map color differences, raised to `COLOR_POWER`, [H, W], to [0, 1] by two lines that meet at `KNEE`.

    The first number of `KNEE` is a share of the largest difference.
    """
    largest, (knee, share) = _max_color_difference(), KNEE
    below = power * (share / (knee * largest))
    above = share + (power - knee * largest) / ((1 - knee) * largest) * (1 - share)
    return np.where(power < knee * largest, below, above)


def _edge_and_point_features(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the strength of edges and the strength of points, [H, W] each, in a luminance Y [H, W] in [0, 1]."""
    sigma = 0.5 * EDGE_WIDTH * PIXELS_PER_DEGREE
    x = np.arange(-ceil(3 * sigma), ceil(3 * sigma) + 1)
    along = np.exp(-(x**2) / (2 * sigma**2))
    strengths = []
    for kernel in (-x * along, (x**2 / sigma**2 - 1) * along):
        # Positive weights sum to 1, negative ones to -1.
        even = np.where(kernel > 0, kernel / kernel.clip(0).sum(), kernel / -kernel.clip(None, 0).sum())
        blur, pairs = along / along.sum(), ((even, 0), (even, 1))
        run = lambda row, column: cv2.sepFilter2D(y, cv2.CV_32F, row, column, borderType=cv2.BORDER_REPLICATE)
        strengths.append(np.hypot(*(run(blur, each) if vertical else run(each, blur) for each, vertical in pairs)))
    return strengths[0], strengths[1]
