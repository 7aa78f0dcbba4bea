"""The depth term of distillation (RefFusion section 4.3): the surface of what is invented lies where a picture of it
says it does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from reffusion.depth import background_depth, estimates
from reffusion.depth.background_depth import Completion, Seen
from reffusion.distill.confinement import TrainView
from reffusion.gaussians.optimize import confine
from reffusion.geometry import Degenerate
from reffusion.params.distill import Depth
from reffusion.prior.inpaint import repaint
from reffusion.prior.model import Prior
from reffusion.splat.rasterizer import render
from reffusion.types import Gaussians, Rendering

# PAPER leaves open: the range of the "random timestep" from which a view is repainted, as parts of the schedule, and
# the size that is painted. Its prior's 512 px are all that a depth model sees of a view.
T_LOW, T_HIGH = 0.02, 0.98
LEVELS, FINEST = 0, 0.6  # finer sizes, and the timestep from which they would start at most: see `inpaint.repaint`
LONGEST = 512  # px, the side at which a larger view is rendered: of the hole neither painter nor estimator sees more
EXTENT = 1.0  # PAPER leaves open: the unit of the loss; the scene's extent, 1 in the normalised frame


class Estimator(NamedTuple):
    """What finds the depth of a view.

    Attributes:
        how: which rendered depth is known.
        disparity: (what a view shows, the view's picture with the hole repainted, painted when it is asked for) ->
            disparity [H, W] of the scene; Degenerate where it cannot be told.
    """

    how: Completion
    disparity: Callable[[Seen, Callable[[], np.ndarray]], np.ndarray]


def by_continuation(points: np.ndarray, how: Completion) -> Estimator:
    """The estimator without a depth network: the scene's own depth around the hole, continued through it.

    Args:
        points: [P, 3] sparse points of the scene.
    """
    return Estimator(how, lambda view, picture: background_depth.continued(view, picture, points, how)[0])


def by_network(network: Callable[[Tensor], Tensor], how: Completion) -> Estimator:
    """The paper's estimator: a network's depth of the repainted view, aligned and passed through the bilateral solver.

    Args:
        network: [3, H, W] in [0, 1] -> [H, W] disparity up to scale and offset.
    """

    def disparity(view: Seen, picture: Callable[[], np.ndarray]) -> np.ndarray:
        painted = picture()
        estimate = network(torch.from_numpy(painted).float().permute(2, 0, 1)).double().cpu().numpy()
        return estimates.estimated(view, painted, estimate, how)[0]

    return Estimator(how, disparity)


def depth_term(
    gaussians: Gaussians,
    masked: Tensor,
    view: TrainView,
    prior: Prior,
    text: Tensor,
    depth: Depth,
    guidance: float,
    generator: torch.Generator,
    estimator: Estimator,
    *,
    longest: int = LONGEST,
    extent: float = EXTENT,
) -> tuple[Tensor, Rendering]:
    """Mean squared difference of rendered and estimated depth in the hole, over the extent squared; it reaches the
    geometry of masked Gaussians only.

    The view is rendered, its hole repainted from a random timestep, and the depth of that picture estimated.

    Args:
        view: with at least one pixel to repaint.
        text: [3, L, D], the hidden states of the global, the local and the empty prompt.
        guidance: the paper's a.
        generator: on the CPU; timestep and noise come from it.
    Raises:
        Degenerate: nothing is to be compared in this view, or its estimate cannot be brought to the scene.
        FloatingPointError: an estimate is not finite.
    """
    camera, hole, hidden = _within(longest, view)
    reached = confine(replace(gaussians, sh=gaussians.sh.detach()), masked)
    rendering = render(reached, camera)
    seen = background_depth.seen(rendering, camera, hole.cpu().numpy(), hidden.cpu().numpy(), estimator.how)
    alpha = rendering.alpha.detach().cpu().numpy()

    def picture() -> np.ndarray:
        start = T_LOW + (T_HIGH - T_LOW) * float(torch.rand((), generator=generator))
        shown = rendering.color.detach().clamp(0, 1).permute(2, 0, 1) * 2 - 1
        painted = repaint(
            prior, shown, hole, text, generator,
            start=max(start, 1 / prior.timesteps), finest=FINEST, levels=LEVELS, steps=depth.steps, guidance=guidance,
        )  # fmt: skip
        return (painted.permute(1, 2, 0).cpu().numpy() + 1) / 2

    target, compared = depth_target(seen, estimator.disparity(seen, picture), alpha > estimator.how.explained)
    place = lambda array: torch.from_numpy(array).to(rendering.depth.device)
    return depth_loss(rendering.depth, place(target), place(compared), extent), rendering


def depth_target(view: Seen, disparity: np.ndarray, covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The depth that the hole should have, [H, W] float64, and the pixels where it is compared, [H, W] bool.

    Where the render covers nothing, and where the estimate lies beyond all that is known of the scene or beyond
    infinity, there is nothing to compare.

    Args:
        disparity: [H, W], of the scene. covered: bool [H, W], the pixels whose rendered depth means something.
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


def _within(longest: int, view: TrainView):
    """(camera, hole, hidden), the view's longer side at most `longest` pixels."""
    camera, hole, hidden = view.camera, view.repaint, ~view.supervises
    factor = longest / max(camera.width, camera.height)
    if factor >= 1:
        return camera, hole, hidden
    small = camera.resized(max(1, round(factor * camera.width)), max(1, round(factor * camera.height)))
    rows = (torch.arange(small.height, device=hole.device) + 0.5) * camera.height / small.height
    columns = (torch.arange(small.width, device=hole.device) + 0.5) * camera.width / small.width
    at = rows.long()[:, None], columns.long()[None]
    return small, hole[at], hidden[at]
