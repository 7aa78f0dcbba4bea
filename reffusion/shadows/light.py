"""The light of a shadow: how much brighter a picture is without the shadow, and relit photographs."""

from __future__ import annotations

import cv2
import numpy as np

from reffusion import morphology

BLUR = 0.008  # of the image's width: standard deviation of the blur with which brightness is compared, against noise
DARK_OFFSET = 8  # of 255, added to both pictures, because the ratios of dark pixels are unreliable


def measure_log_gain(reference: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Return float32 [H, W, 3], the natural logarithm of the completed view's brightness divided by the photograph's.

    Each color channel has its own ratio. The pictures are blurred first.

    Args:
        reference: [H, W, 3] uint8, the completed view.
        view: [H, W, 3] uint8, the photograph in the same exposure.
    """
    sigma = morphology.to_pixels(BLUR, view.shape[1])
    blur = lambda image: cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma) + DARK_OFFSET
    return np.log(blur(reference) / blur(view))


def relight(photo: np.ndarray, log_gain: np.ndarray) -> np.ndarray:
    """Return the photograph, uint8 [H, W, 3], with its brightness multiplied by exp(`log_gain`).

    Args:
        photo: uint8 [H, W, 3].
        log_gain: [H, W, 3], positive where the photograph becomes brighter. Where it is NaN, the photograph stays.
    """
    known = np.isfinite(log_gain)
    lit = (photo.astype(np.float32) + DARK_OFFSET) * np.exp(np.where(known, log_gain, 0)) - DARK_OFFSET
    return np.where(known, np.round(lit).clip(0, 255), photo).astype(np.uint8)
