"""Detect cast shadows, which masks do not cover: there a reference and its photograph differ beside the object."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy import ndimage

from reffusion import geometry, morphology
from reffusion.background.visibility import FREE, DepthView
from reffusion.types import Camera

BLUR = 0.008  # of the image's width: standard deviation at which brightness is compared, so that noise does not count
DARK_OFFSET = 8  # of 255, added to both pictures: ratios of dark pixels say little
MIN_DENSITY = 0.05  # projected points a pixel below which the light of a pixel is unknown
LOG_RATIO = 0.08  # logarithm of the brightness ratio above which a pixel is shadowed
NEAR_MASK = 0.02  # of the image's width: a shadow comes this close to the mask
MIN_AREA = 0.02  # of the mask's area that must differ beside the mask
PENUMBRA = 0.012  # of the image's width: dilation of a detected shadow, for its soft rim

FINE_BLUR, CHANGED = 0.003, 8  # of the image's width; of 255: a difference above it means that a pixel was repainted
NOISE_FACTOR = 4.0  # times the usual log ratio above which a pixel of a redrawn picture is shadowed
REDRAWN_QUANTILE = 0.99  # of the difference of a redrawn picture from its photograph: below, it means nothing
ISLAND, NOTCH = 0.015, 0.01  # of the image's width: smaller islands are dropped; notches twice as wide are closed


def redrawn_difference(reference: np.ndarray, photo: np.ndarray, known: np.ndarray) -> float:
    """The difference, in levels of 255, between a picture and its photograph where both show the same: the texture of
    an autoencoder.

    Args:
        known: bool [H, W], pixels without the object.
    """
    return float(np.quantile(_fine_difference(reference, photo)[known], REDRAWN_QUANTILE)) if known.any() else 0.0


def changed_pixels(reference: np.ndarray, photo: np.ndarray, within: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """bool [H, W]: pixels of `within` where a completed view shows something else than its photograph, holes filled.

    Args:
        noise: levels of 255, see `redrawn_difference`.
    """
    differs = within & (_fine_difference(reference, photo) > max(CHANGED, noise))
    # Here and there what was drawn may look like what it hides.
    kept = morphology.remove_small_parts(differs, ISLAND * within.shape[1], 0)
    closed = ~morphology.dilate(~morphology.dilate(kept, NOTCH), NOTCH)
    return ndimage.binary_fill_holes(closed & within)


def _fine_difference(reference: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """[H, W] levels of 255, of the channel that differs most."""
    sigma = morphology.to_pixels(FINE_BLUR, photo.shape[1])
    blur = lambda image: cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma)
    return np.abs(blur(reference) - blur(photo)).max(-1)


def detect_shadows(reference: np.ndarray, view: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels connected to the mask at which the scene is darker or brighter than the completed view.

    Args:
        reference: [H, W, 3] uint8, the completed view.
        view: [H, W, 3] uint8, in its exposure: the photograph, and inside the mask the remaining Gaussians' render.
        mask: bool [H, W], C.
    """
    sigma = morphology.to_pixels(BLUR, mask.shape[1])
    blur = lambda image: cv2.GaussianBlur(image.astype(np.float32).mean(2), (0, 0), sigma)
    ratio = np.abs(np.log((blur(reference) + DARK_OFFSET) / (blur(view) + DARK_OFFSET)))
    near = morphology.dilate(mask, NEAR_MASK)
    noise = 1.4826 * float(np.median(ratio[~near])) if (~near).any() else 0.0  # 0 unless the whole view was redrawn
    differs = ratio > max(LOG_RATIO, NOISE_FACTOR * noise)
    if (differs & ~near).sum() <= MIN_AREA * mask.sum():  # no shadow: differences inside C have other causes
        return np.zeros_like(mask)
    parts, _ = ndimage.label(differs | near)
    touching = np.unique(parts[mask])
    found = differs & np.isin(parts, touching[touching > 0])
    return morphology.dilate(found, PENUMBRA) if found.any() else found


def log_light(reference: np.ndarray, view: np.ndarray) -> np.ndarray:
    """[H, W, 3] float32, the logarithm of the brightness of the completed view over that of the scene, of blurred
    pictures; arguments as for `detect_shadows`."""
    sigma = morphology.to_pixels(BLUR, view.shape[1])
    blur = lambda image: cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma) + DARK_OFFSET
    return np.log(blur(reference) / blur(view))


def project_shadow(
    shadow: np.ndarray, light: np.ndarray, depth: np.ndarray, camera: Camera, views: Sequence[DepthView]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """View name -> the shadow as the view shows it, bool [H, W], and its log light [H, W, 3]; NaN elsewhere and where
    it is unknown.

    Args:
        shadow: bool [H, W]; light: [H, W, 3], `log_light`; depth: [H, W], above 0 where known; camera: their view.
    """
    rows, columns = np.nonzero(shadow & (depth > 0))
    points = geometry.unproject(np.where(depth > 0, depth, 1.0), camera)[rows, columns]
    values = np.concatenate([light[rows, columns], np.ones((len(rows), 1))], 1)
    found = {}
    for view in views:
        shape = view.masked.shape
        uv, z = geometry.project(points, view.camera)
        surface, inside = geometry.sample_nearest(view.farthest, uv)
        visible = inside & (z > 0) & (z < surface * (1 + FREE))
        at = uv[visible].astype(np.int64)
        mask, total = np.zeros(shape, bool), np.zeros((*shape, 4), np.float32)
        mask[at[:, 1], at[:, 0]] = True
        np.add.at(total, (at[:, 1], at[:, 0]), values[visible])
        total = cv2.GaussianBlur(total, (0, 0), morphology.to_pixels(BLUR, shape[1]))
        mask = morphology.dilate(mask, PENUMBRA) if mask.any() else mask
        known = mask[..., None] & (total[..., 3:] > MIN_DENSITY)
        own = np.where(known, total[..., :3] / np.where(known, total[..., 3:], 1), np.nan)
        found[view.camera.name] = mask, own
    return found


def relight(photo: np.ndarray, light: np.ndarray) -> np.ndarray:
    """The photograph, uint8 [H, W, 3], in the light of the completed view; unchanged where `light` is NaN."""
    known = np.isfinite(light)
    lit = (photo.astype(np.float32) + DARK_OFFSET) * np.exp(np.where(known, light, 0)) - DARK_OFFSET
    return np.where(known, np.round(lit).clip(0, 255), photo).astype(np.uint8)
