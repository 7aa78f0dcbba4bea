"""The lift term: images inpainted in 2D supervise the hole, as in NeRF-In and SPIn-NeRF. It serves baselines only."""

from __future__ import annotations

import torch
from torch import Tensor

from reffusion import seeding
from reffusion.distill.perceptual import Distance
from reffusion.distill.terms.term import Term, TermInputs, TermValue, cycle_through, reach_hole
from reffusion.distill.train_view import TrainView
from reffusion.gaussians.optimize import confine
from reffusion.params.distill import LiftTerm, Params
from reffusion.prior.windows import enlarge_to_fit, windows_around
from reffusion.splat.rasterizer import render
from reffusion.types import Gaussians, Rendering


def build(inputs: TermInputs, settings: Params) -> Term | None:
    """Build the lift term. Return None if its weight is 0 or no inpainted view has a hole.

    Its gradient reaches the masked Gaussians, or with `confined: false` all.

    Raises:
        ValueError: The weight is not 0, and no view was inpainted or the perceptual loss has no distance.
    """
    lift = settings.lift
    if lift.weight == 0:
        return None
    if all(view.lifted is None for view in inputs.views):
        raise ValueError("distillation with lift.weight > 0 needs the pictures of the stage lift")
    if lift.loss == "perceptual" and inputs.distance is None:
        raise ValueError("the perceptual loss of lifted pictures needs a distance")
    views = [view for view in inputs.hole_views if view.lifted is not None]
    if not views:
        return None

    def loss(gaussians: Gaussians, reached: Tensor, view: TrainView, step: int) -> TermValue:
        draws = seeding.generator(settings.seed, "distill", "lift", step)
        value, rendering = evaluate_lift(gaussians, reached, view, lift, inputs.distance, draws)
        return TermValue(value, rendering, {"lift": float(value.detach())})

    return Term(
        "lift",
        weight=lift.weight,
        select_view=cycle_through(views, settings.seed, "lift"),
        reaches=reach_hole(settings),
        loss=loss,
    )


def evaluate_lift(
    gaussians: Gaussians,
    reached: Tensor,
    view: TrainView,
    lift: LiftTerm,
    distance: Distance | None,
    generator: torch.Generator,
) -> tuple[Tensor, Rendering]:
    """Return the difference between a rendered view and its image inpainted in 2D, and the rendering.

    With `lift.loss` = "mse" the difference is the mean squared error of the hole's pixels, as in NeRF-In. Otherwise it
    is the perceptual distance of one random patch that contains a pixel of the hole. Where the images of several views
    disagree, the minimum of the squared error is their mean, which is blurred. Therefore SPIn-NeRF compares patches
    around the hole by LPIPS.

    Args:
        gaussians: All Gaussians of the scene.
        reached: bool [N], True for the Gaussians that get a gradient.
        view: A training view with at least one pixel to repaint and with a lifted image.
        lift: Parameters of the term, which choose the squared error or the perceptual distance.
        distance: Perceptual distance of patches. The squared error does not use it.
        generator: Draws the patch, on the CPU.
    """
    rendering = render(confine(gaussians, reached), view.camera)
    if lift.loss == "mse":
        return (rendering.color - view.lifted)[view.repaint].square().mean(), rendering
    planes = (t.permute(2, 0, 1) for t in (rendering.color, view.lifted, view.repaint[..., None].float()))
    rendered, target, hole = (enlarge_to_fit(plane, lift.patch) for plane in planes)
    top, left = windows_around((hole[0] > 1e-4).cpu(), lift.patch, 1, generator)[0].tolist()
    crop = lambda plane: plane[:, top : top + lift.patch, left : left + lift.patch].permute(1, 2, 0)
    return distance(crop(rendered), crop(target)), rendering
