"""Distillation (RefFusion section 4): several terms on one set of Gaussians, each confined to those it may reach."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from math import log10
from pathlib import Path

import torch
from torch import Tensor

from reffusion import trace
from reffusion.adversary import Adversarial, Adversary
from reffusion.confinement import (
    Distillation,
    Sight,
    adversarial_term,
    gradient_norms,
    reconstruction_term,
    reference_term,
    region_of,
    sds_term,
    strays,
)
from reffusion.densify import densify, prune
from reffusion.depth_term import DepthRegularization, Estimator, depth_term
from reffusion.geometry import Degenerate
from reffusion.optimize import GaussianOptimizer, Rates
from reffusion.prior import Prior
from reffusion.splat import render
from reffusion.types import PARAMETERS, Camera, Gaussians


@dataclass(frozen=True)
class Settings:
    """How distillation runs; moments as parts of the run in [0, 1].

    Attributes:
        iterations: optimisation steps, each with one view for SDS and one for reconstruction.
        seed: of views, windows, timesteps, noise, splits and the critic's first weights.
        sds_weight: lambda of the SDS term; 0 leaves it out.
        sds: the choices within that term.
        depth: the depth term; None leaves it out.
        adversarial: the adversarial term; None leaves it out.
        reconstruction_every: steps between two with a reconstruction term; 0: never.
        reference_weight: of the reference's own pixels in its hole (paper: 0).
        densify_every: steps between densifications of masked Gaussians; 0: never.
        densify_share: share of the masked Gaussians cloned or split each time.
        densify_until: part of the run after which no Gaussian is added.
        split_above: standard deviation from which a Gaussian is split, not cloned.
        budget: most Gaussians.
        least_opacity: fainter ones are pruned when others are added.
        region_every: steps between prunings of Gaussians that changed region.
        stop_drop: stop when the reference's PSNR falls so many dB under its best, and give the best; 0: never.
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
    depth: DepthRegularization | None = None
    adversarial: Adversarial | None = None
    reconstruction_every: int = 1
    reference_weight: float = 0.0
    densify_every: int = 0
    densify_share: float = 0.05
    densify_until: float = 0.5
    split_above: float = 0.01
    budget: int = 2_000_000
    least_opacity: float = 0.005
    region_every: int = 50
    stop_drop: float = 0.0
    rates: Rates = field(default_factory=Rates)
    masked_pace: Mapping[str, float] = field(default_factory=dict)
    epsilon: float = 1e-15
    checkpoint_seconds: float = 10.0


def distill(
    initial: Gaussians,
    masked: Tensor,
    sights: Sequence[Sight],
    holes: Sequence[tuple[Camera, Tensor, Tensor]],
    prior: Prior | None,
    text: Tensor | None,
    settings: Settings,
    folder: Path,
    estimator: Estimator | None = None,
) -> tuple[Gaussians, Tensor]:
    """Optimise an initialization; resumes from `folder`'s checkpoint, bit for bit on the CPU.

    Args:
        initial, masked: the Gaussians and their labels [N] bool; everything else is on their device.
        sights: the training views; only those with pixels to repaint are distilled and judged by the critic.
        holes: (camera, image [H, W, 3] in [0, 1], hole [H, W] bool) of each reference.
        prior: adapted to the reference; None where there is neither SDS nor the depth term.
        text: [3, L, D], hidden states of the global, the local and the empty prompt.
        folder: gets trace.jsonl and checkpoints. A line of the trace: reconstruction (that term's value),
            reference_psnr (in the references' holes), sds_gradient_mean and _max (norm of the weighted SDS gradient
            per masked Gaussian in that step), depth (the last depth term's value), depth_skipped_<reason> (how often it
            was left out so far), adversarial (the generator's loss), critic_loss, critic_slope (R1 before its weight),
            gaussians, masked_gaussians.
        estimator: of the depth term; None where there is none.
    Returns:
        The Gaussians, detached, and their labels.
    Raises:
        FloatingPointError: a value or gradient is not finite; names step, term and view.
        ValueError: a term lacks what it needs: a prior, an estimator, a hole in a reference.
    """
    job = _job(sights, holes, prior, text, estimator, settings, initial.means.device)
    optimizer = GaussianOptimizer(initial, masked, settings.rates, settings.masked_pace, epsilon=settings.epsilon)
    region = region_of(initial.means, masked) if masked.any() else None
    state = trace.load_checkpoint(folder)
    start, seconds, best, best_psnr = 0, 0.0, None, -float("inf")
    if state is not None:
        optimizer.load_state_dict(state["optimizer"])
        if job.adversary is not None:
            job.adversary.load_state_dict(state["adversary"])
        job.tally.update(state["tally"])
        start, seconds, best, best_psnr = (state[k] for k in ("step", "seconds", "best", "best_psnr"))
    log, saved = trace.Trace(folder, seconds, start + 1), seconds  # a line is numbered by the steps done

    for step in trace.progress(settings.iterations, "distill", start):
        line = _step(optimizer, step, job)
        done = step + 1
        if settings.densify_every and done % settings.densify_every == 0:
            _densify(optimizer, settings, done)
        if region is not None and (done % settings.region_every == 0 or done == settings.iterations):
            optimizer.select(~strays(region, optimizer.gaussians.means.detach(), optimizer.masked))
        if trace.log_spaced(done, settings.iterations, per_octave=4):
            with log.paused():
                psnr = reference_psnr(optimizer.gaussians, holes)
            counts = {"gaussians": len(optimizer.masked), "masked_gaussians": int(optimizer.masked.sum())}
            log.log(done, reference_psnr=psnr, **line, **job.tally, **counts)
            if settings.stop_drop > 0 and psnr > best_psnr:
                best, best_psnr = _copy(optimizer), psnr
            if 0 < settings.stop_drop < best_psnr - psnr:
                return replace(optimizer.gaussians, **{name: best[name] for name in PARAMETERS}), best["masked"]
        if log.seconds - saved > settings.checkpoint_seconds:
            saved = log.seconds
            state = {"optimizer": optimizer.state_dict(), "step": done, "seconds": saved, "tally": job.tally}
            state["adversary"] = None if job.adversary is None else job.adversary.state_dict()
            trace.save_checkpoint(folder, state | {"best": best, "best_psnr": best_psnr})
    return optimizer.gaussians.map(Tensor.detach), optimizer.masked


