"""Splatting on the CPU, compiled by numba: float32, all cores, the same bits for any number of threads."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from reffusion.splat import backward, binning, forward, projection
from reffusion.types import Camera, Gaussians, Rendering


class Bins(NamedTuple):
    """Sorted footprints and tile lists of one view; arrays as described in `binning.bin_footprints`."""

    order: np.ndarray
    footprints: np.ndarray
    starts: np.ndarray
    members: np.ndarray
    rows: np.ndarray
    slots: np.ndarray
    first_slots: np.ndarray


def render(
    gaussians: Gaussians, camera: Camera, features: Tensor | None, background: Tensor, degree: int, probe: Tensor | None
) -> Rendering:
    """See `reffusion.splat.render`."""
    blended = background.new_empty(len(gaussians), 0) if features is None else features
    nudge = background.new_empty(0, 2) if probe is None else probe
    color, depth, alpha, blended, radii = _Splat.apply(
        gaussians.means,
        gaussians.quaternions,
        gaussians.log_scales,
        gaussians.opacity_logits,
        gaussians.sh,
        blended,
        background,
        nudge,
        camera,
        degree,
    )
    return Rendering(color, depth, alpha, None if features is None else blended, radii)


def accumulate(gaussians: Gaussians, camera: Camera, values: Tensor, count: bool) -> Tensor:
    """See `reffusion.splat.accumulate`."""
    arrays = [_array(getattr(gaussians, name)) for name in ("means", "quaternions", "log_scales", "opacity_logits")]
    bins, _ = _bin(*arrays, _array(gaussians.sh[:, :1]), np.empty((0, 2), np.float32), camera, 0)
    records = backward.gather_values(*bins[1:6], _array(values), count)
    gathered = np.zeros((len(gaussians), values.shape[-1]), np.float32)
    gathered[bins.order] = backward.add_records(records, bins.first_slots)
    return torch.from_numpy(gathered)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _bin(means, quaternions, log_scales, opacity_logits, sh, probe, camera, degree) -> tuple[Bins, np.ndarray]:
    """Project, sort and bin; returns the bins and radii [N]."""
    footprints, radii = projection.project(
        means, quaternions, log_scales, opacity_logits, probe, projection.view_numbers(camera)
    )
    order = binning.depth_order(radii, footprints)
    footprints = projection.gather_footprints(footprints, order, means, sh, degree, camera.center)
    lists = binning.bin_footprints(footprints, camera.width, camera.height, numba.get_num_threads())
    return Bins(order, footprints, *lists), radii


class _Splat(torch.autograd.Function):
    """Gaussians -> color, depth, alpha, features, radii."""

    @staticmethod
    def forward(ctx, means, quaternions, log_scales, opacity_logits, sh, features, background, probe, camera, degree):
        parameters = [_array(t) for t in (means, quaternions, log_scales, opacity_logits, sh)]
        bins, radii = _bin(*parameters, _array(probe), camera, degree)
        color, depth, blended, transmittance, used = forward.blend(
            bins.footprints,
            _array(features)[bins.order],
            _array(background),
            bins.starts,
            bins.members,
            bins.rows,
            camera.width,
            camera.height,
        )
        outputs = [torch.from_numpy(array) for array in (color, depth, np.float32(1) - transmittance, blended, radii)]
        ctx.mark_non_differentiable(outputs[4])
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(
                means, quaternions, log_scales, opacity_logits, sh, features, *outputs[:2], outputs[3]
            )
            ctx.rest = bins, transmittance, used, camera, degree
        return tuple(outputs)

    @staticmethod
    def backward(ctx, grad_color, grad_depth, grad_alpha, grad_blended, _):
        *inputs, color, depth, blended = (_array(t) for t in ctx.saved_tensors)
        means, quaternions, log_scales, opacity_logits, sh, features = inputs
        bins, transmittance, used, camera, degree = ctx.rest
        grads = [_array(g) for g in (grad_color, grad_depth, grad_alpha, grad_blended)]
        upstream, remainder = backward.upstream_of_blending(
            color, depth, blended, transmittance, *grads, features.shape[1]
        )
        records = backward.blend_backward(
            bins.footprints,
            features[bins.order],
            bins.starts,
            bins.members,
            bins.rows,
            bins.slots,
            used,
            upstream,
            remainder,
            transmittance,
        )
        sums = backward.add_records(records, bins.first_slots)
        g_means, g_quaternions, g_scales, g_opacities, g_probe = projection.project_backward(
            sums,
            bins.order,
            means,
            quaternions,
            log_scales,
            opacity_logits,
            projection.view_numbers(camera),
            ctx.needs_input_grad[7],
        )
        g_sh = projection.colors_backward(sums, bins.order, bins.footprints, means, sh, degree, camera.center, g_means)
        g_features = np.zeros(features.shape, np.float32)
        g_features[bins.order] = sums[:, projection.GRAD_FEATURES :]
        g_background = (transmittance[..., None] * grads[0]).sum((0, 1)) if ctx.needs_input_grad[6] else None
        arrays = (g_means, g_quaternions, g_scales, g_opacities, g_sh, g_features, g_background, g_probe)
        needed = zip(arrays, ctx.needs_input_grad, strict=False)
        return (*(torch.from_numpy(array) if need else None for array, need in needed), None, None)
