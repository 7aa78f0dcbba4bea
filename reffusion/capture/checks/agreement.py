"""Decides whether the poses that come with photographs belong to them, and finds the mistake where they do not.

Pictures alone tell which points two photographs share: SIFT features that match, and that one fundamental matrix
explains. The given poses must explain the same matches: both rays of a match meet, in front of both cameras. Right
poses explain nearly all pairs of photographs, wrong ones few (.93 to 1 on nine captures, and 0 to .23 on seven).
Neither sparse points nor masks are needed.

Where the poses explain less than half of the pairs, the usual mistakes are undone one at a time: EXIF orientation,
camera axes, inverted matrices, transposed rotations, and the order of the photographs. The correction that explains
most pairs is taken. If none explains enough of them, the poses are refused.

PAPER leaves open: it takes the poses as given.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch

from reffusion.capture.layouts.capture import Capture, Correction, invert_pose
from reffusion.capture.lens import Lens, to_directions
from reffusion.io.files import BadInput
from reffusion.io.images import load_thumbnail, orientation_matrix

SIDE = 480  # px, longer side of the reduced photographs in which features are sought
VIEWS = 20  # photographs, spread evenly over the capture, that are compared with each other
FEATURES = 1000  # largest number of features of a photograph
QUICK, MOST = 14, 24  # pairs that confirm right poses; and pairs with which corrections are compared
LEAST_PAIRS = 5  # pairs below which poses are not judged
LEAST_MATCHES, LEAST_SHARE = 30, 0.7  # matches that a pair needs, and share of them that one matrix must explain
RATIO = 0.8  # largest ratio of the distances to the best and to the second best feature (Lowe 2004)
LOOSE = 1.0  # px of the reduced photographs: largest distance of a match from its epipolar line
# Largest distance of a match from the epipolar line of the poses, in units of the focal length (.01: half a degree),
# and relative to the distance by which the match moved between the photographs. Matches that moved less than `STILL`
# are ignored.
CLOSE, ALONG, STILL = 0.01, 0.3, 0.006
EXPLAINED = 0.5  # share of a pair's matches that poses must explain, to explain the pair
# Share of the pairs that given poses, and that corrected poses, must explain; and the share of the first `QUICK` pairs
# that makes more pairs needless.
RIGHT, TAKEN, SURE = 0.5, 0.6, 0.75
MOST_SHIFT = 30  # frames by which photographs are shifted against the poses at most
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenCV's camera axes (y down, z forward) to OpenGL's, and back


@dataclass(frozen=True)
class Agreement:
    """The result of `judge_poses`.

    Attributes:
        pairs: number of pairs of photographs that were compared; fewer than `LEAST_PAIRS` decide nothing.
        given: number of these pairs that the given poses explain.
        placed, explained: number of the pairs whose views have poses, after the correction if there is one, and how
            many of them these poses explain.
        correction: the correction that was found; None if the given poses are right, or cannot be judged.
    """

    pairs: int
    given: int
    placed: int
    explained: int
    correction: Correction | None = None

    @property
    def summary(self) -> str:
        """One line for the log: how many pairs the given poses explain, or that too few pairs match to judge them."""
        if self.pairs < LEAST_PAIRS:
            return f"poses not checked: only {self.pairs} pairs of photographs match"
        return f"poses as given explain {self.given} of {self.pairs} pairs of photographs that match"

    def describe(self, source: Path | None) -> str:
        """Return the warning that tells the correction, which must not be None. `source`: the file of the poses."""
        assert self.correction is not None
        return (
            f"{source}: {self.correction.cause}. Corrected: of {self.placed} pairs of matching photographs, the poses "
            f"explain {self.explained} now; as they were, {self.given} of {self.pairs}"
        )


def judge_poses(capture: Capture) -> Agreement:
    """Decide whether the poses of a capture belong to its photographs, and find the correction if they do not.

    The result has no correction if fewer than `LEAST_PAIRS` pairs of photographs match.

    Args:
        capture: a capture with poses.

    Raises:
        BadInput: the poses contradict the photographs, and no correction makes them agree.
    """
    assert capture.poses is not None
    given, names = capture.poses.world_to_camera, list(capture.pictures)
    chosen = np.unique(np.linspace(0, len(names) - 1, min(VIEWS, len(names))).round().astype(int))
    sources = {names[k]: (capture.pictures[names[k]], capture.poses.lenses[names[k]]) for k in chosen}
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        stored = dict(zip(sources, pool.map(_View.load, *zip(*sources.values(), strict=True)), strict=True))
    upright = {name: view.turned_upright() for name, view in stored.items()}
    views = upright if capture.upright else stored
    pairs: list[_Pair] = []
    for pair in _match_views(views):
        pairs.append(pair)
        if len(pairs) == MOST or (len(pairs) == QUICK and sum(_explain(pairs, views, given)) >= SURE * QUICK):
            break
    known = _explain(pairs, views, given)
    best = Agreement(len(known), sum(known), len(known), sum(known))
    if len(known) < LEAST_PAIRS or sum(known) >= RIGHT * len(known):
        return best
    for correction in _corrections(capture):
        found = _explain(pairs, upright if correction.upright else views, correction.poses(given))
        if len(found) >= max(LEAST_PAIRS, len(pairs) / 3) and sum(found) / len(found) > best.explained / best.placed:
            best = Agreement(len(known), sum(known), len(found), sum(found), correction)
    if best.explained < TAKEN * best.placed:
        raise BadInput(
            f"{capture.pose_source}: its poses are not those of the photographs: of {len(known)} pairs of photographs "
            f"that match, the poses explain {sum(known)}; with other axes, with inverted or transposed matrices, in "
            f"another order, shifted, and with EXIF orientation obeyed at most {best.explained}. Solve the poses "
            "again, or remove the file to have them estimated; poses.trust=true uses them as they are"
        )
    return best


# ---------------------------------------------------------------------------------------------- matches


@dataclass(frozen=True)
class _View:
    """The features of a photograph.

    Attributes:
        at: [F, 2] float64, places in the picture as shares of its width and height, strongest feature first.
        directions: [F, 2], undistorted directions of these places.
        descriptors: [F, 128] float32 of length 1 (RootSIFT).
        size: [2], width and height of the reduced picture.
        lens: lens of the picture.
        path: file of the picture.
    """

    at: np.ndarray
    directions: np.ndarray
    descriptors: np.ndarray
    size: np.ndarray
    lens: Lens
    path: Path

    @classmethod
    def load(cls, path: Path, lens: Lens) -> _View:
        """Read a photograph, and find its features."""
        gray = cv2.cvtColor(load_thumbnail(path, SIDE), cv2.COLOR_RGB2GRAY)
        keys, found = cv2.SIFT_create(FEATURES, contrastThreshold=0.02).detectAndCompute(gray, None)
        order = np.argsort([-key.response for key in keys], kind="stable")
        at = np.array([keys[k].pt for k in order]).reshape(-1, 2) + 0.5
        found = np.zeros((0, 128), np.float32) if found is None else found[order]
        root = np.sqrt(found / np.maximum(found.sum(1, keepdims=True), 1e-9)).astype(np.float32)
        size = np.array(gray.shape[::-1], float)
        at = at / size
        return cls(at, to_directions(at * (lens.width, lens.height), lens), root, size, lens, path)

    def turned_upright(self) -> _View:
        """Return the view with the directions that its features have in the picture turned by its EXIF orientation."""
        turn = orientation_matrix(self.path)
        at = self.at @ turn[:, :2].T + turn[:, 2]
        return replace(self, directions=to_directions(at * (self.lens.width, self.lens.height), self.lens))


@dataclass(frozen=True)
class _Pair:
    """The matches of two photographs: the names of the views, and int [K], the indices of the features of each."""

    names: tuple[str, str]
    features: tuple[np.ndarray, np.ndarray]


def _match_views(views: Mapping[str, _View]) -> Iterator[_Pair]:
    """Yield the pairs of views that match well, with those matches that one fundamental matrix explains."""
    pairs = list(itertools.combinations(views, 2))
    matches = {pair: _mutual_matches(*(views[name].descriptors for name in pair)) for pair in pairs}
    likely = [pair for pair in pairs if len(matches[pair][0]) >= LEAST_MATCHES]
    # First comes, for each view, a pair with a middling number of matches: the most similar photographs hardly differ
    # in place, and the least similar ones share little.
    by_view = []
    for name in views:
        own = sorted((pair for pair in likely if name in pair), key=lambda pair: -len(matches[pair][0]))
        by_view.append(sorted(own, key=lambda pair, own=own: abs(own.index(pair) - len(own) // 2)))
    ranked = dict.fromkeys(filter(None, itertools.chain.from_iterable(itertools.zip_longest(*by_view))))
    for pair in ranked:
        at = [views[name].at[chosen] * views[name].size for name, chosen in zip(pair, matches[pair], strict=True)]
        mask = cv2.findFundamentalMat(*at, cv2.FM_RANSAC, LOOSE, 0.999, 2000)[1]
        # few explained matches, or a small share of them, are typical of repeated patterns
        if mask is not None and mask.sum() >= max(LEAST_MATCHES, LEAST_SHARE * len(mask)):
            right = mask.ravel().astype(bool)
            yield _Pair(pair, tuple(chosen[right] for chosen in matches[pair]))


def _mutual_matches(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return int [K] each: indices of descriptors [F, 128] and [G, 128] that match each other by far the best."""
    if min(len(one), len(other)) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    similarity = one @ other.T
    best, back = similarity.argmax(1), similarity.argmax(0)
    rows = np.arange(len(one))
    top = similarity[rows, best]
    similarity[rows, best] = -1
    distance, second = (np.sqrt(np.maximum(2 - 2 * each, 0)) for each in (top, similarity.max(1)))
    chosen = np.flatnonzero((distance < RATIO * second) & (back[best] == rows))
    return chosen, best[chosen]


