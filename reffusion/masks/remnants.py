"""Remnants: parts of the object that the masks leave out, and that would stay in the scene when the object is removed.

Such a part touches the object more than it touches the surroundings, and its colors resemble those of the object more
than those of the surroundings. A minimum cut through the graph of neighboring Gaussians proposes parts. A part is
selected by its score, the sum of the logarithms of two ratios: contact with the object to contact with the rest, and
density of its colors in the object to their density in the surroundings.
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

from reffusion.gaussians.neighbors import find_neighbors, measure_overlap
from reffusion.graph_cut import HARD, min_cut
from reffusion.splat import rasterizer
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians

EXTENT = 4.0  # in radii of the object: a part farther from its middle touches Gaussians that are labeled by mistake
REACH = 1.0  # in radii of the object: Gaussians farther from the object than this belong to the surroundings
# In radii of the object: distance up to which the surroundings are considered. The distance is increased until the
# surroundings have `SAMPLES` Gaussians.
SURROUNDINGS = 3.0
ATTACHMENT = 2.0  # in the cut, contact with the object is divided by this
LEAST_SIMILARITY = 0.3  # least similarity of two unlabeled Gaussians in the cut, so that a pattern divides no surface
COLOR_WEIGHT = 0.3  # weight of the log-ratio of color densities in the cut; in the score its weight is 1
LARGEST_LOG_RATIO = 3.0  # limit of the absolute value of this log-ratio
SAMPLES, NEAREST = 2000, 10  # density of a color: from the distance to the NEAREST-th of up to SAMPLES random colors
COLOR_BLUR = 0.02  # added to the distances of colors in [0, 1], so that smaller differences hardly count
LEAST_SCORE = 2.5  # score from which a part is a remnant
LEAST_COUNT = 10  # least number of Gaussians of a remnant
# Least number of a remnant's visible pixels, relative to those of the object. Parts that would float stand out more.
LEAST_SHARE, LEAST_FLOATING_SHARE = 0.003, 0.001
ROUNDS = 3  # largest number of searches, each without the floating parts that the former ones found
FLOATING_RATIO = 10.0  # ratio of contact with the object to contact with the rest above which a part would float
SOLID = 0.1  # opacity above which a Gaussian belongs to a surface
TOUCHING = 0.1  # overlap above which two Gaussians touch


@dataclass(frozen=True)
class Remnant:
    """A part of the object that the masks leave out.

    Attributes:
        members: bool [N], True for the Gaussians of the part.
        would_float: True if the part would touch hardly anything without the object.
        share: number of visible pixels of the part, divided by that of the object, in all views together.
        view: name of the view that shows most pixels of the part.
        mask: bool [H, W], the pixels of the part in this view.
    """

    members: np.ndarray
    would_float: bool
    share: float
    view: str
    mask: np.ndarray

    @property
    def center(self) -> tuple[int, int]:
        """The median (column, row) of the pixels of `mask`."""
        rows, columns = np.nonzero(self.mask)
        return round(float(np.median(columns))), round(float(np.median(rows)))

    def describe(self) -> str:
        """Return a text for messages that states the size of the part and where it is seen."""
        return f"{self.share:.1%} of the object's visible size, best seen in {self.view} around {self.center}"


def find_remnants(gaussians: Gaussians, labels: Tensor, cameras: Sequence[Camera]) -> list[Remnant]:
    """Find the remnants of the object that are visible enough, the largest first.

    Parts that would float are removed with the object. This may leave further parts in the air, such as a claw of a
    hand, so the search is repeated with these parts as the object, at most `ROUNDS` times.

    Args:
        gaussians: the N Gaussians of the whole scene.
        labels: bool [N], True for the Gaussians of the object.
        cameras: the views in which visible pixels are counted.
    """
    floating: list[Remnant] = []
    for _ in range(ROUNDS):
        found = _find_visible(gaussians, labels, cameras)
        removed = [each for each in found if each.would_float]
        floating += removed
        if not removed:
            break
        gone = np.any([each.members for each in removed], 0)
        labels = labels | torch.as_tensor(gone, device=labels.device)
    touching = [each for each in found if not each.would_float]
    return sorted([*floating, *touching], key=lambda remnant: -remnant.share)


def _find_visible(gaussians: Gaussians, labels: Tensor, cameras: Sequence[Camera]) -> list[Remnant]:
    """Find the parts that seem to belong to the object and that are visible enough, in one search."""
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
        if share >= (LEAST_FLOATING_SHARE if would_float else LEAST_SHARE):
            best = int(np.argmax(pixels))
            found.append(Remnant(part, would_float, share, cameras[best].name, shown[best][k]))
    return found


def find_parts(gaussians: Gaussians, labels: np.ndarray) -> list[tuple[np.ndarray, bool]]:
    """Find the connected parts of the unlabeled scene that seem to belong to the object, whatever their visible size.

    Args:
        gaussians: the N Gaussians of the whole scene.
        labels: bool [N], True for the Gaussians of the object.

    Returns:
        For each part its Gaussians, bool [N], none of which is labeled, and whether the part would float once the
        object is removed.
    """
    means = gaussians.means.detach().cpu().double().numpy()
    if not labels.any():
        return []
    from_middle = np.linalg.norm(means - np.median(means[labels], axis=0), axis=1)
    radius = float(np.median(from_middle[labels]))
    distance = cKDTree(means[labels]).query(means)[0]
    opacities = gaussians.opacity_logits.detach().sigmoid().cpu().double().numpy()
    beyond = np.sort(distance[(distance > REACH * radius) & (opacities > SOLID)])
    if min((labels & (opacities > SOLID)).sum(), len(beyond)) < NEAREST:
        return []  # too few Gaussians to compare, e.g. no surroundings because everything around a place is removed
    near = np.flatnonzero(distance <= max(SURROUNDINGS * radius, beyond[min(SAMPLES, len(beyond)) - 1]))
    local, opacities = gaussians.map(lambda p: p[torch.as_tensor(near, device=p.device)]), opacities[near]
    inside, stays, solid = labels[near], distance[near] > REACH * radius, opacities > SOLID
    graph, size = find_neighbors(local), surface_sizes(local)
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
        weight = (opacities * size**2)[part]  # the visible area of each Gaussian
        score = np.log(max(ratio, 1e-12)) + float((log_ratio[part] * weight).sum() / weight.sum())
        is_near = np.median(from_middle[near[part]]) <= EXTENT * radius
        if score >= LEAST_SCORE and is_near:
            members = np.zeros(len(gaussians), bool)
            members[near[part]] = True
            parts.append((members, bool(contact[to_object].sum() > FLOATING_RATIO * contact[to_rest].sum())))
    return parts


def compare_densities(colors: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Return [N], for each color the natural logarithm of its density inside divided by its density outside.

    Densities are those of colors in color space, estimated from the distance to the `NEAREST`-th nearest sample.

    Args:
        colors: [N, 3].
        inside: bool [N], True for the colors of one side; at least `NEAREST` are True.
        outside: bool [N], True for the colors of the other side; at least `NEAREST` are True.
    """
    generator, densities = np.random.default_rng(0), []
    for side in (inside, outside):
        samples = generator.permutation(colors[side])[:SAMPLES]
        distance = cKDTree(samples).query(colors, NEAREST)[0][:, -1]
        densities.append(NEAREST / len(samples) / (distance + COLOR_BLUR) ** 3)
    return np.log(densities[0] / densities[1])


