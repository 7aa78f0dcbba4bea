"""Registers a completed view from another tool with its photograph, and tells whether it shows that view.

Pictures are uint8 [H, W, 3] of one size; affine maps are as in `tracks`. Only pixels outside the object are compared. A
picture of this view shows each point where the photograph does, even when an autoencoder redrew it. A picture of
another view displaces points by parallax, which no affine map explains; another scene does not show them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from reffusion.io.images import to_gray
from reffusion.morphology import square
from reffusion.references import tracks
from reffusion.references.color import match_colors, recolor

WORKING_SIDE = 512  # px, the longer side at which pictures are compared; autoencoders keep what is visible at this size
QUICK_SIDE = 256  # px, the same where many views are compared
MARGIN = 0.01  # of the width: pixels nearer to the object are ignored, since its blurred edge lies there
INLIER_DISPLACEMENT = 0.001  # of the longer side: a point displaced by less counts as an inlier
LEAST_INLIER_DISPLACEMENT = 0.5  # px of the working size, where that is less: flow is no finer
LEAST_POINTS = 20  # points; with fewer nothing can be said
LEAST_INLIER_RATIO = 0.7  # share of inliers from which a picture shows its view
SURE_INLIER_RATIO = 0.95  # share of inliers from which no other map is tried
REFINEMENTS = 3  # times that an affine map is estimated from the remaining displacements
IDENTITY_SHIFT = 0.2  # px of the working size: a map that moves no corner further is the identity
IDENTICAL = 1.5  # levels of 255: largest median difference of a picture that equals the photograph outside the hole
LEAST_SCALE, LARGEST_SCALE = 0.8, 1.25  # scales a map may have: people resize and crop, they do not zoom
LARGEST_SHEAR = 0.05  # radians of rotation and shear a map may have
FAR_SHIFT = 0.02  # of the longer side: a map that moves a corner by less may be another tool's shift
CLEAR_MARGIN = 0.1  # inlier ratio by which another view must be better
LARGEST_SHIFT = 0.15  # of the longer side: how far a map may move a corner

IDENTITY = np.eye(2, 3)


@dataclass(frozen=True)
class Registration:
    """How a picture lies over its photograph.

    Attributes:
        affine: [2, 3] affine map from the photograph's pixels to the picture's; None where the picture is aligned as it
            is.
        max_shift: px, by how much the map moves the corner that it moves most.
        gain, offset: [3] each, colours in [0, 1]: photograph = gain * picture + offset; 1 and 0 where none is needed.
        point_count: number of points that were compared.
        inlier_ratio: share in [0, 1] of the points that the picture shows where the photograph does; NaN with too few
            points.
        median_displacement: px, of the tracked points; NaN where none was tracked.
        is_identical: the picture equals the photograph outside the hole, up to rounding.
    """

    affine: np.ndarray | None
    max_shift: float
    gain: np.ndarray
    offset: np.ndarray
    point_count: int
    inlier_ratio: float
    median_displacement: float
    is_identical: bool

    @property
    def fits(self) -> bool:
        """Is it a picture of this view? True where there are too few points to tell."""
        return not self.inlier_ratio < LEAST_INLIER_RATIO

    @property
    def mismatch(self) -> str:
        """How badly it fits, for an error message."""
        moved = f"moved by up to {self.max_shift:.0f} px" if self.affine is not None else "as it lies"
        displaced = (
            "none of the others is found in it"
            if np.isnan(self.median_displacement)
            else f"the median displacement is {self.median_displacement:.1f} px"
        )
        return (
            f"{moved}, it shows {self.inlier_ratio:.0%} of {self.point_count} places around the hole where the "
            f"photograph has them (at least {LEAST_INLIER_RATIO:.0%} must; {displaced})"
        )

    def __str__(self) -> str:
        if np.isnan(self.inlier_ratio):
            return "what it shows around the hole is too plain to be compared"
        moved = f"moved by up to {self.max_shift:.1f} px" if self.affine is not None else "not moved"
        brighter = (self.gain.mean() + self.offset.mean() - 1) * 100
        colors = f"colours matched ({brighter:+.0f} %)" if (self.gain != 1).any() or self.offset.any() else "as exposed"
        share = f"{self.inlier_ratio:.0%} of {self.point_count} places"
        return f"{moved}, {colors}; {share} around the hole lie as in the photograph"


def register(picture: np.ndarray, photo: np.ndarray, hidden: np.ndarray, working: int = WORKING_SIDE) -> Registration:
    """Align a picture with its photograph, in position and colour. The identity is kept where it fits as well.

    Args:
        picture: the completed view, resized to the photograph's size.
        photo: the photograph of the view.
        hidden: bool [H, W], the object's pixels in the photograph.
        working: px, the longer side at which both are compared, where they are larger.
    """
    known = ~_dilate(hidden, MARGIN)
    untouched = known.any() and np.median(np.abs(picture.astype(np.int16) - photo)[known]) <= IDENTICAL
    pair = _Pair.at(picture, photo, known, working)
    best = unmoved = pair.judge(IDENTITY)
    if untouched and best.fits:
        return replace(best, affine=None, gain=np.ones(3), offset=np.zeros(3), is_identical=True)
    for start in pair.starts():
        found = pair.refine(start)
        best = found if found is not None and _is_better(found, best) else best
        if best.inlier_ratio > SURE_INLIER_RATIO:
            break
    return best if best.max_shift > IDENTITY_SHIFT * pair.stride.max() else replace(unmoved, affine=None)


def find_better_view(
    picture: np.ndarray, found: Registration, others: Iterable[tuple[str, np.ndarray, np.ndarray]]
) -> tuple[str, float] | None:
    """The name of another view that the picture shows better than its own, and the inlier ratio there; None for no such
    view.

    Args:
        found: how the picture lies over its own photograph.
        others: of other views the name, the photograph, and bool [H, W] the object's pixels; likely ones first.
    """
    best: tuple[str, float] | None = None
    own = 0.0 if np.isnan(found.inlier_ratio) else found.inlier_ratio
    is_far = found.max_shift > FAR_SHIFT * max(picture.shape)
    for name, photo, hidden in others:
        size = (photo.shape[1], photo.shape[0])
        image = picture if picture.shape == photo.shape else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        match = register(image, photo, hidden, QUICK_SIDE)
        # Other views of a plane show the same points, all displaced alike: then the view that needs no shift is right.
        as_well = is_far and match.inlier_ratio > own - 0.05 and match.max_shift < found.max_shift / 2
        if match.inlier_ratio >= LEAST_INLIER_RATIO and (match.inlier_ratio > own + CLEAR_MARGIN or as_well):
            best = (name, match.inlier_ratio) if best is None or match.inlier_ratio > best[1] else best
            if match.inlier_ratio > SURE_INLIER_RATIO:
                break
    return best


def warp(picture: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The picture resampled to the photograph's pixels, and bool [H, W]: pixels that lie inside the picture."""
    height, width = picture.shape[:2]
    linear, shift = moved[:, :2], moved[:, 2] + (moved[:, :2] - np.eye(2)) @ (0.5, 0.5)
    matrix = np.concatenate([linear, shift[:, None]], 1)  # OpenCV counts from the centre of the first pixel
    read = cv2.warpAffine(picture, matrix, (width, height), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
                          borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).astype(np.float32)
    at = pixels @ linear.T.astype(np.float32) + moved[:, 2].astype(np.float32)
    return read, np.all((at >= 0) & (at <= (width, height)), -1)


