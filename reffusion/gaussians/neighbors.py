"""Neighbors among Gaussians: which are near each other, how alike they are, and how much they touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from reffusion.gaussians.densify import rotate
from reffusion.splat.conventions import SH0
from reffusion.types import Gaussians

NEIGHBORS = 8  # number of nearest neighbors to which each Gaussian has an edge
UNLIKE = 1.0  # relative increase of an edge's length if its two colors differ as those of neighbors do on average


@dataclass(frozen=True)
class NeighborGraph:
    """The graph whose E edges join neighboring Gaussians, with the similarity of their colors.

    Attributes:
        pairs: [E, 2] int, indices of the two Gaussians of each edge, the smaller one first; each pair occurs once.
        likeness: [E] in [0, 1], similarity of the two colors: exp(-d / 2), where d is the squared distance of the two
            RGB colors, divided by its mean over all edges.
        way: [E], positive, length of the edge: the distance of the two means times 1 + `UNLIKE` sqrt(d).
    """

    pairs: np.ndarray
    likeness: np.ndarray
    way: np.ndarray


def find_neighbors(gaussians: Gaussians) -> NeighborGraph:
    """Build the graph that joins each Gaussian to its `NEIGHBORS` nearest ones, by the distance of means.

    A Gaussian can have more than `NEIGHBORS` edges, because other Gaussians may have it among their nearest ones.
    Colors are compared without their view-dependent part.
    """
    means, color = (each.detach().cpu().double().numpy() for each in (gaussians.means, gaussians.sh[:, 0] * SH0))
    near = cKDTree(means).query(means, min(NEIGHBORS + 1, len(means)))[1].reshape(len(means), -1)[:, 1:]
    own = np.repeat(np.arange(len(means)), near.shape[1])
    pairs = np.unique(np.sort(np.stack([own, near.ravel()], 1), 1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    square = ((color[pairs[:, 0]] - color[pairs[:, 1]]) ** 2).sum(1)
    unlike = square / (square.sum() / max(len(square), 1) + 1e-12)
    apart = np.linalg.norm(means[pairs[:, 0]] - means[pairs[:, 1]], axis=1)
    return NeighborGraph(pairs, np.exp(-unlike / 2), apart * (1 + UNLIKE * np.sqrt(unlike)) + 1e-12)


def measure_overlap(gaussians: Gaussians, pairs: np.ndarray) -> np.ndarray:
    """Return how much the two Gaussians of each pair overlap: exp(-g^2 / 2), 1 if their means coincide.

    Here g is the distance of their means, over the sum of their standard deviations along the line between the means.

    Args:
        pairs: [E, 2] int, indices of the two Gaussians.

    Returns:
        [E] float64 in [0, 1].
    """
    means, scales = (each.detach().cpu().double() for each in (gaussians.means, gaussians.log_scales.exp()))
    inverse = gaussians.quaternions.detach().cpu().double() * torch.tensor([1.0, -1.0, -1.0, -1.0])
    first, second = torch.as_tensor(pairs).T
    way = means[second] - means[first]
    apart = way.norm(dim=1).clamp_min(1e-12)
    deviation = lambda k: (rotate(inverse[k], way / apart[:, None]) * scales[k]).norm(dim=1)
    gap = apart / (deviation(first) + deviation(second)).clamp_min(1e-12)
    return torch.exp(-(gap**2) / 2).numpy()
