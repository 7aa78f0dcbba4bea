"""One step of a fit: render, compare, move; and where the schedule says so, add, prune and fade Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from reffusion import seeding
from reffusion.fit.exposure import Exposures
from reffusion.gaussians.densify import densify, prune, viewing_distance
from reffusion.gaussians.optimize import GaussianOptimizer, Rates, reconstruction_loss
from reffusion.geometry import cameras_extent
from reffusion.kernels.compiled import torch_on_one_thread
from reffusion.params.fit import LearningRates, Params
from reffusion.splat.rasterizer import render
from reffusion.types import Camera

PRUNE_OPA = 0.005  # 3DGS's: fainter Gaussians are pruned
# Between those of a fit's start and end, for a scene that is there, in which what does not agree must move.
GENTLE = Rates(
    means=4e-4,
    means_last=2e-5,
    quaternions=2e-3,
    log_scales=5e-3,
    opacity_logits=0.05,
    sh_dc=5e-3,
    sh_rest=5e-4,
)
COARSE = 0.3  # of the steps, that look at half the size
SPARSE = 0.9  # of the steps, up to which they look at every second pixel
AVERAGED = 0.9  # of the steps, from which on the Gaussians' mean is what a fit ends with
GROW_SCALE3D = 0.01  # deviation / distance from which on a Gaussian is split, not cloned


def rates_of(lr: LearningRates, cameras: Sequence[Camera]) -> Rates:
    """Adam's step sizes of a fit to these views; that of positions falls to a hundredth."""
    rates = Rates(
        means=lr.means,
        means_last=lr.means / 100,
        quaternions=lr.quats,
        log_scales=lr.scales,
        sh_dc=lr.sh0,
        sh_rest=lr.shN,
    )
    return rates.in_units_of(cameras_extent(cameras)) if lr.means_unit == "cameras" else rates


@torch_on_one_thread()
def step(
    optimizer: GaussianOptimizer,
    exposures: Exposures | None,
    camera: Camera,
    target: Tensor,
    counts: Tensor | None,
    settings: Params,
    i: int,
    impl: str,
) -> tuple[float, float]:
    """Render, compare, move; returns the loss and the mean squared error over the pixels that count."""
    where = f"step {i}, view '{camera.name}'"
    probe = None
    if i < settings.densify.stop * settings.iterations:
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
    loss.backward()
    if probe is not None:
        optimizer.observe(probe.grad, rendering.radii, camera.width, camera.height)
    try:
        optimizer.step(i / settings.iterations, visible=rendering.radii > 0, sh_degree=degree)
    except FloatingPointError as error:
        raise FloatingPointError(f"fit, {where}, reconstruction: {error}") from None
    if exposures is not None:
        exposures.step(i / settings.iterations)
    return value, squared_error(image.detach(), target, counts)


def squared_error(image: Tensor, target: Tensor, counts: Tensor | None) -> float:
    """Mean over the channels of the pixels that count."""
    if counts is None:
        error = (image - target).flatten()
        return float(error @ error) / error.numel()
    squared = (image - target).square()
    inside = counts > 0
    return float(squared[inside].mean()) if inside.any() else 0.0


def coarse_steps(settings: Params) -> int:
    """How many of the first steps look at views of half the size. A start with a point every few pixels has its places:
    it is sizes and colours that are learnt first, and those a small view tells as well."""
    return round(COARSE * settings.iterations) if settings.init.flow_cell else 0


def sparse_steps(settings: Params) -> range:
    """Which of the steps look at every second pixel each way: of those after the coarse ones, once no Gaussian is added
    any more, all but the last. None without such a start, as in 3DGS."""
    if not settings.init.flow_cell:
        return range(0)
    return range(round(settings.densify.stop * settings.iterations), round(SPARSE * settings.iterations))


def average(optimizer: GaussianOptimizer, settings: Params, done: int) -> None:
    """Remember the Gaussians after `done` steps where they count, and put the mean in their place after the last."""
    if remembered(settings, done):
        optimizer.remember()
    if done == settings.iterations:
        optimizer.take_mean()


def remembered(settings: Params, done: int) -> bool:
    """Do the Gaussians after so many steps count in the mean that a fit ends with? In the last steps every second, once
    none is added any more; in runs as 3DGS's own, which begins with few, never."""
    many = settings.init.flow_cell or settings.densify.stop == 0
    begin = max(AVERAGED, settings.densify.stop) * settings.iterations
    return bool(many) and done > begin and (settings.iterations - done) % 2 == 0


def degree_at(settings: Params, i: int) -> int:
    """Of the spherical harmonics in step `i`."""
    if settings.sh.every == 0:
        return settings.sh.degree
    return min(settings.sh.degree, int(i / (settings.sh.every * settings.iterations)))


def adapt(optimizer: GaussianOptimizer, centers: Tensor, started_with: int, settings: Params, done: int) -> None:
    """Add, prune and fade Gaussians where the schedule says so after `done` steps."""
    schedule, progress = settings.densify, done / settings.iterations
    if not schedule.start <= progress < schedule.stop:
        return
    if done % schedule.every == 0:
        noise, allowed = seeding.generator(settings.seed, "densify", done), _allowed(started_with, settings, done)
        away = viewing_distance(optimizer.gaussians.means, centers)
        densify(optimizer, schedule.grow_grad2d, GROW_SCALE3D * away, allowed, noise)
        away = viewing_distance(optimizer.gaussians.means, centers)
        prune(optimizer, PRUNE_OPA, schedule.prune_scale3d * away)
    period = round(schedule.reset_every * settings.iterations)
    if period and done % period == 0:
        optimizer.cap_opacity(0.01)


def _allowed(started_with: int, settings: Params, done: int) -> int:
    """The number of Gaussians after `done` steps may be this."""
    first, last = settings.densify.start * settings.iterations, settings.densify.stop * settings.iterations
    passed = (done + settings.densify.every - first) / (last - first)
    return round(started_with + (settings.densify.cap_max - started_with) * min(1.0, passed))
