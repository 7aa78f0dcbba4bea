"""Splatting on the CPU, compiled by numba, in float32 on all cores; results are the same for any number of threads."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from reffusion.kernels.compiled import empty_aligned, parallel_for
from reffusion.splat import backward, binning, footprints, forward
from reffusion.splat.layout import FOOTPRINT
from reffusion.splat.projection import view_numbers
from reffusion.types import Camera, Gaussians, Rendering


class ProjectedView(NamedTuple):
    """The Gaussians projected into one view, as footprints, and binned by tile.

    Attributes:
        footprints: [padded(N), FOOTPRINT] float32 flat (columns: see `layout`; N is rounded up by `footprints.padded`).
        radii: [padded(N)] int32, radii of the footprints in pixels, 0 where culled.
        bins: lists of the footprints that touch each tile.
    """

    footprints: np.ndarray
    radii: np.ndarray
    bins: binning.Bins


def render(
    gaussians: Gaussians, camera: Camera, features: Tensor | None, background: Tensor, degree: int, probe: Tensor | None
) -> Rendering:
    """Render Gaussians; see `reffusion.splat.rasterizer.render`, which checks the arguments."""
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
        gaussians.antialiased,
    )
    return Rendering(color, depth, alpha, None if features is None else blended, radii)


def accumulate(gaussians: Gaussians, camera: Camera, values: Tensor, count: bool) -> Tensor:
    """Sum pixel values by Gaussian; see `reffusion.splat.rasterizer.accumulate`, which checks the arguments."""
    parameters = (gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.opacity_logits, gaussians.sh)
    no_probe = np.empty((0, 2), np.float32)
    view = project_and_bin([_array(p) for p in parameters], gaussians.antialiased, no_probe, camera, 0)
    records, written = backward.gather_values(view.footprints, view.bins, _array(values), count)
    gathered = np.empty((footprints.padded(len(gaussians)), values.shape[-1]), np.float32)
    parallel_for(footprints.add_all_records, records, written, view.bins.first_slots, gathered)
    return torch.from_numpy(gathered[: len(gaussians)])


def _array(tensor: Tensor) -> np.ndarray:
    """Return a tensor on the CPU as a contiguous array, without a copy if possible."""
    return tensor.detach().contiguous().numpy()


def project_and_bin(
    parameters: list[np.ndarray], antialiased: bool, probe: np.ndarray, camera: Camera, degree: int
) -> ProjectedView:
    """Project the Gaussians into a view, sort them by depth, and list them by tile.

    Args:
        parameters: float32 arrays in the order of `types.PARAMETERS`.
        antialiased: True uses the 2D filter of Mip-Splatting.
        probe: [N, 2] added to the 2D means, in pixels, or [0, 2] for none.
        camera: the view.
        degree: degree of the spherical harmonics used.
    """
    count, rows = len(parameters[0]), footprints.padded(len(parameters[0]))
    footprint_array, radii = empty_aligned(rows * FOOTPRINT), np.zeros(rows, np.int32)
    view_arguments = view_numbers(camera, antialiased), camera.center
    parallel_for(
        footprints.project_gaussians,
        _flat(parameters, degree),
        probe.reshape(-1),
        *view_arguments,
        footprint_array,
        radii,
        gaussians=count,
    )
    order = binning.depth_order(radii[:count], footprint_array)
    return ProjectedView(
        footprint_array, radii, binning.bin_footprints(footprint_array, order, count, camera.width, camera.height)
    )


def _flat(parameters: list[np.ndarray], degree: int) -> footprints.Parameters:
    """Return the parameters as flat arrays, in the form that kernels take."""
    means, quaternions, log_scales, logits, sh = (array.reshape(-1) for array in parameters)
    width = 3 * parameters[4].shape[1]
    return footprints.Parameters(means, quaternions, log_scales, logits, sh, width, degree)


class _Splat(torch.autograd.Function):
    """Rendering as a differentiable function of the Gaussians, the features, the background and the probe.

    The results are color, depth, alpha, features and radii. The radii have no gradient.
    """

    @staticmethod
    def forward(
        ctx, means, quaternions, log_scales, opacity_logits, sh, features, background, probe, camera, degree, antialias
    ):
        """Return the five results; `probe` is [N, 2] or [0, 2], and `features` is [N, C], where C may be 0."""
        parameters = [_array(t) for t in (means, quaternions, log_scales, opacity_logits, sh)]
        view = project_and_bin(parameters, antialias, _array(probe), camera, degree)
        color, depth, alpha, blended, transmittance, used = forward.blend(
            view.footprints, _array(features), _array(background), view.bins, camera.width, camera.height
        )
        radii = view.radii[: len(means)]
        color, depth, alpha, blended, radii = map(torch.from_numpy, (color, depth, alpha, blended, radii))
        ctx.mark_non_differentiable(radii)
        if any(ctx.needs_input_grad):
            inputs = (means, quaternions, log_scales, opacity_logits, sh, features)
            ctx.save_for_backward(*inputs, color, depth, alpha, blended)
            ctx.rest = view, transmittance, used, view_numbers(camera, antialias), camera.center, degree
        return color, depth, alpha, blended, radii

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_color, grad_depth, grad_alpha, grad_blended, _):
        """Return the gradients of the inputs of `forward`, None where no gradient is needed."""
        saved = [_array(t) for t in ctx.saved_tensors]
        parameters, features, images = saved[:5], saved[5], saved[6:]
        view, transmittance, used, numbers, center, degree = ctx.rest
        gradients = [_array(g) for g in (grad_color, grad_depth, grad_alpha, grad_blended)]
        records, written = backward.blend_backward(
            view.footprints, features, view.bins, used, images, transmittance, gradients
        )
        arrays = _to_parameters(
            view, records, written, parameters, features.shape[1], numbers, center, degree, ctx.needs_input_grad[7]
        )
        to_background = np.einsum("hw,hwc->c", transmittance, gradients[0]) if ctx.needs_input_grad[6] else None
        arrays = (*arrays[:6], to_background, arrays[6])
        needed = zip(arrays, ctx.needs_input_grad, strict=False)
        return (*(torch.from_numpy(array) if need else None for array, need in needed), None, None, None)


def _to_parameters(
    view, records, written, parameters, channels, numbers, center, degree, want_probe
) -> list[np.ndarray]:
    """Return the gradients of the parameters, the features [N, channels] and the probe [N, 2], from `records`."""
    count, rows = len(parameters[0]), footprints.padded(len(parameters[0]))
    # The order is that of `types.PARAMETERS`. Without `want_probe` the gradient of the probe is empty.
    shapes = [(rows, *array.shape[1:]) for array in parameters] + [(rows, channels), (rows if want_probe else 0, 2)]
    out = [empty_aligned(*shape) for shape in shapes]
    flat = [array.reshape(-1) for array in out]
    parallel_for(
        footprints.project_gaussians_backward,
        records.reshape(-1),
        written,
        view.bins.first_slots,
        records.shape[1],
        view.radii,
        view.footprints,
        _flat(parameters, degree),
        numbers,
        center,
        footprints.Gradients(*flat[:5], out[5], flat[6]),
    )
    return [array[:count] for array in out]
