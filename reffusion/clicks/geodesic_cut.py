"""Segmentation of a graph by geodesic distances (lengths of shortest paths) and minimum cuts.

The N nodes of the graph are the pixels of a picture, or Gaussians. Its E pairs are neighbors.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from reffusion.clicks.marks import OBJECT, OTHER
from reffusion.graph_cut import HARD, min_cut

BINS = 20  # bins of a color histogram along each axis of 8-bit L*a*b*
ROUNDS = 3  # rounds of `grow_object`; each takes its color models from the labels of the round before
# Cost of a path from the second round on: per unit of `color_steps`, and per unit of change in the probability [0, 1]
# that a color is the object's.
COLOR_COST, LIKELIHOOD_COST = 0.3, 100.0
# Where depth is known: weight of a color difference within a surface, and cost of an edge between surfaces.
COLOR_ON_SURFACE, DEPTH_EDGE_COST = 0.35, 60.0
SMOOTH = 5.0  # cost of a border between two neighbors of the same color
# A candidate contains the nodes that lie within this share of the path from a click to the background.
REACHES = 0.5, 0.44, 0.37, 0.3
# Path cost (units of 8-bit L*a*b* plus pixels) over which the influence of a correcting click falls to 1/e.
CORRECTION_REACH = 150.0
EDGE_CONTRAST = 10.0  # color difference in 8-bit L*a*b* that counts as a full edge of an object
SIZE_PENALTY = 0.05  # subtracted from the score per natural logarithm of the object's size
LARGEST_LOG_RATIO = 3.0  # bound of the natural logarithm of a ratio of color frequencies


def grow_object(
    lab: np.ndarray,
    pairs: np.ndarray,
    length: np.ndarray,
    seeds: np.ndarray,
    weak: np.ndarray,
    depth_edges: np.ndarray | None = None,
) -> np.ndarray:
    """Return bool [N], True = the object, grown from a few seeds by geodesic graph cuts.

    Each of `ROUNDS` rounds measures the geodesic distances of all nodes to the object's seeds and to the other seeds,
    estimates the colors of object and background from the labels of the round before (from the distances in the first
    round), and labels all nodes by a minimum cut. The result contains only nodes that are connected with a seed of the
    object.

    Args:
        lab: float [N, 3], colors in L*a*b*, each axis in [0, 255] as in 8-bit pictures.
        pairs: int [E, 2], neighbors, each pair once.
        length: [E] > 0, distance of the two neighbors of a pair; 1 for adjacent pixels.
        seeds: int8 [N], OBJECT, OTHER or UNKNOWN; at least one OBJECT.
        weak: bool [N], True = unlikely to be the object, such as the picture's border. Distances treat these nodes as
            OTHER, but the cut may still label them as object.
        depth_edges: [E] in [0, 1], 1 where the two neighbors lie on different surfaces; None if depth is unknown.
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
    """Return candidates for the object that clicks mean, bool [N] each, from the largest to the smallest.

    There is one candidate for each share in `REACHES`, and each lies within the one before. The cuts use geodesic
    distances along surfaces and colors, but no color models.

    Args:
        lab, pairs, length, seeds, weak, depth_edges: as for `grow_object`; `depth_edges` is required.
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
        # A smaller share raises the cost of the label "object", so the new cut is searched within the one before.
        inside_of = _cut_within(inside_of, cost_object, cost_other, pairs, smooth)
        found.append(keep_connected(inside_of, pairs, seeds == OBJECT))
    return found


def _cut_within(
    inside_of: np.ndarray, true_cost: np.ndarray, false_cost: np.ndarray, pairs: np.ndarray, strength: np.ndarray
) -> np.ndarray:
    """Return the labels, bool [N], of `min_cut` if only the nodes in `inside_of`, bool [N], may become True."""
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
    """Score how well labels outline one complete object; a higher score is better.

    The score is high if the border follows edges of surfaces or of colors, if no edge of a surface lies inside, and if
    the colors inside differ from the colors around. A penalty on size prefers the smaller of two equal candidates.

    Args:
        labels: bool [N], True = the object.
        around: bool [N], True = the surroundings whose colors are compared.
        lab, pairs, depth_edges: as for `grow_object`; `depth_edges` is required.

    Returns:
        The score, or -inf if the labels contain no two neighbors, have no border, or nothing is around them.
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
    """Return [E] >= 0, how different the two neighbors of each pair are.

    This is the color difference in 8-bit L*a*b* if `depth_edges` is None. Otherwise it is a weighted sum of the color
    difference and `depth_edges`, in which edges of surfaces dominate.

    Args:
        lab, pairs, depth_edges: as for `grow_object`.
    """
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
    """Return bool [N]: the labels `before`, changed around the seeds that contradict them.

    The influence of a contradicting seed falls with the geodesic distance, which grows at changes of color and at
    edges of surfaces. A contradicting seed has no influence on nodes that are nearer to a seed which agrees with
    `before`.

    Args:
        lab, pairs, length, seeds, depth_edges: as for `grow_object`; no seed of the object is required.
        before: bool [N], the labels to correct.
    """
    step = color_steps(lab, pairs, depth_edges)
    smooth = _smoothness(step, length)
    wrong = (seeds == OBJECT) & ~before | (seeds == OTHER) & before
    right = (seeds == OBJECT) & before | (seeds == OTHER) & ~before
    across = before[pairs[:, 0]] != before[pairs[:, 1]]  # a correction should not cross the former border
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
    """Return the cost [E] of a border between neighbors, low where `step` (`color_steps`) is large for this graph."""
    usual = float((step**2).sum()) / max(len(step), 1)  # mean square
    return SMOOTH * np.exp(-(step**2) / (2 * usual + 1e-9)) / length


