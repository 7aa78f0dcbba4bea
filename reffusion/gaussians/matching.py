"""Search for the Gaussians that were deleted from a scene in an editor.

The positions in the editor's file (the *cleaned* scene) are matched to those of the *whole* scene; their order does not
matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

CANDIDATES = 8  # nearest Gaussians of the whole scene with which a Gaussian of the cleaned scene is compared
# Matching radius of a Gaussian of the whole scene, as a share of the distance to its nearest neighbour: within it a
# position of the cleaned scene counts as the Gaussian's own position, moved by quantisation.
MAX_DISTANCE = 0.5
# Least radius, as a share of the median of these distances; it matters for several Gaussians at one position.
MIN_SPACING = 0.1
SAMPLE_SIZE = 5000  # Gaussians of the cleaned scene by which axis flips and different scenes are detected
QUERY_SIZE = 100_000  # points per query of neighbours
MIN_MATCHED_SHARE = 0.95  # share of the cleaned scene's Gaussians that must be matched for both files to be one scene
# A deleted Gaussian is a core if so large a share of its NEIGHBORS nearest Gaussians was deleted, too. Connected cores
# form a hole if there are at least LEAST_CORES. A deleted Gaussian belongs to the hole if it is at most REACH times as
# far from the nearest core as that core's farthest neighbour is.
NEIGHBORS, CORE_SHARE, LEAST_CORES, REACH = 16, 1 / 3, 16, 2.0
# Signs of x, y and z: unchanged, or rotated by 180 degrees about x, y or z, as editors do with scenes that have y down.
AXIS_FLIPS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))


@dataclass(frozen=True)
class Match:
    """Correspondence between a whole scene and a cleaned one.

    Attributes:
        deleted: bool [N], True for the Gaussians of the whole scene that are not in the cleaned one. All False if the
            scenes are different ones: less than `MIN_MATCHED_SHARE` of a sample of the cleaned scene is near Gaussians
            of the whole scene.
        found: share in [0, 1] of the cleaned scene's Gaussians that are matched; if the scenes are different ones, of
            the sample.
        turn: one of `AXIS_FLIPS`, the signs of x, y and z by which the cleaned scene was rotated.
    """

    deleted: np.ndarray
    found: float
    turn: tuple[int, int, int]


def match_gaussians(whole: np.ndarray, cleaned: np.ndarray) -> Match:
    """Match the Gaussians of a cleaned scene to those of the whole scene, one to one and the nearest pairs first.

    Most editors keep positions to the last bit; equal positions are matched by sorting. Some editors quantise
    positions. This moves a Gaussian by far less than the distance to its neighbours, even in a compressed .ply, whose
    steps are 1/2000 of the extent of 256 neighbours. Gaussians that were moved, scaled, or rotated other than by
    `AXIS_FLIPS` are not matched.

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


def find_scattered(whole: np.ndarray, deleted: np.ndarray) -> np.ndarray:
    """Find the deleted Gaussians that stood alone among others that stay, and so leave no hole to fill.

    Only the nearest Gaussians are compared, so the result does not depend on the scale of the scene or on how densely
    it is sampled. An object may be a single layer on a surface that stays.

    Args:
        whole: [N, 3] positions of the whole scene.
        deleted: bool [N], True for the Gaussians that were deleted.

    Returns:
        bool [N], True for scattered Gaussians, all of which were deleted.
    """
    index, count = np.flatnonzero(deleted), min(NEIGHBORS, len(whole) - 1)
    distances, near = cKDTree(whole).query(whole[index], range(2, count + 2), workers=-1)  # the first is itself
    cores = np.flatnonzero(deleted[near].mean(1) >= CORE_SHARE)
    number = np.full(len(whole), -1)
    number[index[cores]] = np.arange(len(cores))
    first, column = np.nonzero(number[near[cores]] >= 0)
    pairs = first, number[near[cores[first], column]]
    links = csr_array((np.ones(len(first), bool), pairs), shape=(len(cores), len(cores)))
    labels = connected_components(links, directed=False)[1]
    cores = cores[np.bincount(labels)[labels] >= LEAST_CORES]
    scattered = deleted.copy()
    if len(cores):
        away, nearest = cKDTree(whole[index[cores]]).query(whole[index])
        scattered[index] = away > REACH * distances[cores[nearest], -1]
    return scattered


