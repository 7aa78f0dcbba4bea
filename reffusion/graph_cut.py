"""Minimum cuts through graphs of neighboring pixels or Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

UNIT = 1000  # integer capacity that stands for a cost of 1: the solver of the cut takes integers only
NEIGHBORS = ((0, 1), (1, 0), (1, 1), (1, -1))  # offsets to the 8 neighbors, one of each opposite two
HARD = 1e4  # cost that forbids a label, because no sum of the costs of pairs exceeds it


def neighbor_pairs(index: np.ndarray, offsets: Sequence[tuple[int, int]] = NEIGHBORS) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs int [E, 2] of neighboring pixels, and their distances [E] in pixels.

    Args:
        index: int [H, W], the numbers of the pixels; those with the number -1 take no part.
        offsets: (row >= 0, column) of the second pixel of a pair relative to the first one.
    """
    pairs, length = [], []
    for down, right in offsets:
        height, width = max(0, index.shape[0] - down), max(0, index.shape[1] - abs(right))
        first = index[:height, max(0, -right) :][:, :width]
        second = index[down:, max(0, right) :][:, :width]
        both = np.stack([first.ravel(), second.ravel()], 1)
        both = both[(both >= 0).all(1)]
        pairs.append(both)
        length.append(np.full(len(both), np.hypot(down, right)))
    return np.concatenate(pairs), np.concatenate(length)


def min_cut(true_cost: np.ndarray, false_cost: np.ndarray, pairs: np.ndarray, strength: np.ndarray) -> np.ndarray:
    """Return bool [N], the labeling of N nodes with the smallest total cost, found by a minimum cut.

    The total cost is the sum of the costs of the nodes' labels and of the pairs whose nodes have different labels. It
    is the smallest up to rounding: costs are rounded to multiples of 1 / `UNIT`, and a strength above `HARD` counts as
    `HARD`.

    Args:
        true_cost, false_cost: [N], cost of labeling a node True or False. Only the difference of both matters, and a
            difference above `HARD` counts as `HARD`.
        pairs: [E, 2] int, indices of neighboring nodes, each pair once.
        strength: [E] >= 0, cost of a pair whose nodes have different labels.
    """
    count = len(true_cost)
    source, sink, nodes = count, count + 1, np.arange(count)
    shared = np.minimum(true_cost, false_cost)
    whole = lambda cost: np.minimum(np.round(cost * UNIT), HARD * UNIT).astype(np.int32)
    capacity = [whole(false_cost - shared), whole(true_cost - shared), whole(strength), whole(strength)]
    first = [np.full(count, source), nodes, pairs[:, 0], pairs[:, 1]]
    second = [nodes, np.full(count, sink), pairs[:, 1], pairs[:, 0]]
    links = tuple(np.concatenate(each) for each in (first, second))
    network = sparse.coo_array((np.concatenate(capacity), links), (count + 2, count + 2)).tocsr()
    residual = network - csgraph.maximum_flow(network, source, sink).flow
    residual.data = (residual.data > 0).astype(np.int32)
    residual.eliminate_zeros()
    reached = csgraph.breadth_first_order(residual, source, return_predecessors=False)
    return np.isin(nodes, reached)


def alpha_expansion(
    cost: np.ndarray,
    pairs: np.ndarray,
    pair_cost: Callable[[np.ndarray, np.ndarray], np.ndarray],
    start: np.ndarray,
) -> np.ndarray:
    """Return int [N] in [0, K), a labeling of N nodes with a low total cost, by expansion moves (Boykov et al. 2001).

    The total cost is the sum of the costs of the nodes' labels and of the pairs' labels. An expansion move gives one
    label to the set of nodes for which this lowers the total cost most. The moves of all labels are repeated until none
    lowers the cost by more than 1 / `UNIT`. The result is a local minimum.

    Args:
        cost: [K, N], cost of each label at each node.
        pairs: [E, 2] int, indices of neighboring nodes, each pair once.
        pair_cost: takes the labels of the first and of the second nodes of all pairs, int [E] each, and returns the
            costs of the pairs, [E] >= 0. Equal labels cost 0. The cost must be a metric on labels for each pair:
            symmetric, and obeying the triangle inequality.
        start: int [N], initial labels. This array is not modified.
    """
    (first, second), nodes = pairs.T, np.arange(cost.shape[1])
    labels, between = start, pair_cost(start[first], start[second])
    lowest, is_changed = cost[labels, nodes].sum() + between.sum(), True
    while is_changed:
        is_changed = False
        for label in range(len(cost)):
            one = np.full(len(pairs), label)
            first_moves, second_moves = pair_cost(one, labels[second]), pair_cost(labels[first], one)
            # As in Kolmogorov and Zabih 2004, the cost of a pair is split into costs of its nodes and a cost of a cut
            # between them. A node "moves" if it takes `label`.
            cut = np.maximum(first_moves + second_moves - between, 0) / 2
            move, keep = cost[label].copy(), cost[labels, nodes]
            np.add.at(move, first, first_moves - between - cut)
            np.add.at(move, second, cut - first_moves)
            moved = np.where(min_cut(move, keep, pairs, cut), label, labels)
            if (moved == labels).all():
                continue
            moved_between = pair_cost(moved[first], moved[second])
            total = cost[moved, nodes].sum() + moved_between.sum()
            if total < lowest - 1 / UNIT:
                labels, between, lowest, is_changed = moved, moved_between, total, True
    return labels


def potts_cost(strength: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the pair cost of `alpha_expansion` by which pairs [E] with different labels cost `strength` [E]."""
    return lambda first, second: np.where(first != second, strength, 0.0)
