"""Detection of the object's cast shadows, which the masks do not cover.

A reference is a view completed without the object. Where the object casts a shadow, reference and photograph differ
beside the object. The shadow is projected into the other views, whose photographs are relit.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy import ndimage

from reffusion import geometry, morphology
from reffusion.background.visibility import DepthView
from reffusion.types import Camera

BLUR = 0.008  # of the image's width: standard deviation of the blur with which brightness is compared, against noise
DARK_OFFSET = 8  # of 255, added to both pictures, because the ratios of dark pixels are unreliable
MIN_DENSITY = 0.05  # number of projected points per pixel below which the light of a pixel is unknown
LOG_RATIO = 0.08  # absolute logarithm of the brightness ratio above which a pixel is in a shadow
NEAR_MASK = 0.02  # of the image's width: distance from the mask that a shadow must reach
MIN_AREA = 0.02  # of the mask's area: area beside the mask that must differ
PENUMBRA = 0.012  # of the image's width: dilation of a detected shadow, to include its soft rim

# Repainted pixels are found after a blur with a standard deviation of FINE_BLUR of the image's width. A difference of
# more than CHANGED levels of 255 means that a pixel was repainted.
FINE_BLUR, CHANGED = 0.003, 8
NOISE_FACTOR = 4.0  # a pixel of a redrawn picture is in a shadow if its log-ratio is this many times the usual one
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


def detect_shadows(reference: np.ndarray, view: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Find the object's shadow in a view: pixels that are darker or brighter than in the completed view.

    A shadow is connected to the mask, up to a small gap. If too few pixels beside the mask differ, there is no shadow.

    Args:
        reference: [H, W, 3] uint8, the completed view.
        view: [H, W, 3] uint8 in the same exposure, the photograph. Inside the mask it may show a rendering of the scene
            without the object instead.
        mask: bool [H, W], C, True at pixels that show the object.

    Returns:
        bool [H, W], the shadow with its soft rim; it may extend into the mask.
    """
    sigma = morphology.to_pixels(BLUR, mask.shape[1])
    blur = lambda image: cv2.GaussianBlur(image.astype(np.float32).mean(2), (0, 0), sigma)
    ratio = np.abs(np.log((blur(reference) + DARK_OFFSET) / (blur(view) + DARK_OFFSET)))
    near = morphology.dilate(mask, NEAR_MASK)
    noise = 1.4826 * float(np.median(ratio[~near])) if (~near).any() else 0.0  # about 0 unless the view is redrawn
    differs = ratio > max(LOG_RATIO, NOISE_FACTOR * noise)
    if (differs & ~near).sum() <= MIN_AREA * mask.sum():  # no shadow: differences inside C have other causes
        return np.zeros_like(mask)
    parts, _ = ndimage.label(differs | near)
    touching = np.unique(parts[mask])
    found = differs & np.isin(parts, touching[touching > 0])
    return morphology.dilate(found, PENUMBRA) if found.any() else found


def log_light(reference: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Return float32 [H, W, 3], the natural logarithm of the completed view's brightness divided by the photograph's.

    Each color channel has its own ratio. The pictures are blurred first. The arguments are those of `detect_shadows`.
    """
    sigma = morphology.to_pixels(BLUR, view.shape[1])
    blur = lambda image: cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma) + DARK_OFFSET
    return np.log(blur(reference) / blur(view))


def project_shadow(
    shadow: np.ndarray, light: np.ndarray, depth: np.ndarray, camera: Camera, views: Sequence[DepthView]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Project the shadow that was detected in one view, and its log light (see `log_light`), into other views.

    Args:
        shadow: bool [H, W], the shadow in the view `camera`.
        light: [H, W, 3], the result of `log_light` for the view `camera`.
        depth: [H, W], camera z of the surfaces in the view `camera`; 0 where unknown.
        camera: the view in which the shadow was detected.
        views: the views into which the shadow is projected. The view `camera` may be among them.

    Returns:
        View name -> (bool [H, W], the shadow in this view; [H, W, 3], its log light). The log light is NaN outside the
        shadow, and where too few points are projected.
    """
    rows, columns = np.nonzero(shadow & (depth > 0))
    points = geometry.unproject(np.where(depth > 0, depth, 1.0), camera)[rows, columns]
    values = np.concatenate([light[rows, columns], np.ones((len(rows), 1))], 1)
    found = {}
    for view in views:
        shape = view.masked.shape
        uv, z = geometry.project(points, view.camera)
        surface, inside = geometry.sample_nearest(view.farthest, uv)
        visible = inside & (z > 0) & (z < surface * (1 + geometry.OTHER_SURFACE))
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
    """Return the photograph, uint8 [H, W, 3], with the shadow's brightness changed to that of the completed view.

    Args:
        light: [H, W, 3], log light as from `project_shadow`. Where it is NaN, the photograph stays the same.
    """
    known = np.isfinite(light)
    lit = (photo.astype(np.float32) + DARK_OFFSET) * np.exp(np.where(known, light, 0)) - DARK_OFFSET
    return np.where(known, np.round(lit).clip(0, 255), photo).astype(np.uint8)
