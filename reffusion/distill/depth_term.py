"""The depth term of distillation (RefFusion section 4.3): the surface of what is invented lies where a picture of it
says it does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from reffusion.depth import behind, estimates
from reffusion.depth.behind import Completion, Seen
from reffusion.distill.confinement import Sight
from reffusion.gaussians.optimize import confine
from reffusion.geometry import Degenerate
from reffusion.prior.inpaint import repaint
from reffusion.prior.model import Prior
from reffusion.splat.rasterizer import render
from reffusion.types import Gaussians, Rendering

# (what a view shows, the view's picture with the hole repainted, painted when it is asked for) -> disparity [H, W] of
# the scene; Degenerate where it cannot be told.
Estimator = Callable[[Seen, Callable[[], np.ndarray]], np.ndarray]


@dataclass(frozen=True)
class DepthRegularization:
    """The choices within the depth term.

    PAPER leaves open: the timestep, the sampler, the guidance, at which size the view is painted, and the unit.

    Attributes:
        weight: lambda; above 0.
        every: steps between two with this term.
        low, high: range of the timestep from which the view is repainted, as parts of the schedule.
        steps: sampler steps from pure noise; a later start takes its share of them.
        levels: finer sizes that are painted after the whole view at the prior's native size, see `inpaint.repaint`.
        finest: timestep from which these start at most.
        guidance: the paper's a.
        longest: side in pixels that the view is rendered at where it is larger: estimators see no more.
        extent: of the scene, the unit of the loss; 1 in the normalised frame.
        how: which rendered depth is known.
    """

    weight: float = 0.0625
    every: int = 8
    low: float = 0.02
    high: float = 0.98
    steps: int = 20
    levels: int = 0
    finest: float = 0.6
    guidance: float = 7.5
    longest: int = 800
    extent: float = 1.0
    how: Completion = field(default_factory=Completion)


def by_continuation(points: np.ndarray, how: Completion) -> Estimator:
    """The estimator without a depth network: the scene's own depth around the hole, continued through it.

    Args:
        points: [P, 3] sparse points of the scene.
    """
    return lambda view, picture: behind.continued(view, picture, points, how)[0]


def by_network(network: Callable[[Tensor], Tensor], how: Completion) -> Estimator:
    """The paper's estimator: a network's depth of the repainted view, aligned and passed through the bilateral solver.

    Args:
        network: [3, H, W] in [0, 1] -> [H, W] disparity up to scale and offset.
    """

    def estimator(view: Seen, picture: Callable[[], np.ndarray]) -> np.ndarray:
        painted = picture()
        estimate = network(torch.from_numpy(painted).float().permute(2, 0, 1)).double().cpu().numpy()
        return estimates.estimated(view, painted, estimate, how)[0]

    return estimator


def depth_term(
    gaussians: Gaussians,
    masked: Tensor,
    sight: Sight,
    prior: Prior,
    text: Tensor,
    settings: DepthRegularization,
    generator: torch.Generator,
    estimator: Estimator,
) -> tuple[Tensor, Rendering]:
    """Mean squared difference of rendered and estimated depth in the hole, over the extent squared; it reaches the
    geometry of masked Gaussians only.

    The view is rendered, its hole repainted from a random timestep, and the depth of that picture estimated.

    Args:
        sight: with at least one pixel to repaint.
        text: [3, L, D], the hidden states of the global, the local and the empty prompt.
        generator: on the CPU; timestep and noise come from it.
    Raises:
        Degenerate: nothing is to be compared in this view, or its estimate cannot be brought to the scene.
        FloatingPointError: an estimate is not finite.
    """
    camera, hole, hidden = _within(settings.longest, sight)
    reached = confine(replace(gaussians, sh=gaussians.sh.detach()), masked)
    rendering = render(reached, camera)
    view = behind.seen(rendering, camera, hole.cpu().numpy(), hidden.cpu().numpy(), settings.how)
    alpha = rendering.alpha.detach().cpu().numpy()

    def picture() -> np.ndarray:
        start = settings.low + (settings.high - settings.low) * float(torch.rand((), generator=generator))
        shown = rendering.color.detach().clamp(0, 1).permute(2, 0, 1) * 2 - 1
        painted = repaint(
            prior, shown, hole, text, generator,
            start=max(start, 1 / prior.timesteps), finest=settings.finest, levels=settings.levels,
            steps=settings.steps, guidance=settings.guidance,
        )  # fmt: skip
        return (painted.permute(1, 2, 0).cpu().numpy() + 1) / 2

    target, compared = depth_target(view, estimator(view, picture), alpha > settings.how.explained)
    place = lambda array: torch.from_numpy(array).to(rendering.depth.device)
    return depth_loss(rendering.depth, place(target), place(compared), settings.extent), rendering


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


def _within(longest: int, sight: Sight):
    """(camera, hole, hidden), the view's longer side at most `longest` pixels."""
    camera, hole, hidden = sight.camera, sight.repaint, ~sight.supervises
    factor = longest / max(camera.width, camera.height)
    if factor >= 1:
        return camera, hole, hidden
    small = camera.resized(max(1, round(factor * camera.width)), max(1, round(factor * camera.height)))
    rows = (torch.arange(small.height, device=hole.device) + 0.5) * camera.height / small.height
    columns = (torch.arange(small.width, device=hole.device) + 0.5) * camera.width / small.width
    at = rows.long()[:, None], columns.long()[None]
    return small, hole[at], hidden[at]
