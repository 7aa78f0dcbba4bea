"""3DGS optimisation of a whole scene from its training views: what `fit` runs, and any baseline that masks pixels."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reffusion import mcmc, trace
from reffusion.densify import densify, prune, viewing_distance
from reffusion.exposure import Exposures
from reffusion.feed import check_sizes, sample, samples
from reffusion.optimize import GaussianOptimizer, Rates, reconstruction_loss
from reffusion.splat import render
from reffusion.types import PARAMETERS, Camera, Gaussians

GROWTH = 1.05  # mcmc: the number grows by at most a twentieth at a time


@dataclass(frozen=True)
class Settings:
    """How long and how finely to fit. Moments are parts of the run in [0, 1].

    PAPER leaves open: 3DGS measures Gaussians by the extent of the cameras, and so, in a street, prunes what is far
    away and large. Here sizes are standard deviations divided by the distance to the nearest camera.

    Attributes:
        iterations: optimisation steps, one view each.
        seed: of the order of the views, random backgrounds and splits.
        sh_degree: highest degree of the spherical harmonics, 0-3.
        sh_every: part of the run after which one more degree joins in (3DGS: 1000 of 30000 steps).
        random_background: a new colour each step instead of black.
            PAPER leaves open: 3DGS takes black by default. Dark texture is then drawn by leaving holes, which the
            stages after this one would read as places that no Gaussian explains.
        coarse_until: part of the run on views of half the width and height, whose steps take about a third of the time.
        densify_by: `slopes`, 3DGS's way; `mcmc`, see `reffusion.mcmc`, in which `slope`, `split_above`, `largest` and
            `reset_every` mean nothing.
        opacity_weight, scale_weight: of the mean opacity and standard deviation in the loss; they make room for
            relocation (mcmc: 0.01 each, 3DGS: 0).
        densify_from, densify_until: parts of the run between which Gaussians are added.
        densify_every: steps between two densifications.
        slope: mean screen-space gradient from which on a Gaussian is cloned or split, see `densify`.
        split_above: size from which on a Gaussian is split, not cloned.
        budget: most Gaussians, reached at `densify_until`: the number allowed grows evenly from that of the start, so
            that some are left for where late views still pull.
        least_opacity: fainter Gaussians are pruned.
        largest: Gaussians of a larger size are pruned.
        reset_every: part of the run after which opacities are capped at 0.01, while densifying; 0: never.
        exposure: fit each view's exposure too, see `reffusion.exposure`.
        rates, betas: Adam's step sizes, and its memory of gradients and of their squares (3DGS: 0.9, 0.999). A short
            run is better off with a short memory.
        patience, stop_gain: stop when in so many twentieths of the run the main quantity of the trace has not gained so
            many dB; 0: never. Counted from `densify_until` on: before, it rises and falls with the Gaussians' number.
        checkpoint_seconds: seconds of work between checkpoints.
    """

    iterations: int = 30_000
    seed: int = 0
    sh_degree: int = 3
    sh_every: float = 1 / 30
    random_background: bool = True
    coarse_until: float = 0.0
    densify_by: str = "slopes"
    opacity_weight: float = 0.0
    scale_weight: float = 0.0
    densify_from: float = 1 / 60
    densify_until: float = 0.5
    densify_every: int = 100
    slope: float = 2e-4
    split_above: float = 0.01
    budget: int = 1_000_000
    least_opacity: float = 0.005
    largest: float = 0.5
    reset_every: float = 0.1
    exposure: bool = False
    rates: Rates = field(default_factory=Rates)
    betas: tuple[float, float] = (0.9, 0.999)
    patience: int = 0
    stop_gain: float = 0.0
    checkpoint_seconds: float = 10.0


def fit(
    cameras: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    initial: Gaussians,
    settings: Settings,
    *,
    folder: Path,
    weights: Mapping[str, np.ndarray] | None = None,
    held_out: Sequence[Camera] = (),
    spent: float = 0.0,
    impl: str = "auto",
) -> Gaussians:
    """Optimise `initial` until its renders look like the views; resumes from `folder`'s checkpoint, bit for bit.

    Args:
        cameras: the views to fit, at least one.
        images: view name -> uint8 [H, W, 3], for `cameras` and `held_out`.
        initial: the Gaussians to start from; the work is done on their device. Where there is a checkpoint, only their
            degree, device and way of being drawn still matter.
        folder: gets trace.jsonl (loss, psnr of the steps since the last line, gaussians, and psnr_held_out, during
            whose measurement the clock stands), checkpoints, and exposures.json where they are fitted.
        weights: view name -> [H, W], how much each pixel counts; pixels of weight 0, and they alone, influence nothing.
            A view without an entry counts as a whole.
        held_out: views that are only measured.
        spent: seconds that making `initial` took; the trace counts from there.
        impl: `splat.render`'s.

    Raises:
        ValueError: no view, or an image or mask of another size than its camera; before any work.
        FloatingPointError: a loss, gradient or parameter became infinite or NaN; names the step and the view.
    """
    weights = weights or {}
    if not cameras:
        raise ValueError("a fit needs at least one view")
    check_sizes(cameras, images, weights)
    check_sizes(held_out, images, {})
    run = _Run.begun(initial, cameras, settings, trace.load_checkpoint(folder), spent)
    optimizer, exposures = run.optimizer, run.exposures
    log = trace.Trace(folder, run.seconds, run.iteration + 1 if run.iteration else 0)
    centers = torch.tensor(np.stack([camera.center for camera in cameras]), dtype=torch.float32)
    saved_at, measured = time.monotonic(), (held_out, images, settings)
    if run.iteration == 0:
        with log.paused():
            log.log(0, **_summary(run, *measured, impl))

    coarse = settings.coarse_until * settings.iterations
    for i, (camera, target, counts) in zip(
        trace.progress(settings.iterations, "fit", run.iteration),
        samples(cameras, images, weights, range(run.iteration, settings.iterations), settings.seed, coarse),
        strict=False,  # it may stop early
    ):
        target, counts = _move(target, optimizer), _move(counts, optimizer)
        loss, error = _step(optimizer, exposures, camera, target, counts, settings, i, impl)
        run.iteration = done = i + 1
        run.loss, run.error, run.steps = run.loss + loss, run.error + error, run.steps + 1
        _adapt(optimizer, centers, run.started_with, settings, done)
        if not len(optimizer.gaussians):
            raise ValueError(f"fit, step {i}: pruning left no Gaussian: lower `least_opacity`, or raise `largest`")
        if run.patience.due(done, settings.iterations):
            _check_finite(optimizer.gaussians, f"step {i}, view '{camera.name}'")
            with log.paused():
                line = _summary(run, *measured, impl)
                end = _end(run, line, settings)
                log.log(done, **line, **end)
            run.loss, run.error, run.steps = 0.0, 0.0, 0
            if end:
                break
        if time.monotonic() - saved_at > settings.checkpoint_seconds and done < settings.iterations:
            _check_finite(optimizer.gaussians, f"step {i}, view '{camera.name}'")
            trace.save_checkpoint(folder, run.state_dict() | {"seconds": log.seconds})
            saved_at = time.monotonic()
    if exposures is not None:
        exposures.save(folder)
    return optimizer.gaussians.map(Tensor.detach)


@dataclass
class _Run:
    """What a fit continues from.

    Attributes:
        started_with: Gaussians at the start. iteration, seconds: done and spent so far.
        loss, error, steps: sums over the steps since the last line of the trace, and their number.
    """

    optimizer: GaussianOptimizer
    exposures: Exposures | None
    patience: trace.Patience
    started_with: int
    seconds: float
    iteration: int = 0
    loss: float = 0.0
    error: float = 0.0
    steps: int = 0

    _NUMBERS = ("started_with", "seconds", "iteration", "loss", "error", "steps")

    @classmethod
    def begun(
        cls,
        initial: Gaussians,
        cameras: Sequence[Camera],
        settings: Settings,
        state: dict[str, Any] | None,
        spent: float,
    ) -> _Run:
        """From the start, or from a checkpoint's state."""
        exposures = Exposures((camera.name for camera in cameras), initial.means.device) if settings.exposure else None
        optimizer = GaussianOptimizer(initial, rates=settings.rates, betas=settings.betas)
        run = cls(optimizer, exposures, trace.Patience(settings.patience, settings.stop_gain), len(initial), spent)
        if state is not None:
            optimizer.load_state_dict(state["optimizer"])
            run.patience.load_state_dict(state["patience"])
            if exposures is not None:
                exposures.load_state_dict(state["exposures"])
            for name in cls._NUMBERS:
                setattr(run, name, state[name])
        return run

    def state_dict(self) -> dict[str, Any]:
        state = {"optimizer": self.optimizer.state_dict(), "patience": self.patience.state_dict()}
        state["exposures"] = self.exposures and self.exposures.state_dict()
        return state | {name: getattr(self, name) for name in self._NUMBERS}


