"""Minimum cuts through graphs of neighboring pixels or Gaussians."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

UNIT = 1000  # integer capacity that stands for a cost of 1: the solver of the cut takes integers only
HARD = 1e4  # cost that forbids a label, because no sum of the costs of pairs exceeds it


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


def alpha_expansion(cost: np.ndarray, pairs: np.ndarray, strength: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return int [N] in [0, K), a labeling of N nodes with a low total cost, by expansion moves (Boykov et al. 2001).

    The total cost is that of `min_cut`, with K labels. An expansion move gives one label to the set of nodes for which
    this lowers the total cost most. The moves of all labels are repeated until none lowers the cost by more than
    1 / `UNIT`. The result is a local minimum.

    Args:
        cost: [K, N] >= 0, cost of each label at each node.
        pairs: [E, 2] int, indices of neighboring nodes, each pair once.
        strength: [E] >= 0, cost of a pair whose nodes have different labels.
        start: int [N], initial labels. This array is not modified.
    """
    labels, changed = start.copy(), True
    first, second = pairs.T
    while changed:
        changed = False
        for label in range(len(cost)):
            apart = labels[first] != labels[second]
            keep = cost[labels, np.arange(len(labels))]
            # A node "moves" if it takes `label`. A pair with different labels costs `strength` unless both nodes move.
            # So each node that moves saves half of this cost, and a pair of which only one node moves pays half.
            gain = np.bincount(pairs[apart].T.ravel(), np.tile(strength[apart] / 2, 2), len(labels))
            stay = np.where(labels == label, HARD, keep)  # a node that has the label counts as moved
            moves = min_cut(cost[label] - gain, stay, pairs, np.where(apart, strength / 2, strength))
            moved = np.where(moves, label, labels)
            if _total(cost, pairs, strength, moved) < _total(cost, pairs, strength, labels) - 1 / UNIT:
                labels, changed = moved, True
    return labels


def _total(cost: np.ndarray, pairs: np.ndarray, strength: np.ndarray, labels: np.ndarray) -> float:
    """Return the total cost of a labeling."""
    between = strength[labels[pairs[:, 0]] != labels[pairs[:, 1]]]
    return float(cost[labels, np.arange(len(labels))].sum() + between.sum())
