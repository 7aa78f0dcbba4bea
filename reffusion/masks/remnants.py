"""Remnants: parts of the object that the masks leave out, and that would stay when the object is removed.

A part of the object touches the object more than what stays, and its colours are the object's rather than those of the
surroundings. A minimum cut through the neighbouring Gaussians proposes parts; the sum of both log-ratios selects them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from reffusion.gaussians.neighbours import find_neighbours, measure_overlap
from reffusion.graph_cut import HARD, min_cut
from reffusion.splat import rasterizer
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians

REACH = 1.0  # of the object's radius: Gaussians farther from the object surely stay
# What lies between `REACH` and here stands for what stays; farther, if it has fewer than `SAMPLES` Gaussians.
SURROUNDINGS = 3.0  # of the object's radius
ATTACHMENT = 2.0  # contact with the object is divided by this in the cut
LEAST_SIMILARITY = 0.3  # of the colours of two Gaussians without labels: a pattern does not divide a surface
COLOR_WEIGHT = 0.3  # of the log-ratio of colour densities in the cut; in the score it is 1
LARGEST_LOG_RATIO = 3.0  # bound of that logarithm
SAMPLES, NEAREST = 2000, 10  # colours that stand for each side; their distance to the nearest ones gives a density
COLOR_BLUR = 0.02  # of a colour's range: differences below this do not count
LEAST_SCORE = 2.5  # logarithms of the ratios of contact and of colours, together, from which a part is a remnant
LEAST_COUNT = 10  # Gaussians of a remnant
LEAST_SHARE = 0.003  # of the object's visible pixels
FLOATING_RATIO = 10.0  # of contact with the object to contact with what stays, from which a part would float
SOLID = 0.1  # opacity from which a Gaussian belongs to a surface
TOUCHING = 0.1  # overlap from which two Gaussians touch


@dataclass(frozen=True)
class Remnant:
    """A part of the object that the masks leave out.

    Attributes:
        members: bool [N].
        would_float: without the object it would touch hardly anything.
        share: its visible pixels over the object's, all training views together.
        view: the view that shows most of it; mask: bool [H, W], its pixels there.
    """

    members: np.ndarray
    would_float: bool
    share: float
    view: str
    mask: np.ndarray

    @property
    def center(self) -> tuple[int, int]:
        """(x, y) of the middle of its pixels, px."""
        rows, columns = np.nonzero(self.mask)
        return round(float(np.median(columns))), round(float(np.median(rows)))

    def describe(self) -> str:
        """Where it is and how large, for messages."""
        return f"{self.share:.1%} of the object's visible size, best seen in {self.view} around {self.center}"


def find_remnants(gaussians: Gaussians, labels: Tensor, cameras: Sequence[Camera]) -> list[Remnant]:
    """Remnants of the labelled object, bool [N], the largest first."""
    parts = find_parts(gaussians, labels.cpu().numpy())
    if not parts:
        return []
    shown = [render_parts(gaussians, [labels.cpu().numpy(), *(part for part, _ in parts)], c) for c in cameras]
    object_pixels = sum(int(masks[0].sum()) for masks in shown)
    if not object_pixels:
        return []
    found = []
    for k, (part, would_float) in enumerate(parts, start=1):
        pixels = [int(masks[k].sum()) for masks in shown]
        share = sum(pixels) / object_pixels
        if share >= LEAST_SHARE:
            best = int(np.argmax(pixels))
            found.append(Remnant(part, would_float, share, cameras[best].name, shown[best][k]))
    return sorted(found, key=lambda remnant: -remnant.share)


def find_parts(gaussians: Gaussians, labels: np.ndarray) -> list[tuple[np.ndarray, bool]]:
    """(bool [N], would it float) for each connected part that continues the labelled object, bool [N]."""
    means = gaussians.means.detach().cpu().double().numpy()
    if not labels.any():
        return []
    radius = float(np.median(np.linalg.norm(means[labels] - np.median(means[labels], axis=0), axis=1)))
    distance = cKDTree(means[labels]).query(means)[0]
    opacities = gaussians.opacity_logits.detach().sigmoid().cpu().double().numpy()
    beyond = np.sort(distance[(distance > REACH * radius) & (opacities > SOLID)])
    if min((labels & (opacities > SOLID)).sum(), len(beyond)) < NEAREST:
        return []  # nothing is known to stay, as where everything around a place is removed
    near = np.flatnonzero(distance <= max(SURROUNDINGS * radius, beyond[min(SAMPLES, len(beyond)) - 1]))
    local, opacities = gaussians.map(lambda p: p[torch.as_tensor(near, device=p.device)]), opacities[near]
    inside, stays, solid = labels[near], distance[near] > REACH * radius, opacities > SOLID
    graph, size = find_neighbours(local), surface_sizes(local)
    first, second = graph.pairs.T
    overlap = measure_overlap(local, graph.pairs)
    contact = overlap * np.minimum(*opacities[graph.pairs.T]) * np.minimum(*size[graph.pairs.T])
    color = local.sh[:, 0].detach().cpu().double().numpy() * SH0
    log_ratio = compare_densities(color, inside & solid, stays & solid).clip(-LARGEST_LOG_RATIO, LARGEST_LOG_RATIO)
    similarity, free = graph.likeness**2, ~inside & ~stays
    strength = contact * np.where(
        inside[first] | inside[second], similarity / ATTACHMENT, np.maximum(similarity, LEAST_SIMILARITY)
    )
    unit = max(float(strength.mean()), 1e-12)
    gain = COLOR_WEIGHT * opacities * size * log_ratio * free / unit
    sides = (HARD * stays + np.maximum(-gain, 0), HARD * inside + np.maximum(gain, 0))
    found = min_cut(*sides, graph.pairs, strength / unit) & ~inside
    parts = []
    for part in connected_parts(found, graph.pairs[overlap > TOUCHING]):
        to_object = (part[first] & inside[second]) | (part[second] & inside[first])
        to_rest = (part[first] ^ part[second]) & ~inside[first] & ~inside[second]
        ratio = (contact * similarity)[to_object].sum() / max((contact * similarity)[to_rest].sum(), 1e-12)
        weight = (opacities * size**2)[part]  # area that a Gaussian shows
        score = np.log(max(ratio, 1e-12)) + float((log_ratio[part] * weight).sum() / weight.sum())
        if score >= LEAST_SCORE:
            members = np.zeros(len(gaussians), bool)
            members[near[part]] = True
            parts.append((members, bool(contact[to_object].sum() > FLOATING_RATIO * contact[to_rest].sum())))
    return parts


def compare_densities(colors: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """[N] natural logarithm of the density of the colours inside over that of the colours outside, at each colour.

    Args:
        colors: [N, 3]. inside, outside: bool [N], at least `NEAREST` each.
    """
    generator, densities = np.random.default_rng(0), []
    for side in (inside, outside):
        samples = generator.permutation(colors[side])[:SAMPLES]
        distance = cKDTree(samples).query(colors, NEAREST)[0][:, -1]
        densities.append(NEAREST / len(samples) / (distance + COLOR_BLUR) ** 3)
    return np.log(densities[0] / densities[1])


def surface_sizes(gaussians: Gaussians) -> np.ndarray:
    """[N], the geometric mean of the two larger standard deviations."""
    scales = gaussians.log_scales.detach().cpu().double().numpy()
    return np.exp(np.sort(scales, 1)[:, 1:].mean(1))


def connected_parts(found: np.ndarray, pairs: np.ndarray) -> list[np.ndarray]:
    """bool [N] each: the parts of `found` that pairs connect, of at least `LEAST_COUNT`."""
    pairs = pairs[found[pairs].all(1)]
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), (len(found), len(found)))
    part = connected_components(links, directed=False)[1]
    sizes = np.bincount(part[found], minlength=part.max(initial=0) + 1)
    return [part == k for k in np.flatnonzero(sizes >= LEAST_COUNT)]


@torch.no_grad()
def render_parts(gaussians: Gaussians, parts: Sequence[np.ndarray], camera: Camera) -> list[np.ndarray]:
    """bool [H, W] for each part, bool [N]: where it makes up most of what a view shows."""
    features = torch.as_tensor(np.stack(parts, -1)).to(gaussians.means)
    shares = rasterizer.render(gaussians, camera, sh_degree=0, features=features).features.cpu().numpy()
    return [shares[..., k] > 0.5 for k in range(len(parts))]
