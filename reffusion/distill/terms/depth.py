"""The depth term: invented surfaces are drawn to the depth that is estimated from the repainted view (section 4.3)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from reffusion import seeding
from reffusion.depth import background_depth
from reffusion.depth.background_depth import ViewDepth
from reffusion.distill.depth_estimator import DepthEstimator
from reffusion.distill.terms.term import Term, TermInputs, TermValue, cycle_through, reach_hole
from reffusion.distill.train_view import TrainView
from reffusion.gaussians.optimize import confine
from reffusion.geometry import Degenerate
from reffusion.params.distill import DepthTerm, Params
from reffusion.prior.inpaint import repaint
from reffusion.prior.model import Prior
from reffusion.splat.rasterizer import render
from reffusion.types import Camera, Gaussians, Rendering

# PAPER leaves open: the range of the "random timestep" from which a view is repainted, as fractions of the schedule,
# and the size at which the view is painted. Here it is the native size of the prior (512 px for the paper's prior).
T_LOW, T_HIGH = 0.02, 0.98
LEVELS = 0  # number of finer sizes at which the view is painted as well, see `inpaint.repaint`
FINEST = 0.6  # the latest timestep from which a finer size would start, as a fraction of the schedule
MAX_SIDE = 512  # px, the longer side at which a larger view is rendered: prior and estimator use no finer detail


def build(inputs: TermInputs, settings: Params) -> Term | None:
    """Build the depth term. Return None if its weight is 0 or no view has a hole.

    Its gradient reaches the masked Gaussians, or with `confined: false` all, in all parameters except the spherical
    harmonics.

    Raises:
        ValueError: There is no prior, its prompts are not embedded, or there is no depth estimator.
    """
    depth = settings.depth
    if depth.weight == 0 or not inputs.hole_views:
        return None
    prior, text, estimator = inputs.prior, inputs.text, inputs.estimator
    if prior is None or text is None:
        raise ValueError("the depth term needs a prior and its prompts' embeddings")
    if estimator is None:
        raise ValueError("the depth term needs an estimator of depth")

    def loss(gaussians: Gaussians, reached: Tensor, view: TrainView, step: int) -> TermValue:
        draws = seeding.generator(settings.seed, "distill", "depth", step)
        # PAPER leaves open: the guidance with which the view is repainted. Here it is that of SDS.
        guidance = settings.sds.guidance
        value, rendering = evaluate_depth(gaussians, reached, view, prior, text, depth, guidance, draws, estimator)
        return TermValue(value, rendering, latest={"depth": float(value.detach())})

    return Term(
        "depth",
        weight=depth.weight,
        select_view=cycle_through(inputs.hole_views, settings.seed, "depth"),
        reaches=reach_hole(settings),
        loss=loss,
        every=depth.every,
    )


def evaluate_depth(
    gaussians: Gaussians,
    reached: Tensor,
    view: TrainView,
    prior: Prior,
    text: Tensor,
    depth: DepthTerm,
    guidance: float,
    generator: torch.Generator,
    estimator: DepthEstimator,
    *,
    max_side: int = MAX_SIDE,
) -> tuple[Tensor, Rendering]:
    """Return the depth loss of one view, and its rendering.

    The view is rendered, its hole is repainted by the prior from a random timestep, and the depth of the repainted
    picture is estimated. An estimator that does not use the picture estimates without repainting. The loss is the mean
    of ((rendered depth - estimated depth) / depth.unit)^2 over the pixels of the hole that can be compared (see
    `depth_target`).

    Args:
        gaussians: All Gaussians of the scene.
        reached: bool [N], True for the Gaussians whose geometry gets a gradient. No spherical harmonics get one.
        view: A training view with at least one pixel to repaint.
        prior: The adapted prior.
        text: [3, L, D], the embeddings of the global, the local and the empty prompt.
        depth: Parameters of the depth term.
        guidance: γ, the strength of classifier-free guidance.
        generator: Draws timestep and noise, on the CPU.
        estimator: The depth estimator.
        max_side: Longer side, in pixels, at which a larger view is rendered. The returned rendering has this size.

    Raises:
        Degenerate: No pixel of the view can be compared, or the estimate cannot be aligned with the scene.
        FloatingPointError: An estimate is not finite.
    """
    camera, hole, hidden = _downscale(view, max_side)
    geometry_only = confine(replace(gaussians, sh=gaussians.sh.detach()), reached)
    rendering = render(geometry_only, camera)
    seen = background_depth.extract_depth(rendering, camera, hole.cpu().numpy(), hidden.cpu().numpy(), estimator.how)
    alpha = rendering.alpha.detach().cpu().numpy()

    def repaint_hole() -> np.ndarray:
        start = T_LOW + (T_HIGH - T_LOW) * float(torch.rand((), generator=generator))
        rendered = rendering.color.detach().clamp(0, 1).permute(2, 0, 1) * 2 - 1
        painted = repaint(
            prior, rendered, hole, text, generator,
            start=max(start, 1 / prior.timesteps), finest=FINEST, levels=LEVELS, steps=depth.steps, guidance=guidance,
        )  # fmt: skip
        return (painted.permute(1, 2, 0).cpu().numpy() + 1) / 2

    disparity = estimator.disparity(seen, repaint_hole)
    target, compared = depth_target(seen, disparity, alpha > estimator.how.explained)
    to_device = lambda array: torch.from_numpy(array).to(rendering.depth.device)
    return depth_loss(rendering.depth, to_device(target), to_device(compared), depth.unit), rendering


def depth_target(view: ViewDepth, disparity: np.ndarray, covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth that the hole should have, [H, W] float64, and the pixels to compare, bool [H, W].

    The pixels to compare are the pixels of the hole that are covered and have a rendered depth, and whose estimate is
    nearer than the limit `ViewDepth.least_disparity`.

    Args:
        view: The rendered depth of the view.
        disparity: [H, W], the estimate in the unit of the scene.
        covered: bool [H, W], True at pixels that Gaussians cover enough for their rendered depth to be meaningful.

    Returns:
        The target, which is 0 at pixels that are not compared, and the pixels to compare.

    Raises:
        Degenerate: There is no pixel to compare, or no depth is known.
        FloatingPointError: The disparity is not finite.
    """
    if not np.isfinite(disparity).all():
        raise FloatingPointError(f"view {view.camera.name}: the estimated depth is not finite")
    compared = view.hole & covered & (view.depth > 0) & (disparity > view.least_disparity)
    if not compared.any():
        raise Degenerate("nothing compared", f"view {view.camera.name}: no pixel of the hole has a depth to compare")
    return np.divide(1.0, disparity, out=np.zeros_like(disparity), where=compared), compared


def depth_loss(depth: Tensor, target: Tensor, compared: Tensor, unit: float) -> Tensor:
    """Return the mean of ((depth - target) / unit)^2 over the compared pixels.

    Args:
        depth, target: [H, W].
        compared: bool [H, W], with at least one True pixel.
        unit: The depth that counts as 1.
    """
    return ((depth[compared] - target[compared].to(depth.dtype)) / unit).square().mean()


def _downscale(view: TrainView, max_side: int) -> tuple[Camera, Tensor, Tensor]:
    """Return camera, hole and hidden pixels (bool [H, W] each) of a view whose longer side is at most `max_side` px."""
    # The photograph may not supervise hidden pixels.
    camera, hole, hidden = view.camera, view.repaint, ~view.supervises
    small = camera.shrunk(max_side)
    rows = (torch.arange(small.height, device=hole.device) + 0.5) * camera.height / small.height
    columns = (torch.arange(small.width, device=hole.device) + 0.5) * camera.width / small.width
    pixels = rows.long()[:, None], columns.long()[None]
    return small, hole[pixels], hidden[pixels]
