"""Splatting on a CUDA GPU by gsplat 1.5, with the conventions of the other implementations.

The steps of gsplat's `rasterization` are called one by one, because the probe (see `rasterizer.render`) is added to the
2D means between two of them. Two differences from `pure_torch` cannot be configured. A pixel ends where its
transmittance would be <= 1e-4, instead of < 1e-4. And the 2D covariance is inverted by a float32 determinant, so that
long needles lose digits.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from reffusion.splat.conventions import LOW_PASS, NEAR
from reffusion.types import Camera, Gaussians, Rendering

_TILE = 16  # side of a tile in pixels


class _Footprints(NamedTuple):
    """The Gaussians projected into one view, as gsplat represents them, with a leading dimension for the view."""

    means: Tensor  # [1, N, 2] pixels
    radii: Tensor  # [1, N, 2] int32 pixels, along x and y; 0 where culled
    depths: Tensor  # [1, N] camera z
    conics: Tensor  # [1, N, 3], xx, xy and yy of the inverse 2D covariance
    opacities: Tensor  # [1, N], compensated for the low-pass if the Gaussians are antialiased
    tiles: tuple[Tensor, Tensor]  # start of each tile's list [1, tiles down, tiles across], and the concatenated lists


def require_gpu(means: Tensor) -> None:
    """Raise ValueError unless a CUDA GPU and gsplat are available, and `means` is a float32 tensor on the GPU."""
    if not torch.cuda.is_available():
        raise ValueError("impl='cuda' needs a CUDA GPU and there is none here; take impl='cpu' or 'auto'")
    if not means.is_cuda or means.dtype != torch.float32:
        raise ValueError(f"impl='cuda' needs float32 tensors on the GPU, not {means.dtype} on {means.device}")
    try:
        from gsplat.cuda import _backend
    except ImportError as error:
        raise ValueError("impl='cuda' needs gsplat: `make gpu` installs it") from error
    if _backend._C is None:  # it can be imported without its extension
        raise ValueError("impl='cuda' needs gsplat's compiled extension, and there is no nvcc to build it: `make gpu`")


def render(
    gaussians: Gaussians, camera: Camera, features: Tensor | None, background: Tensor, degree: int, probe: Tensor | None
) -> Rendering:
    """Render Gaussians; see `reffusion.splat.rasterizer.render`, which checks the arguments."""
    if len(gaussians) == 0:
        return _empty(camera, features, background)
    import gsplat

    footprints = _project(gaussians, camera)
    means = footprints.means if probe is None else footprints.means + probe
    center = torch.as_tensor(camera.center, dtype=means.dtype, device=means.device)
    visible = (footprints.radii > 0).all(-1)[0]
    colors = gsplat.spherical_harmonics(degree, gaussians.means - center, gaussians.sh, masks=visible)
    colors = torch.clamp_min(colors + 0.5, 0)
    columns = [colors, footprints.depths[0, :, None]] + ([] if features is None else [features])
    behind_all = torch.cat((background, background.new_zeros(sum(c.shape[1] for c in columns) - 3)))
    image, alpha = gsplat.rasterize_to_pixels(
        means,
        footprints.conics,
        torch.cat(columns, 1)[None],
        footprints.opacities,
        camera.width,
        camera.height,
        _TILE,
        *footprints.tiles,
        backgrounds=behind_all[None],
    )
    image, alpha = image[0], alpha[0, ..., 0]
    covered = alpha > 0
    return Rendering(
        color=image[..., :3],
        depth=torch.where(covered, image[..., 3], 0) / torch.where(covered, alpha, 1),
        alpha=alpha,
        features=None if features is None else image[..., 4:],
        radii=(footprints.radii[0].amax(1) * visible).to(torch.int32),
    )


def accumulate(gaussians: Gaussians, camera: Camera, values: Tensor, count: bool) -> Tensor:
    """Sum pixel values by Gaussian; see `reffusion.splat.rasterizer.accumulate`, which checks the arguments.

    Sums with blending weights are computed as the gradient of blended features: a feature's gradient is the sum of
    weight x upstream gradient over the pixels.
    """
    size = len(gaussians), values.shape[-1]
    if 0 in size:
        return values.new_zeros(size)
    if not count:
        with torch.enable_grad():
            features = values.new_zeros(size).requires_grad_()
            blended = render(gaussians, camera, features, values.new_zeros(3), 0, None).features
            assert blended is not None
            return torch.autograd.grad(blended, features, values)[0]
    import gsplat

    footprints = _project(gaussians, camera)
    members, pixels, _ = gsplat.rasterize_to_indices_in_range(
        0,
        2**30,
        values.new_ones(1, camera.height, camera.width),
        footprints.means,
        footprints.conics,
        footprints.opacities,
        camera.width,
        camera.height,
        _TILE,
        *footprints.tiles,
    )
    return values.new_zeros(size).index_add(0, members.long(), values.reshape(-1, size[1])[pixels.long()])


def _project(gaussians: Gaussians, camera: Camera) -> _Footprints:
    """Project the Gaussians into the view, and list them by tile; differentiable except for the lists."""
    import gsplat

    like = gaussians.means
    pose = torch.as_tensor(camera.world_to_camera, dtype=like.dtype, device=like.device)
    intrinsics = torch.as_tensor(camera.intrinsics, dtype=like.dtype, device=like.device)
    # gsplat divides by the length, so the zero quaternion is replaced by the identity here.
    zero = (gaussians.quaternions == 0).all(1, keepdim=True)
    quaternions = torch.where(zero, like.new_tensor([1.0, 0.0, 0.0, 0.0]), gaussians.quaternions)
    opacities = torch.sigmoid(gaussians.opacity_logits)
    radii, means, depths, conics, compensations = gsplat.fully_fused_projection(
        like,
        None,
        quaternions,
        gaussians.log_scales.exp(),
        pose[None],
        intrinsics[None],
        camera.width,
        camera.height,
        eps2d=LOW_PASS,
        near_plane=NEAR,
        calc_compensations=gaussians.antialiased,
        opacities=opacities,
    )
    opacities = opacities[None] if compensations is None else opacities[None] * compensations
    across, down = -(-camera.width // _TILE), -(-camera.height // _TILE)
    with torch.no_grad():
        _, pairs, lists = gsplat.isect_tiles(means, radii, depths, _TILE, across, down, n_images=1)
        starts = gsplat.isect_offset_encode(pairs, 1, across, down)
    return _Footprints(means, radii, depths, conics, opacities, (starts.reshape(1, down, across), lists))


def _empty(camera: Camera, features: Tensor | None, background: Tensor) -> Rendering:
    """Return the rendering of no Gaussians: the background."""
    zeros = background.new_zeros(camera.height, camera.width)
    return Rendering(
        color=zeros[..., None] + background,
        depth=zeros,
        alpha=zeros,
        features=None if features is None else zeros[..., None] * features.sum(0),
        radii=torch.zeros(0, dtype=torch.int32, device=background.device),
    )
