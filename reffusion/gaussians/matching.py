"""Search for the Gaussians that were deleted from a scene in an editor.

The positions in the editor's file (the *cleaned* scene) are matched to those of the *whole* scene; their order does not
matter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, cKDTree

from reffusion.gaussians.movement import SAME_LOOKS, Cloud, Movement, find_movement

CANDIDATES = 8  # nearest Gaussians of the whole scene with which a Gaussian of the cleaned scene is compared
# Matching radius of a Gaussian of the whole scene, as a share of the distance to its nearest neighbor: within it a
# position of the cleaned scene counts as the Gaussian's own position, moved by quantization.
MAX_DISTANCE = 0.5
# Least radius, as a share of the median of these distances; it matters for several Gaussians at one position.
MIN_SPACING = 0.1
SAMPLE_SIZE = 5000  # Gaussians of the cleaned scene by which axis flips and different scenes are detected
QUERY_SIZE = 100_000  # points per query of neighbors
HULL_SIZE = 5_000  # points that are compared at once with the facets of a convex hull
# Shares of a sample of the cleaned scene from which on it was not moved: of exact positions, and of positions nearby. A
# scene that another one was merged into has less, but `find_movement` finds that it was not moved.
MIN_EXACT_SHARE, MIN_MATCHED_SHARE = 0.05, 0.95
MOSTLY_ALIKE = 0.5  # share of nearest pairs of one look above which all pairs must have one look
MIN_FOUND_SHARE = 0.05  # share of the cleaned scene's Gaussians that must be matched for both files to be one scene
# A deleted Gaussian is a core if so large a share of its NEIGHBORS nearest Gaussians was deleted, too. Connected cores
# form a hole if there are at least LEAST_CORES. A deleted Gaussian belongs to the hole if it is at most REACH times as
# far from the nearest core as that core's farthest neighbor is.
NEIGHBORS, CORE_SHARE, LEAST_CORES, REACH = 16, 1 / 3, 16, 2.0
# Gaussians less opaque than this quantile of those that stay were filtered, if they are so large a share of the scene.
FILTER_RANK, LEAST_FILTERED = 0.001, 0.02
# A region lies beyond what stays if so large a share of it is outside its convex hull, and surrounds it if so large a
# share is beyond either end of one of some directions.
BEYOND_SHARE, SIDE_SHARE = 0.8, 0.02
OPPOSITES = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1), (0, 1, 1), (0, 1, -1))
# Signs of x, y and z: unchanged, or rotated by 180 degrees about x, y or z, as editors do with scenes that have y down.
AXIS_FLIPS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))


@dataclass(frozen=True)
class Match:
    """Correspondence between a whole scene and a cleaned one.

    Attributes:
        places: int [M], for each Gaussian of the cleaned scene its index in the whole scene; -1 if it is not there, and
            for all Gaussians if `movement` is None or mirrors.
        deleted: bool [N], True for the Gaussians of the whole scene that are not in the cleaned one. All False if
            `movement` is None or mirrors.
        found: share in [0, 1] of the cleaned scene's Gaussians that are in the whole scene.
        movement: takes Gaussians of the whole scene to those of the cleaned one. None if the scenes are different ones.
    """

    places: np.ndarray
    deleted: np.ndarray
    found: float
    movement: Movement | None


def match_gaussians(whole: Cloud, cleaned: Cloud) -> Match:
    """Match the Gaussians of a cleaned scene to those of the whole scene, one to one and the nearest pairs first.

    Most editors keep positions to the last bit; equal positions are matched by sorting. Some editors quantize
    positions. This moves a Gaussian by far less than the distance to its neighbors, even in a compressed .ply, whose
    steps are 1/2000 of the extent of 256 neighbors. Where neither is the case, the scene was moved, or another one was
    added; `find_movement` then compares how Gaussians look.

    Args:
        whole: N >= 2 Gaussians.
        cleaned: M >= 1 Gaussians, of which some may be new.
    """
    sample = cleaned.take(slice(None, None, max(1, len(cleaned) // SAMPLE_SIZE)))
    index, near_index = _ExactIndex(whole.means), None
    exact = {flip: float((index.find(sample.means * flip) >= 0).mean()) for flip in AXIS_FLIPS}
    flip = max(AXIS_FLIPS, key=exact.__getitem__)
    movement: Movement | None = Movement(1.0, np.diag(np.array(flip, float)), np.zeros(3))
    if exact[flip] < MIN_EXACT_SHARE:
        near_index = _NearIndex(whole)
        near = {flip: near_index.share(sample, flip) for flip in AXIS_FLIPS}
        flip = max(AXIS_FLIPS, key=near.__getitem__)
        movement = Movement(1.0, np.diag(np.array(flip, float)), np.zeros(3))
        if near[flip] < MIN_MATCHED_SHARE:
            movement = find_movement(whole, cleaned)
            if movement is None or movement.mirrors:
                return Match(np.full(len(cleaned), -1), np.zeros(len(whole), bool), near[flip], movement)
    assert movement is not None
    placed = replace(cleaned, means=movement.invert(cleaned.means))
    places = index.find(placed.means)
    unmatched = np.flatnonzero(places < 0)
    if len(unmatched):
        taken = np.zeros(len(whole), bool)
        taken[places[places >= 0]] = True
        owners = _match_one_to_one(near_index or _NearIndex(whole), placed.take(unmatched), taken)
        matched = np.flatnonzero(owners >= 0)
        places[unmatched[owners[matched]]] = matched
    found = float((places >= 0).mean())
    if found < MIN_FOUND_SHARE:
        return Match(np.full(len(cleaned), -1), np.zeros(len(whole), bool), found, None)
    deleted = np.ones(len(whole), bool)
    deleted[places[places >= 0]] = False
    return Match(places, deleted, found, movement)


def find_regions(whole: np.ndarray, deleted: np.ndarray) -> np.ndarray:
    """Group the deleted Gaussians into regions, in which they lie close together.

    Only the nearest Gaussians are compared, so the result does not depend on the scale of the scene or on how densely
    it is sampled. An object may be a single layer on a surface that stays.

    Args:
        whole: [N, 3] positions of the whole scene.
        deleted: bool [N], True for the Gaussians that were deleted.

    Returns:
        int [N], the number of the region; -1 for Gaussians that stay or are scattered, i.e. stood alone among others
        that stay. The numbers have gaps, and no order.
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
    large = np.bincount(labels)[labels] >= LEAST_CORES
    cores, labels = cores[large], labels[large]
    regions = np.full(len(whole), -1)
    if len(cores):
        away, nearest = cKDTree(whole[index[cores]]).query(whole[index])
        regions[index] = np.where(away <= REACH * distances[cores[nearest], -1], labels[nearest], -1)
    return regions


