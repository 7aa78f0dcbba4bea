"""The pixels that a completed view changes, and how much a redrawn picture differs where it changes nothing."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from reffusion import morphology

# Repainted pixels are found after a blur with a standard deviation of FINE_BLUR of the image's width. A difference of
# more than CHANGED levels of 255 means that a pixel was repainted.
FINE_BLUR, CHANGED = 0.003, 8
REDRAWN_QUANTILE = 0.99  # quantile of the differences between picture and photograph in `redrawn_difference`
ISLAND, NOTCH = 0.015, 0.01  # of the image's width: smaller islands are removed; notches up to twice as wide are closed


def redrawn_difference(reference: np.ndarray, photo: np.ndarray, known: np.ndarray) -> float:
    """Return how much a picture differs from its photograph where both show the same, in levels of 255.

    The difference of a pixel is that of the color channel that differs most, after a slight blur. If an autoencoder
    redrew the picture, its texture differs from that of the photograph everywhere. The result is a high quantile
    (`REDRAWN_QUANTILE`) of these differences, so smaller differences do not mean that a pixel was repainted.

    Args:
        reference, photo: [H, W, 3] uint8.
        known: bool [H, W], True at pixels without the object. If none is True, the result is 0.
    """
    return float(np.quantile(_fine_difference(reference, photo)[known], REDRAWN_QUANTILE)) if known.any() else 0.0


def changed_pixels(reference: np.ndarray, photo: np.ndarray, within: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """Return bool [H, W], the pixels where a completed view shows something else than its photograph.

    Small islands are removed, and holes and notches are filled.

    Args:
        reference: [H, W, 3] uint8, the completed view.
        photo: [H, W, 3] uint8, its photograph.
        within: bool [H, W], the pixels to compare. All others are False in the result, unless changed pixels enclose
            them: such a hole is filled.
        noise: the result of `redrawn_difference`. Differences up to this many levels of 255 do not count, nor do
            differences up to `CHANGED` levels.
    """
    differs = within & (_fine_difference(reference, photo) > max(CHANGED, noise))
    # Some of the repainted pixels may look like the photograph, so holes and notches are closed.
    kept = morphology.remove_small_parts(differs, ISLAND * within.shape[1], 0)
    closed = ~morphology.dilate(~morphology.dilate(kept, NOTCH), NOTCH)
    return ndimage.binary_fill_holes(closed & within)


def _fine_difference(reference: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Return [H, W] in levels of 255, the difference of two blurred pictures in the channel that differs most."""
    sigma = morphology.to_pixels(FINE_BLUR, photo.shape[1])
    blur = lambda image: cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma)
    return np.abs(blur(reference) - blur(photo)).max(-1)
