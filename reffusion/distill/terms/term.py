"""The interface of a term of the distillation loss, and the inputs from which terms are built."""

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
    """The view on which a term is computed in one step: a `TrainView` or a `ReferenceHole`."""

    @property
    def camera(self) -> Camera:
        """Return the camera of the view."""
        ...


class TermValue(NamedTuple):
    """The value of a term in one step.

    Attributes:
        loss: Scalar, before the term's weight.
        rendering: The rendering from which the loss was computed. The term moves only Gaussians that show in this
            rendering.
        log: Values that are added to the trace for this step.
        latest: Values that are added to the trace for this step and for all later steps, until the term is computed
            again. For terms that are not computed in every step.
        probe: [N, 2], the probe of the rendering (see `splat.render`). Its gradient selects the Gaussians to densify.
            None if the term does not drive densification.
    """

    loss: Tensor
    rendering: Rendering
    log: Mapping[str, float] = {}
    latest: Mapping[str, float] = {}
    probe: Tensor | None = None


class Stateful(Protocol):
    """An object that a term trains beside the Gaussians. Checkpoints contain its state, under the term's name."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""
        ...


@dataclass(frozen=True)
class Term:
    """One term of the weighted sum (Eq. 5 of the paper), confined to its own Gaussians.

    A term is computed in every `every`-th step, from step 0 on. The number step / `every`, called its turn, selects the
    view.

    Attributes:
        name: The name in error messages. In lower case it is the prefix of keys in the trace.
        weight: The factor lambda of the term in the sum.
        select_view: Function of the turn that returns the view on which the term is computed, or None to leave the term
            out of this step.
        reaches: Function of the labels `masked`, bool [N], and of the view. It returns bool [N], the Gaussians that the
            term's gradient reaches.
        loss: Function of the Gaussians, of the Gaussians that the gradient reaches (bool [N]), of the view and of the
            step. It returns a `TermValue`. All other Gaussians get no gradient. It raises Degenerate if the view does
            not determine the loss; the loop counts such views and goes on.
        every: Number of steps from one computation of the term to the next.
        fills_hole: Whether the term acts on masked Gaussians. Such a term is left out if there are no masked Gaussians.
        uses_one_thread: Whether torch computes the term on one thread, which is faster if most of the work is
            rendering, or tensors are small.
        logs_gradient: Whether the norm of the term's gradient is logged. Such a term is computed before all others,
            which add their gradients to its own.
        state: The object that the term trains; None if it trains nothing.
    """

    name: str
    weight: float
    select_view: Callable[[int], TermView | None]
    reaches: Callable[[Tensor, Any], Tensor]
    loss: Callable[[Gaussians, Tensor, Any, int], TermValue]
    every: int = 1
    fills_hole: bool = True
    uses_one_thread: bool = False
    logs_gradient: bool = False
    state: Stateful | None = None


@dataclass(frozen=True)
class TermInputs:
    """The inputs from the scene with which terms are built.

    Attributes:
        views: The training views. Terms that fill the hole use only views with pixels to repaint.
        references: The references with their holes.
        masked_means: [M, 3], centers of the masked Gaussians of the initialization, on the device of all other tensors.
        prior: The prior adapted to the reference. None if neither SDS nor the depth term is on.
        text: [3, L, D], the embeddings of the global, the local and the empty prompt. None without a prior.
        estimator: The depth estimator of the depth term. None if this term is off.
        distance: The perceptual distance of the lift term. None if this term does not use one.
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
        """Return the training views with pixels to repaint."""
        return [view for view in self.views if view.repaint.any()]


def cycle_through(views: Sequence[TrainView], seed: int, label: str) -> Callable[[int], TrainView]:
    """Return a function that selects the view of each turn: every view once per epoch, in a random order.

    Args:
        views: The views.
        seed, label: The order within an epoch depends on both, and on the number of the epoch.
    """
    return lambda turn: views[seeding.epoch_index(turn, len(views), seed, "distill", label)]


def reach_hole(settings: Params, everywhere: bool = False) -> Callable[[Tensor, TermView], Tensor]:
    """Return the function `Term.reaches` of a term that fills the hole. It selects the masked Gaussians, or all.

    Args:
        settings: If `settings.confined` is False, the term reaches all Gaussians.
        everywhere: If True, the term reaches all Gaussians.
    """
    reaches_all = everywhere or not settings.confined
    return lambda masked, view: torch.ones_like(masked) if reaches_all else masked
