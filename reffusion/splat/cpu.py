"""Splatting on the CPU, compiled by numba: float32, all cores, the same bits for any number of threads."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from reffusion.splat import backward, binning, forward, harmonics, projection
from reffusion.splat.compiled import share
from reffusion.types import Camera, Gaussians, Rendering


class View(NamedTuple):
    """The Gaussians that reach one view.

    Attributes:
        order: [M] int32 their indices, front to back.
        ranks: [N] int32, the place of each Gaussian in `order`, or -1.
        footprints: [M, FOOTPRINT] float32, see `projection`.
        bins: starts, members, rows, slots of the tile lists, see `binning.bin_footprints`.
        first_slots: [M + 1] int64.
        radii: [N] int32.
    """

    order: np.ndarray
    ranks: np.ndarray
    footprints: np.ndarray
    bins: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    first_slots: np.ndarray
    radii: np.ndarray


def render(
    gaussians: Gaussians, camera: Camera, features: Tensor | None, background: Tensor, degree: int, probe: Tensor | None
) -> Rendering:
    """See `reffusion.splat.render`."""
    color, depth, alpha, blended, radii = _Splat.apply(
        gaussians.means,
        gaussians.quaternions,
        gaussians.log_scales,
        gaussians.opacity_logits,
        gaussians.sh,
        background.new_empty(len(gaussians), 0) if features is None else features,
        background,
        background.new_empty(0, 2) if probe is None else probe,
        camera,
        degree,
    )
    return Rendering(color, depth, alpha, None if features is None else blended, radii)


def accumulate(gaussians: Gaussians, camera: Camera, values: Tensor, count: bool) -> Tensor:
    """See `reffusion.splat.accumulate`."""
    parameters = (gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.opacity_logits)
    view = _view([_array(p) for p in (*parameters, gaussians.sh)], np.empty((0, 2), np.float32), camera, 0)
    records = backward.gather_values(view.footprints, view.bins, _array(values), count)
    gathered = np.zeros((len(gaussians), values.shape[-1]), np.float32)
    gathered[view.order] = backward.add_records(records, view.first_slots, values.shape[-1])
    return torch.from_numpy(gathered)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _view(parameters: list[np.ndarray], probe: np.ndarray, camera: Camera, degree: int) -> View:
    """Project, sort and bin; `parameters` in the order of `types.PARAMETERS`."""
    *geometry, sh = parameters
    means = geometry[0]
    every, radii = np.empty((len(means), projection.FOOTPRINT), np.float32), np.zeros(len(means), np.int32)
    share(projection.project, *geometry, probe, projection.view_numbers(camera), every, radii)
    order, ranks = binning.depth_order(radii, every)
    footprints = np.empty((len(order), projection.FOOTPRINT), np.float32)
    share(harmonics.paint, every, ranks, means, sh, degree, camera.center, footprints)
    *bins, first_slots = binning.bin_footprints(footprints, camera.width, camera.height)
    return View(order, ranks, footprints, tuple(bins), first_slots, radii)


class _Splat(torch.autograd.Function):
    """Gaussians -> color, depth, alpha, features, radii."""

    @staticmethod
    def forward(ctx, means, quaternions, log_scales, opacity_logits, sh, features, background, probe, camera, degree):
        parameters = [_array(t) for t in (means, quaternions, log_scales, opacity_logits, sh)]
        view = _view(parameters, _array(probe), camera, degree)
        color, depth, alpha, blended, transmittance, used = forward.blend(
            view.footprints,
            _array(features)[view.order],
            _array(background),
            *view.bins[:3],
            camera.width,
            camera.height,
        )
        color, depth, alpha, blended, radii = map(torch.from_numpy, (color, depth, alpha, blended, view.radii))
        ctx.mark_non_differentiable(radii)
        if any(ctx.needs_input_grad):
            inputs = (means, quaternions, log_scales, opacity_logits, sh, features)
            ctx.save_for_backward(*inputs, color, depth, alpha, blended)
            ctx.rest = view, transmittance, used, camera, degree
        return color, depth, alpha, blended, radii

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_color, grad_depth, grad_alpha, grad_blended, _):
        saved = [_array(t) for t in ctx.saved_tensors]
        parameters, features, images = saved[:5], saved[5], saved[6:]
        *geometry, sh = parameters
        means = geometry[0]
        view, transmittance, used, camera, degree = ctx.rest
        gradients = [_array(g) for g in (grad_color, grad_depth, grad_alpha, grad_blended)]
        records = backward.blend_backward(
            view.footprints,
            features[view.order],
            view.bins,
            used,
            images,
            transmittance,
            gradients,
        )
        sums = backward.add_records(records, view.first_slots, projection.GRAD_FEATURES + features.shape[1])

        to_parameters = [np.zeros_like(array) for array in parameters]
        *to_geometry, to_sh = to_parameters
        to_probe = np.zeros((len(means) if ctx.needs_input_grad[7] else 0, 2), np.float32)
        numbers = projection.view_numbers(camera)
        share(projection.project_backward, sums, view.ranks, *geometry, numbers, *to_geometry, to_probe)
        share(
            harmonics.paint_backward,
            *(sums, view.ranks, view.footprints, means, sh, degree, camera.center, to_geometry[0], to_sh),
        )
        to_features = np.zeros_like(features)
        to_features[view.order] = sums[:, projection.GRAD_FEATURES :]
        to_background = np.einsum("hw,hwc->c", transmittance, gradients[0]) if ctx.needs_input_grad[6] else None
        arrays = (*to_parameters, to_features, to_background, to_probe)
        needed = zip(arrays, ctx.needs_input_grad, strict=False)
        return (*(torch.from_numpy(array) if need else None for array, need in needed), None, None)
