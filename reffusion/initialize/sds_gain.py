"""Prediction of whether score distillation (SDS) can improve an initialization.

The embedded prior, adapted to the reference, improves renders whose PSNR is below `PRIOR_PSNR`, and degrades better
ones (docs/method.md#the-embedded-prior). The PSNR is that of a whole view, reduced to the prior's size of `SIDE_PX`
pixels. Inside the hole the truth is unknown. So the PSNR is measured against the photographs beside the hole, and
assumed to be lower by `HOLE_LOSS` inside. Patches of photographs, which fill pixels that no reference shows, are better
there than what the embedded prior paints (docs/results.md#score-distillation).
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

SIDE_PX = 64  # side of the images that the embedded prior takes
PRIOR_PSNR = 25.0  # dB, PSNR of the best renders that the prior improves
HOLE_LOSS = 8.5  # dB, by which the PSNR of renders is lower inside the hole than beside it
RING_PX = 4  # pixels of the reduced view: width of the ring around the mask in which errors are measured
MAX_VIEWS = 12  # views that are compared at most, evenly spread


class GainPrediction(NamedTuple):
    """The prediction of `predict_gain`.

    Attributes:
        may_gain: whether SDS may improve the initialization.
        reason: the reason, in words.
        psnr_beside: PSNR in dB of the renders beside the hole, from the mean squared error over the pixels of all
            compared views; None if there was no photograph to compare with.
    """

    may_gain: bool
    reason: str
    psnr_beside: float | None


@torch.no_grad()
def predict_gain(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    sets: Mapping[str, MaskSet],
    photos: Mapping[str, np.ndarray],
) -> GainPrediction:
    """Predict whether SDS may improve an initialization, from its renders of views in which something is invented.

    SDS may gain if the PSNR estimated inside the hole is below `PRIOR_PSNR`, or if there is no photograph to compare
    with.

    Args:
        gaussians: the initialization.
        cameras: the training views.
        sets: view name -> pixel classes.
        photos: view name -> uint8 [H, W, 3]; views without an entry are not compared.
    """
    usable = [camera for camera in cameras if camera.name in photos and sets[camera.name].invent.any()]
    indices = np.unique(np.linspace(0, len(usable) - 1, MAX_VIEWS).round().astype(int)) if usable else []
    errors = []
    for camera in (usable[k] for k in indices):
        each = sets[camera.name]  # where an object is inserted and none removed, the hole is I, not C
        errors.append(_errors_beside(gaussians, camera, each.consistent | each.invent, photos[camera.name]))
    squared = torch.cat(errors) if errors else torch.zeros(0)
    if not len(squared):
        return GainPrediction(True, "no photograph tells how good the initialization is", None)
    beside = decibels(float(squared.mean()))
    inside = beside - HOLE_LOSS
    reason = f"beside the hole renders show photographs at {beside:.1f} dB, so about {inside:.1f} dB in it"
    return GainPrediction(inside < PRIOR_PSNR, f"{reason}; the embedded prior teaches up to {PRIOR_PSNR:g} dB", beside)


def _errors_beside(gaussians: Gaussians, camera: Camera, mask: np.ndarray, photo: np.ndarray) -> Tensor:
    """Return [N, 3], squared errors of a render of the N pixels beside the mask, in a view reduced to `SIDE_PX` pixels.

    Args:
        gaussians: the scene to render.
        camera: the view.
        mask: bool [H, W], the hole.
        photo: uint8 [H, W, 3], the photograph, with which the render is compared in [0, 1].
    """
    reduce = lambda image: two_scales(image.permute(2, 0, 1).float().cpu(), [], SIDE_PX)[0]
    rendering = rasterizer.render(gaussians, camera).color.clamp(0, 1)
    small = two_scale_masks(torch.from_numpy(mask), [], SIDE_PX)
    ring = (F.max_pool2d(small, 2 * RING_PX + 1, 1, RING_PX) > small)[0, 0]
    return (reduce(rendering) - reduce(torch.from_numpy(photo) / 255)).square()[:, ring].T