# ---------------------------------------------------------------------------------------------- geometry


def _explain(pairs: Sequence[_Pair], views: Mapping[str, _View], poses: Mapping[str, np.ndarray]) -> list[bool]:
    """Return whether world-to-camera poses explain each pair; a pair without parallax, or a pose, has no entry."""
    found = []
    for pair in pairs:
        if all(name in poses for name in pair.names):
            rays = (views[name].directions[k] for name, k in zip(pair.names, pair.features, strict=True))
            explained, moved = _explained_matches(*rays, *(poses[name] for name in pair.names))
            if moved.sum() >= LEAST_MATCHES / 2:
                found.append(bool(explained[moved].mean() >= EXPLAINED))
    return found


def _explained_matches(
    one: np.ndarray, other: np.ndarray, pose: np.ndarray, other_pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return bool [K] each: matches whose rays meet in front of both cameras, and matches that can judge the poses."""
    rays, other_rays = (np.concatenate([each, np.ones((len(each), 1))], axis=1) for each in (one, other))
    turn = other_pose[:3, :3] @ pose[:3, :3].T
    shift = other_pose[:3, 3] - turn @ pose[:3, 3]
    shift = shift / max(float(np.linalg.norm(shift)), 1e-12)
    turned = rays @ turn.T
    # Sampson's distance from the epipolar lines
    normal, other_normal = np.cross(shift, turned), np.cross(other_rays, shift) @ turn
    miss = np.abs((other_rays * normal).sum(1))
    slope = np.sqrt((normal[:, :2] ** 2).sum(1) + (other_normal[:, :2] ** 2).sum(1))
    # depths a, b of the nearest points of both rays: a turned + shift = b other_rays
    aa, bb, ab = (turned**2).sum(1), (other_rays**2).sum(1), (turned * other_rays).sum(1)
    depth = (other_rays @ shift) * ab - (turned @ shift) * bb
    other_depth = (other_rays @ shift) * aa - (turned @ shift) * ab
    # Only matches that moved by more than the rotation between the poses can judge the poses.
    moved = np.linalg.norm(turned / np.sqrt(aa)[:, None] - other_rays / np.sqrt(bb)[:, None], axis=1)
    close = miss < np.minimum(CLOSE, ALONG * moved) * slope
    return close & (depth > 0) & (other_depth > 0), ~(moved < STILL)  # a match with a NaN direction is not explained


# ---------------------------------------------------------------------------------------------- corrections


def _corrections(capture: Capture) -> Iterator[Correction]:
    """Yield the corrections that are tried, the likeliest first."""
    if not capture.upright and any(_is_turned(path) for path in capture.pictures.values()):
        yield Correction("its poses are those of the photographs turned by their EXIF orientation", dict, upright=True)
    for cause, axes in _axes():
        yield Correction(f"its camera axes are {cause}", lambda given, axes=axes: _each(given, lambda m: axes @ m))
    for cause, axes in (("", np.eye(4)), *((f", with camera axes {cause}", axes) for cause, axes in _axes())):
        yield Correction(
            f"its matrices are inverted (world to camera, camera to world){cause}",
            lambda given, axes=axes: _each(given, lambda m: axes @ invert_pose(m)),
        )
        for world in (FLIP, np.eye(4)):
            yield Correction(
                f"its rotations are transposed{cause}",
                lambda given, axes=axes, world=world: _each(given, lambda m: axes @ _transpose_rotation(m, world)),
            )
    yield from _orders(list(capture.poses.world_to_camera))


def _is_turned(path: Path) -> bool:
    return not np.array_equal(orientation_matrix(path), np.eye(2, 3))


def _each(poses: Mapping[str, np.ndarray], change: Callable[[np.ndarray], np.ndarray]) -> dict[str, np.ndarray]:
    return {name: change(pose) for name, pose in poses.items()}


def _transpose_rotation(pose: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return a world-to-camera pose [4, 4] with its rotation R replaced by axes R^T axes, at the same camera center."""
    center = -pose[:3, :3].T @ pose[:3, 3]
    result = np.eye(4)
    result[:3, :3] = axes[:3, :3] @ pose[:3, :3].T @ axes[:3, :3]
    result[:3, 3] = -result[:3, :3] @ center
    return result


def _axes() -> list[tuple[str, np.ndarray]]:
    """Return (name, [4, 4]) of the 23 rotations that permute the camera's axes, the likeliest first."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.eye(4)
            matrix[:3, :3] = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(matrix) > 0 and not np.array_equal(matrix, np.eye(4)):
                found.append((_name_axes(order, signs, matrix), matrix))
    return sorted(found, key=lambda each: (not np.array_equal(each[1], FLIP), -np.trace(each[1])))


def _name_axes(order: Sequence[int], signs: Sequence[float], matrix: np.ndarray) -> str:
    """Return the name, for a message, of the camera axes that `matrix` rotates."""
    if np.array_equal(matrix, FLIP):
        return "OpenCV's in place of OpenGL's, or the other way round (y and z have the other sign)"
    if matrix[2, 2] == 1:
        angle = round(float(np.degrees(np.arctan2(matrix[1, 0], matrix[0, 0])))) % 360
        return f"rolled by {angle} degrees around the line of sight"
    named = ", ".join(f"{'-' if sign < 0 else ''}{'xyz'[axis]}" for axis, sign in zip(order, signs, strict=True))
    return f"other ones: its ({named}) are x right, y down and z forward"


def _orders(names: Sequence[str]) -> Iterator[Correction]:
    """Yield the corrections of the order in which poses are given to the views `names`."""
    natural = sorted(names, key=_numeric_key)
    for cause, order in (
        ("its poses are in numerical order of the names, such as 2 before 10", natural),
        ("its poses are in reverse order of the names", names[::-1]),
    ):
        if order != names:
            yield Correction(cause, lambda given, order=order: {v: given[o] for v, o in zip(order, names, strict=True)})
    for shift in sorted(range(-MOST_SHIFT, MOST_SHIFT + 1), key=abs):
        ahead = list(zip(names[max(0, -shift) :], names[max(0, shift) :], strict=False))
        if shift and len(ahead) >= len(names) / 2:
            own, other = ahead[0]
            yield Correction(
                f"its poses are shifted against the photographs by {abs(shift)}: {own} has the pose of {other}, and "
                f"{abs(shift)} photographs have none and are left out",
                lambda given, ahead=ahead: {own: given[other] for own, other in ahead},
            )


def _numeric_key(name: str) -> list[tuple[int, str]]:
    """Return the key that sorts names by their numbers, so that `frame_2` stands before `frame_10`."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
