"""Minimum cuts through graphs of neighbouring pixels or Gaussians."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

UNIT = 1000  # capacity of a cost of 1, since capacities are integers
HARD = 1e4  # a cost that no sum of links outweighs


def min_cut(true_cost: np.ndarray, false_cost: np.ndarray, pairs: np.ndarray, strength: np.ndarray) -> np.ndarray:
    """bool [N], the labels with the smallest total cost, by a minimum cut.

    Args:
        true_cost, false_cost: [N] >= 0, cost of each label.
        pairs: [E, 2] int, neighbours, each pair once.
        strength: [E] >= 0, cost of a pair with different labels.
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
    """int [N], labels with a low total cost, by expansion moves (Boykov et al. 2001): each move gives one label to all
    that gain from it, until no move lowers the cost.

    Args:
        cost: [K, N] >= 0 of each label. start: int [N], initial labels.
        pairs: [E, 2] int, neighbours, each pair once. strength: [E] >= 0, cost of a pair with different labels.
    """
    labels, changed = start.copy(), True
    first, second = pairs.T
    while changed:
        changed = False
        for label in range(len(cost)):
            apart = labels[first] != labels[second]
            keep = cost[labels, np.arange(len(labels))]
            # Neighbours with different labels cost once unless both move: each that moves gains half of it.
            gain = np.bincount(pairs[apart].T.ravel(), np.tile(strength[apart] / 2, 2), len(labels))
            stay = np.where(labels == label, HARD, keep)  # what has the label is as if it had moved
            moves = min_cut(cost[label] - gain, stay, pairs, np.where(apart, strength / 2, strength))
            moved = np.where(moves, label, labels)
            if _total(cost, pairs, strength, moved) < _total(cost, pairs, strength, labels) - 1 / UNIT:
                labels, changed = moved, True
    return labels


def _total(cost: np.ndarray, pairs: np.ndarray, strength: np.ndarray, labels: np.ndarray) -> float:
    between = strength[labels[pairs[:, 0]] != labels[pairs[:, 1]]]
    return float(cost[labels, np.arange(len(labels))].sum() + between.sum())