def find_filtered(opacities: np.ndarray, deleted: np.ndarray) -> np.ndarray:
    """Find the Gaussians that were deleted because they are transparent: wherever they lie, they leave no hole.

    Args:
        opacities: [N], in [0, 1], of the whole scene.
        deleted: bool [N], with at least one False.

    Returns:
        bool [N]. All False if no filter for opacity was used: if Gaussians as transparent stay, or if the transparent
        ones are at most the share `LEAST_FILTERED` of the scene.
    """
    filtered = deleted & (opacities < np.quantile(opacities[~deleted], FILTER_RANK))
    return filtered if filtered.mean() > LEAST_FILTERED else np.zeros_like(filtered)


def find_cropped(whole: np.ndarray, deleted: np.ndarray, regions: np.ndarray) -> np.ndarray:
    """Find the Gaussians that were cropped: deleted around what stays.

    Args:
        whole: [N, 3] positions of the whole scene.
        deleted: bool [N].
        regions: int [N], from `find_regions`.

    Returns:
        bool [N]. All False if no region surrounds what stays. An object that stood beside what stays is not cropped.
    """
    cropped, kept = np.zeros(len(whole), bool), whole[~deleted]
    numbers, number = np.unique(regions[regions >= 0], return_inverse=True)
    if not len(numbers) or len(kept) < 4 or np.linalg.matrix_rank(kept - kept.mean(0), 1e-6 * np.ptp(kept)) < 3:
        return cropped
    index = np.flatnonzero(regions >= 0)
    facets = ConvexHull(kept).equations
    outside = np.zeros(len(index), bool)
    for start in range(0, len(index), HULL_SIZE):
        points = whole[index[start : start + HULL_SIZE]]
        outside[start : start + HULL_SIZE] = (points @ facets[:, :3].T + facets[:, 3]).max(1) > 0
    numbered = [index[number == k] for k in range(len(numbers))]
    beyond = np.array([outside[number == k].mean() > BEYOND_SHARE for k in range(len(numbers))])
    if not beyond.any() or not _surrounds(np.concatenate([numbered[k] for k in np.flatnonzero(beyond)]), whole, kept):
        return cropped
    # If there is a hole within what stays, an editor cropped whatever lies beyond. Else an object may stand there.
    within = not beyond.all()
    for k in np.flatnonzero(beyond):
        cropped[numbered[k]] = within or _surrounds(numbered[k], whole, kept)
    return cropped


