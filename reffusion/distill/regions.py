"""The region of space to which the masked Gaussians belong, and the detection of Gaussians that cross its border.

Masked Gaussians are those that the initialization added; all others are unmasked.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

RESOLUTION = 32  # number of voxels along the diagonal of the bounding box of the masked Gaussians
# Number of voxels along each axis by which a masked Gaussian may be away from the nearest masked Gaussian of the
# initialization.
REACH = 2


@dataclass(frozen=True)
class VoxelRegion:
    """The part of space to which the masked Gaussians belong, as voxels of a grid around them.

    `foreign` is a part of `home`. In the other voxels of `home` masked and unmasked Gaussians may be.

    Attributes:
        origin: [3], the lowest corner of the grid.
        voxel: Side of a voxel.
        home: bool [X, Y, Z], True at voxels in which a masked Gaussian may be: those within `REACH` voxels of a masked
            Gaussian of the initialization (see `build_region`).
        foreign: bool [X, Y, Z], True at voxels in which no unmasked Gaussian may be: those that held a masked Gaussian
            of the initialization, while neither they nor their 26 neighbors held an unmasked one.
    """

    origin: Tensor
    voxel: float
    home: Tensor
    foreign: Tensor


def build_region(means: Tensor, masked: Tensor) -> VoxelRegion:
    """Return the region of the masked Gaussians of an initialization.

    PAPER leaves open: the region whose border Gaussians must not cross. The masked Gaussians of the initialization lie
    on the surfaces to be invented, so they define the region.

    Args:
        means: [N, 3], the centers of all Gaussians of the initialization.
        masked: bool [N], True for masked Gaussians, of which there is at least one.
    """
    masked_means = means[masked]
    low, high = masked_means.amin(0), masked_means.amax(0)
    voxel = max(float((high - low).norm()) / RESOLUTION, 1e-6)
    origin = low - (REACH + 0.5) * voxel
    shape = [int(n) + 1 for n in ((high - origin) / voxel + REACH + 0.5).long()]

    def voxelize(points: Tensor) -> Tensor:
        grid = torch.zeros(shape, dtype=torch.bool, device=means.device)
        cells, is_inside = _grid_cells(points, origin, voxel, shape)
        grid[tuple(cells[is_inside].T)] = True
        return grid

    def dilate(grid: Tensor, cells: int) -> Tensor:
        return F.max_pool3d(grid.float()[None], 2 * cells + 1, stride=1, padding=cells)[0] > 0

    core, others = voxelize(masked_means), voxelize(means[~masked])
    return VoxelRegion(origin, voxel, dilate(core, REACH), core & ~dilate(others, 1))


def has_changed_region(region: VoxelRegion, means: Tensor, masked: Tensor) -> Tensor:
    """Return bool [N], the Gaussians to prune: masked ones outside `region.home`, unmasked ones in `region.foreign`.

    Args:
        region: The region of the initialization.
        means: [N, 3], the present centers.
        masked: bool [N], True for masked Gaussians.
    """
    cells, is_inside = _grid_cells(means, region.origin, region.voxel, region.home.shape)
    home, foreign = torch.zeros_like(masked), torch.zeros_like(masked)
    home[is_inside] = region.home[tuple(cells[is_inside].T)]
    foreign[is_inside] = region.foreign[tuple(cells[is_inside].T)]
    return torch.where(masked, ~home, foreign)


def _grid_cells(points: Tensor, origin: Tensor, voxel: float, shape) -> tuple[Tensor, Tensor]:
    """Return the cell of each point, long [N, 3], and whether the cell is inside the grid, bool [N]."""
    cells = ((points - origin) / voxel).floor().long()
    return cells, ((cells >= 0) & (cells < torch.tensor(list(shape), device=cells.device))).all(1)