def _copy(optimizer: GaussianOptimizer) -> dict[str, Tensor]:
    """The Gaussians' parameters and labels as they are now."""
    tensors = {name: getattr(optimizer.gaussians, name) for name in PARAMETERS} | {"masked": optimizer.masked}
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}


@dataclass(frozen=True)
class _Job:
    """What `distill` was given, for its terms; only the adversary and the tally change.

    Attributes:
        painted: the sights with pixels to repaint.
        adversary: the critic; None where it has no part.
        tally: what there is to log of steps gone by, of terms that not every step has.
    """

    sights: Sequence[Sight]
    painted: Sequence[Sight]
    holes: Sequence[tuple[Camera, Tensor, Tensor]]
    prior: Prior | None
    text: Tensor | None
    estimator: Estimator | None
    adversary: Adversary | None
    settings: Settings
    tally: dict[str, float]


def _job(sights, holes, prior, text, estimator, settings: Settings, device: torch.device) -> _Job:
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
        adversary = Adversary(settings.adversarial, settings.seed, device)
    return _Job(sights, painted, holes, prior, text, estimator, adversary, settings, {})


_Done = tuple[Tensor, dict[str, float]] | None  # what a term gives: see `_step`


def _step(optimizer: GaussianOptimizer, step: int, job: _Job) -> dict[str, float]:
    """The terms of one step, one after another, then one step of Adam; what there is to log.

    A term gathers its gradient and gives the Gaussians it drew and may move, [N] bool, and its part of the log; None
    where this step is without it.
    """
    moved, line = torch.zeros_like(optimizer.masked), {}
    for term in (_sds, _depth, _adversarial, _reference, _reconstruction):  # SDS first: it logs what has been gathered
        done = term(optimizer, step, job)
        if done is not None:
            moved |= done[0]
            line |= done[1]
    optimizer.step(step / job.settings.iterations, visible=moved)
    return line


def _sds(optimizer: GaussianOptimizer, step: int, job: _Job) -> _Done:
    gaussians, masked, settings = optimizer.gaussians, optimizer.masked, job.settings
    if not (settings.sds_weight > 0 and job.painted and masked.any()):
        return None
    sight = _drawn(job.painted, step, settings.seed, "sds")
    probe = torch.zeros(len(masked), 2, device=masked.device, requires_grad=True)
    draw = trace.generator(settings.seed, "distill", "sds", step)
    with _named(step, "SDS", sight.camera):
        loss, rendering = sds_term(gaussians, masked, sight, job.prior, job.text, settings.sds, draw, probe)
        _backward(settings.sds_weight * loss, gaussians)
    norms = gradient_norms(gaussians, masked)
    if settings.densify_every:
        optimizer.observe(probe.grad, rendering.radii * masked, sight.camera.width, sight.camera.height)
    line = {"sds_gradient_mean": float(norms.mean()), "sds_gradient_max": float(norms.max())}
    return masked & (rendering.radii > 0), line


