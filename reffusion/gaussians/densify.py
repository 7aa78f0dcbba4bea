"""Adaptive density control of 3DGS: clone or split Gaussians with large screen-space gradients, prune faint ones.

All lengths are in units of the normalized frame, in which cameras are about 1 from the scene.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from reffusion.gaussians.optimize import GaussianOptimizer
from reffusion.types import Gaussians

PRUNED_OPACITY = 0.005  # opacity below which Gaussians are pruned, as in 3DGS
SPLIT_SCALE = 0.01  # standard deviation, in a unit of sizes, above which a Gaussian is split, not cloned
SHRINK = 1.6  # factor by which the standard deviations of the two children of a split are smaller; 0.8 * 2 in 3DGS


def densify(
    optimizer: GaussianOptimizer,
    grow_grad2d: float,
    grow_scale3d: float | Tensor,
    cap_max: int,
    generator: torch.Generator,
) -> int:
    """Clone small and split large Gaussians whose mean screen-space gradient is at least `grow_grad2d`.

    The mean screen-space gradient is the mean of the gradient's norm over the views that `GaussianOptimizer.observe`
    accumulated. The accumulated gradients are reset. A clone is a copy at the same position; later steps move the clone
    away from the original, because its Adam moments start at zero. A split replaces a Gaussian by two smaller children
    at positions sampled from it. Clones and children inherit the label.

    Args:
        optimizer: holds the Gaussians, which are replaced: first the survivors in their order, then clones, then
            children. The running mean is discarded (see `GaussianOptimizer.append`).
        grow_grad2d: in units of normalized device coordinates (see `GaussianOptimizer.observe`); 3DGS: 2e-4.
        grow_scale3d: Gaussians whose largest standard deviation is above this value are split, all other ones cloned.
            One value for all Gaussians, or [N]. 3DGS: 0.01.
        cap_max: maximum number of Gaussians. If there are more candidates than room, the ones with the largest
            gradients are chosen.
        generator: random generator for the positions of children.

    Returns:
        The increase in the number of Gaussians.
    """
    grad2d = optimizer.grad2d_sum / optimizer.grad2d_count.clamp(min=1)
    growth = max(0, min(cap_max - len(grad2d), int((grad2d >= grow_grad2d).sum())))
    selected = torch.zeros_like(optimizer.masked)
    selected[grad2d.topk(growth).indices] = True

    gaussians = optimizer.gaussians.map(Tensor.detach)
    large = gaussians.log_scales.exp().amax(dim=1) > grow_scale3d
    to_clone, to_split = selected & ~large, selected & large
    clones = gaussians.map(lambda p: p[to_clone])
    children = split(gaussians.map(lambda p: p[to_split]), generator)
    labels = torch.cat([optimizer.masked[to_clone], optimizer.masked[to_split].repeat(2)])
    optimizer.append(clones.zip_map(children, lambda a, b: torch.cat([a, b])), labels)
    optimizer.select(torch.cat([~to_split, torch.ones_like(labels)]))
    optimizer.forget_grad2d()
    return growth


def viewing_distance(means: Tensor, centers: Tensor) -> Tensor:
    """Return the distance [N] of each mean [N, 3] to the nearest camera center [V, 3].

    The stage `fit` measures sizes of Gaussians in units of this distance.
    """
    return torch.cdist(means.detach(), centers.to(means)).amin(dim=1)


def split(gaussians: Gaussians, generator: torch.Generator) -> Gaussians:
    """Return two children for each of M Gaussians, at positions sampled from it and smaller by the factor `SHRINK`.

    Rotation, opacity and color are those of the parent.

    Returns:
        2 M Gaussians: the first child of every parent, then the second child of every parent.
    """
    repeated = gaussians.map(lambda p: torch.cat([p, p]))
    noise = torch.randn(repeated.means.shape, generator=generator, device=generator.device).to(repeated.means)
    offsets = rotate(repeated.quaternions, noise * repeated.log_scales.exp())
    shrink = torch.log(torch.tensor(SHRINK))
    return replace(repeated, means=repeated.means + offsets, log_scales=repeated.log_scales - shrink)


def rotate(quaternions: Tensor, vectors: Tensor) -> Tensor:
    """Return the vectors [M, 3] rotated by wxyz quaternions [M, 4] of any length (zero is the identity)."""
    quaternions = unit(quaternions)
    w, axis = quaternions[:, :1], quaternions[:, 1:]
    across = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * across + torch.linalg.cross(axis, across)


def unit(quaternions: Tensor) -> Tensor:
    """Return the quaternions [M, 4] normalized to length 1; zero stays zero."""
    # Divide by the largest entry first: the squares of very short quaternions would underflow.
    quaternions = quaternions / quaternions.abs().amax(1, keepdim=True).clamp_min(torch.finfo(quaternions.dtype).tiny)
    return torch.nn.functional.normalize(quaternions, dim=1)


def prune(optimizer: GaussianOptimizer, prune_opa: float, prune_scale3d: float | Tensor) -> int:
    """Remove the Gaussians of the optimizer that are too faint or too large, in place.

    PAPER leaves open: 3DGS also removes Gaussians that cover more than 20 pixels of a view. This limit depends on the
    image size, and would remove whole walls in small images, so it is left out here.

    Args:
        prune_opa: opacity in [0, 1] below which a Gaussian is removed.
        prune_scale3d: a Gaussian whose largest standard deviation is above this value is removed. One value for all
            Gaussians, or [N].

    Returns:
        The number of removed Gaussians.
    """
    gaussians = optimizer.gaussians
    with torch.no_grad():
        keep = (gaussians.opacity_logits.sigmoid() >= prune_opa) & (gaussians.log_scales.exp().amax(1) <= prune_scale3d)
    if not keep.all():
        optimizer.select(keep)
    return int((~keep).sum())
