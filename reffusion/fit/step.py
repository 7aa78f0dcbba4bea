"""One step of a fit: render, compute the loss, update; and the schedules of densification, resolution and averaging."""

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
from reffusion.splat.rasterizer import Implementation, render
from reffusion.types import Camera

PRUNE_OPA = 0.005  # opacity below which Gaussians are pruned, as in 3DGS
# For refining an existing scene: between the rates at the start and at the end of a fit, so that Gaussians which
# contradict the views can still move.
REFIT_RATES = Rates(
    means=4e-4, means_last=2e-5, quaternions=2e-3, log_scales=5e-3, opacity_logits=0.05, sh_dc=5e-3, sh_rest=5e-4
)
COARSE_SHARE = 0.3  # of the steps, at the start, that use views of half the size
SPARSE_UNTIL = 0.9  # of the steps, up to which every second pixel is used
AVERAGED_FROM = 0.9  # of the steps, from which on Gaussians are averaged into the result
GROW_SCALE3D = 0.01  # standard deviation / distance to the camera above which a Gaussian is split, not cloned


def learning_rates(lr: LearningRates, cameras: Sequence[Camera]) -> Rates:
    """Adam's learning rates for a fit to these views; that of positions decays to a hundredth."""
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
    impl: Implementation,
) -> tuple[float, float]:
    """Render a view, compute the loss and update; returns the loss and the mean squared error of weighted pixels."""
    location = f"step {i}, view '{camera.name}'"
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
    loss_value = float(loss.detach())
    if not math.isfinite(loss_value):
        raise FloatingPointError(f"fit, {location}: the reconstruction loss is {loss_value}")
    loss.backward()
    if probe is not None:
        assert probe.grad is not None
        optimizer.observe(probe.grad, rendering.radii, camera.width, camera.height)
    try:
        optimizer.step(i / settings.iterations, visible=rendering.radii > 0, sh_degree=degree)
    except FloatingPointError as error:
        raise FloatingPointError(f"fit, {location}, reconstruction: {error}") from None
    if exposures is not None:
        exposures.step(i / settings.iterations)
    return loss_value, squared_error(image.detach(), target, counts)


def squared_error(image: Tensor, target: Tensor, counts: Tensor | None) -> float:
    """Mean squared error over the channels of the pixels with positive weight `counts` [H, W]."""
    if counts is None:
        error = (image - target).flatten()
        return float(error @ error) / error.numel()
    squared = (image - target).square()
    inside = counts > 0
    return float(squared[inside].mean()) if inside.any() else 0.0


def coarse_steps(settings: Params) -> int:
    """Number of initial steps that use views of half the size.

    With a dense start (a point every few pixels) positions are known. Sizes and colours are learnt first, and small
    views are enough for these. 0 without such a start, as in 3DGS.
    """
    return round(COARSE_SHARE * settings.iterations) if settings.init.flow_cell else 0


def sparse_steps(settings: Params) -> range:
    """The steps that use every second pixel each way: from the end of densification up to `SPARSE_UNTIL`.

    None without a dense start, as in 3DGS.
    """
    if not settings.init.flow_cell:
        return range(0)
    return range(round(settings.densify.stop * settings.iterations), round(SPARSE_UNTIL * settings.iterations))


def average(optimizer: GaussianOptimizer, settings: Params, done: int) -> None:
    """Accumulate the Gaussians after `done` steps into the mean, and replace them by it after the last step."""
    if is_averaged(settings, done):
        optimizer.remember()
    if done == settings.iterations:
        optimizer.apply_mean()


def is_averaged(settings: Params, done: int) -> bool:
    """Do the Gaussians after `done` steps count in the final mean?

    Every second of the last steps, after densification, does. In runs like those of 3DGS, which start with few
    Gaussians, none does.
    """
    has_dense_start = settings.init.flow_cell or settings.densify.stop == 0
    first = max(AVERAGED_FROM, settings.densify.stop) * settings.iterations
    return bool(has_dense_start) and done > first and (settings.iterations - done) % 2 == 0


def degree_at(settings: Params, i: int) -> int:
    """Degree of the spherical harmonics in step `i`."""
    if settings.sh.every == 0:
        return settings.sh.degree
    return min(settings.sh.degree, int(i / (settings.sh.every * settings.iterations)))


def control_density(
    optimizer: GaussianOptimizer, centers: Tensor, started_with: int, settings: Params, done: int
) -> None:
    """Densify, prune and reset opacities where the schedule asks for it after `done` steps."""
    schedule, progress = settings.densify, done / settings.iterations
    if not schedule.start <= progress < schedule.stop:
        return
    if done % schedule.every == 0:
        generator = seeding.generator(settings.seed, "densify", done)
        max_gaussians = _max_gaussians(started_with, settings, done)
        distance = viewing_distance(optimizer.gaussians.means, centers)
        densify(optimizer, schedule.grow_grad2d, GROW_SCALE3D * distance, max_gaussians, generator)
        distance = viewing_distance(optimizer.gaussians.means, centers)
        prune(optimizer, PRUNE_OPA, schedule.prune_scale3d * distance)
    period = round(schedule.reset_every * settings.iterations)
    if period and done % period == 0:
        optimizer.cap_opacity(0.01)


def _max_gaussians(started_with: int, settings: Params, done: int) -> int:
    """Maximum number of Gaussians after `done` steps; it grows linearly during densification."""
    first, last = settings.densify.start * settings.iterations, settings.densify.stop * settings.iterations
    progress = (done + settings.densify.every - first) / (last - first)
    return round(started_with + (settings.densify.cap_max - started_with) * min(1.0, progress))