def _end(run: _Run, line: Mapping[str, float], settings: Settings) -> dict[str, Any]:
    """What this line of the trace says of the end, {} while the fit goes on. Its result is always the last state."""
    main = line.get("psnr_held_out", line["psnr"])
    end = run.patience.ends(run.iteration, settings.iterations, main, settings.densify_until)
    return end and end | {"kept": run.iteration}


def _move(tensor: Tensor | None, optimizer: GaussianOptimizer) -> Tensor | None:
    return None if tensor is None else tensor.to(optimizer.masked.device, non_blocking=True)


def _step(
    optimizer: GaussianOptimizer,
    exposures: Exposures | None,
    camera: Camera,
    target: Tensor,
    counts: Tensor | None,
    settings: Settings,
    i: int,
    impl: str,
) -> tuple[float, float]:
    """Render, compare, move; returns the loss and the mean squared error over the pixels that count."""
    where = f"step {i}, view '{camera.name}'"
    probe = None
    if settings.densify_by == "slopes" and i < settings.densify_until * settings.iterations:
        probe = torch.zeros(len(optimizer.gaussians), 2, device=target.device, requires_grad=True)
    background = None
    if settings.random_background:
        background = torch.rand(3, generator=trace.generator(settings.seed, "background", i)).to(target.device)
    degree = _degree(settings, i)
    rendering = render(optimizer.gaussians, camera, background=background, impl=impl, sh_degree=degree, probe=probe)
    image = rendering.color if exposures is None else exposures.apply(rendering.color, camera.name)
    loss = reconstruction_loss(image, target, counts)
    value = float(loss.detach())
    if not math.isfinite(value):
        raise FloatingPointError(f"fit, {where}: the reconstruction loss is {value}")
    (loss + _thrift(optimizer.gaussians, settings)).backward()
    if probe is not None:
        optimizer.observe(probe.grad, rendering.radii, camera.width, camera.height)
    try:
        optimizer.step(i / settings.iterations, visible=rendering.radii > 0, sh_degree=degree)
    except FloatingPointError as error:
        raise FloatingPointError(f"fit, {where}, reconstruction: {error}") from None
    if settings.densify_by == "mcmc":
        mcmc.explore(optimizer, i / settings.iterations, trace.generator(settings.seed, "explore", i))
    if exposures is not None:
        exposures.step(i / settings.iterations)
    return value, _squared_error(image.detach(), target, counts)


