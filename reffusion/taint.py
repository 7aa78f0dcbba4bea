"""A cast shadow is in no mask: where a reference differs from its photograph beside the object, that tainted it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy import ndimage

from reffusion import geometry
from reffusion.types import Camera
from reffusion.witness import FREE, Witness, pixels, widened

SOFT = 0.008  # of the image's width: blur under which two pictures are compared, so that grain does not count
DARKER = 0.08  # logarithm of the ratio of brightness from which a pixel is tainted
BESIDE = 0.02  # of the image's width: so near to the mask a tainted patch must come
SHADOW = 0.02  # of the mask's area, that must differ beside it
WIDER = 0.012  # of the image's width: a shadow's soft rim beyond what is found


def tainted(reference: np.ndarray, shown: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels where the scene is darker or brighter than the completed view, in one piece with the mask.

    Args:
        reference: [H, W, 3] uint8, the completed view.
        shown: [H, W, 3] uint8, in its exposure: the photograph, and inside the mask what the Gaussians show.
        hidden: bool [H, W], C.
    """
    sigma = pixels(SOFT, hidden.shape[1])
    soft = lambda image: cv2.GaussianBlur(image.astype(np.float32).mean(2), (0, 0), sigma)
    # A few levels are added: in the dark a ratio says little.
    differs = np.abs(np.log((soft(reference) + 8) / (soft(shown) + 8))) > DARKER
    near = widened(hidden, BESIDE)
    if (differs & ~near).sum() <= SHADOW * hidden.sum():  # no shadow: what differs within C is for other rules
        return np.zeros_like(hidden)
    pieces, _ = ndimage.label(differs | near)
    touching = np.unique(pieces[hidden])
    found = differs & np.isin(pieces, touching[touching > 0])
    return widened(found, WIDER) if found.any() else found


def carried(taint: np.ndarray, depth: np.ndarray, camera: Camera, views: Sequence[Witness]) -> dict[str, np.ndarray]:
    """View name -> bool [H, W], the same places of the scene in other views, as far as they show there.

    Args:
        taint: bool [H, W]; depth: [H, W] of the surface, above 0 where it is known; camera: their view.
    """
    rows, columns = np.nonzero(taint & (depth > 0))
    points = geometry.unproject(np.where(depth > 0, depth, 1.0), camera)[rows, columns]
    found = {}
    for view in views:
        mask = np.zeros(view.hidden.shape, bool)
        uv, z = geometry.project(points, view.camera)
        shown, inside = geometry.sample_nearest(view.farthest, uv)
        at = uv[inside & (z > 0) & (z < shown * (1 + FREE))].astype(np.int64)
        mask[at[:, 1], at[:, 0]] = True
        found[view.camera.name] = widened(mask, WIDER) if mask.any() else mask
    return found
