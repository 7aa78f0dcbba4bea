"""Pictures inpainted in 2D as supervision: the term by which NeRF-In and SPIn-NeRF carry them into a scene."""

from __future__ import annotations

import torch
from torch import Tensor

from reffusion.distill.confinement import TrainView
from reffusion.distill.perceptual import Distance
from reffusion.gaussians.optimize import confine
from reffusion.params.distill import Lift
from reffusion.prior.windows import enlarged, window_around
from reffusion.splat.rasterizer import render
from reffusion.types import Gaussians, Rendering


def lift_term(
    gaussians: Gaussians,
    reached: Tensor,
    view: TrainView,
    lift: Lift,
    distance: Distance | None,
    generator: torch.Generator,
) -> tuple[Tensor, Rendering]:
    """How far one view is from the picture that was inpainted for it; the gradient reaches `reached` Gaussians only.

    NeRF-In compares the hole's pixels by their squared error. That draws the mean of pictures which disagree; SPIn-NeRF
    therefore compares patches around the hole by LPIPS.

    Args:
        reached: [N] bool.
        view: with at least one pixel to repaint, and its `lifted` picture.
        distance: of patches; not asked for the squared error.
        generator: on the CPU; the patch comes from it.
    """
    rendering = render(confine(gaussians, reached), view.camera)
    if lift.loss == "mse":
        return (rendering.color - view.lifted)[view.repaint].square().mean(), rendering
    planes = (t.permute(2, 0, 1) for t in (rendering.color, view.lifted, view.repaint[..., None].float()))
    shown, target, hole = (enlarged(plane, lift.patch) for plane in planes)
    top, left = window_around((hole[0] > 1e-4).cpu(), lift.patch, generator)
    cut = lambda plane: plane[:, top : top + lift.patch, left : left + lift.patch].permute(1, 2, 0)
    return distance(cut(shown), cut(target)), rendering
