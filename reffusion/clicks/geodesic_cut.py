"""Cuts through graphs of neighbours, pixels or Gaussians: which of them are the object."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from reffusion.clicks.marks import OBJECT, OTHER
from reffusion.graph_cut import HARD, least_cut

BINS = 20  # of colours, a side of L*a*b* of 8 bit
ROUNDS = 3  # of distances and colours, each by the labels of the one before
BY_COLOR, BY_LIKELIHOOD = 0.3, 100.0  # what a way costs from the second round on: a step of colour, of likelihood
ON_ONE, TORN = 0.35, 60.0  # where surfaces are known: what a step of colour counts on one, and what leaving one counts
SMOOTH = 5.0  # cost of a border between two that look alike
REACHES = 0.5, 0.44, 0.37, 0.3  # shares of the way from a click to what is not the object
REACH = 150.0  # of colour and pixels, how far a click goes that corrects
CHANGE = 10.0  # of colour, in L*a*b* of 8 bit, that an edge of a thing shows
SMALLER = 0.05  # what an object e times as large is worth less
MOST = 3.0  # that colour may cost, natural logarithm of a ratio


def grown(
    lab: np.ndarray,
    pairs: np.ndarray,
    length: np.ndarray,
    seeds: np.ndarray,
    weak: np.ndarray,
    torn: np.ndarray | None = None,
) -> np.ndarray:
    """bool [N]: the object, grown from few seeds: a geodesic graph cut, whose colours follow from its own labels.

    Args:
        lab: [N, 3] float, colours in L*a*b* of 8 bit.
        pairs: [E, 2] int, neighbours, each pair once; length: [E] > 0, how far apart they are, 1 = next to each other.
        seeds: int8 [N], OBJECT, OTHER or UNKNOWN; at least one OBJECT.
        weak: bool [N], the object less likely than not.
        torn: [E] in [0, 1], 1 where two do not lie on one surface; None: not known.
    """
    step = steps(lab, pairs, torn)
    smooth = _smoothness(step, length)
    other = (seeds == OTHER) | (weak & (seeds != OBJECT))
    cost, labels = step, None
    for _ in range(ROUNDS):
        side = nearer(pairs, (cost + 1.0) * length, seeds == OBJECT, other)
        inside = np.maximum(side, 0) if labels is None else labels * (0.5 + side).clip(0.1, 1)
        outside = np.maximum(-side, 0) if labels is None else ~labels * (0.5 - side).clip(0.1, 1)
        like, unlike = (frequency(lab, weight) for weight in (inside, outside))
        gain = 2 * side + np.log(like / unlike).clip(-MOST, MOST)
        against = np.where(seeds == OTHER, HARD, np.maximum(-gain, 0) * (seeds != OBJECT))
        against_other = np.where(seeds == OBJECT, HARD, np.maximum(gain, 0) * (seeds != OTHER))
        labels = least_cut(against, against_other, pairs, smooth)
        likelihood = like / (like + unlike)
        change = np.abs(likelihood[pairs[:, 0]] - likelihood[pairs[:, 1]])
        cost = BY_COLOR * step + BY_LIKELIHOOD * (change if torn is None else ON_ONE * change)
    return attached(labels, pairs, seeds == OBJECT)


def enclosed(
    lab: np.ndarray, pairs: np.ndarray, length: np.ndarray, seeds: np.ndarray, weak: np.ndarray, torn: np.ndarray
) -> list[np.ndarray]:
    """What clicks may mean by surfaces alone, from the most to the least: bool [N] each, each within the one before.

    Args:
        lab, pairs, length, seeds, weak, torn: as `grown` takes them.
    """
    step = steps(lab, pairs, torn)
    smooth = _smoothness(step, length)
    side = nearer(pairs, (step + 1.0) * length, seeds == OBJECT, (seeds == OTHER) | (weak & (seeds != OBJECT)))
    within, found = np.ones(len(lab), bool), []
    for share in REACHES:
        gain = 2 * (side - (1 - 2 * share))
        against = np.where(seeds == OTHER, HARD, np.maximum(-gain, 0) * (seeds != OBJECT))
        for_it = np.where(seeds == OBJECT, HARD, np.maximum(gain, 0) * (seeds != OTHER))
        # What costs more to take is part of what costs less.
        within = _cut_within(within, against, for_it, pairs, smooth)
        found.append(attached(within, pairs, seeds == OBJECT))
    return found


def _cut_within(
    within: np.ndarray, true_cost: np.ndarray, false_cost: np.ndarray, pairs: np.ndarray, strength: np.ndarray
) -> np.ndarray:
    """bool [N]: `least_cut` of those in `within`, the others being False."""
    ends, at = within[pairs], np.cumsum(within) - 1
    both, crossing = ends.all(1), ends[:, 0] != ends[:, 1]
    inner = np.where(ends[crossing, 0], pairs[crossing, 0], pairs[crossing, 1])
    border = np.bincount(inner, strength[crossing], len(within))
    found = np.zeros(len(within), bool)
    found[within] = least_cut((true_cost + border)[within], false_cost[within], at[pairs[both]], strength[both])
    return found


def merit(labels: np.ndarray, around: np.ndarray, lab: np.ndarray, pairs: np.ndarray, torn: np.ndarray) -> float:
    """How well labels stand for a thing of its own: its rim is where surfaces end or colours change, and none end
    within it; its colours are not those around it; and of two as good it is the smaller. -inf where there is nothing.

    Args:
        labels: bool [N]; around: bool [N], its surroundings.
    """
    ends = labels[pairs]
    inside, rim = ends.all(1), ends[:, 0] != ends[:, 1]
    if not inside.any() or not rim.any() or not around.any():
        return -np.inf
    of, off = (histogram(lab, each.astype(float)) for each in (labels, around))
    alike = float(np.minimum(of / of.sum(), off / off.sum()).sum())
    edge = np.maximum(torn[rim], (steps(lab, pairs[rim], None) / CHANGE).clip(0, 1))
    return float(edge.mean() - torn[inside].mean()) - alike - SMALLER * float(np.log(labels.sum()))


def steps(lab: np.ndarray, pairs: np.ndarray, torn: np.ndarray | None) -> np.ndarray:
    """[E] >= 0, how unlike neighbours are, in colour; where surfaces are known, in these first of all."""
    color = np.linalg.norm(lab[pairs[:, 0]] - lab[pairs[:, 1]], axis=1)
    return color if torn is None else ON_ONE * color + TORN * torn


def regrown(
    lab: np.ndarray,
    pairs: np.ndarray,
    length: np.ndarray,
    seeds: np.ndarray,
    was: np.ndarray,
    torn: np.ndarray | None = None,
) -> np.ndarray:
    """bool [N]: the labels `was`, but for what seeds that say otherwise reach without crossing a change of colour.

    Args:
        lab, pairs, length, seeds, torn: as `grown` takes them.
        was: bool [N].
    """
    step = steps(lab, pairs, torn)
    smooth = _smoothness(step, length)
    wrong = (seeds == OBJECT) & ~was | (seeds == OTHER) & was
    right = (seeds == OBJECT) & was | (seeds == OTHER) & ~was
    across = was[pairs[:, 0]] != was[pairs[:, 1]]  # what is changed lies on one side of the former border
    way = sparse.coo_array(((step + 1.0) * length + REACH * across, tuple(pairs.T)), (len(lab),) * 2).tocsr()
    lost = 2 * np.exp(-_distance(way, wrong) / REACH)
    if right.any():
        lost *= _distance(way, right) > _distance(way, wrong)
    gain = np.where(was, 1.0, -1.0) * (1 - lost)
    against = np.where(seeds == OTHER, HARD, np.maximum(-gain, 0) * (seeds != OBJECT))
    against_other = np.where(seeds == OBJECT, HARD, np.maximum(gain, 0) * (seeds != OTHER))
    return least_cut(against, against_other, pairs, smooth)


def _smoothness(step: np.ndarray, length: np.ndarray) -> np.ndarray:
    """[E], cost of a border between neighbours: less where colours change more than they do on average."""
    usual = float((step**2).sum()) / max(len(step), 1)
    return SMOOTH * np.exp(-(step**2) / (2 * usual + 1e-9)) / length


def attached(labels: np.ndarray, pairs: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """bool [N]: of the labelled those that hang together with a seed."""
    kept = pairs[labels[pairs].all(1)]
    links = sparse.coo_array((np.ones(len(kept)), tuple(kept.T)), (len(labels),) * 2)
    part = csgraph.connected_components(links, directed=False)[1]
    return labels & np.isin(part, part[seeds & labels])


def nearer(pairs: np.ndarray, length: np.ndarray, these: np.ndarray, those: np.ndarray) -> np.ndarray:
    """[N] in [-1, 1]: 1 at `these`, -1 at `those` (bool [N]), between them by the shortest ways along pairs."""
    way = sparse.coo_array((length, tuple(pairs.T)), (len(these),) * 2).tocsr()
    near, far = (_distance(way, start) for start in (these, those))
    return (far - near) / (far + near + 1e-9)


def _distance(way: sparse.csr_array, start: np.ndarray) -> np.ndarray:
    """[N], length of the shortest way from any of `start`; where none leads there, longer than all."""
    if not start.any():
        return np.ones(way.shape[0])
    found = csgraph.dijkstra(way, directed=False, indices=np.flatnonzero(start), min_only=True)
    reached = np.isfinite(found)
    return np.where(reached, found, 2 * found[reached].max() + 1)


def frequency(lab: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """[N], how frequent the colour of each is among all by weight; never 0. lab: [N, 3], L*a*b* of 8 bit."""
    count = histogram(lab, weight)
    return (count / max(count.sum(), 1e-9))[_bins(lab)] + 1e-5


def histogram(lab: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """[BINS, BINS, BINS], the weight of each colour, blurred."""
    count = np.zeros((BINS,) * 3)
    np.add.at(count, _bins(lab), weight)
    return ndimage.gaussian_filter(count, 0.7, mode="nearest")


def _bins(lab: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple((lab * (BINS / 256)).astype(int).clip(0, BINS - 1).T)
