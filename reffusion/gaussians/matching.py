"""Finds the Gaussians that were deleted from a scene in an editor, by matching positions in any order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

CANDIDATES = 8  # nearest Gaussians of the whole scene that a kept one is compared with
MAX_DISTANCE = 0.5  # of the distance to its nearest neighbour, within which a position counts as quantised
MIN_SPACING = 0.1  # of the median distance, used for Gaussians at the same position
SAMPLE_SIZE = 5000  # kept Gaussians by which axis flips and different scenes are detected
QUERY_SIZE = 100_000  # points per query of neighbours
MIN_MATCHED_SHARE = 0.95  # share of the kept Gaussians that must be matched for both files to be one scene
# Signs of the axes: unchanged, or rotated by 180 degrees about x, y or z, as editors do with scenes that have y down.
AXIS_FLIPS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))


@dataclass(frozen=True)
class Match:
    """Correspondence between a whole scene and a cleaned one.

    Attributes:
        deleted: bool [N], Gaussians of the whole scene that are not in the cleaned one; all False where `found` is
            less than `MIN_MATCHED_SHARE`.
        found: share of the cleaned scene's Gaussians that are matched.
        turn: signs of the axes by which the cleaned scene was rotated.
    """

    deleted: np.ndarray
    found: float
    turn: tuple[int, int, int]


def match_gaussians(whole: np.ndarray, cleaned: np.ndarray) -> Match:
    """Match the Gaussians of a cleaned scene to those of the whole scene: one to one, nearest pairs first.

    Most editors keep positions to the last bit; these are matched by sorting. Quantisation moves a Gaussian by far less
    than the distance to its neighbours, even in a compressed .ply, whose steps are 1/2000 of the extent of 256
    neighbours. Gaussians that were moved, rotated otherwise or scaled are not matched.

    Args:
        whole: [N, 3] positions, N >= 2.
        cleaned: [M, 3] positions, M >= 1.
    """
    sample = cleaned[:: max(1, len(cleaned) // SAMPLE_SIZE)]
    index = _ExactIndex(whole)
    exact_share = {flip: float((index.find(sample * flip) >= 0).mean()) for flip in AXIS_FLIPS}
    flip, near_index = max(AXIS_FLIPS, key=exact_share.__getitem__), None
    if exact_share[flip] < MIN_MATCHED_SHARE:
        near_index = _NearIndex(whole)
        near_share = {flip: near_index.share(sample * flip) for flip in AXIS_FLIPS}
        flip = max(AXIS_FLIPS, key=near_share.__getitem__)
        if near_share[flip] < MIN_MATCHED_SHARE:
            return Match(np.zeros(len(whole), bool), near_share[flip], flip)
    exact_matches = index.find(cleaned * flip)
    unmatched = np.flatnonzero(exact_matches < 0)
    is_kept = np.zeros(len(whole), bool)
    is_kept[exact_matches[exact_matches >= 0]] = True
    if len(unmatched):
        is_kept |= _match_one_to_one(near_index or _NearIndex(whole), cleaned[unmatched] * flip, is_kept)
    return Match(~is_kept, float(is_kept.sum() / len(cleaned)), flip)


class _ExactIndex:
    """Looks up Gaussians of a scene by their exact positions."""

    def __init__(self, whole: np.ndarray):
        self._whole, keys = whole, _hash_positions(whole)
        self._order = np.argsort(keys, kind="stable")
        self._keys = keys[self._order]

    def find(self, points: np.ndarray) -> np.ndarray:
        """int [M]: for each point [M, 3] the Gaussian at exactly this position, one to one; -1 where there is none."""
        index, keys = np.full(len(points), -1), _hash_positions(points)
        order = np.argsort(keys, kind="stable")
        keys = keys[order]
        rank = np.arange(len(keys)) - np.searchsorted(keys, keys)  # among points at the same position
        position = np.searchsorted(self._keys, keys) + rank
        is_inside = position < len(self._keys)
        position, order = position[is_inside], order[is_inside]
        is_same = (self._whole[self._order[position]] == points[order]).all(1)
        index[order[is_same]] = self._order[position[is_same]]
        return index


def _hash_positions(points: np.ndarray) -> np.ndarray:
    """uint64 [N]: hashes that are equal for equal positions; zeros of both signs are equal."""
    bits = np.ascontiguousarray(points + 0.0, np.float64).view(np.uint64)
    key = np.zeros(len(points), np.uint64)
    for axis in range(3):
        key = (key ^ bits[:, axis]) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    return key


class _NearIndex:
    """Looks up Gaussians of a scene within a radius that depends on their spacing."""

    def __init__(self, whole: np.ndarray):
        self.tree = cKDTree(whole)
        self._spacing = np.full(len(whole), np.nan, np.float32)  # distance to the nearest other one; computed on demand
        self._position = np.empty(len(whole), np.int32)
        self._position[self.tree.indices] = np.arange(len(whole))
        sample = np.arange(0, len(whole), max(1, len(whole) // SAMPLE_SIZE))
        self._min_radius = 0.0
        self._min_radius = MIN_SPACING * float(np.median(self.radius(sample))) / MAX_DISTANCE

    def radius(self, splats: np.ndarray) -> np.ndarray:
        """float32, shape of `splats`: matching radius of Gaussians, given by their indices in the tree."""
        unknown = np.unique(splats[np.isnan(self._spacing[splats])])
        unknown = unknown[np.argsort(self._position[unknown])]  # in the order of the tree, for the cache
        self._spacing[unknown] = self.tree.query(self.tree.data[unknown], 2, workers=-1)[0][:, 1]
        return np.maximum(MAX_DISTANCE * self._spacing[splats], self._min_radius)

    def share(self, points: np.ndarray) -> float:
        """Share of the points that lie within the radius of a Gaussian."""
        distances, nearest = self.tree.query(points)
        return float((distances <= self.radius(nearest)).mean())


def _find_candidates(index: _NearIndex, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest Gaussians of each point: distances float32 [M, C], inf beyond the radius; indices int32 [M, C]."""
    count = min(CANDIDATES, index.tree.n)
    distances, candidates = np.empty((len(points), count), np.float32), np.empty((len(points), count), np.int32)
    order = cKDTree(points).indices
    for start in range(0, len(points), QUERY_SIZE):
        block = order[start : start + QUERY_SIZE]
        near_distances, splats = (
            each.reshape(-1, count) for each in index.tree.query(points[block], count, workers=-1)
        )
        distances[block] = np.where(near_distances <= index.radius(splats), near_distances, np.inf)
        candidates[block] = splats
    return distances, candidates