class _ExactIndex:
    """Index of a scene's Gaussians by their exact positions."""

    def __init__(self, whole: np.ndarray):
        self._whole, keys = whole, _hash_positions(whole)
        self._order = np.argsort(keys, kind="stable")
        self._keys = keys[self._order]

    def find(self, points: np.ndarray) -> np.ndarray:
        """Return int [M], for each point [M, 3] the index of the Gaussian at exactly this position, or -1 without one.

        If several Gaussians have the same position, each of them is given to one point only.
        """
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
    """Return uint64 [N], hashes that are equal for equal positions [N, 3]; 0.0 and -0.0 are equal."""
    bits = np.ascontiguousarray(points + 0.0, np.float64).view(np.uint64)
    key = np.zeros(len(points), np.uint64)
    for axis in range(3):
        key = (key ^ bits[:, axis]) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    return key


class _NearIndex:
    """Index of a scene's Gaussians by position, with a matching radius for each that depends on its neighbours."""

    def __init__(self, whole: np.ndarray):
        self.tree = cKDTree(whole)
        self._spacing = np.full(len(whole), np.nan, np.float32)  # distance to the nearest other one; computed on demand
        self._position = np.empty(len(whole), np.int32)
        self._position[self.tree.indices] = np.arange(len(whole))
        sample = np.arange(0, len(whole), max(1, len(whole) // SAMPLE_SIZE))
        self._min_radius = 0.0
        self._min_radius = MIN_SPACING * float(np.median(self.radius(sample))) / MAX_DISTANCE

    def radius(self, splats: np.ndarray) -> np.ndarray:
        """Return the matching radii of Gaussians of the scene, as float32 of the shape of `splats`.

        The radius of a Gaussian is `MAX_DISTANCE` times the distance to its nearest neighbour, but not below the least
        radius (see `MIN_SPACING`).

        Args:
            splats: int array of any shape, indices of the Gaussians.
        """
        unknown = np.unique(splats[np.isnan(self._spacing[splats])])
        unknown = unknown[np.argsort(self._position[unknown])]  # in the order of the tree, for the cache
        self._spacing[unknown] = self.tree.query(self.tree.data[unknown], 2, workers=-1)[0][:, 1]
        return np.maximum(MAX_DISTANCE * self._spacing[splats], self._min_radius)

    def share(self, points: np.ndarray) -> float:
        """Return the share of the points [M, 3] that lie within the matching radius of their nearest Gaussian."""
        distances, nearest = self.tree.query(points)
        return float((distances <= self.radius(nearest)).mean())


def _find_candidates(index: _NearIndex, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances float32 and indices int32, [M, C] each, of the C nearest Gaussians of points [M, 3]."""
    # C is `CANDIDATES`, or all Gaussians if there are fewer; the nearest come first.
    count = min(CANDIDATES, index.tree.n)
    distances, candidates = np.empty((len(points), count), np.float32), np.empty((len(points), count), np.int32)
    order = cKDTree(points).indices
    for start in range(0, len(points), QUERY_SIZE):
        block = order[start : start + QUERY_SIZE]
        near_distances, splats = (
            each.reshape(-1, count) for each in index.tree.query(points[block], count, workers=-1)
        )
        # Distances beyond the Gaussian's matching radius are infinite.
        distances[block] = np.where(near_distances <= index.radius(splats), near_distances, np.inf)
        candidates[block] = splats
    return distances, candidates


def _match_one_to_one(index: _NearIndex, points: np.ndarray, excluded: np.ndarray) -> np.ndarray:
    """Match points [M, 3] one to one, the nearest pairs first; return bool [N], the Gaussians that are matched."""
    distances, candidates = _find_candidates(index, points)
    # Gaussians that are `excluded`, bool [N], cannot be matched.
    distances[excluded[candidates]] = np.inf
    count = distances.shape[1]
    owner = np.full(index.tree.n, -1)
    owner_distance = np.full(index.tree.n, np.inf)  # distance to the owner
    rank = np.zeros(len(points), int)  # next candidate that each point proposes to
    proposers = np.arange(len(points))
    # Stable matching: each point proposes to its nearest Gaussian, then to the next ones; a Gaussian keeps the nearest
    # point. The result equals that of greedily matching the nearest pairs.
    while len(proposers):
        proposers = proposers[rank[proposers] < count]
        proposed, proposed_distance = (table[proposers, rank[proposers]] for table in (candidates, distances))
        rank[proposers] += 1
        order = np.lexsort((proposers, proposed_distance))[::-1]
        # Farthest first: if several points propose to one Gaussian, the nearest is written last and stays.
        order = order[proposed_distance[order] < owner_distance[proposed[order]]]
        displaced = owner[proposed[order]]
        owner[proposed[order]], owner_distance[proposed[order]] = proposers[order], proposed_distance[order]
        proposers = np.setdiff1d(np.concatenate([proposers, displaced[displaced >= 0]]), owner)
    return owner >= 0
