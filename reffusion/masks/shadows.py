"""A cast shadow is in no mask: where a reference differs from its photograph beside the object, that tainted it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy import ndimage

from reffusion import geometry
from reffusion.background.visibility import FREE, Witness, pixels, widened
from reffusion.masks.voting import tidy
from reffusion.types import Camera

SOFT = 0.008  # of the image's width: blur under which two pictures are compared, so that grain does not count
DARK = 8  # levels of 255 that are added: in the dark a ratio says little
SPARSE = 0.05  # points a pixel under which their light is not known
DARKER = 0.08  # logarithm of the ratio of brightness from which a pixel is tainted
BESIDE = 0.02  # of the image's width: so near to the mask a tainted patch must come
SHADOW = 0.02  # of the mask's area, that must differ beside it
WIDER = 0.012  # of the image's width: a shadow's soft rim beyond what is found

FINE, CHANGED = 0.003, 8  # of the image's width: a finer blur; levels of 255 from which a pixel was drawn anew
DOUBT = 4.0  # times the usual difference of brightness from which a pixel is tainted, of a redrawn picture
REDRAWN = 0.99  # quantile of the difference of a redrawn picture from its photograph that says nothing
SPECK, CLOSED = 0.015, 0.01  # of it: islands below this diameter are none; notches twice as wide are closed


def redrawn_difference(reference: np.ndarray, photo: np.ndarray, known: np.ndarray) -> float:
    """Levels of 255 by which a picture differs from its photograph where it shows the same: an autoencoder's texture.

    `known`: bool [H, W], pixels without the object.
    """
    return float(np.quantile(_fine_difference(reference, photo)[known], REDRAWN)) if known.any() else 0.0


def changed(reference: np.ndarray, photo: np.ndarray, within: np.ndarray, usual: float = 0.0) -> np.ndarray:
    """bool [H, W]: pixels of `within` where a completed view shows something else than its photograph, holes filled.

    `usual`: levels of 255, `redrawn_difference`.
    """
    differs = within & (_fine_difference(reference, photo) > max(CHANGED, usual))
    # What was drawn in may here and there look like what it hides.
    closed = ~widened(~widened(tidy(differs, SPECK * within.shape[1], 0), CLOSED), CLOSED)
    return ndimage.binary_fill_holes(closed & within)


def _fine_difference(reference: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """[H, W] levels of 255, of the channel that differs most."""
    sigma = pixels(FINE, photo.shape[1])
    soft = lambda image: cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma)
    return np.abs(soft(reference) - soft(photo)).max(-1)


def tainted(reference: np.ndarray, shown: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels where the scene is darker or brighter than the completed view, in one piece with the mask.

    Args:
        reference: [H, W, 3] uint8, the completed view.
        shown: [H, W, 3] uint8, in its exposure: the photograph, and inside the mask what the Gaussians show.
        hidden: bool [H, W], C.
    """
    sigma = pixels(SOFT, hidden.shape[1])
    soft = lambda image: cv2.GaussianBlur(image.astype(np.float32).mean(2), (0, 0), sigma)
    ratio, near = np.abs(np.log((soft(reference) + DARK) / (soft(shown) + DARK))), widened(hidden, BESIDE)
    usual = 1.4826 * float(np.median(ratio[~near])) if (~near).any() else 0.0  # 0 unless it was redrawn everywhere
    differs = ratio > max(DARKER, DOUBT * usual)
    if (differs & ~near).sum() <= SHADOW * hidden.sum():  # no shadow: what differs within C is for other rules
        return np.zeros_like(hidden)
    pieces, _ = ndimage.label(differs | near)
    touching = np.unique(pieces[hidden])
    found = differs & np.isin(pieces, touching[touching > 0])
    return widened(found, WIDER) if found.any() else found


def light(reference: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """[H, W, 3] float32, the logarithm of how much brighter the completed view is than the scene, of soft pictures;
    both as for `tainted`."""
    sigma = pixels(SOFT, shown.shape[1])
    soft = lambda image: cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma) + DARK
    return np.log(soft(reference) / soft(shown))


def carried(
    taint: np.ndarray, brighter: np.ndarray, depth: np.ndarray, camera: Camera, views: Sequence[Witness]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """View name -> the same places of the scene in other views, as far as they show there, bool [H, W]; and their
    light, [H, W, 3], NaN elsewhere and where it is not known.

    Args:
        taint: bool [H, W]; brighter: [H, W, 3], `light`; depth: [H, W] of the surface, above 0 where it is known;
            camera: their view.
    """
    rows, columns = np.nonzero(taint & (depth > 0))
    points = geometry.unproject(np.where(depth > 0, depth, 1.0), camera)[rows, columns]
    values = np.concatenate([brighter[rows, columns], np.ones((len(rows), 1))], 1)
    found = {}
    for view in views:
        shape = view.hidden.shape
        uv, z = geometry.project(points, view.camera)
        shown, inside = geometry.sample_nearest(view.farthest, uv)
        there = inside & (z > 0) & (z < shown * (1 + FREE))
        at = uv[there].astype(np.int64)
        mask, total = np.zeros(shape, bool), np.zeros((*shape, 4), np.float32)
        mask[at[:, 1], at[:, 0]] = True
        np.add.at(total, (at[:, 1], at[:, 0]), values[there])
        total = cv2.GaussianBlur(total, (0, 0), pixels(SOFT, shape[1]))
        mask = widened(mask, WIDER) if mask.any() else mask
        known = mask[..., None] & (total[..., 3:] > SPARSE)
        own = np.where(known, total[..., :3] / np.where(known, total[..., 3:], 1), np.nan)
        found[view.camera.name] = mask, own
    return found


def relit(photo: np.ndarray, brighter: np.ndarray) -> np.ndarray:
    """The photograph, uint8 [H, W, 3], in the light of the completed view; as it is where `brighter` is NaN."""
    known = np.isfinite(brighter)
    lit = (photo.astype(np.float32) + DARK) * np.exp(np.where(known, brighter, 0)) - DARK
    return np.where(known, np.round(lit).clip(0, 255), photo).astype(np.uint8)