def _match_one_to_one(index: _NearIndex, points: np.ndarray, excluded: np.ndarray) -> np.ndarray:
    """bool [N]: the Gaussians that are matched to one of the points [M, 3], one to one; never one of `excluded` [N]."""
    distances, candidates = _find_candidates(index, points)
    distances[excluded[candidates]] = np.inf
    count = distances.shape[1]
    owner = np.full(index.tree.n, -1)
    owner_distance = np.full(index.tree.n, np.inf)  # distance to the owner
    rank = np.zeros(len(points), int)  # next candidate that each point proposes to
    proposers = np.arange(len(points))
    while len(proposers):  # stable matching: the result equals that of greedily taking the nearest pairs
        proposers = proposers[rank[proposers] < count]
        proposed, proposed_distance = (table[proposers, rank[proposers]] for table in (candidates, distances))
        rank[proposers] += 1
        order = np.lexsort((proposers, proposed_distance))[::-1]
        order = order[
            proposed_distance[order] < owner_distance[proposed[order]]
        ]  # the nearest comes last, and overwrites the others
        displaced = owner[proposed[order]]
        owner[proposed[order]], owner_distance[proposed[order]] = proposers[order], proposed_distance[order]
        proposers = np.setdiff1d(np.concatenate([proposers, displaced[displaced >= 0]]), owner)
    return owner >= 0
