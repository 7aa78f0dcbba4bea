"""3D Gaussian splatting: one call, three implementations of the same conventions (docs/splatting.md).

`reference` is plain torch in the dtype it is given (the oracle of the tests), `cpu` is compiled by numba,
`cuda` is gsplat. Each is imported when it is first asked for.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from reffusion.types import PARAMETERS, Camera, Gaussians, Rendering

Implementation = Literal["auto", "reference", "cpu", "cuda"]


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    features: Tensor | None = None,
    background: Tensor | None = None,
    impl: Implementation = "auto",
    sh_degree: int | None = None,
    probe: Tensor | None = None,
) -> Rendering:
    """Draw the Gaussians: colour, depth, alpha and blended features in one pass, differentiable in all of them.

    Args:
        gaussians: N of them, N = 0 allowed. Those the conventions leave out (docs/splatting.md) get zero gradients.
        camera: the view; any size from 1 x 1.
        features: [N, C] values to blend like colours, over a background of zeros; differentiable.
        background: [3] colour behind everything, black if None; differentiable.
        impl: "auto" takes "cuda" for tensors on a GPU, else "cpu". "reference" also takes float64 and any device.
        sh_degree: highest degree of spherical harmonics used, 0 to the stored one (the default).
        probe: [N, 2] added to the 2D means, in pixels; give zeros that require a gradient to read
            dLoss/d(2D mean) from them after the backward pass.

    Returns:
        A Rendering on the Gaussians' device, of their dtype.

    Raises:
        ValueError: shapes, dtypes or devices that do not fit together, or "cuda" without a GPU.
    """
    _check_gaussians(gaussians, camera)
    count, means = len(gaussians), gaussians.means
    if features is not None:
        _check_tensor("features", features, (count, None), means)
    if background is not None:
        _check_tensor("background", background, (3,), means)
    if probe is not None:
        _check_tensor("probe", probe, (count, 2), means)
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    if not 0 <= degree <= gaussians.sh_degree:
        raise ValueError(f"sh_degree {degree} is outside 0..{gaussians.sh_degree}, the degrees stored in `sh`")
    if background is None:
        background = means.new_zeros(3)
    return _implementation(impl, means).render(gaussians, camera, features, background, degree, probe)


def prepare(device: str) -> None:
    """Load what draws on this device, before a clock runs: gsplat compiles its extension when it is first loaded."""
    if torch.device(device).type == "cuda":
        _implementation("cuda", torch.zeros(1, device=device))


@torch.no_grad()
def accumulate(
    gaussians: Gaussians, camera: Camera, values: Tensor, *, impl: Implementation = "auto", count: bool = False
) -> Tensor:
    """What each Gaussian gathers from the pixels: sum over pixels of blending weight x value. Not differentiable.

    With `values` = 1 - mask and mask side by side, the two columns are the votes of the paper's mask lifting.

    Args:
        values: [H, W, C] of the Gaussians' dtype.
        count: add the value itself wherever the Gaussian is blended, instead of its share by weight.

    Returns:
        [N, C].

    Raises:
        ValueError: as `render`.
    """
    _check_gaussians(gaussians, camera)
    _check_tensor("values", values, (camera.height, camera.width, None), gaussians.means)
    return _implementation(impl, gaussians.means).accumulate(gaussians, camera, values, count)


def _implementation(impl: Implementation, means: Tensor):
    if impl == "auto":
        impl = "cuda" if means.is_cuda else "cpu"
    if impl == "reference":
        from reffusion.splat import reference

        return reference
    if impl == "cuda":
        from reffusion.splat import cuda

        cuda.require_gpu(means)
        return cuda
    if impl != "cpu":
        raise ValueError(f"impl {impl!r} is none of auto, reference, cpu, cuda")
    if means.dtype != torch.float32 or means.device.type != "cpu":
        raise ValueError(
            f"the cpu splatting takes float32 tensors on the CPU, not {means.dtype} on {means.device}; "
            "impl='reference' takes any"
        )
    from reffusion.splat import cpu

    return cpu


def _check_gaussians(gaussians: Gaussians, camera: Camera) -> None:
    count, means = gaussians.means.shape[0], gaussians.means
    if camera.width < 1 or camera.height < 1 or camera.fx <= 0 or camera.fy <= 0:
        raise ValueError(f"view {camera.name!r}: size and focal lengths must be positive, not {camera}")
    shapes = {
        "means": (count, 3),
        "quaternions": (count, 4),
        "log_scales": (count, 3),
        "opacity_logits": (count,),
        "sh": (count, None, 3),
    }
    for name in PARAMETERS:
        _check_tensor(name, getattr(gaussians, name), shapes[name], means)
    if gaussians.sh.shape[1] not in (1, 4, 9, 16):
        raise ValueError(f"sh is {list(gaussians.sh.shape)}; its middle size must be 1, 4, 9 or 16")


def _check_tensor(name: str, tensor: Tensor, shape: tuple[int | None, ...], like: Tensor) -> None:
    fits = tensor.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, tensor.shape, strict=True)
    )
    if not fits:
        wanted = ", ".join("*" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} has shape {list(tensor.shape)}; [{wanted}] is needed")
    if tensor.dtype != like.dtype or tensor.device != like.device:
        raise ValueError(
            f"{name} is {tensor.dtype} on {tensor.device}, but the Gaussians' means are {like.dtype} on {like.device}"
        )
