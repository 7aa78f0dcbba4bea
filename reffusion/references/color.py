"""Colors of a reference: they are matched to those of its photograph, and its hole is pasted into the photograph."""

from __future__ import annotations

import cv2
import numpy as np

from reffusion.io.images import to_uint8

VISIBLE_CHANGE = 1.0  # levels of 255: smaller changes of color are ignored
SAMPLES = 5000  # pixels that are compared
LEAST_PIXELS = 100  # pixels that determine a gain
LEAST_GAIN, MOST_GAIN = 0.5, 2.0  # with a gain beyond these bounds the fit is meaningless and ignored


def match_colors(picture: np.ndarray, photo: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the gain and offset that map the colors of a picture to those of its photograph.

    For each channel, photo = gain * picture + offset, with colors in [0, 1], is fitted robustly over known pixels.

    Args:
        picture, photo: uint8 [H, W, 3], aligned with each other.
        known: bool [H, W], the pixels to compare.

    Returns:
        Gain and offset, [3] each. All are 1 and 0 if the fit would hardly change any color, if a gain is not within
        `LEAST_GAIN` and `MOST_GAIN`, or if fewer than `LEAST_PIXELS` pixels are known.
    """
    x, y = (_samples(image, known) for image in (picture, photo))
    gain, offset = np.ones(3), np.zeros(3)
    for channel in range(3):
        gain[channel], offset[channel] = _robust_line(x[:, channel], y[:, channel])
    low, high = np.quantile(x, (0.05, 0.95), axis=0) if len(x) else (np.zeros(3), np.ones(3))
    change = max(np.abs((gain - 1) * at + offset).max() for at in (low, high)) * 255
    sensible = gain.min() > LEAST_GAIN and gain.max() < MOST_GAIN
    return (gain, offset) if sensible and change > VISIBLE_CHANGE else (np.ones(3), np.zeros(3))


def recolor(picture: np.ndarray, gain: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return gain * picture + offset, computed for colors in [0, 1] and clipped there, as uint8 [H, W, 3].

    Args:
        picture: uint8 [H, W, 3].
        gain, offset: [3] each, from `match_colors`.
    """
    return to_uint8(picture / 255.0 * gain + offset)


def paste(
    picture: np.ndarray, photo: np.ndarray, hole: np.ndarray, inside: np.ndarray, margin: float, rim: float
) -> np.ndarray:
    """Return the photograph, uint8 [H, W, 3], with the hole of the picture pasted in where the picture covers it.

    Args:
        picture: uint8 [H, W, 3], aligned with the photograph and matched to its colors.
        photo: uint8 [H, W, 3].
        hole: bool [H, W].
        inside: bool [H, W], the pixels that the picture covers.
        margin: px; pixels this close to the hole are taken from the picture too.
        rim: px, width of the strip beyond the margin in which picture and photograph are blended.
    """
    away = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5) if hole.any() else np.full(hole.shape, 1e9)
    share = np.clip(1 - (away - margin) / max(rim, 1e-6), 0, 1) * inside
    mixed = share[..., None] * picture + (1 - share[..., None]) * photo
    return np.round(mixed).astype(np.uint8)


def _samples(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return [N, 3], low-passed colors in [0, 1] of every k-th known pixel, row by row; N < 2 `SAMPLES`."""
    rows, columns = np.nonzero(known)
    every = max(1, len(rows) // SAMPLES)
    soft = cv2.GaussianBlur(image, (0, 0), 1.5)
    return soft[rows[::every], columns[::every]].astype(np.float64) / 255


def _robust_line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Fit y = gain * x + offset robustly, and return gain and offset: 1 and 0 for fewer than `LEAST_PIXELS` values."""
    if len(x) < LEAST_PIXELS:
        return 1.0, 0.0
    gain, offset = 1.0, float(np.median(y - x))
    for _ in range(20):
        error = y - gain * x - offset
        spread = max(1.4826 * float(np.median(np.abs(error))), 1e-3)
        weight = (1 + (error / (2 * spread)) ** 2) ** -2
        mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
        dx = x - mean_x
        variance = np.average(dx**2, weights=weight)
        # The gain is 1 if x hardly varies.
        gain = float(np.average(dx * (y - mean_y), weights=weight) / variance) if variance > 1e-4 else 1.0
        offset = float(mean_y - gain * mean_x)
    return gain, offset
