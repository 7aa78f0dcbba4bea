"""A step of distillation: its terms one after another (RefFusion section 4)."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from reffusion import seeding
from reffusion.distill.adversary import Adversary
from reffusion.distill.confinement import (
    TrainView,
    adversarial_term,
    gradient_norms,
    reconstruction_term,
    reference_term,
    sds_term,
)
from reffusion.distill.depth_term import Estimator, depth_term
from reffusion.distill.lift import lift_term
from reffusion.distill.overlap_worker import Crew
from reffusion.distill.perceptual import Distance
from reffusion.gaussians.optimize import GaussianOptimizer
from reffusion.geometry import Degenerate, angle_between_views
from reffusion.kernels.compiled import torch_on_one_thread
from reffusion.params.distill import Params
from reffusion.prior.model import Prior
from reffusion.types import PARAMETERS, Camera, Gaussians

# PAPER leaves open: when the critic starts, as a part of the run. At once: the paper trains with the sum of all terms.
ADVERSARIAL_FROM = 0.0
# PAPER leaves open: the paper's "all spherical harmonics" may mean all coefficients or those of all Gaussians ("all").
ADVERSARIAL_REACHES = "masked"


@dataclass(frozen=True)
class Job:
    """What `distill` was given, for its terms; only the adversary and the tally change.

    Attributes:
        photographed: the views with pixels that supervise. painted: those with pixels to repaint.
        distilled: names of those that SDS distils: near enough to a reference.
        distance: of patches, for lifted pictures; None where they are compared by their squared error.
        adversary: the critic; None where it has no part.
        tally: what there is to log of steps gone by, of terms that not every step has.
        crew: who does SDS beside the other terms.
    """

    views: Sequence[TrainView]
    photographed: Sequence[TrainView]
    painted: Sequence[TrainView]
    distilled: frozenset[str]
    holes: Sequence[tuple[Camera, Tensor, Tensor]]
    prior: Prior | None
    text: Tensor | None
    estimator: Estimator | None
    distance: Distance | None
    adversary: Adversary | None
    settings: Params
    tally: dict[str, float]
    crew: Crew


def job_of(
    views: Sequence[TrainView],
    holes: Sequence[tuple[Camera, Tensor, Tensor]],
    prior: Prior | None,
    text: Tensor | None,
    settings: Params,
    initial: Gaussians,
    masked: Tensor,
    estimator: Estimator | None = None,
    distance: Distance | None = None,
) -> Job:
    """ValueError where a term lacks what it needs."""
    painted = [view for view in views if view.repaint.any()]
    asked = settings.sds.weight > 0 or settings.depth.weight > 0
    if painted and asked and (prior is None or text is None):
        raise ValueError("distillation with sds.weight > 0 or the depth term needs a prior and its prompts' embeddings")
    if painted and settings.depth.weight > 0 and estimator is None:
        raise ValueError("the depth term needs an estimator of depth")
    adversary = None
    if painted and settings.adversarial.weight > 0:
        if not any(hole.any() for _, _, hole in holes):
            raise ValueError("the adversarial term takes its real patches around a reference's hole; there is none")
        adversary = Adversary(settings.adversarial, settings.seed, initial.means.device)
    if settings.lift.weight > 0:
        if all(view.lifted is None for view in views):
            raise ValueError("distillation with lift.weight > 0 needs the pictures of the stage lift")
        if settings.lift.loss == "perceptual" and distance is None:
            raise ValueError("the perceptual loss of lifted pictures needs a distance")
    references = [camera for camera, _, _ in holes]
    distilled = near_a_reference(painted, references, initial.means[masked], settings.sds.within)
    photographed = [view for view in views if view.supervises.any()]
    # The depth term asks the prior too, the critic draws from its own state, and a card does one thing after another.
    alone = not distilled or settings.depth.weight > 0 or adversary is not None or initial.means.is_cuda
    given = views, photographed, painted, distilled, holes, prior, text, estimator, distance, adversary, settings
    return Job(*given, {}, Crew(1 if alone or settings.sds.weight == 0 else torch.get_num_threads()))


def near_a_reference(
    views: Sequence[TrainView], references: Sequence[Camera], means: Tensor, degrees: float
) -> frozenset[str]:
    """Names of the views that see the middle of `means` [M, 3] from within so many degrees of a reference."""
    if degrees >= 180 or len(means) == 0:
        return frozenset(view.camera.name for view in views)
    middle = means.detach().median(0).values.double().cpu().numpy()
    angles = {view.camera.name: angle_between_views(middle, view.camera, references) for view in views}
    return frozenset(name for name, angle in angles.items() if angle <= degrees)


_Done = tuple[Tensor, dict[str, float]] | None  # what a term gives: see `step_of`


def step_of(optimizer: GaussianOptimizer, step: int, job: Job) -> dict[str, float]:
    """The terms of one step, one after another, then one step of Adam; what there is to log.

    A term gathers its gradient and gives the Gaussians it drew and may move, [N] bool, and its part of the log; None
    where this step is without it.
    """
    moved, line = torch.zeros_like(optimizer.masked), {}
    apart = copy.copy(optimizer)  # SDS gathers for itself, and logs what that is
    apart.gaussians = optimizer.gaussians.map(lambda p: p.detach().requires_grad_())
    rest = lambda: [term(optimizer, step, job) for term in (_depth, _adversarial, _reference, _lift, _reconstruction)]
    with job.crew.beside(lambda: _sds(apart, step, job)) as sds:
        terms = rest()
    for done in (sds(), *terms):
        if done is not None:
            moved |= done[0]
            line |= done[1]
    for name in PARAMETERS:
        parameter, gradient = getattr(optimizer.gaussians, name), getattr(apart.gaussians, name).grad
        if gradient is not None:
            parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
    with torch_on_one_thread():
        optimizer.step(step / job.settings.iterations, visible=moved)
    return line


def _reached(optimizer: GaussianOptimizer, job: Job) -> Tensor:
    """[N] bool, the Gaussians that may be moved by what fills the hole: the masked ones."""
    return optimizer.masked if job.settings.confined else torch.ones_like(optimizer.masked)


def _sds(optimizer: GaussianOptimizer, step: int, job: Job) -> _Done:
    gaussians, masked, settings = optimizer.gaussians, optimizer.masked, job.settings
    if not (settings.sds.weight > 0 and job.painted and masked.any()):
        return None
    view = _drawn(job.painted, step, settings.seed, "sds")
    if view.camera.name not in job.distilled:
        return None
    reached = _reached(optimizer, job) | (settings.sds.reaches == "all")
    probe = torch.zeros(len(masked), 2, device=masked.device, requires_grad=True)
    draw = seeding.generator(settings.seed, "distill", "sds", step)
    with _named(step, "SDS", view.camera):
        loss, rendering = sds_term(gaussians, reached, view, job.prior, job.text, settings.sds, draw, probe)
        _backward(settings.sds.weight * loss, gaussians)
    norms = gradient_norms(gaussians, masked)
    if settings.densify.every:
        optimizer.observe(probe.grad, rendering.radii * masked, view.camera.width, view.camera.height)
    line = {"sds_gradient_mean": float(norms.mean()), "sds_gradient_max": float(norms.max())}
    return reached & (rendering.radii > 0), line


def _depth(optimizer: GaussianOptimizer, step: int, job: Job) -> _Done:
    gaussians, masked, settings = optimizer.gaussians, optimizer.masked, job.settings
    depth = settings.depth
    if depth.weight == 0 or step % depth.every or not job.painted or not masked.any():
        return None
    view, reached = _drawn(job.painted, step // depth.every, settings.seed, "depth"), _reached(optimizer, job)
    draw = seeding.generator(settings.seed, "distill", "depth", step)
    # PAPER leaves open: the guidance of the view's repainting; SDS's.
    given = job.prior, job.text, depth, settings.sds.guidance, draw, job.estimator
    with _named(step, "depth", view.camera):
        try:
            loss, rendering = depth_term(gaussians, reached, view, *given)
        except Degenerate as error:
            reason = f"depth_skipped_{error.reason.replace(' ', '_')}"
            job.tally[reason] = job.tally.get(reason, 0) + 1
            return None
        _backward(depth.weight * loss, gaussians)
    job.tally["depth"] = float(loss.detach())
    return reached & (rendering.radii > 0), {}


@torch_on_one_thread()
def _adversarial(optimizer: GaussianOptimizer, step: int, job: Job) -> _Done:
    gaussians, masked, settings, adversary = optimizer.gaussians, optimizer.masked, job.settings, job.adversary
    if adversary is None or step < ADVERSARIAL_FROM * settings.iterations or not masked.any():
        return None
    view = _drawn(job.painted, step, settings.seed, "adversarial")
    reached = _reached(optimizer, job) | (ADVERSARIAL_REACHES == "all")
    real = [(image, hole) for _, image, hole in job.holes if hole.any()]
    draw = seeding.generator(settings.seed, "distill", "adversarial", step)
    with _named(step, "adversarial", view.camera):
        loss, rendering, line = adversarial_term(gaussians, reached, view, *real[step % len(real)], adversary, draw)
        _backward(settings.adversarial.weight * loss, gaussians)
    return reached & (rendering.radii > 0), line


@torch_on_one_thread()
def _reference(optimizer: GaussianOptimizer, step: int, job: Job) -> _Done:
    gaussians, masked, reference = optimizer.gaussians, optimizer.masked, job.settings.reference
    if not (reference.weight > 0 and masked.any()):
        return None
    camera, image, hole = job.holes[step % len(job.holes)]
    reached = _reached(optimizer, job) | (reference.reaches == "all")
    with _named(step, "reference", camera):
        loss, rendering = reference_term(gaussians, reached, camera, image, hole)
        _backward(reference.weight * loss, gaussians)
    return reached & (rendering.radii > 0), {}


def _lift(optimizer: GaussianOptimizer, step: int, job: Job) -> _Done:
    gaussians, lift = optimizer.gaussians, job.settings.lift
    lifted = [view for view in job.painted if view.lifted is not None]
    if lift.weight == 0 or not lifted or not optimizer.masked.any():
        return None
    view, reached = _drawn(lifted, step, job.settings.seed, "lift"), _reached(optimizer, job)
    draw = seeding.generator(job.settings.seed, "distill", "lift", step)
    with _named(step, "lift", view.camera):
        loss, rendering = lift_term(gaussians, reached, view, lift, job.distance, draw)
        _backward(lift.weight * loss, gaussians)
    return reached & (rendering.radii > 0), {"lift": float(loss.detach())}


@torch_on_one_thread()
def _reconstruction(optimizer: GaussianOptimizer, step: int, job: Job) -> _Done:
    gaussians, settings, every = optimizer.gaussians, job.settings, job.settings.reconstruction.every
    if not every or step % every or not job.photographed:
        return None
    view = _drawn(job.photographed, step // every, settings.seed, "reconstruction")
    # Gaussians that photographs without the clean mark leave alone.
    left = optimizer.masked & (settings.confined and settings.reconstruction.reaches == "unmasked")
    with _named(step, "reconstruction", view.camera):
        loss, rendering = reconstruction_term(gaussians, left, view)
        _backward(loss, gaussians)
    return (rendering.radii > 0) & (~left | view.clean), {"reconstruction": float(loss.detach())}


def _drawn(views: Sequence[TrainView], turn: int, seed: int, label: str) -> TrainView:
    return views[seeding.in_epochs(turn, len(views), seed, "distill", label)]


@contextmanager
def _named(step: int, term: str, camera: Camera) -> Iterator[None]:
    """A number that is not finite is said to have appeared here."""
    try:
        yield
    except FloatingPointError as error:
        raise FloatingPointError(f"distill, step {step}, {term}, view '{camera.name}': {error}") from None


def _backward(loss: Tensor, gaussians: Gaussians) -> None:
    if not torch.isfinite(loss):
        raise FloatingPointError(f"the loss is {float(loss.detach())}")
    loss.backward()
    for name in PARAMETERS:
        gradient = getattr(gaussians, name).grad
        if gradient is not None and not torch.isfinite(gradient.sum()):
            raise FloatingPointError(f"the gradient of the Gaussians' {name} is not finite")
