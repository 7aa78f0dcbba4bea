"""The depth term: the invented surface lies where a depth estimate of the repainted view puts it (section 4.3)."""

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
# and the size at which it is painted: its prior's 512 px are all that the depth model sees of a view.
T_LOW, T_HIGH = 0.02, 0.98
LEVELS = 0  # finer sizes at which the view is painted as well, see `inpaint.repaint`
FINEST = 0.6  # the latest timestep from which a finer size would start, as a fraction of the schedule
MAX_SIDE = 512  # px, the longer side at which a larger view is rendered: painter and estimator see no more of the hole
EXTENT = 1.0  # PAPER leaves open: the unit of the loss. The scene's extent, which is 1 in the normalised frame


def build(inputs: TermInputs, settings: Params) -> Term | None:
    """The term; None if its weight is 0 or no view has a hole.

    Its gradient reaches the masked Gaussians, all parameters but the spherical harmonics.

    Raises:
        ValueError: there is no prior, its prompts are not embedded, or there is no estimator of depth.
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
        # PAPER leaves open: the guidance with which the view is repainted; SDS's.
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
    extent: float = EXTENT,
) -> tuple[Tensor, Rendering]:
    """Mean squared difference of rendered and estimated depth in the hole over the extent squared, and the rendering.

    The view is rendered, its hole is repainted from a random timestep, and the depth of that image is estimated.

    Args:
        reached: [N] bool, the Gaussians whose geometry the gradient reaches. It reaches no spherical harmonics.
        view: with at least one pixel to repaint.
        text: [3, L, D], the hidden states of the global, the local and the empty prompt.
        guidance: the paper's a.
        generator: on the CPU; draws timestep and noise.
        max_side: px, the longer side at which a larger view is rendered.
        extent: the unit of depth.
    Raises:
        Degenerate: no pixel of this view can be compared, or its estimate cannot be aligned with the scene.
        FloatingPointError: an estimate is not finite.
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
    return depth_loss(rendering.depth, to_device(target), to_device(compared), extent), rendering


def depth_target(view: ViewDepth, disparity: np.ndarray, covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The depth that the hole should have, [H, W] float64, and the pixels to compare it in, [H, W] bool.

    Left out are pixels that no Gaussian covers, and those whose estimate is farther than everything known of the scene
    or beyond infinity.

    Args:
        disparity: [H, W], in the scene's units. covered: [H, W] bool, the pixels whose rendered depth is meaningful.
    Raises:
        Degenerate: no pixel is compared, or no depth is known.
        FloatingPointError: the disparity is not finite.
    """
    if not np.isfinite(disparity).all():
        raise FloatingPointError(f"view {view.camera.name}: the estimated depth is not finite")
    compared = view.hole & covered & (view.depth > 0) & (disparity > view.least_disparity)
    if not compared.any():
        raise Degenerate("nothing compared", f"view {view.camera.name}: no pixel of the hole has a depth to compare")
    return np.divide(1.0, disparity, out=np.zeros_like(disparity), where=compared), compared


def depth_loss(depth: Tensor, target: Tensor, compared: Tensor, extent: float) -> Tensor:
    """Mean over the compared pixels of ((depth - target) / extent)^2.

    Args:
        depth, target: [H, W]; compared: [H, W] bool, at least one pixel.
    """
    return ((depth[compared] - target[compared].to(depth.dtype)) / extent).square().mean()


def _downscale(view: TrainView, max_side: int) -> tuple[Camera, Tensor, Tensor]:
    """(camera, hole [H, W] bool, hidden [H, W] bool) of a view whose longer side is at most `max_side` px."""
    camera, hole, hidden = view.camera, view.repaint, ~view.supervises
    factor = max_side / max(camera.width, camera.height)
    if factor >= 1:
        return camera, hole, hidden
    small = camera.resized(max(1, round(factor * camera.width)), max(1, round(factor * camera.height)))
    rows = (torch.arange(small.height, device=hole.device) + 0.5) * camera.height / small.height
    columns = (torch.arange(small.width, device=hole.device) + 0.5) * camera.width / small.width
    pixels = rows.long()[:, None], columns.long()[None]
    return small, hole[pixels], hidden[pixels]
