"""One step of a fit (render, compute the loss, update), and the schedules of densification, resolution and averaging.

A *dense start* below is a start with many points: `fit.init.flow_cell` adds a point from optical flow every few pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from reffusion import seeding
from reffusion.fit.exposure import Exposures
from reffusion.gaussians.densify import PRUNED_OPACITY, SPLIT_SCALE, densify, prune, viewing_distance
from reffusion.gaussians.optimize import GaussianOptimizer, Rates, reconstruction_loss
from reffusion.geometry import cameras_extent
from reffusion.kernels.compiled import torch_on_one_thread
from reffusion.params.fit import Densify, LearningRates, Params
from reffusion.splat.rasterizer import render
from reffusion.types import Camera

# Learning rates for refining an existing scene. The rates of positions lie between those at the start and at the end of
# a fit with the profile `laptop`, so that Gaussians which contradict the views can still move.
REFIT_RATES = Rates(
    means=4e-4, means_last=2e-5, quaternions=2e-3, log_scales=5e-3, opacity_logits=0.05, sh_dc=5e-3, sh_rest=5e-4
)
COARSE_SHARE = 0.3  # share of the steps, at the start, that use views of half the size
AVERAGED_FROM = 0.9  # share of the steps after which Gaussians are averaged into the result


def learning_rates(lr: LearningRates, cameras: Sequence[Camera]) -> Rates:
    """Return Adam's learning rates for a fit to these views.

    The learning rate of positions decays to a hundredth of `lr.means` by the end of the fit. With `lr.means_unit` =
    "cameras" it is in units of `cameras_extent(cameras)`, the unit of 3DGS, else in units of the normalized frame. The
    views matter only for this unit.
    """
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
) -> tuple[float, float]:
    """Take one optimization step on one view: render the view, compute the loss, and update Gaussians and exposures.

    As long as the schedule densifies, the screen-space gradients of the step are accumulated in `optimizer`.

    Args:
        optimizer: holds the Gaussians, which are updated in place.
        exposures: exposures of the views, which are updated, too; None leaves colors as they are rendered.
        camera: the view.
        target: [H, W, 3] in [0, 1], its photograph.
        counts: [H, W], weights of its pixels; None: all 1.
        settings: parameters of the stage `fit`.
        i: number of the step, from 0.

    Returns:
        The reconstruction loss with the weights `counts`, and the unweighted mean squared error of the pixels of
        positive weight. Both compare the rendering before the update, with the view's exposure applied.

    Raises:
        FloatingPointError: the loss or a gradient is infinite or NaN. The message names the step and the view.
    """
    location = f"step {i}, view '{camera.name}'"
    probe = None
    if i < settings.densify.stop * settings.iterations:
        probe = torch.zeros(len(optimizer.gaussians), 2, device=target.device, requires_grad=True)
    background = None
    if settings.random_background:
        background = torch.rand(3, generator=seeding.generator(settings.seed, "background", i)).to(target.device)
    degree = degree_at(settings, i)
    rendering = render(optimizer.gaussians, camera, background=background, sh_degree=degree, probe=probe)
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
    """Return the mean squared error between two pictures, over the channels of the pixels of positive weight.

    Args:
        image, target: [H, W, 3].
        counts: [H, W], weights of the pixels, which only select pixels: all positive weights count the same. None
            includes all pixels. If no weight is positive, the error is 0.
    """
    if counts is None:
        error = (image - target).flatten()
        return float(error @ error) / error.numel()
    squared = (image - target).square()
    inside = counts > 0
    return float(squared[inside].mean()) if inside.any() else 0.0


def coarse_steps(settings: Params) -> int:
    """Return the number of steps, at the start, that use views of half the size.

    With a dense start positions are known. Sizes and colors are learned first, and small views are enough for these.
    Without a dense start the number is 0, as in 3DGS.
    """
    return round(COARSE_SHARE * settings.iterations) if settings.init.flow_cell else 0


def average(optimizer: GaussianOptimizer, settings: Params, done: int) -> None:
    """Add the current Gaussians to the running mean if `is_averaged`; after the last step replace them by the mean.

    Args:
        done: number of steps done, this one included.
    """
    if is_averaged(settings, done):
        optimizer.remember()
    if done == settings.iterations:
        optimizer.apply_mean()


def is_averaged(settings: Params, done: int) -> bool:
    """Return whether the Gaussians after `done` steps are part of the mean that becomes the result of the fit.

    The mean contains the Gaussians after every second one of the last steps (from the share `AVERAGED_FROM` of the fit
    on, and after densification). A fit that starts with few Gaussians and densifies, as 3DGS, has no such mean.
    """
    has_dense_start = settings.init.flow_cell or settings.densify.stop == 0
    first = max(AVERAGED_FROM, settings.densify.stop) * settings.iterations
    return bool(has_dense_start) and done > first and (settings.iterations - done) % 2 == 0


def degree_at(settings: Params, i: int) -> int:
    """Return the degree of spherical harmonics that step `i` renders.

    It is 0 at first, and grows by one each time another share `sh.every` of the fit's steps is done, up to `sh.degree`.
    With `sh.every` = 0 it is `sh.degree` from the first step on.
    """
    if settings.sh.every == 0:
        return settings.sh.degree
    return min(settings.sh.degree, int(i / (settings.sh.every * settings.iterations)))


def control_density(
    optimizer: GaussianOptimizer, cameras: Sequence[Camera], started_with: int, settings: Params, done: int
) -> None:
    """Densify, prune and reset opacities (cap them at 0.01), each if `settings.densify` schedules it after this step.

    Args:
        optimizer: holds the Gaussians, which are replaced or changed in place.
        cameras: the training views. `settings.densify.size_unit` is measured from them.
        started_with: number of Gaussians at the start of the fit.
        done: number of steps done, this one included.
    """
    schedule, progress = settings.densify, done / settings.iterations
    if not schedule.start < progress < schedule.stop:
        return
    period = round(schedule.reset_every * settings.iterations)
    if done % schedule.every == 0:
        generator = seeding.generator(settings.seed, "densify", done)
        max_gaussians = _max_gaussians(started_with, settings, done)
        unit = _size_unit(optimizer.gaussians.means, cameras, schedule)
        densify(optimizer, schedule.grow_grad2d, SPLIT_SCALE * unit, max_gaussians, generator)
        unit = _size_unit(optimizer.gaussians.means, cameras, schedule)
        # As in 3DGS, large Gaussians stay until the first reset of opacities: at first they stand for whole surfaces.
        prune(optimizer, PRUNED_OPACITY, schedule.prune_scale3d * unit if done > period else math.inf)
    if period and done % period == 0:
        optimizer.cap_opacity()


def _size_unit(means: Tensor, cameras: Sequence[Camera], schedule: Densify) -> Tensor | float:
    """Return the unit of sizes: the extent of the cameras, or the viewing distance of each Gaussian, [N]."""
    if schedule.size_unit == "cameras":
        return cameras_extent(cameras)
    return viewing_distance(means, torch.tensor(np.stack([each.center for each in cameras]), dtype=torch.float32))


def _max_gaussians(started_with: int, settings: Params, done: int) -> int:
    """Return the maximum number of Gaussians after the densification at `done` steps."""
    if settings.densify.cap_growth == "immediate":
        return settings.densify.cap_max
    # With `densify.cap_growth: linear` the maximum grows linearly while the schedule densifies, so that late
    # densifications can still add Gaussians.
    first, last = settings.densify.start * settings.iterations, settings.densify.stop * settings.iterations
    progress = (done + settings.densify.every - first) / (last - first)
    return round(started_with + (settings.densify.cap_max - started_with) * min(1.0, progress))