def _depth(optimizer: GaussianOptimizer, step: int, job: _Job) -> _Done:
    gaussians, masked, settings = optimizer.gaussians, optimizer.masked, job.settings
    choices = settings.depth
    if choices is None or step % choices.every or not job.painted or not masked.any():
        return None
    sight = _drawn(job.painted, step // choices.every, settings.seed, "depth")
    draw = trace.generator(settings.seed, "distill", "depth", step)
    with _named(step, "depth", sight.camera):
        try:
            loss, rendering = depth_term(gaussians, masked, sight, job.prior, job.text, choices, draw, job.estimator)
        except Degenerate as error:
            reason = f"depth_skipped_{error.reason.replace(' ', '_')}"
            job.tally[reason] = job.tally.get(reason, 0) + 1
            return None
        _backward(choices.weight * loss, gaussians)
    job.tally["depth"] = float(loss.detach())
    return masked & (rendering.radii > 0), {}


def _adversarial(optimizer: GaussianOptimizer, step: int, job: _Job) -> _Done:
    gaussians, masked, settings, adversary = optimizer.gaussians, optimizer.masked, job.settings, job.adversary
    if adversary is None or step < adversary.choices.start * settings.iterations or not masked.any():
        return None
    sight = _drawn(job.painted, step, settings.seed, "adversarial")
    real = [(image, hole) for _, image, hole in job.holes if hole.any()]
    draw = trace.generator(settings.seed, "distill", "adversarial", step)
    with _named(step, "adversarial", sight.camera):
        loss, rendering, line = adversarial_term(gaussians, masked, sight, *real[step % len(real)], adversary, draw)
        _backward(adversary.choices.weight * loss, gaussians)
    drawn = rendering.radii > 0
    return drawn if adversary.choices.reaches == "all" else drawn & masked, line


def _reference(optimizer: GaussianOptimizer, step: int, job: _Job) -> _Done:
    gaussians, masked, weight = optimizer.gaussians, optimizer.masked, job.settings.reference_weight
    if not (weight > 0 and masked.any()):
        return None
    camera, image, hole = job.holes[step % len(job.holes)]
    with _named(step, "reference", camera):
        loss, rendering = reference_term(gaussians, masked, camera, image, hole)
        _backward(weight * loss, gaussians)
    return masked & (rendering.radii > 0), {}


def _reconstruction(optimizer: GaussianOptimizer, step: int, job: _Job) -> _Done:
    gaussians, masked, every = optimizer.gaussians, optimizer.masked, job.settings.reconstruction_every
    if not every or step % every:
        return None
    sight = _drawn(job.sights, step // every, job.settings.seed, "reconstruction")
    with _named(step, "reconstruction", sight.camera):
        loss, rendering = reconstruction_term(gaussians, masked, sight)
        _backward(loss, gaussians)
    return (rendering.radii > 0) & (~masked | sight.clean), {"reconstruction": float(loss.detach())}


def _drawn(sights: Sequence[Sight], turn: int, seed: int, label: str) -> Sight:
    """Every view once an epoch, in an order of the epoch's own."""
    order = torch.randperm(len(sights), generator=trace.generator(seed, "distill", label, turn // len(sights)))
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


def _densify(optimizer: GaussianOptimizer, settings: Settings, done: int) -> None:
    """Clone or split the masked Gaussians pulled hardest on the screen; only they have been observed."""
    if done > settings.densify_until * settings.iterations or not optimizer.masked.any():
        return
    slopes = (optimizer.slope_sum / optimizer.slope_count.clamp(min=1))[optimizer.masked]
    least = torch.finfo(slopes.dtype).tiny
    threshold = max(float(slopes.kthvalue(max(1, round((1 - settings.densify_share) * len(slopes)))).values), least)
    noise = trace.generator(settings.seed, "distill", "densify", done)
    densify(optimizer, threshold, settings.split_above, settings.budget, noise)
    prune(optimizer, settings.least_opacity, float("inf"))


@torch.no_grad()
def reference_psnr(gaussians: Gaussians, holes: Sequence[tuple[Camera, Tensor, Tensor]]) -> float:
    """PSNR in dB over the pixels of all the references' holes."""
    squared = [(render(gaussians, c).color.clamp(0, 1) - image)[hole].square().flatten() for c, image, hole in holes]
    return -10 * log10(max(float(torch.cat(squared).mean()), 1e-10))
