"""A step of distillation: its settings, and its terms one after another (RefFusion section 4)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from reffusion import seeding
from reffusion.distill.adversary import Adversarial, Adversary
from reffusion.distill.confinement import (
    Distillation,
    Sight,
    adversarial_term,
    gradient_norms,
    reconstruction_term,
    reference_term,
    sds_term,
)
from reffusion.distill.depth_term import DepthRegularization, Estimator, depth_term
from reffusion.distill.lift import Lift, lift_term
from reffusion.gaussians.optimize import GaussianOptimizer, Rates
from reffusion.geometry import Degenerate, angle_between_views
from reffusion.prior.model import Prior
from reffusion.types import PARAMETERS, Camera, Gaussians


@dataclass(frozen=True)
class Settings:
    """How distillation runs; moments as parts of the run in [0, 1].

    Attributes:
        iterations: optimisation steps, each with one view for SDS and one for reconstruction.
        seed: of views, windows, timesteps, noise, splits and the critic's first weights.
        sds_weight: lambda of the SDS term; 0 leaves it out.
        sds: the choices within that term.
        sds_reaches: the Gaussians that it moves: "masked" ones, or "all" that show, the background in the hole too.
        sds_within: degrees, at the middle of the masked Gaussians, between a view and the nearest reference, up to
            which the view is distilled; 180: every view. A step that draws another view is without the term.
        depth: the depth term; None leaves it out.
        adversarial: the adversarial term; None leaves it out.
        reconstruction_every: steps between two with a reconstruction term; 0: never.
        reference_weight: of the reference's own pixels in its hole (paper: 0).
        reference_reaches: the Gaussians that those pixels move: "masked" ones, or "all" that show in the hole; what of
            the background other views saw there carries the object's tint.
        lift: supervision by pictures inpainted in 2D (baselines; not in the paper's method); None leaves it out.
        reconstruction_reaches: "unmasked" Gaussians, or all that are "shown" in the pixels a photograph may supervise:
            also the masked ones at the hole's rim, whose footprints reach out of it.
        confined: each term reaches its own Gaussians. False, an ablation: every term reaches all Gaussians, and none is
            pruned for changing region.
        densify_every: steps between densifications of masked Gaussians; 0: never.
        densify_rule: "share": those pulled hardest on the screen, a share of the masked ones; "slope", 3DGS's: all that
            are pulled by `densify_slope` or more.
        densify_share: share of the masked Gaussians cloned or split each time.
        densify_slope: 3DGS's threshold, in its units (see `GaussianOptimizer.observe`).
        densify_until: part of the run after which no Gaussian is added.
        split_above: standard deviation from which a Gaussian is split, not cloned.
        budget: most Gaussians.
        least_opacity: fainter ones are pruned when others are added.
        region_every: steps between prunings of Gaussians that changed region.
        stop_drop: stop when the reference's PSNR falls so many dB under its best, and give the best; 0: never.
        patience, stop_gain: the same when in so many twentieths of the run it has not gained so many dB; 0: never.
        rates: Adam's step sizes.
        masked_pace: parameter -> factor on them for masked Gaussians.
        epsilon: Adam's; against it a gradient is large or small. At 3DGS's 1e-15 a Gaussian that hardly anything but
            SDS reaches takes full steps, however small lambda is.
        checkpoint_seconds: seconds of work between checkpoints.
    """

    iterations: int
    seed: int = 0
    sds_weight: float = 1e-3
    sds: Distillation = field(default_factory=Distillation)
    sds_reaches: Literal["masked", "all"] = "masked"
    sds_within: float = 180.0
    depth: DepthRegularization | None = None
    adversarial: Adversarial | None = None
    reconstruction_every: int = 1
    reference_weight: float = 0.0
    reference_reaches: Literal["masked", "all"] = "masked"
    lift: Lift | None = None
    reconstruction_reaches: Literal["unmasked", "shown"] = "unmasked"
    confined: bool = True
    densify_every: int = 0
    densify_rule: Literal["share", "slope"] = "share"
    densify_share: float = 0.05
    densify_slope: float = 2e-4
    densify_until: float = 0.5
    split_above: float = 0.01
    budget: int = 2_000_000
    least_opacity: float = 0.005
    region_every: int = 50
    stop_drop: float = 0.0
    patience: int = 0
    stop_gain: float = 0.0
    rates: Rates = field(default_factory=Rates)
    masked_pace: Mapping[str, float] = field(default_factory=dict)
    epsilon: float = 1e-15
    checkpoint_seconds: float = 10.0


@dataclass(frozen=True)
class Job:
    """What `distill` was given, for its terms; only the adversary and the tally change.

    Attributes:
        painted: the sights with pixels to repaint.
        taught: names of those that SDS distils: near enough to a reference.
        adversary: the critic; None where it has no part.
        tally: what there is to log of steps gone by, of terms that not every step has.
    """

    sights: Sequence[Sight]
    painted: Sequence[Sight]
    taught: frozenset[str]
    holes: Sequence[tuple[Camera, Tensor, Tensor]]
    prior: Prior | None
    text: Tensor | None
    estimator: Estimator | None
    adversary: Adversary | None
    settings: Settings
    tally: dict[str, float]


def job_of(
    sights: Sequence[Sight],
    holes: Sequence[tuple[Camera, Tensor, Tensor]],
    prior: Prior | None,
    text: Tensor | None,
    estimator: Estimator | None,
    settings: Settings,
    initial: Gaussians,
    masked: Tensor,
) -> Job:
    """ValueError where a term lacks what it needs."""
    painted = [sight for sight in sights if sight.repaint.any()]
    asked = settings.sds_weight > 0 or settings.depth is not None
    if painted and asked and (prior is None or text is None):
        raise ValueError("distillation with sds_weight > 0 or the depth term needs a prior and its prompts' embeddings")
    if painted and settings.depth is not None and estimator is None:
        raise ValueError("the depth term needs an estimator of depth")
    adversary = None
    if painted and settings.adversarial is not None:
        if not any(hole.any() for _, _, hole in holes):
            raise ValueError("the adversarial term takes its real patches around a reference's hole; there is none")
        adversary = Adversary(settings.adversarial, settings.seed, initial.means.device)
    if settings.lift is not None and all(sight.lifted is None for sight in sights):
        raise ValueError("distillation with lift_weight > 0 needs the pictures of the stage lift")
    references = [camera for camera, _, _ in holes]
    taught = near_a_reference(painted, references, initial.means[masked], settings.sds_within)
    return Job(sights, painted, taught, holes, prior, text, estimator, adversary, settings, {})


def near_a_reference(
    sights: Sequence[Sight], references: Sequence[Camera], means: Tensor, degrees: float
) -> frozenset[str]:
    """Names of the sights that see the middle of `means` [M, 3] from within so many degrees of a reference."""
    if degrees >= 180 or len(means) == 0:
        return frozenset(sight.camera.name for sight in sights)
    middle = means.detach().median(0).values.double().cpu().numpy()
    angles = {sight.camera.name: angle_between_views(middle, sight.camera, references) for sight in sights}
    return frozenset(name for name, angle in angles.items() if angle <= degrees)


_Done = tuple[Tensor, dict[str, float]] | None  # what a term gives: see `step_of`


def step_of(optimizer: GaussianOptimizer, step: int, job: Job) -> dict[str, float]:
    """The terms of one step, one after another, then one step of Adam; what there is to log.

    A term gathers its gradient and gives the Gaussians it drew and may move, [N] bool, and its part of the log; None
    where this step is without it.
    """
    moved, line = torch.zeros_like(optimizer.masked), {}
    # SDS first: it logs what has been gathered.
    for term in (_sds, _depth, _adversarial, _reference, _lift, _reconstruction):
        done = term(optimizer, step, job)
        if done is not None:
            moved |= done[0]
            line |= done[1]
    optimizer.step(step / job.settings.iterations, visible=moved)
    return line


def _reached(optimizer: GaussianOptimizer, job: Job) -> Tensor:
    """[N] bool, the Gaussians that may be moved by what fills the hole: the masked ones."""
    return optimizer.masked if job.settings.confined else torch.ones_like(optimizer.masked)


def _sds(optimizer: GaussianOptimizer, step: int, job: Job) -> _Done:
    gaussians, masked, settings = optimizer.gaussians, optimizer.masked, job.settings
    if not (settings.sds_weight > 0 and job.painted and masked.any()):
        return None
    sight = _drawn(job.painted, step, settings.seed, "sds")
    if sight.camera.name not in job.taught:
        return None
    reached = _reached(optimizer, job) | (settings.sds_reaches == "all")
    probe = torch.zeros(len(masked), 2, device=masked.device, requires_grad=True)
    draw = seeding.generator(settings.seed, "distill", "sds", step)
    with _named(step, "SDS", sight.camera):
        loss, rendering = sds_term(gaussians, reached, sight, job.prior, job.text, settings.sds, draw, probe)
        _backward(settings.sds_weight * loss, gaussians)
    norms = gradient_norms(gaussians, masked)
    if settings.densify_every:
        optimizer.observe(probe.grad, rendering.radii * masked, sight.camera.width, sight.camera.height)
    line = {"sds_gradient_mean": float(norms.mean()), "sds_gradient_max": float(norms.max())}
    return reached & (rendering.radii > 0), line


def _depth(optimizer: GaussianOptimizer, step: int, job: Job) -> _Done:
    gaussians, masked, settings = optimizer.gaussians, optimizer.masked, job.settings
    choices = settings.depth
    if choices is None or step % choices.every or not job.painted or not masked.any():
        return None
    sight, reached = _drawn(job.painted, step // choices.every, settings.seed, "depth"), _reached(optimizer, job)
    draw = seeding.generator(settings.seed, "distill", "depth", step)
    with _named(step, "depth", sight.camera):
        try:
            loss, rendering = depth_term(gaussians, reached, sight, job.prior, job.text, choices, draw, job.estimator)
        except Degenerate as error:
            reason = f"depth_skipped_{error.reason.replace(' ', '_')}"
            job.tally[reason] = job.tally.get(reason, 0) + 1
            return None
        _backward(choices.weight * loss, gaussians)
    job.tally["depth"] = float(loss.detach())
    return reached & (rendering.radii > 0), {}


def _adversarial(optimizer: GaussianOptimizer, step: int, job: Job) -> _Done:
    gaussians, masked, settings, adversary = optimizer.gaussians, optimizer.masked, job.settings, job.adversary
    if adversary is None or step < adversary.choices.start * settings.iterations or not masked.any():
        return None
    sight, reached = _drawn(job.painted, step, settings.seed, "adversarial"), _reached(optimizer, job)
    real = [(image, hole) for _, image, hole in job.holes if hole.any()]
    draw = seeding.generator(settings.seed, "distill", "adversarial", step)
    with _named(step, "adversarial", sight.camera):
        loss, rendering, line = adversarial_term(gaussians, reached, sight, *real[step % len(real)], adversary, draw)
        _backward(adversary.choices.weight * loss, gaussians)
    drawn = rendering.radii > 0
    return drawn if adversary.choices.reaches == "all" else drawn & reached, line


def _reference(optimizer: GaussianOptimizer, step: int, job: Job) -> _Done:
    gaussians, masked, weight = optimizer.gaussians, optimizer.masked, job.settings.reference_weight
    if not (weight > 0 and masked.any()):
        return None
    camera, image, hole = job.holes[step % len(job.holes)]
    reached = _reached(optimizer, job) | (job.settings.reference_reaches == "all")
    with _named(step, "reference", camera):
        loss, rendering = reference_term(gaussians, reached, camera, image, hole)
        _backward(weight * loss, gaussians)
    return reached & (rendering.radii > 0), {}


def _lift(optimizer: GaussianOptimizer, step: int, job: Job) -> _Done:
    gaussians, choices = optimizer.gaussians, job.settings.lift
    lifted = [sight for sight in job.painted if sight.lifted is not None]
    if choices is None or not lifted or not optimizer.masked.any():
        return None
    sight, reached = _drawn(lifted, step, job.settings.seed, "lift"), _reached(optimizer, job)
    draw = seeding.generator(job.settings.seed, "distill", "lift", step)
    with _named(step, "lift", sight.camera):
        loss, rendering = lift_term(gaussians, reached, sight, choices, draw)
        _backward(choices.weight * loss, gaussians)
    return reached & (rendering.radii > 0), {"lift": float(loss.detach())}


def _reconstruction(optimizer: GaussianOptimizer, step: int, job: Job) -> _Done:
    gaussians, every = optimizer.gaussians, job.settings.reconstruction_every
    if not every or step % every:
        return None
    sight = _drawn(job.sights, step // every, job.settings.seed, "reconstruction")
    # Gaussians that photographs without the clean mark leave alone.
    left = optimizer.masked & (job.settings.confined and job.settings.reconstruction_reaches == "unmasked")
    with _named(step, "reconstruction", sight.camera):
        loss, rendering = reconstruction_term(gaussians, left, sight)
        _backward(loss, gaussians)
    return (rendering.radii > 0) & (~left | sight.clean), {"reconstruction": float(loss.detach())}


def _drawn(sights: Sequence[Sight], turn: int, seed: int, label: str) -> Sight:
    """Every view once an epoch, in an order of the epoch's own."""
    order = torch.randperm(len(sights), generator=seeding.generator(seed, "distill", label, turn // len(sights)))
    return sights[int(order[turn % len(sights)])]


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