# ------------------------------------------------------------------------------------------------------- the parts


@dataclass(frozen=True)
class _Pair:
    """Picture and photograph at the working size.

    Attributes:
        picture, photo: uint8 [h, w, 3]; known: bool [h, w], pixels of the photograph without the object.
        stride: [2] full-size pixels per working pixel, across and down.
    """

    picture: np.ndarray
    photo: np.ndarray
    known: np.ndarray
    stride: np.ndarray

    @classmethod
    def at(cls, picture: np.ndarray, photo: np.ndarray, known: np.ndarray, working: int) -> _Pair:
        full_size = np.array(photo.shape[1::-1])
        size = np.maximum(1, np.rint(full_size * min(1.0, working / full_size.max()))).astype(int)
        if (size == full_size).all():
            return cls(picture, photo, known, np.ones(2))
        reduce = lambda image: cv2.resize(image, size.tolist(), interpolation=cv2.INTER_AREA)
        return cls(reduce(picture), reduce(photo), reduce(known.astype(np.float32)) > 0.99, full_size / size)

    def judge(self, moved: np.ndarray) -> Registration:
        """The registration by a map [2, 3] in working pixels, in full-size pixels."""
        gain, offset, found = self.compare(moved)
        limit = max(INLIER_DISPLACEMENT * max(self.known.shape), LEAST_INLIER_DISPLACEMENT)
        places = len(found.points)
        in_place = float((found.lengths < limit).mean()) if places >= LEAST_POINTS else float("nan")
        displaced = float(np.median(found.lengths[found.tracked])) if found.tracked.any() else float("nan")
        stride = self.stride
        full = np.concatenate([moved[:, :2] * stride[:, None] / stride, (moved[:, 2] * stride)[:, None]], 1)
        shift, displaced = (each * float(stride.max()) for each in (_shift(moved, self.known.shape), displaced))
        return Registration(full, shift, gain, offset, places, in_place, displaced, is_identical=False)

    @cached_property
    def unmoved(self) -> tuple[np.ndarray, np.ndarray, tracks.Tracks]:
        """`compare` for the identity."""
        return self._compare(self.picture, self.known)

    def compare(self, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray, tracks.Tracks]:
        """(Gain, offset, tracks): colours of the moved picture, and where it shows the photograph's points."""
        if moved is IDENTITY:
            return self.unmoved
        read, inside = warp(self.picture, moved)
        return self._compare(read, self.known & inside)

    def _compare(self, read: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray, tracks.Tracks]:
        gain, offset = match_colors(read, self.photo, known)
        in_photo, in_picture = (tracks.low_pass(to_gray(image)) for image in (self.photo, recolor(read, gain, offset)))
        in_picture = np.where(known, in_picture, in_photo)  # no displacement in the hole and outside the picture
        points = tracks.find_points(in_photo, known)
        if len(points) >= LEAST_POINTS:
            return gain, offset, tracks.track(in_photo, in_picture, points)
        return (
            gain,
            offset,
            tracks.track(in_picture, in_photo, tracks.find_points(in_picture, known)),
        )  # of a plain photograph

    def starts(self) -> Iterator[np.ndarray]:
        """Initial maps: the identity, then one by matching features, for larger displacements."""
        yield IDENTITY
        if (found := _by_features(self.picture, self.photo, self.known)) is not None:
            yield found

    def refine(self, moved: np.ndarray) -> Registration | None:
        """Refine a map by the affine part of the remaining displacements. None for a map that resizing and cropping
        cannot make, and where the identity needs no refinement."""
        for _ in range(REFINEMENTS):
            correction = self.compare(moved)[2].affine()
            if correction is None or (moved is IDENTITY and _shift(correction, self.known.shape) < IDENTITY_SHIFT):
                return None
            moved = _compose(moved, correction)
            if not self.is_plausible(moved):
                return None
            if _shift(correction, self.known.shape) < IDENTITY_SHIFT / 4:
                break
        return self.judge(moved)

    def is_plausible(self, moved: np.ndarray) -> bool:
        """Can resizing and cropping make this map?"""
        (a, b), (c, d) = moved[:, :2]
        scales = min(a, d) > LEAST_SCALE and max(a, d) < LARGEST_SCALE
        near = _shift(moved, self.known.shape) < LARGEST_SHIFT * max(self.known.shape)
        return bool(np.isfinite(moved).all() and scales and max(abs(b), abs(c)) < LARGEST_SHEAR and near)


