"""Adaptive density control of 3DGS: clone or split where the image pulls hard, prune what shows nothing.

All lengths are in units of the normalised frame, where cameras stand about 1 from the scene.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from reffusion.gaussians.optimize import GaussianOptimizer
from reffusion.types import Gaussians

SHRINK = 1.6  # 3DGS: the two children of a split are 0.8 * 2 times smaller


def densify(
    optimizer: GaussianOptimizer,
    grow_grad2d: float,
    grow_scale3d: float | Tensor,
    cap_max: int,
    generator: torch.Generator,
) -> int:
    """Clone the small and split the large Gaussians whose mean observed gradient is at least `grow_grad2d`.

    A clone is a copy at the same place, which moves off as it gathers other moments; a split draws two children from
    the Gaussian itself. Children inherit the label. The observed gradients are forgotten.

    Args:
        grow_grad2d: in units of normalised device coordinates (see `GaussianOptimizer.observe`); 3DGS: 2e-4.
        grow_scale3d: the largest standard deviation above which a Gaussian is split, not cloned; one for all or [N].
            3DGS: 0.01.
        cap_max: no more Gaussians than this; if there are more candidates, those of the largest are taken.
        generator: of the split's noise.

    Returns:
        By how many the number grew.
    """
    grad2d = optimizer.grad2d_sum / optimizer.grad2d_count.clamp(min=1)
    room = max(0, min(cap_max - len(grad2d), int((grad2d >= grow_grad2d).sum())))
    chosen = torch.zeros_like(optimizer.masked)
    chosen[grad2d.topk(room).indices] = True

    gaussians = optimizer.gaussians.map(Tensor.detach)
    large = gaussians.log_scales.exp().amax(dim=1) > grow_scale3d
    to_clone, to_split = chosen & ~large, chosen & large
    clones = gaussians.map(lambda p: p[to_clone])
    children = split(gaussians.map(lambda p: p[to_split]), generator)
    labels = torch.cat([optimizer.masked[to_clone], optimizer.masked[to_split].repeat(2)])
    optimizer.append(clones.zipped(children, lambda a, b: torch.cat([a, b])), labels)
    optimizer.select(torch.cat([~to_split, torch.ones_like(labels)]))
    optimizer.forget_grad2d()
    return room


def viewing_distance(means: Tensor, centers: Tensor) -> Tensor:
    """[N] distance of each mean [N, 3] to the nearest camera centre [V, 3]: what sizes are to be measured by."""
    return torch.cdist(means.detach(), centers.to(means)).amin(dim=1)


def split(gaussians: Gaussians, generator: torch.Generator) -> Gaussians:
    """Two smaller Gaussians for each one, at places drawn from it: [M] -> [2 M], all first children before the second.

    Opacity and colour are the parent's.
    """
    twice = gaussians.map(lambda p: torch.cat([p, p]))
    noise = torch.randn(twice.means.shape, generator=generator, device=generator.device).to(twice.means)
    offsets = rotate(twice.quaternions, noise * twice.log_scales.exp())
    shrink = torch.log(torch.tensor(SHRINK))
    return replace(twice, means=twice.means + offsets, log_scales=twice.log_scales - shrink)


def rotate(quaternions: Tensor, vectors: Tensor) -> Tensor:
    """[M, 3] vectors turned by wxyz quaternions [M, 4] of any length (zero: not turned)."""
    quaternions = unit(quaternions)
    w, axis = quaternions[:, :1], quaternions[:, 1:]
    across = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * across + torch.linalg.cross(axis, across)


def unit(quaternions: Tensor) -> Tensor:
    """[M, 4] of length 1; zero stays zero."""
    # First by the largest entry: the squares of short ones would vanish.
    quaternions = quaternions / quaternions.abs().amax(1, keepdim=True).clamp_min(torch.finfo(quaternions.dtype).tiny)
    return torch.nn.functional.normalize(quaternions, dim=1)


def prune(optimizer: GaussianOptimizer, prune_opa: float, prune_scale3d: float | Tensor) -> int:
    """Remove the Gaussians fainter than `prune_opa` or with a standard deviation above `prune_scale3d` (or its row).

    PAPER leaves open: 3DGS also removes what covers more than 20 pixels of a view; that is a size in pixels, takes
    whole walls with it in small images, and is left out here.

    Returns:
        How many were removed.
    """
    gaussians = optimizer.gaussians
    with torch.no_grad():
        keep = (gaussians.opacity_logits.sigmoid() >= prune_opa) & (gaussians.log_scales.exp().amax(1) <= prune_scale3d)
    if not keep.all():
        optimizer.select(keep)
    return int((~keep).sum())
