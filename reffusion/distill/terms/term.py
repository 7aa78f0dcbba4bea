"""What a term of the distillation loss is, and what terms are built from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from reffusion import seeding
from reffusion.distill.depth_estimator import DepthEstimator
from reffusion.distill.perceptual import Distance
from reffusion.distill.train_view import ReferenceHole, TrainView
from reffusion.params.distill import Params
from reffusion.prior.model import Prior
from reffusion.types import Camera, Gaussians, Rendering


class TermView(Protocol):
    """What a term is computed on in one step: a `TrainView` or a `ReferenceHole`."""

    @property
    def camera(self) -> Camera: ...


class TermValue(NamedTuple):
    """The value of a term in one step.

    Attributes:
        loss: scalar, before the term's weight.
        rendering: what the loss was computed from. Gaussians that are not in it do not move.
        log: what the term adds to the trace in this step.
        latest: what it adds in this step and in all later ones, until it is computed again. For terms that are not
            computed in every step.
        probe: [N, 2], the rendering's probe (see `splat.render`): its gradient selects the Gaussians to densify.
    """

    loss: Tensor
    rendering: Rendering
    log: Mapping[str, float] = {}
    latest: Mapping[str, float] = {}
    probe: Tensor | None = None


class Stateful(Protocol):
    """What a term trains beside the Gaussians. It is kept in checkpoints, under the term's name."""

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


@dataclass(frozen=True)
class Term:
    """One term of the weighted sum (Eq. 5 of the paper), confined to its own Gaussians.

    A term is computed in the steps that `every` divides. Its turn, step / every, selects the view.

    Attributes:
        name: as error messages call it; in lower case the prefix of what the loop logs of it.
        weight: its factor lambda in the sum.
        select_view: turn -> the view to compute the term on, or None to leave it out of this step.
        reaches: (masked [N] bool, view) -> [N] bool, the Gaussians that its gradient reaches.
        loss: (Gaussians, the ones it reaches [N] bool, view, step) -> `TermValue`. No gradient goes to Gaussians that
            it does not reach. Raises Degenerate where the view determines nothing: the loop counts these and goes on.
        every: steps between two in which it is computed.
        fills_hole: it acts on the masked Gaussians, and is left out where there are none.
        uses_one_thread: torch computes it on one thread, which is faster where most of the work is rendering.
        runs_apart: its gradient is accumulated apart from that of the others, so that its norm can be logged, and
            in another thread where that is faster.
        allows_overlap: it may be computed at the same time as a term that runs apart.
        state: what it trains; None for nothing.
    """

    name: str
    weight: float
    select_view: Callable[[int], TermView | None]
    reaches: Callable[[Tensor, Any], Tensor]
    loss: Callable[[Gaussians, Tensor, Any, int], TermValue]
    every: int = 1
    fills_hole: bool = True
    uses_one_thread: bool = False
    runs_apart: bool = False
    allows_overlap: bool = False
    state: Stateful | None = None


@dataclass(frozen=True)
class TermInputs:
    """What the scene provides for the terms.

    Attributes:
        views: the training views. Terms that fill the hole use only those with pixels to repaint.
        references: the reference images with their holes.
        masked_means: [M, 3], centres of the initialization's masked Gaussians; on the device of everything else.
        prior: adapted to the reference; None if there is neither SDS nor the depth term.
        text: [3, L, D], hidden states of the global, the local and the empty prompt.
        estimator: of depth, for the depth term.
        distance: of patches, for the perceptual loss of lifted images.
    """

    views: Sequence[TrainView]
    references: Sequence[ReferenceHole]
    masked_means: Tensor
    prior: Prior | None = None
    text: Tensor | None = None
    estimator: DepthEstimator | None = None
    distance: Distance | None = None

    @cached_property
    def hole_views(self) -> Sequence[TrainView]:
        """The training views with pixels to repaint."""
        return [view for view in self.views if view.repaint.any()]


def cycle_through(views: Sequence[TrainView], seed: int, label: str) -> Callable[[int], TrainView]:
    """Turn -> view: every view once an epoch, in a random order that `seed`, `label` and epoch determine."""
    return lambda turn: views[seeding.epoch_index(turn, len(views), seed, "distill", label)]


def reach_hole(settings: Params, everywhere: bool = False) -> Callable[[Tensor, TermView], Tensor]:
    """The Gaussians that a term which fills the hole reaches: the masked ones; all if `everywhere` or unconfined."""
    reaches_all = everywhere or not settings.confined
    return lambda masked, view: torch.ones_like(masked) if reaches_all else masked