def _surrounds(chosen: np.ndarray, whole: np.ndarray, kept: np.ndarray) -> bool:
    """Return whether chosen Gaussians reach beyond the kept ones [K, 3] on opposite sides."""
    for direction in OPPOSITES:
        along, range_ = whole[chosen] @ direction, kept @ direction
        if min((along < range_.min()).mean(), (along > range_.max()).mean()) > SIDE_SHARE:
            return True
    return False


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
    """Index of a scene's Gaussians by position, with a matching radius for each that depends on its neighbors."""

    def __init__(self, whole: Cloud):
        self.whole, self.tree = whole, cKDTree(whole.means)
        self._spacing = np.full(len(whole), np.nan, np.float32)  # distance to the nearest other one; computed on demand
        self._position = np.empty(len(whole), np.int32)
        self._position[self.tree.indices] = np.arange(len(whole))
        sample = np.arange(0, len(whole), max(1, len(whole) // SAMPLE_SIZE))
        self._min_radius = 0.0
        self._min_radius = MIN_SPACING * float(np.median(self.radius(sample))) / MAX_DISTANCE

    def radius(self, splats: np.ndarray) -> np.ndarray:
        """Return the matching radii of Gaussians of the scene, as float32 of the shape of `splats`.

        The radius of a Gaussian is `MAX_DISTANCE` times the distance to its nearest neighbor, but not below the least
        radius (see `MIN_SPACING`).

        Args:
            splats: int array of any shape, indices of the Gaussians.
        """
        unknown = np.unique(splats[np.isnan(self._spacing[splats])])
        unknown = unknown[np.argsort(self._position[unknown])]  # in the order of the tree, for the cache
        self._spacing[unknown] = self.tree.query(self.tree.data[unknown], 2, workers=-1)[0][:, 1]
        return np.maximum(MAX_DISTANCE * self._spacing[splats], self._min_radius)

    def share(self, sample: Cloud, flip: tuple[int, int, int]) -> float:
        """Return the share of Gaussians that, flipped, lie within the matching radius of their nearest Gaussian."""
        distances, nearest = self.tree.query(sample.means * flip)
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


def _match_one_to_one(index: _NearIndex, points: Cloud, excluded: np.ndarray) -> np.ndarray:
    """Match `points` one to one, nearest pairs first; return int [N], each indexed Gaussian's point or -1."""
    distances, candidates = _find_candidates(index, points.means)
    # Gaussians that are `excluded`, bool [N], cannot be matched.
    distances[excluded[candidates]] = np.inf
    # Where colors were not edited, Gaussians of another look are others that happen to lie there.
    looks, whole_looks = points.looks(), index.whole.looks()
    alike = np.stack([np.linalg.norm(whole_looks[each] - looks, axis=1) < SAME_LOOKS for each in candidates.T], axis=1)
    near = np.isfinite(distances[:, 0])
    if np.count_nonzero(alike[near, 0]) > MOSTLY_ALIKE * np.count_nonzero(near):
        distances[~alike] = np.inf
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
    return owner
