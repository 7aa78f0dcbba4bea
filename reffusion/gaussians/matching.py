"""Which Gaussians of a scene someone deleted in an editor: matched by position, whatever order it wrote them in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

NEIGHBOURS = 8  # of the scene's splats that each one kept is compared with
APART = 0.5  # of the distance to its neighbours within which a splat is the same, quantised
FLOOR = 0.1  # of the median distance: what counts for splats that lie on each other
SAMPLE = 5000  # of the kept, by which the turn is found, and scenes that are not the same
BLOCK = 100_000  # points whose neighbours are looked up at once
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

    Most editors keep positions to the last bit: these are matched by sorting. Quantisation moves a splat by far less
    than the distance to its neighbours, in a compressed .ply too, whose steps are a two thousandth of 256 neighbours'
    extent. What was moved, turned otherwise or scaled is not found.

    Args:
        whole: [N, 3] positions, N at least 2; cleaned: [M, 3], M at least 1.
    """
    sample = cleaned[:: max(1, len(cleaned) // SAMPLE)]
    index = _Index(whole)
    exact = {turn: float((index.find(sample * turn) >= 0).mean()) for turn in TURNS}
    turn, spaces = max(TURNS, key=exact.__getitem__), None
    if exact[turn] < SAME:
        spaces = _Spaces(whole)
        shares = {turn: spaces.share(sample * turn) for turn in TURNS}
        turn = max(TURNS, key=shares.__getitem__)
        if shares[turn] < SAME:
            return Match(np.zeros(len(whole), bool), shares[turn], turn)
    found = index.find(cleaned * turn)
    left = np.flatnonzero(found < 0)
    owned = np.zeros(len(whole), bool)
    owned[found[found >= 0]] = True
    if len(left):
        owned |= _match_one_to_one(spaces or _Spaces(whole), cleaned[left] * turn, owned)
    return Match(~owned, float(owned.sum() / len(cleaned)), turn)


class _Index:
    """The splats of a scene by their exact positions."""

    def __init__(self, whole: np.ndarray):
        self._whole, keys = whole, _keys(whole)
        self._order = np.argsort(keys, kind="stable")
        self._keys = keys[self._order]

    def find(self, points: np.ndarray) -> np.ndarray:
        """int [M], for each point [M, 3] the splat at the very same place, one to one; -1 where none is."""
        found, keys = np.full(len(points), -1), _keys(points)
        asking = np.argsort(keys, kind="stable")
        keys = keys[asking]
        rank = np.arange(len(keys)) - np.searchsorted(keys, keys)  # among points at one place
        at = np.searchsorted(self._keys, keys) + rank
        inside = at < len(self._keys)
        at, asking = at[inside], asking[inside]
        same = (self._whole[self._order[at]] == points[asking]).all(1)
        found[asking[same]] = self._order[at[same]]
        return found


def _keys(points: np.ndarray) -> np.ndarray:
    """uint64 [N], equal where positions are; zeros of both signs are one."""
    bits = np.ascontiguousarray(points + 0.0, np.float64).view(np.uint64)
    key = np.zeros(len(points), np.uint64)
    for axis in range(3):
        key = (key ^ bits[:, axis]) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    return key


class _Spaces:
    """The splats of a scene, and the distance within which a point is one of them."""

    def __init__(self, whole: np.ndarray):
        self.tree = cKDTree(whole)
        self._spacing = np.full(len(whole), np.nan, np.float32)  # to the nearest other one; computed when asked for
        self._place = np.empty(len(whole), np.int32)
        self._place[self.tree.indices] = np.arange(len(whole))
        some = np.arange(0, len(whole), max(1, len(whole) // SAMPLE))
        self._least = 0.0
        self._least = FLOOR * float(np.median(self.near(some))) / APART

    def near(self, splats: np.ndarray) -> np.ndarray:
        """float32, in the shape of `splats`, numbers of splats of the tree."""
        unknown = np.unique(splats[np.isnan(self._spacing[splats])])
        unknown = unknown[np.argsort(self._place[unknown])]  # neighbours after each other, for the processor's cache
        self._spacing[unknown] = self.tree.query(self.tree.data[unknown], 2, workers=-1)[0][:, 1]
        return np.maximum(APART * self._spacing[splats], self._least)

    def share(self, points: np.ndarray) -> float:
        """Of the points, those that lie where a splat of the tree lies."""
        distances, nearest = self.tree.query(points)
        return float((distances <= self.near(nearest)).mean())


def _candidates(spaces: _Spaces, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest splats of each point: distances float32 [M, C], infinite where too far; int32 [M, C]."""
    count = min(NEIGHBOURS, spaces.tree.n)
    distances, candidates = np.empty((len(points), count), np.float32), np.empty((len(points), count), np.int32)
    order = cKDTree(points).indices
    for start in range(0, len(points), BLOCK):
        some = order[start : start + BLOCK]
        away, found = (each.reshape(-1, count) for each in spaces.tree.query(points[some], count, workers=-1))
        distances[some], candidates[some] = np.where(away <= spaces.near(found), away, np.inf), found
    return distances, candidates


def _match_one_to_one(spaces: _Spaces, points: np.ndarray, taken: np.ndarray) -> np.ndarray:
    """bool [N], the splats of the tree that are one of the points [M, 3], one to one; none of those `taken` [N]."""
    distances, candidates = _candidates(spaces, points)
    distances[taken[candidates]] = np.inf
    count = distances.shape[1]
    owner = np.full(spaces.tree.n, -1)
    owned = np.full(spaces.tree.n, np.inf)  # distance to its owner
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
    return owner >= 0
