"""Predict whether score distillation can improve an initialization, from how well it shows the photographs.

The embedded prior, adapted to the reference, improves pictures of up to `PRIOR_PSNR`, at its own size of `SIDE_PX` for
a whole view, and degrades better ones (docs/method.md#the-embedded-prior). The truth inside the hole is unknown. Beside
the hole there are photographs, and renders inside the hole are about `HOLE_LOSS` worse. This says nothing of pixels
that no reference shows and that patches of photographs filled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from reffusion.prior.windows import two_scale_masks, two_scales
from reffusion.splat import rasterizer
from reffusion.trace import decibels
from reffusion.types import Camera, Gaussians, MaskSet

SIDE_PX = 64  # the embedded prior's size
PRIOR_PSNR = 26.0  # dB
HOLE_LOSS = 8.5  # dB
RING_PX = 4  # of the reduced view: how far around the mask errors are measured
MAX_VIEWS = 12  # spread evenly
GUESSED_SHARE = 0.05  # of a view's mask: it was 0.19 where SDS gained (`demo-corner`), below 0.03 elsewhere


class GainPrediction(NamedTuple):
    """Whether SDS may gain, the reason in words, and the PSNR in dB beside the hole (None where nothing was
    compared)."""

    may_gain: bool
    reason: str
    psnr_beside: float | None


@torch.no_grad()
def predict_gain(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    sets: Mapping[str, MaskSet],
    photos: Mapping[str, np.ndarray],
    guessed_share: float = 0.0,
) -> GainPrediction:
    """Predict the gain for an initialization from references, by the training views in which something is invented.

    Args:
        photos: view name -> uint8 [H, W, 3]; other views are not used.
        guessed_share: the largest share of a view's mask that no reference covers, and that patches fill.
    """
    usable = [camera for camera in cameras if camera.name in photos and sets[camera.name].invent.any()]
    indices = np.unique(np.linspace(0, len(usable) - 1, MAX_VIEWS).round().astype(int)) if usable else []
    errors = []
    for camera in (usable[k] for k in indices):
        each = sets[camera.name]  # an inserted object has nothing removed behind it: I counts beside C
        errors.append(_errors_beside(gaussians, camera, each.consistent | each.invent, photos[camera.name]))
    squared = torch.cat(errors) if errors else torch.zeros(0)
    if not len(squared):
        return GainPrediction(True, "no photograph tells how good the initialization is", None)
    beside = decibels(float(squared.mean()))
    if guessed_share > GUESSED_SHARE:
        reason = f"no reference covers {guessed_share:.0%} of a view's mask, and patches are a guess"
        return GainPrediction(True, reason, beside)
    inside = beside - HOLE_LOSS
    reason = f"beside the hole renders show photographs at {beside:.1f} dB, so about {inside:.1f} dB in it"
    return GainPrediction(inside < PRIOR_PSNR, f"{reason}; the embedded prior teaches up to {PRIOR_PSNR:g} dB", beside)


def _errors_beside(gaussians: Gaussians, camera: Camera, mask: np.ndarray, photo: np.ndarray) -> Tensor:
    """[N, 3]: squared errors of the pixels of the reduced view that lie beside the mask, bool [H, W]."""
    reduce = lambda image: two_scales(image.permute(2, 0, 1).float().cpu(), [], SIDE_PX)[0]
    rendering = rasterizer.render(gaussians, camera).color.clamp(0, 1)
    small = two_scale_masks(torch.from_numpy(mask), [], SIDE_PX)
    ring = (F.max_pool2d(small, 2 * RING_PX + 1, 1, RING_PX) > small)[0, 0]
    return (reduce(rendering) - reduce(torch.from_numpy(photo) / 255)).square()[:, ring].T