def keep_connected(labels: np.ndarray, pairs: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Return bool [N], the labeled nodes that a path of labeled nodes connects with a labeled seed.

    Args:
        labels: bool [N].
        pairs: int [E, 2], neighbors.
        seeds: bool [N].
    """
    kept = pairs[labels[pairs].all(1)]
    links = sparse.coo_array((np.ones(len(kept)), tuple(kept.T)), (len(labels),) * 2)
    part = csgraph.connected_components(links, directed=False)[1]
    return labels & np.isin(part, part[seeds & labels])


def relative_distance(pairs: np.ndarray, length: np.ndarray, these: np.ndarray, those: np.ndarray) -> np.ndarray:
    """Return [N] in [-1, 1], how much nearer each node is to the nodes in `these` than to the nodes in `those`.

    With the lengths a and b of the shortest paths to `these` and `those`, the value is (b - a) / (a + b): 1 at `these`,
    -1 at `those`. If `these` (or `those`) has no node, a (or b) is 1 everywhere.

    Args:
        pairs: int [E, 2], neighbors.
        length: [E] > 0, length of each pair.
        these, those: bool [N].
    """
    graph = sparse.coo_array((length, tuple(pairs.T)), (len(these),) * 2).tocsr()
    near, far = (_distance(graph, start) for start in (these, those))
    return (far - near) / (far + near + 1e-9)


def _distance(graph: sparse.csr_array, start: np.ndarray) -> np.ndarray:
    """Return the length [N] of the shortest path from a `start` node; without a path, a large one; 1 without starts."""
    if not start.any():
        return np.ones(graph.shape[0])
    found = csgraph.dijkstra(graph, directed=False, indices=np.flatnonzero(start), min_only=True)
    reached = np.isfinite(found)
    return np.where(reached, found, 2 * found[reached].max() + 1)


def color_frequency(lab: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return [N] > 0, for each node the relative frequency of its color among all nodes.

    Args:
        lab: float [N, 3], colors in 8-bit L*a*b*.
        weight: [N] >= 0, how much each node counts in the frequencies.
    """
    count = color_histogram(lab, weight)
    return (count / max(count.sum(), 1e-9))[_bins(lab)] + 1e-5


def color_histogram(lab: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return [BINS, BINS, BINS], a slightly blurred histogram of L*, a*, b*; arguments as for `color_frequency`."""
    count = np.zeros((BINS,) * 3)
    np.add.at(count, _bins(lab), weight)
    return ndimage.gaussian_filter(count, 0.7, mode="nearest")


def _bins(lab: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple((lab * (BINS / 256)).astype(int).clip(0, BINS - 1).T)
