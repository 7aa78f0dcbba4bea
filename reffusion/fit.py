"""3DGS optimisation of a whole scene from its training views: what `fit` runs, and any baseline that masks pixels."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from reffusion import mcmc, trace
from reffusion.densify import densify, prune, viewing_distance
from reffusion.exposure import Exposures
from reffusion.optimize import GaussianOptimizer, Rates, reconstruction_loss
from reffusion.splat import render
from reffusion.types import PARAMETERS, Camera, Gaussians

GROWTH = 1.05  # mcmc: the number grows by at most a twentieth at a time
SH_0 = 0.28209479177387814  # the constant spherical harmonic


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
    _check_sizes(cameras, images, weights)
    _check_sizes(held_out, images, {})
    optimizer, start = GaussianOptimizer(initial, rates=settings.rates, betas=settings.betas), 0
    exposures = Exposures((camera.name for camera in cameras), initial.means.device) if settings.exposure else None
    recent, started_with = {"loss": 0.0, "error": 0.0, "steps": 0}, len(initial)
    state, seconds = trace.load_checkpoint(folder), spent
    if state is not None:
        optimizer.load_state_dict(state["optimizer"])
        if exposures is not None:
            exposures.load_state_dict(state["exposures"])
        start, seconds, recent = state["iteration"], state["seconds"], state["recent"]
        started_with = state["started_with"]
    log = trace.Trace(folder, seconds, start + 1)  # a line is numbered by the steps done
    centers = torch.tensor(np.stack([camera.center for camera in cameras]), dtype=torch.float32)
    saved_at = time.monotonic()

    for i, (camera, target, counts) in zip(
        trace.progress(settings.iterations, "fit", start),
        _samples(cameras, images, weights, settings, start),
        strict=True,
    ):
        target, counts = _move(target, optimizer), _move(counts, optimizer)
        loss, error = _step(optimizer, exposures, camera, target, counts, settings, i, impl)
        recent = {"loss": recent["loss"] + loss, "error": recent["error"] + error, "steps": recent["steps"] + 1}
        done = i + 1
        _adapt(optimizer, centers, started_with, settings, done)
        if not len(optimizer.gaussians):
            raise ValueError(f"fit, step {i}: pruning left no Gaussian: lower `least_opacity`, or raise `largest`")
        if trace.log_spaced(done, settings.iterations):
            _check_finite(optimizer.gaussians, f"step {i}, view '{camera.name}'")
            with log.paused():
                line = _summary(recent, optimizer, held_out, images, settings, done, impl)
            log.log(done, **line)
            recent = {"loss": 0.0, "error": 0.0, "steps": 0}
        if time.monotonic() - saved_at > settings.checkpoint_seconds and done < settings.iterations:
            _check_finite(optimizer.gaussians, f"step {i}, view '{camera.name}'")
            state = {"optimizer": optimizer.state_dict(), "iteration": done, "recent": recent, "seconds": log.seconds}
            state |= {"started_with": started_with, "exposures": exposures and exposures.state_dict()}
            trace.save_checkpoint(folder, state)
            saved_at = time.monotonic()
    if exposures is not None:
        exposures.save(folder)
    return optimizer.gaussians.map(Tensor.detach)


def initial_gaussians(
    points: np.ndarray,
    colors: np.ndarray,
    sh_degree: int,
    budget: int,
    generator: torch.Generator,
    opacity: float = 0.1,
    size: float = 1.0,
) -> Gaussians:
    """3DGS's start: a round Gaussian at each point, sized by the way to its 3 nearest neighbours.

    Args:
        points: [P, 3] in the normalised frame, P >= 4.
        colors: [P, 3] uint8.
        budget: no more Gaussians than this; a random subset of the points then.
        generator: of that subset.
        opacity: of each, in (0, 1). size: standard deviations over that way (root mean square).

    Raises:
        ValueError: fewer than 4 points.
    """
    if len(points) < 4:
        raise ValueError(f"a fit starts from sparse points, at least 4; the scene has {len(points)}")
    if len(points) > budget:
        kept = torch.randperm(len(points), generator=generator)[:budget].numpy()
        points, colors = points[kept], colors[kept]
    distance = cKDTree(points).query(points, k=4)[0][:, 1:]
    spread = size * np.sqrt((distance**2).mean(1)).clip(min=1e-4)
    count = len(points)
    sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = (torch.from_numpy(colors.astype(np.float32)) / 255 - 0.5) / SH_0
    return Gaussians(
        means=torch.from_numpy(points.astype(np.float32)),
        quaternions=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.from_numpy(np.log(spread).astype(np.float32))[:, None].repeat(1, 3),
        opacity_logits=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh=sh,
    )


def _samples(
    cameras: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    weights: Mapping[str, np.ndarray],
    settings: Settings,
    start: int,
) -> Iterator[tuple[Camera, Tensor, Tensor | None]]:
    """What the steps from `start` on see, each prepared by a thread of its own while the step before it runs."""

    def sample(i: int) -> tuple[Camera, Tensor, Tensor | None]:
        camera = cameras[_view(i, len(cameras), settings.seed)]
        return _sample(camera, images[camera.name], weights.get(camera.name))

    with ThreadPoolExecutor(1, thread_name_prefix="fit") as ahead:
        coming = ahead.submit(sample, start)
        for i in range(start, settings.iterations):
            ready = coming.result()
            coming = ahead.submit(sample, min(i + 1, settings.iterations - 1))
            yield ready


def _view(iteration: int, count: int, seed: int) -> int:
    """Every view once an epoch, in an order of the epoch's own."""
    order = torch.randperm(count, generator=trace.generator(seed, "views", iteration // count))
    return int(order[iteration % count])


def _sample(camera: Camera, image: np.ndarray, weights: np.ndarray | None) -> tuple[Camera, Tensor, Tensor | None]:
    """The view as the step sees it: camera, image in [0, 1], weights."""
    counts = None if weights is None else torch.from_numpy(np.asarray(weights, np.float32))
    return camera, torch.from_numpy(image).float() / 255, counts


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
    recent: Mapping[str, float],
    optimizer: GaussianOptimizer,
    held_out: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    settings: Settings,
    done: int,
    impl: str,
) -> dict[str, Any]:
    steps = max(recent["steps"], 1)
    line = {
        "loss": recent["loss"] / steps,
        "psnr": -10 * math.log10(max(recent["error"] / steps, 1e-10)),
        "gaussians": len(optimizer.gaussians),
    }
    if not held_out:
        return line
    degree, gaussians = _degree(settings, done), optimizer.gaussians.map(Tensor.detach)
    psnr = []
    for camera in held_out:
        image = render(gaussians, camera, impl=impl, sh_degree=degree).color.clamp(0, 1)
        error = _squared_error(image, _move(_sample(camera, images[camera.name], None)[1], optimizer), None)
        psnr.append(-10 * math.log10(max(error, 1e-10)))
    return line | {"psnr_held_out": sum(psnr) / len(psnr)}


def _check_sizes(cameras: Sequence[Camera], images: Mapping[str, np.ndarray], weights: Mapping[str, np.ndarray]):
    for camera in cameras:
        for kind, array in (("image", images.get(camera.name)), ("mask", weights.get(camera.name))):
            if array is None and kind == "image":
                raise ValueError(f"view '{camera.name}': no image was given")
            if array is not None and array.shape[:2] != (camera.height, camera.width):
                size = f"{array.shape[1]}x{array.shape[0]}"
                raise ValueError(f"view '{camera.name}': {kind} is {size}, camera is {camera.width}x{camera.height}")


def _check_finite(gaussians: Gaussians, where: str) -> None:
    for name in PARAMETERS:
        if not torch.isfinite(getattr(gaussians, name).detach()).all():
            raise FloatingPointError(f"fit, {where}: the Gaussians' {name} are not finite")
