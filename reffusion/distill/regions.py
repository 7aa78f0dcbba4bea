"""The region of space that the masked Gaussians belong to, and the Gaussians that cross its border."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor


@dataclass(frozen=True)
class VoxelRegion:
    """The part of space the masked Gaussians belong to, as voxels of a grid around them.

    Attributes:
        origin: [3], the grid's lowest corner. voxel: its pitch.
        home: [X, Y, Z] bool, voxels within reach of a masked Gaussian of the initialization.
        foreign: [X, Y, Z] bool, voxels that hold masked Gaussians of the initialization and have no unmasked one in
            them or beside them.
    """

    origin: Tensor
    voxel: float
    home: Tensor
    foreign: Tensor


def build_region(means: Tensor, masked: Tensor, resolution: int = 32, reach: int = 2) -> VoxelRegion:
    """The region of an initialization.

    PAPER leaves open: the region whose border Gaussians must not cross. The masked Gaussians of the initialization lie
    on the surfaces to be invented, so they mark it: the grid has `resolution` voxels along the diagonal of their
    bounding box, and Gaussians may move within `reach` voxels of each.

    Args:
        means: [N, 3]; masked: [N] bool with at least one True.
    """
    masked_means = means[masked]
    low, high = masked_means.amin(0), masked_means.amax(0)
    voxel = max(float((high - low).norm()) / resolution, 1e-6)
    origin = low - (reach + 0.5) * voxel
    shape = [int(n) + 1 for n in ((high - origin) / voxel + reach + 0.5).long()]

    def voxelize(points: Tensor) -> Tensor:
        grid = torch.zeros(shape, dtype=torch.bool, device=means.device)
        cells, is_inside = _grid_cells(points, origin, voxel, shape)
        grid[tuple(cells[is_inside].T)] = True
        return grid

    def dilate(grid: Tensor, cells: int) -> Tensor:
        return F.max_pool3d(grid.float()[None], 2 * cells + 1, stride=1, padding=cells)[0] > 0

    core, others = voxelize(masked_means), voxelize(means[~masked])
    return VoxelRegion(origin, voxel, dilate(core, reach), core & ~dilate(others, 1))


def has_changed_region(region: VoxelRegion, means: Tensor, masked: Tensor) -> Tensor:
    """[N] bool: masked Gaussians that have left the region and unmasked ones that have entered it. Both are pruned."""
    cells, is_inside = _grid_cells(means, region.origin, region.voxel, region.home.shape)
    home, foreign = torch.zeros_like(masked), torch.zeros_like(masked)
    home[is_inside] = region.home[tuple(cells[is_inside].T)]
    foreign[is_inside] = region.foreign[tuple(cells[is_inside].T)]
    return torch.where(masked, ~home, foreign)


def _grid_cells(points: Tensor, origin: Tensor, voxel: float, shape) -> tuple[Tensor, Tensor]:
    """([N, 3] long grid cells, [N] bool: is inside the grid)."""
    cells = ((points - origin) / voxel).floor().long()
    return cells, ((cells >= 0) & (cells < torch.tensor(list(shape), device=cells.device))).all(1)
