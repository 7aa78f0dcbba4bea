"""One step of a fit: render, compare, move; and where the schedule says so, add, prune and fade Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from reffusion import seeding
from reffusion.fit.exposure import Exposures
from reffusion.gaussians import mcmc
from reffusion.gaussians.densify import densify, prune, viewing_distance
from reffusion.gaussians.optimize import GaussianOptimizer, Rates, reconstruction_loss
from reffusion.splat.rasterizer import render
from reffusion.types import Camera, Gaussians

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
        densify_by: `slopes`, 3DGS's way; `mcmc`, see `gaussians.mcmc`, in which `slope`, `split_above`, `largest` and
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
        exposure: fit each view's exposure too, see `reffusion.fit.exposure`.
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


def step(
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
        background = torch.rand(3, generator=seeding.generator(settings.seed, "background", i)).to(target.device)
    degree = degree_at(settings, i)
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
        mcmc.explore(optimizer, i / settings.iterations, seeding.generator(settings.seed, "explore", i))
    if exposures is not None:
        exposures.step(i / settings.iterations)
    return value, squared_error(image.detach(), target, counts)


def _thrift(gaussians: Gaussians, settings: Settings) -> Tensor | float:
    """The price of opacity and size."""
    price = 0.0
    if settings.opacity_weight:
        price = price + settings.opacity_weight * gaussians.opacity_logits.sigmoid().mean()
    if settings.scale_weight:
        price = price + settings.scale_weight * gaussians.log_scales.exp().mean()
    return price


def squared_error(image: Tensor, target: Tensor, counts: Tensor | None) -> float:
    """Mean over the channels of the pixels that count."""
    if counts is None:
        error = (image - target).flatten()
        return float(error @ error) / error.numel()
    squared = (image - target).square()
    inside = counts > 0
    return float(squared[inside].mean()) if inside.any() else 0.0


def degree_at(settings: Settings, i: int) -> int:
    """Of the spherical harmonics in step `i`."""
    if settings.sh_every == 0:
        return settings.sh_degree
    return min(settings.sh_degree, int(i / (settings.sh_every * settings.iterations)))


def adapt(optimizer: GaussianOptimizer, centers: Tensor, started_with: int, settings: Settings, done: int) -> None:
    """Add, prune and fade Gaussians where the schedule says so after `done` steps."""
    progress = done / settings.iterations
    if not settings.densify_from <= progress < settings.densify_until:
        return
    noise, due = seeding.generator(settings.seed, "densify", done), done % settings.densify_every == 0
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
