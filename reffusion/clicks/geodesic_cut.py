"""Segments pixels or Gaussians by cuts through the graph of their neighbours."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from reffusion.clicks.marks import OBJECT, OTHER
from reffusion.graph_cut import HARD, min_cut

BINS = 20  # of colours, along each axis of L*a*b* with 8 bits
ROUNDS = 3  # of distances and colours, each with the labels of the one before
COLOR_COST, LIKELIHOOD_COST = 0.3, 100.0  # cost of a path from the second round on, per step of colour, of likelihood
# Where surfaces are known: weight of a step of colour on a surface, and cost of leaving it.
COLOR_ON_SURFACE, DEPTH_EDGE_COST = 0.35, 60.0
SMOOTH = 5.0  # cost of a border between two that look alike
REACHES = 0.5, 0.44, 0.37, 0.3  # shares of the path from a click to what is not the object
CORRECTION_REACH = 150.0  # of colour and pixels: how far a correcting click reaches
EDGE_CONTRAST = 10.0  # of colour, in L*a*b* with 8 bits, at the edge of an object
SIZE_PENALTY = 0.05  # subtracted from the score per natural logarithm of the object's size
LARGEST_LOG_RATIO = 3.0  # bound of the natural logarithm of a ratio of colour frequencies


def grow_object(
    lab: np.ndarray,
    pairs: np.ndarray,
    length: np.ndarray,
    seeds: np.ndarray,
    weak: np.ndarray,
    depth_edges: np.ndarray | None = None,
) -> np.ndarray:
    """bool [N]: the object, grown from few seeds by a geodesic graph cut, whose colour models follow from its own
    labels.

    Args:
        lab: [N, 3] float, colours in L*a*b* with 8 bits.
        pairs: [E, 2] int, neighbours, each pair once; length: [E] > 0, distance of neighbours, 1 = adjacent.
        seeds: int8 [N], OBJECT, OTHER or UNKNOWN; at least one OBJECT.
        weak: bool [N], unlikely to be the object.
        torn: [E] in [0, 1], 1 where two do not lie on one surface; None: not known.
    """
    step = color_steps(lab, pairs, depth_edges)
    smooth = _smoothness(step, length)
    other = (seeds == OTHER) | (weak & (seeds != OBJECT))
    cost, labels = step, None
    for _ in range(ROUNDS):
        side = relative_distance(pairs, (cost + 1.0) * length, seeds == OBJECT, other)
        inside = np.maximum(side, 0) if labels is None else labels * (0.5 + side).clip(0.1, 1)
        outside = np.maximum(-side, 0) if labels is None else ~labels * (0.5 - side).clip(0.1, 1)
        like, unlike = (color_frequency(lab, weight) for weight in (inside, outside))
        gain = 2 * side + np.log(like / unlike).clip(-LARGEST_LOG_RATIO, LARGEST_LOG_RATIO)
        cost_object = np.where(seeds == OTHER, HARD, np.maximum(-gain, 0) * (seeds != OBJECT))
        cost_other = np.where(seeds == OBJECT, HARD, np.maximum(gain, 0) * (seeds != OTHER))
        labels = min_cut(cost_object, cost_other, pairs, smooth)
        likelihood = like / (like + unlike)
        change = np.abs(likelihood[pairs[:, 0]] - likelihood[pairs[:, 1]])
        cost = COLOR_COST * step + LIKELIHOOD_COST * (change if depth_edges is None else COLOR_ON_SURFACE * change)
    assert labels is not None
    return keep_connected(labels, pairs, seeds == OBJECT)


def nested_candidates(
    lab: np.ndarray, pairs: np.ndarray, length: np.ndarray, seeds: np.ndarray, weak: np.ndarray, depth_edges: np.ndarray
) -> list[np.ndarray]:
    """What clicks may mean by surfaces alone, from the largest to the smallest: bool [N] each, each within the one
    before.

    Args:
        lab, pairs, length, seeds, weak, torn: as for `grow_object`.
    """
    step = color_steps(lab, pairs, depth_edges)
    smooth = _smoothness(step, length)
    side = relative_distance(
        pairs, (step + 1.0) * length, seeds == OBJECT, (seeds == OTHER) | (weak & (seeds != OBJECT))
    )
    inside_of, found = np.ones(len(lab), bool), []
    for share in REACHES:
        gain = 2 * (side - (1 - 2 * share))
        cost_object = np.where(seeds == OTHER, HARD, np.maximum(-gain, 0) * (seeds != OBJECT))
        cost_other = np.where(seeds == OBJECT, HARD, np.maximum(gain, 0) * (seeds != OTHER))
        # What costs more to take is part of what costs less.
        inside_of = _cut_within(inside_of, cost_object, cost_other, pairs, smooth)
        found.append(keep_connected(inside_of, pairs, seeds == OBJECT))
    return found


def _cut_within(
    inside_of: np.ndarray, true_cost: np.ndarray, false_cost: np.ndarray, pairs: np.ndarray, strength: np.ndarray
) -> np.ndarray:
    """bool [N]: `least_cut` of those in `inside_of`; the others are False."""
    ends, at = inside_of[pairs], np.cumsum(inside_of) - 1
    both, crossing = ends.all(1), ends[:, 0] != ends[:, 1]
    inner = np.where(ends[crossing, 0], pairs[crossing, 0], pairs[crossing, 1])
    border = np.bincount(inner, strength[crossing], len(inside_of))
    found = np.zeros(len(inside_of), bool)
    found[inside_of] = min_cut((true_cost + border)[inside_of], false_cost[inside_of], at[pairs[both]], strength[both])
    return found


def object_score(
    labels: np.ndarray, around: np.ndarray, lab: np.ndarray, pairs: np.ndarray, depth_edges: np.ndarray
) -> float:
    """How well labels stand for an object of its own; -inf for an empty one.

    High if the border follows edges of surfaces or colours, no surface ends inside, and its colours differ from those
    around it. Of two that are as good the smaller one wins.

    Args:
        labels: bool [N]; around: bool [N], the surroundings.
    """
    ends = labels[pairs]
    inside, rim = ends.all(1), ends[:, 0] != ends[:, 1]
    if not inside.any() or not rim.any() or not around.any():
        return -np.inf
    of, off = (color_histogram(lab, each.astype(float)) for each in (labels, around))
    alike = float(np.minimum(of / of.sum(), off / off.sum()).sum())
    edge = np.maximum(depth_edges[rim], (color_steps(lab, pairs[rim], None) / EDGE_CONTRAST).clip(0, 1))
    return float(edge.mean() - depth_edges[inside].mean()) - alike - SIZE_PENALTY * float(np.log(labels.sum()))


def color_steps(lab: np.ndarray, pairs: np.ndarray, depth_edges: np.ndarray | None) -> np.ndarray:
    """[E] >= 0, difference of neighbours: in colour; where surfaces are known, mainly across their edges."""
    color = np.linalg.norm(lab[pairs[:, 0]] - lab[pairs[:, 1]], axis=1)
    return color if depth_edges is None else COLOR_ON_SURFACE * color + DEPTH_EDGE_COST * depth_edges


def correct_labels(
    lab: np.ndarray,
    pairs: np.ndarray,
    length: np.ndarray,
    seeds: np.ndarray,
    before: np.ndarray,
    depth_edges: np.ndarray | None = None,
) -> np.ndarray:
    """bool [N]: the labels `before`, changed where contradicting seeds reach without crossing a change of colour.

    Args:
        lab, pairs, length, seeds, torn: as for `grow_object`.
        was: bool [N].
    """
    step = color_steps(lab, pairs, depth_edges)
    smooth = _smoothness(step, length)
    wrong = (seeds == OBJECT) & ~before | (seeds == OTHER) & before
    right = (seeds == OBJECT) & before | (seeds == OTHER) & ~before
    across = before[pairs[:, 0]] != before[pairs[:, 1]]  # what is changed lies on one side of the former border
    graph = sparse.coo_array(
        ((step + 1.0) * length + CORRECTION_REACH * across, tuple(pairs.T)), (len(lab),) * 2
    ).tocsr()
    weight_lost = 2 * np.exp(-_distance(graph, wrong) / CORRECTION_REACH)
    if right.any():
        weight_lost *= _distance(graph, right) > _distance(graph, wrong)
    gain = np.where(before, 1.0, -1.0) * (1 - weight_lost)
    cost_object = np.where(seeds == OTHER, HARD, np.maximum(-gain, 0) * (seeds != OBJECT))
    cost_other = np.where(seeds == OBJECT, HARD, np.maximum(gain, 0) * (seeds != OTHER))
    return min_cut(cost_object, cost_other, pairs, smooth)


def _smoothness(step: np.ndarray, length: np.ndarray) -> np.ndarray:
    """[E], cost of a border between neighbours; lower where colours change more than on average."""
    usual = float((step**2).sum()) / max(len(step), 1)
    return SMOOTH * np.exp(-(step**2) / (2 * usual + 1e-9)) / length


def keep_connected(labels: np.ndarray, pairs: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """bool [N]: the labelled ones that are connected with a seed."""
    kept = pairs[labels[pairs].all(1)]
    links = sparse.coo_array((np.ones(len(kept)), tuple(kept.T)), (len(labels),) * 2)
    part = csgraph.connected_components(links, directed=False)[1]
    return labels & np.isin(part, part[seeds & labels])


def relative_distance(pairs: np.ndarray, length: np.ndarray, these: np.ndarray, those: np.ndarray) -> np.ndarray:
    """[N] in [-1, 1]: 1 at `these`, -1 at `those` (bool [N]), in between by the shortest paths along pairs."""
    graph = sparse.coo_array((length, tuple(pairs.T)), (len(these),) * 2).tocsr()
    near, far = (_distance(graph, start) for start in (these, those))
    return (far - near) / (far + near + 1e-9)


def _distance(graph: sparse.csr_array, start: np.ndarray) -> np.ndarray:
    """[N], length of the shortest path from any of `start`; unreachable ones get more than the longest."""
    if not start.any():
        return np.ones(graph.shape[0])
    found = csgraph.dijkstra(graph, directed=False, indices=np.flatnonzero(start), min_only=True)
    reached = np.isfinite(found)
    return np.where(reached, found, 2 * found[reached].max() + 1)


def color_frequency(lab: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """[N], weighted frequency of each one's colour among all; never 0. lab: [N, 3], L*a*b* with 8 bits."""
    count = color_histogram(lab, weight)
    return (count / max(count.sum(), 1e-9))[_bins(lab)] + 1e-5


def color_histogram(lab: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """[BINS, BINS, BINS], blurred weighted histogram of colours."""
    count = np.zeros((BINS,) * 3)
    np.add.at(count, _bins(lab), weight)
    return ndimage.gaussian_filter(count, 0.7, mode="nearest")


def _bins(lab: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple((lab * (BINS / 256)).astype(int).clip(0, BINS - 1).T)