def surface_sizes(gaussians: Gaussians) -> np.ndarray:
    """Return [N], for each Gaussian the geometric mean of its two larger standard deviations, its size on a surface."""
    scales = gaussians.log_scales.detach().cpu().double().numpy()
    return np.exp(np.sort(scales, 1)[:, 1:].mean(1))


def connected_parts(found: np.ndarray, pairs: np.ndarray) -> list[np.ndarray]:
    """Return those connected parts of a set of nodes that consist of at least `LEAST_COUNT` nodes.

    Args:
        found: bool [N], True for the nodes of the set.
        pairs: [E, 2] int, indices of nodes that are connected.

    Returns:
        bool [N] for each part.
    """
    pairs = pairs[found[pairs].all(1)]
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), (len(found), len(found)))
    part = connected_components(links, directed=False)[1]
    sizes = np.bincount(part[found], minlength=part.max(initial=0) + 1)
    return [part == k for k in np.flatnonzero(sizes >= LEAST_COUNT)]


@torch.no_grad()
def render_parts(gaussians: Gaussians, parts: Sequence[np.ndarray], camera: Camera) -> list[np.ndarray]:
    """Return for each part the pixels, bool [H, W], at which the blending weights of its Gaussians sum to above 0.5.

    Args:
        parts: bool [N] for each part, True for its Gaussians; at least one part.
    """
    features = torch.as_tensor(np.stack(parts, -1)).to(gaussians.means)
    shares = rasterizer.render(gaussians, camera, sh_degree=0, features=features).features.cpu().numpy()
    return [shares[..., k] > 0.5 for k in range(len(parts))]
