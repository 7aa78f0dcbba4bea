"""Neighbours among Gaussians: which are near each other, how alike they are, and how much they touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from reffusion.gaussians.densify import rotate
from reffusion.splat.conventions import SH0
from reffusion.types import Gaussians

NEIGHBOURS = 8  # nearest neighbours of each Gaussian
UNLIKE = 1.0  # how much longer an edge is where colours differ as neighbours do on average


@dataclass(frozen=True)
class NeighbourGraph:
    """The graph of neighbouring Gaussians, with the similarity of their colours.

    Attributes:
        pairs: [E, 2] int, each pair once.
        likeness: [E] in (0, 1], similarity of colours.
        way: [E] > 0, length of the edge: the distance, longer where colours differ.
    """

    pairs: np.ndarray
    likeness: np.ndarray
    way: np.ndarray


def find_neighbours(gaussians: Gaussians) -> NeighbourGraph:
    """The graph of neighbouring Gaussians; likeness of colours is relative to the mean difference of neighbours."""
    means, color = (each.detach().cpu().double().numpy() for each in (gaussians.means, gaussians.sh[:, 0] * SH0))
    near = cKDTree(means).query(means, min(NEIGHBOURS + 1, len(means)))[1].reshape(len(means), -1)[:, 1:]
    own = np.repeat(np.arange(len(means)), near.shape[1])
    pairs = np.unique(np.sort(np.stack([own, near.ravel()], 1), 1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    square = ((color[pairs[:, 0]] - color[pairs[:, 1]]) ** 2).sum(1)
    unlike = square / (square.sum() / max(len(square), 1) + 1e-12)
    apart = np.linalg.norm(means[pairs[:, 0]] - means[pairs[:, 1]], axis=1)
    return NeighbourGraph(pairs, np.exp(-unlike / 2), apart * (1 + UNLIKE * np.sqrt(unlike)) + 1e-12)


def measure_overlap(gaussians: Gaussians, pairs: np.ndarray) -> np.ndarray:
    """[E] in [0, 1], how much the Gaussians of each pair overlap: exp(-g^2 / 2), where g is their distance over the sum
    of their standard deviations towards each other.

    Args:
        pairs: [E, 2] int.
    """
    means, scales = (each.detach().cpu().double() for each in (gaussians.means, gaussians.log_scales.exp()))
    inverse = gaussians.quaternions.detach().cpu().double() * torch.tensor([1.0, -1.0, -1.0, -1.0])
    first, second = torch.as_tensor(pairs).T
    way = means[second] - means[first]
    apart = way.norm(dim=1).clamp_min(1e-12)
    deviation = lambda k: (rotate(inverse[k], way / apart[:, None]) * scales[k]).norm(dim=1)
    gap = apart / (deviation(first) + deviation(second)).clamp_min(1e-12)
    return torch.exp(-(gap**2) / 2).numpy()
