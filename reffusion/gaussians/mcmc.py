"""Densification as sampling: 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al., 2024).

Gaussians too faint to show anything move to where others already are, in such a way that the picture hardly changes;
noise keeps the faint ones exploring. Their number follows a budget instead of a threshold of slopes.
All lengths are in units of the normalised frame.
"""

from __future__ import annotations

from math import comb

import torch
from torch import Tensor

from reffusion.gaussians.densify import rotate
from reffusion.gaussians.optimize import GaussianOptimizer
from reffusion.types import Gaussians

MOST_COPIES = 51  # one Gaussian is never shared by more
NOISE = 5e5  # of the exploration, in step sizes of the means


def shared(opacity: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """What one Gaussian's opacity [M] becomes when `copies` [M] long of it stand in one place, and by what factor
    their standard deviations [M] shrink, so that together they draw what it drew (eq. 9 there).

    (1 - o')^c = 1 - o; and with the Gaussian integrated along a line,
    factor = o / sum_{i=1..c} sum_{k<i} binomial(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1).
    """
    opacity, copies = opacity.double(), copies.clamp(1, MOST_COPIES)
    each = 1 - (1 - opacity) ** (1 / copies)
    total = torch.zeros_like(each)
    # sum_{i=1..c} binomial(i-1, k) = binomial(c, k+1)
    table = torch.tensor([[comb(c, k + 1) for k in range(MOST_COPIES)] for c in range(MOST_COPIES + 1)])
    table = table.to(each)
    for k in range(int(copies.max()) if len(copies) else 0):
        total += table[copies, k] * (-1) ** k * each ** (k + 1) / (k + 1) ** 0.5
    return each.float(), (opacity / total).float()


def relocate(optimizer: GaussianOptimizer, least_opacity: float, generator: torch.Generator) -> int:
    """Move the Gaussians of at most `least_opacity` onto others, drawn by opacity; how many were moved.

    Moved Gaussians and those they join start Adam afresh; labels go with the place.
    """
    opacity = optimizer.gaussians.opacity_logits.detach().sigmoid()
    dead = opacity <= least_opacity
    if not dead.any() or dead.all():
        return 0
    hosts = _drawn(torch.where(dead, 0.0, opacity), int(dead.sum()), generator)
    _join(optimizer, hosts, dead.nonzero()[:, 0], least_opacity)
    return len(hosts)


def grow(optimizer: GaussianOptimizer, count: int, least_opacity: float, generator: torch.Generator) -> int:
    """Add `count` Gaussians onto others, drawn by opacity; how many were added."""
    if count <= 0:
        return 0
    start = len(optimizer.gaussians)
    hosts = _drawn(optimizer.gaussians.opacity_logits.detach().sigmoid(), count, generator)
    optimizer.append(optimizer.gaussians.map(lambda p: p.detach()[hosts]), optimizer.masked[hosts])
    _join(optimizer, hosts, torch.arange(start, start + count, device=hosts.device), least_opacity)
    return count


def _drawn(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """[count] indices, each drawn with these weights; a cumulative sum, for multinomial takes 2^24 at most."""
    edges = weights.double().cumsum(0)
    where = torch.rand(count, generator=generator, dtype=torch.float64).to(edges) * edges[-1]
    return torch.searchsorted(edges, where).clamp(max=len(weights) - 1)


def _join(optimizer: GaussianOptimizer, hosts: Tensor, guests: Tensor, least_opacity: float) -> None:
    """Put Gaussian guests[i] where hosts[i] stands, host and all its guests sharing what the host drew."""
    gaussians = optimizer.gaussians
    copies = torch.bincount(hosts, minlength=len(gaussians))[hosts] + 1
    with torch.no_grad():
        opacity, shrink = shared(gaussians.opacity_logits[hosts].sigmoid(), copies)
        opacity = opacity.clamp(least_opacity, 1 - torch.finfo(torch.float32).eps)
        logits = torch.logit(opacity)
        log_scales = gaussians.log_scales[hosts] + shrink.log()[:, None]
        for rows in (hosts, guests):
            gaussians.opacity_logits[rows] = logits
            gaussians.log_scales[rows] = log_scales
        for name in ("means", "quaternions", "sh"):
            parameter = getattr(gaussians, name)
            parameter[guests] = parameter[hosts]
        optimizer.masked[guests] = optimizer.masked[hosts]
    optimizer.restart(torch.cat([hosts, guests]))


@torch.no_grad()
def explore(optimizer: GaussianOptimizer, progress: float, generator: torch.Generator) -> None:
    """Noise on the means, drawn from each Gaussian's own covariance, large for the faint and none for the opaque."""
    gaussians = optimizer.gaussians
    opacity = gaussians.opacity_logits.sigmoid()
    faint = torch.sigmoid(100 * (0.005 - opacity))
    size = NOISE * optimizer.rates.at(progress, gaussians)["means"][0]
    noise = torch.randn(gaussians.means.shape, generator=generator).to(gaussians.means)
    gaussians.means.add_(_by_covariance(gaussians, noise * (faint * size)[:, None]))


def _by_covariance(gaussians: Gaussians, vectors: Tensor) -> Tensor:
    """R diag(s^2) R^T v, [N, 3]."""
    inverse = gaussians.quaternions * gaussians.quaternions.new_tensor([1.0, -1.0, -1.0, -1.0])
    turned = rotate(inverse, vectors) * (2 * gaussians.log_scales).exp()
    return rotate(gaussians.quaternions, turned)
