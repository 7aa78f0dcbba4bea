"""3D Gaussian splatting: one interface, three implementations of the same conventions (docs/method.md#splatting).

`torch` uses autograd in any dtype, and is the standard of the tests; `cpu` is compiled by numba; `cuda` is gsplat. Each
implementation is imported at its first use.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from reffusion.types import PARAMETERS, Camera, Gaussians, Rendering

Implementation = Literal["auto", "torch", "cpu", "cuda"]


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
    """Render Gaussians in one pass: color, depth (divided by alpha), alpha and blended features, all differentiable.

    Args:
        gaussians: N Gaussians; N may be 0. Culled Gaussians (docs/method.md#splatting) get zero gradients.
        camera: the view, of size 1 x 1 or larger.
        features: [N, C] values that are blended like colors, over a background of zeros, and not divided by alpha;
            differentiable. None: none.
        background: [3] color behind everything, black if None; differentiable.
        impl: the implementation. "auto" selects "cuda" for tensors on a GPU, else "cpu". "torch" supports any dtype,
            such as float64, and any device.
        sh_degree: highest degree of spherical harmonics used, from 0 to the stored one; None: the stored one.
        probe: [N, 2] added to the 2D means, in pixels. Pass zeros that require a gradient; after the backward pass
            their gradient is dLoss/d(2D mean).

    Returns:
        A Rendering on the device and of the dtype of the Gaussians.

    Raises:
        ValueError: shapes, dtypes or devices do not match, `sh_degree` is not stored, the camera's size or focal
            lengths are not positive, or the implementation is unknown or not available.
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
    """Load gsplat if the device is CUDA, so that timings leave out its loading and the compilation of its extension.

    On the CPU nothing is done.

    Args:
        device: a torch device, such as "cpu" or "cuda".

    Raises:
        ValueError: the device is CUDA, and there is no GPU or no compiled gsplat.
    """
    if torch.device(device).type == "cuda":
        _implementation("cuda", torch.zeros(1, device=device))


@torch.no_grad()
def accumulate(
    gaussians: Gaussians, camera: Camera, values: Tensor, *, impl: Implementation = "auto", count: bool = False
) -> Tensor:
    """Sum blending weight x value over the pixels of a view, for each Gaussian. Not differentiable.

    The blending weight of a Gaussian at a pixel is its alpha times the transmittance in front of it.

    With 1 - mask and mask as two channels of `values`, the sums are the votes of the paper's mask lifting.

    Args:
        gaussians: N Gaussians.
        camera: the view.
        values: [H, W, C] of the dtype of the Gaussians.
        impl: the implementation, as for `render`.
        count: True takes weight 1 at each pixel where the Gaussian is blended, instead of its blending weight. Then the
            votes are counts of pixels, as in the paper.

    Returns:
        [N, C], the sums.

    Raises:
        ValueError: as for `render`.
    """
    _check_gaussians(gaussians, camera)
    _check_tensor("values", values, (camera.height, camera.width, None), gaussians.means)
    return _implementation(impl, gaussians.means).accumulate(gaussians, camera, values, count)


def _implementation(impl: Implementation, means: Tensor):
    """Return the module that implements `impl`, or raise ValueError if it does not support tensors like `means`."""
    if impl == "auto":
        impl = "cuda" if means.is_cuda else "cpu"
    if impl == "torch":
        from reffusion.splat import pure_torch

        return pure_torch
    if impl == "cuda":
        from reffusion.splat import cuda

        cuda.require_gpu(means)
        return cuda
    if impl != "cpu":
        raise ValueError(f"impl {impl!r} is none of auto, torch, cpu, cuda")
    if means.dtype != torch.float32 or means.device.type != "cpu":
        raise ValueError(
            f"the cpu splatting takes float32 tensors on the CPU, not {means.dtype} on {means.device}; "
            "impl='torch' takes any"
        )
    from reffusion.splat import cpu

    return cpu


def _check_gaussians(gaussians: Gaussians, camera: Camera) -> None:
    """Raise ValueError if a parameter of the Gaussians has a wrong shape, dtype or device, or the camera is invalid."""
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
    """Raise ValueError unless `tensor` has this shape (None: any size) and the dtype and device of `like`."""
    fits = tensor.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, tensor.shape, strict=True)
    )
    if not fits:
        expected = ", ".join("*" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} has shape {list(tensor.shape)}; [{expected}] is needed")
    if tensor.dtype != like.dtype or tensor.device != like.device:
        raise ValueError(
            f"{name} is {tensor.dtype} on {tensor.device}, but the Gaussians' means are {like.dtype} on {like.device}"
        )