def _is_better(found: Registration, best: Registration) -> bool:
    """Does `found` have a larger inlier ratio than `best`, or the same with smaller displacements?"""
    if found.inlier_ratio > best.inlier_ratio + 0.01 or np.isnan(best.inlier_ratio):
        return not np.isnan(found.inlier_ratio)
    return found.inlier_ratio > best.inlier_ratio - 0.01 and found.median_displacement < best.median_displacement


def _compose(first: np.ndarray, then: np.ndarray) -> np.ndarray:
    """[2, 3] of `first` after `then`: photograph -> moved picture -> picture."""
    linear = first[:, :2] @ then[:, :2]
    return np.concatenate([linear, (first[:, :2] @ then[:, 2] + first[:, 2])[:, None]], 1)


def _shift(moved: np.ndarray, shape: tuple[int, ...]) -> float:
    """px, by how much the map moves the corner that it moves most."""
    height, width = shape
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)], np.float64)
    return float(np.linalg.norm(corners @ moved[:, :2].T + moved[:, 2] - corners, axis=1).max())


def _by_features(picture: np.ndarray, photo: np.ndarray, known: np.ndarray) -> np.ndarray | None:
    """An affine map by SIFT matches; None where there are too few."""
    finder = cv2.SIFT_create(1000)
    grey = lambda image: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    in_photo, of_photo = finder.detectAndCompute(grey(photo), known.astype(np.uint8))
    in_picture, of_picture = finder.detectAndCompute(grey(picture), None)
    if of_photo is None or of_picture is None or min(len(in_photo), len(in_picture)) < tracks.LEAST_PAIRS:
        return None
    pairs = [p for p in cv2.BFMatcher().knnMatch(of_photo, of_picture, k=2) if len(p) == 2]
    pairs = [first for first, second in pairs if first.distance < 0.75 * second.distance]
    if len(pairs) < tracks.LEAST_PAIRS:
        return None
    source = np.array([in_photo[p.queryIdx].pt for p in pairs]) + 0.5
    target = np.array([in_picture[p.trainIdx].pt for p in pairs]) + 0.5
    return tracks.estimate_affine(source, target, 2.0)


def _dilate(mask: np.ndarray, fraction: float) -> np.ndarray:
    reach = max(1, round(fraction * mask.shape[1]))
    return cv2.dilate(mask.astype(np.uint8), square(reach)) > 0
