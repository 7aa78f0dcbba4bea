"""Colours of a reference: matched to its photograph's, and the hole pasted into the photograph."""

from __future__ import annotations

import cv2
import numpy as np

from reffusion.io.images import to_uint8

VISIBLE_CHANGE = 1.0  # levels of 255: smaller changes of colour are ignored
SAMPLES = 5000  # pixels that are compared
LEAST_PIXELS = 100  # pixels that determine a gain
LEAST_GAIN, MOST_GAIN = 0.5, 2.0  # beyond these bounds the pictures have nothing in common


def match_colors(picture: np.ndarray, photo: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain and offset [3] per channel, colours in [0, 1]: photo = gain * picture + offset, by a robust fit over known
    pixels.

    1 and 0 where they would hardly change a colour, or where no line fits.
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
    """uint8 [H, W, 3], the picture in the colours of the photograph."""
    return to_uint8(picture / 255.0 * gain + offset)


def paste(
    picture: np.ndarray, photo: np.ndarray, hole: np.ndarray, inside: np.ndarray, margin: float, rim: float
) -> np.ndarray:
    """Paste the hole of the picture into the photograph, uint8 [H, W, 3].

    Args:
        picture: aligned with the photograph, in its colours.
        hole: bool [H, W]. inside: bool [H, W], pixels that the picture covers.
        margin: px around the hole that are taken from the picture too; rim: px beyond, over which both are blended.
    """
    away = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5) if hole.any() else np.full(hole.shape, 1e9)
    share = np.clip(1 - (away - margin) / max(rim, 1e-6), 0, 1) * inside
    mixed = share[..., None] * picture + (1 - share[..., None]) * photo
    return np.round(mixed).astype(np.uint8)


def _samples(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """[N, 3] colours in [0, 1] of known pixels, low-passed, evenly chosen."""
    rows, columns = np.nonzero(known)
    every = max(1, len(rows) // SAMPLES)
    soft = cv2.GaussianBlur(image, (0, 0), 1.5)
    return soft[rows[::every], columns[::every]].astype(np.float64) / 255


def _robust_line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Gain and offset of y ~ gain * x + offset, by reweighted least squares; gain 1 where x hardly varies."""
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
        gain = float(np.average(dx * (y - mean_y), weights=weight) / variance) if variance > 1e-4 else 1.0
        offset = float(mean_y - gain * mean_x)
    return gain, offset
