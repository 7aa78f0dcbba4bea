"""Pictures inpainted in 2D as supervision: the term by which NeRF-In and SPIn-NeRF carry them into a scene."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from reffusion.distill.confinement import Sight
from reffusion.distill.perceptual import Distance
from reffusion.gaussians.optimize import confine
from reffusion.prior.windows import enlarged, window_around
from reffusion.splat.rasterizer import render
from reffusion.types import Gaussians, Rendering


@dataclass(frozen=True)
class Lift:
    """The choices within the term.

    Attributes:
        weight: of the term.
        distance: of a patch; None: the mean squared error over the hole's pixels.
        patch: side of a patch, px.
    """

    weight: float
    distance: Distance | None = None
    patch: int = 64


def lift_term(
    gaussians: Gaussians, reached: Tensor, sight: Sight, lift: Lift, generator: torch.Generator
) -> tuple[Tensor, Rendering]:
    """How far one view is from the picture that was inpainted for it; the gradient reaches `reached` Gaussians only.

    NeRF-In compares the hole's pixels by their squared error. That draws the mean of pictures which disagree; SPIn-NeRF
    therefore compares patches around the hole by LPIPS.

    Args:
        reached: [N] bool.
        sight: with at least one pixel to repaint, and its `lifted` picture.
        generator: on the CPU; the patch comes from it.
    """
    rendering = render(confine(gaussians, reached), sight.camera)
    if lift.distance is None:
        return (rendering.color - sight.lifted)[sight.repaint].square().mean(), rendering
    planes = (t.permute(2, 0, 1) for t in (rendering.color, sight.lifted, sight.repaint[..., None].float()))
    shown, target, hole = (enlarged(plane, lift.patch) for plane in planes)
    top, left = window_around((hole[0] > 1e-4).cpu(), lift.patch, generator)
    cut = lambda plane: plane[:, top : top + lift.patch, left : left + lift.patch].permute(1, 2, 0)
    return lift.distance(cut(shown), cut(target)), rendering
