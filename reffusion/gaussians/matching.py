"""Which Gaussians of a scene someone deleted in an editor: matched by position, whatever order it wrote them in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

NEIGHBOURS = 8  # of the scene's splats that each one kept is compared with
APART = 0.5  # of the distance to its neighbours within which a splat is the same, quantised
FLOOR = 0.1  # of the median distance: what counts for splats that lie on each other
SAMPLE = 5000  # of the kept, by which the turn is found, and scenes that are not the same
SAME = 0.95  # share of the kept that must be found for both to be one scene
# The axes' signs: as it is, and turned by 180 degrees about x, y or z, as editors show scenes that have y down.
TURNS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))


@dataclass(frozen=True)
class Match:
    """What a cleaned scene keeps of the whole one.

    Attributes:
        deleted: bool [N], those of the whole that are not in the cleaned one; none where `found` is less than `SAME`.
        found: share of the cleaned one's splats that are the whole's.
        turn: the axes' signs by which the cleaned one was turned.
    """

    deleted: np.ndarray
    found: float
    turn: tuple[int, int, int]


def matched(whole: np.ndarray, cleaned: np.ndarray) -> Match:
    """The cleaned scene's splats, each found among the whole's: one to one, the nearest pairs first.

    Quantisation moves a splat by far less than the distance to its neighbours, in a compressed .ply too, whose steps
    are a two thousandth of 256 neighbours' extent. What was moved, turned otherwise or scaled is not found.

    Args:
        whole: [N, 3] positions, N at least 2; cleaned: [M, 3], M at least 1.
    """
    tree, sample = cKDTree(whole), cleaned[:: max(1, len(cleaned) // SAMPLE)]
    spacing = tree.query(whole, 2)[0][:, 1]
    near = np.maximum(APART * spacing, FLOOR * float(np.median(spacing)))
    shares = {turn: _share(tree, sample * turn, near) for turn in TURNS}
    turn = max(TURNS, key=shares.__getitem__)
    if shares[turn] < SAME:
        return Match(np.zeros(len(whole), bool), shares[turn], turn)
    owner = _owners(tree, cleaned * turn, near)
    return Match(owner < 0, float((owner >= 0).sum() / len(cleaned)), turn)


def _share(tree: cKDTree, points: np.ndarray, near: np.ndarray) -> float:
    """Of the points, those that lie where a splat of the tree lies."""
    distances, nearest = tree.query(points)
    return float((distances <= near[nearest]).mean())


def _owners(tree: cKDTree, points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """int [N], for each splat of the tree the index of the point [M, 3] that is it; -1 where none is."""
    count = min(NEIGHBOURS, tree.n)
    distances, candidates = tree.query(points, count)
    distances = np.where(distances <= near[candidates], distances, np.inf)
    owner = np.full(tree.n, -1)
    owned = np.full(tree.n, np.inf)  # distance to its owner
    rank = np.zeros(len(points), int)  # which of its candidates each asks next
    asking = np.arange(len(points))
    while len(asking):  # each asks its nearest, which keeps the nearest that asks: the pairs that a greedy choice makes
        asking = asking[rank[asking] < count]
        asked, far = (table[asking, rank[asking]] for table in (candidates, distances))
        rank[asking] += 1
        order = np.lexsort((asking, far))[::-1]
        order = order[far[order] < owned[asked[order]]]  # the nearest comes last, and stays
        before = owner[asked[order]]
        owner[asked[order]], owned[asked[order]] = asking[order], far[order]
        asking = np.setdiff1d(np.concatenate([asking, before[before >= 0]]), owner)
    return owner