def _thrift(gaussians: Gaussians, settings: Settings) -> Tensor | float:
    """The price of opacity and size."""
    price = 0.0
    if settings.opacity_weight:
        price = price + settings.opacity_weight * gaussians.opacity_logits.sigmoid().mean()
    if settings.scale_weight:
        price = price + settings.scale_weight * gaussians.log_scales.exp().mean()
    return price


def _squared_error(image: Tensor, target: Tensor, counts: Tensor | None) -> float:
    if counts is None:
        error = (image - target).flatten()
        return float(error @ error) / error.numel()
    squared = (image - target).square()
    inside = counts > 0
    return float(squared[inside].mean()) if inside.any() else 0.0


def _degree(settings: Settings, i: int) -> int:
    if settings.sh_every == 0:
        return settings.sh_degree
    return min(settings.sh_degree, int(i / (settings.sh_every * settings.iterations)))


def _adapt(optimizer: GaussianOptimizer, centers: Tensor, started_with: int, settings: Settings, done: int) -> None:
    """Add, prune and fade Gaussians where the schedule says so after `done` steps."""
    progress = done / settings.iterations
    if not settings.densify_from <= progress < settings.densify_until:
        return
    noise, due = trace.generator(settings.seed, "densify", done), done % settings.densify_every == 0
    if settings.densify_by == "mcmc":
        if due:
            mcmc.relocate(optimizer, settings.least_opacity, noise)
            allowed = min(_allowed(started_with, settings, done), round(GROWTH * len(optimizer.gaussians)))
            mcmc.grow(optimizer, allowed - len(optimizer.gaussians), settings.least_opacity, noise)
            optimizer.forget_slopes()
        return
    if due:
        away = viewing_distance(optimizer.gaussians.means, centers)
        densify(optimizer, settings.slope, settings.split_above * away, _allowed(started_with, settings, done), noise)
        away = viewing_distance(optimizer.gaussians.means, centers)
        prune(optimizer, settings.least_opacity, settings.largest * away)
    period = round(settings.reset_every * settings.iterations)
    if period and done % period == 0:
        optimizer.cap_opacity(0.01)


def _allowed(started_with: int, settings: Settings, done: int) -> int:
    """The number of Gaussians after `done` steps may be this."""
    first, last = settings.densify_from * settings.iterations, settings.densify_until * settings.iterations
    passed = (done + settings.densify_every - first) / (last - first)
    return round(started_with + (settings.budget - started_with) * min(1.0, passed))


def _summary(
    run: _Run, held_out: Sequence[Camera], images: Mapping[str, np.ndarray], settings: Settings, impl: str
) -> dict[str, Any]:
    """A line of the trace; without steps since the last line there is no loss and no training PSNR."""
    line: dict[str, Any] = {"gaussians": len(run.optimizer.gaussians)}
    if run.steps:
        line = {"loss": run.loss / run.steps, "psnr": trace.decibels(run.error / run.steps)} | line
    if not held_out:
        return line
    degree, gaussians = _degree(settings, run.iteration), run.optimizer.gaussians.map(Tensor.detach)
    psnr = []
    for camera in held_out:
        image = render(gaussians, camera, impl=impl, sh_degree=degree).color.clamp(0, 1)
        target = _move(sample(camera, images[camera.name], None)[1], run.optimizer)
        psnr.append(trace.decibels(_squared_error(image, target, None)))
    return line | {"psnr_held_out": sum(psnr) / len(psnr)}


def _check_finite(gaussians: Gaussians, where: str) -> None:
    for name in PARAMETERS:
        if not torch.isfinite(getattr(gaussians, name).detach()).all():
            raise FloatingPointError(f"fit, {where}: the Gaussians' {name} are not finite")
