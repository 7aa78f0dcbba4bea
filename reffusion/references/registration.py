"""Registration of a completed view from another tool with its photograph, and a test of whether it shows that view.

Pictures are uint8 [H, W, 3] of one size. Affine maps [2, 3] lead from pixels of the photograph to pixels of the picture
(`tracks`). Only pixels outside the object are compared. A picture of the same view shows each point at the place where
the photograph shows it, even if an autoencoder redrew the picture. In a picture of another view, parallax displaces
points in a way that no affine map explains. A picture of another scene does not show these points at all.

An inlier is a tracked point that picture and photograph show at the same place. The inlier ratio is the share of
inliers among all points compared.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from reffusion.io.images import to_gray
from reffusion.morphology import dilate_square, to_pixels
from reffusion.references import tracks
from reffusion.references.color import match_colors, recolor

WORKING_SIDE = 512  # px, the longer side at which pictures are compared; autoencoders keep what is visible at this size
QUICK_SIDE = 256  # px, the longer side at which a picture is compared with many views
MARGIN = 0.01  # of the width: pixels nearer to the object are ignored, because the object's blurred edge lies there
INLIER_DISPLACEMENT = 0.001  # of the longer side: a point displaced by less counts as an inlier
LEAST_INLIER_DISPLACEMENT = 0.5  # px of the working size: lower bound of this limit, because flow is no more accurate
LEAST_POINTS = 20  # points that must be found in a picture to judge it
LEAST_INLIER_RATIO = 0.7  # share of inliers from which a picture shows its view
SURE_INLIER_RATIO = 0.95  # share of inliers from which no other map is tried
REFINEMENTS = 3  # times that an affine map is estimated from the remaining displacements
IDENTITY_SHIFT = 0.2  # px of the working size: a map that moves no corner further counts as the identity
IDENTICAL = 1.5  # levels of 255: largest median difference of a picture that equals the photograph outside the hole
LEAST_SCALE, LARGEST_SCALE = 0.8, 1.25  # scales a map may have: people resize and crop, they do not zoom
LARGEST_SHEAR = 0.05  # radians of rotation and shear a map may have
# Of the longer side: a map that moves a corner by less may only undo a shift by the tool that made the picture. A
# larger shift raises the suspicion that the picture shows another view.
FAR_SHIFT = 0.02
CLEAR_MARGIN = 0.1  # difference of inlier ratios by which another view must be better
LARGEST_SHIFT = 0.15  # of the longer side: how far a map may move a corner

IDENTITY = np.eye(2, 3)


@dataclass(frozen=True)
class Registration:
    """The alignment of a picture with its photograph, in position and color, and how well both agree then.

    Attributes:
        affine: [2, 3], the affine map from pixels of the photograph to pixels of the picture; None if the picture is
            aligned without one.
        max_shift: px, the largest distance by which the map moves a corner of the picture. Here and in
            `median_displacement`, pixels are those of the full-size picture.
        gain, offset: [3] each, so that photograph = gain * picture + offset for colors in [0, 1]; 1 and 0 if the
            colors need no correction.
        point_count: number of points that were compared.
        inlier_ratio: share in [0, 1] of all compared points, tracked or not, that the aligned picture shows at the same
            place as the photograph; NaN if there are too few points.
        median_displacement: px, median of the displacements of the tracked points that remain after alignment; NaN if
            no point was tracked.
        is_identical: True if the picture fits without a map and equals the photograph outside the hole: the median
            difference of the values there is at most `IDENTICAL`, so that single areas may differ.
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
        """Whether the picture shows this view. True also if there are too few points to tell."""
        return not self.inlier_ratio < LEAST_INLIER_RATIO

    @property
    def mismatch(self) -> str:
        """A description of how badly the picture fits its view, for an error message."""
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
        colors = f"colors matched ({brighter:+.0f} %)" if (self.gain != 1).any() or self.offset.any() else "as exposed"
        share = f"{self.inlier_ratio:.0%} of {self.point_count} places"
        return f"{moved}, {colors}; {share} around the hole lie as in the photograph"


def register(picture: np.ndarray, photo: np.ndarray, hidden: np.ndarray, working: int = WORKING_SIDE) -> Registration:
    """Align a picture with its photograph, in position and color.

    The picture is not moved if the best affine map hardly moves it or improves nothing.

    Args:
        picture: uint8 [H, W, 3], the completed view, resized to the photograph's size.
        photo: uint8 [H, W, 3], the photograph of the view.
        hidden: bool [H, W], the object's pixels in the photograph.
        working: px; larger pictures are reduced to this longer side before they are compared. The result is for the
            full size in any case.
    """
    known = ~dilate_square(hidden, to_pixels(MARGIN, hidden.shape[1]))
    untouched = known.any() and np.median(np.abs(picture.astype(np.int16) - photo)[known]) <= IDENTICAL
    pair = _Pair.at(picture, photo, known, working)
    best = identity_comparison = pair.judge(IDENTITY)
    if untouched and best.fits:
        return replace(best, affine=None, gain=np.ones(3), offset=np.zeros(3), is_identical=True)
    for start in pair.starts():
        found = pair.refine(start)
        best = found if found is not None and _is_better(found, best) else best
        if best.inlier_ratio > SURE_INLIER_RATIO:
            break
    return best if best.max_shift > IDENTITY_SHIFT * pair.stride.max() else replace(identity_comparison, affine=None)


def find_better_view(
    picture: np.ndarray, found: Registration, others: Iterable[tuple[str, np.ndarray, np.ndarray]]
) -> tuple[str, float] | None:
    """Search for another view that the picture shows better than its own.

    Args:
        picture: uint8 [H, W, 3].
        found: the registration of the picture with the photograph of its own view.
        others: for each other view its name, its photograph (of any size), and the object's pixels in the photograph,
            bool [H, W]. Likely views should come first, because the search ends at the first better view that surely
            fits.

    Returns:
        The name of the best such view and its inlier ratio; None if no other view is better. A view is better if its
        inlier ratio is clearly larger, or about the same with a much smaller shift.
    """
    best: tuple[str, float] | None = None
    own = 0.0 if np.isnan(found.inlier_ratio) else found.inlier_ratio
    is_far = found.max_shift > FAR_SHIFT * max(picture.shape)
    for name, photo, hidden in others:
        size = (photo.shape[1], photo.shape[0])
        image = picture if picture.shape == photo.shape else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        match = register(image, photo, hidden, QUICK_SIDE)
        # If a view shows a plane, other views show the same points, all displaced alike, and fit as well. Then the view
        # to which the picture fits with the much smaller shift is the right one.
        as_well = is_far and match.inlier_ratio > own - 0.05 and match.max_shift < found.max_shift / 2
        if match.inlier_ratio >= LEAST_INLIER_RATIO and (match.inlier_ratio > own + CLEAR_MARGIN or as_well):
            best = (name, match.inlier_ratio) if best is None or match.inlier_ratio > best[1] else best
            if match.inlier_ratio > SURE_INLIER_RATIO:
                break
    return best


def warp(picture: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Resample the picture at the pixels of the photograph.

    Args:
        picture: uint8 [H, W, 3].
        moved: [2, 3], the affine map from pixels of the photograph to pixels of the picture.

    Returns:
        The resampled picture, uint8 [H, W, 3], and bool [H, W], the pixels that the map takes into the picture. At
        other pixels the border of the picture is repeated.
    """
    height, width = picture.shape[:2]
    linear, shift = moved[:, :2], moved[:, 2] + (moved[:, :2] - np.eye(2)) @ (0.5, 0.5)
    matrix = np.concatenate([linear, shift[:, None]], 1)  # OpenCV's origin is the center of the first pixel
    read = cv2.warpAffine(picture, matrix, (width, height), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
                          borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).astype(np.float32)
    at = pixels @ linear.T.astype(np.float32) + moved[:, 2].astype(np.float32)
    return read, np.all((at >= 0) & (at <= (width, height)), -1)


# ------------------------------------------------------------------------------------------------------- the parts


@dataclass(frozen=True)
class _Pair:
    """A picture and its photograph, reduced to the working size.

    Affine maps are called `moved` and lead from pixels of the photograph to pixels of the picture, at the working size.

    Attributes:
        picture, photo: uint8 [h, w, 3].
        known: bool [h, w], the pixels of the photograph that do not show the object.
        stride: [2], full-size pixels per working pixel, across and down.
    """

    picture: np.ndarray
    photo: np.ndarray
    known: np.ndarray
    stride: np.ndarray

    @classmethod
    def at(cls, picture: np.ndarray, photo: np.ndarray, known: np.ndarray, working: int) -> _Pair:
        """Reduce full-size arrays so that the longer side has at most `working` px."""
        full_size = np.array(photo.shape[1::-1])
        size = np.maximum(1, np.rint(full_size * min(1.0, working / full_size.max()))).astype(int)
        if (size == full_size).all():
            return cls(picture, photo, known, np.ones(2))
        reduce = lambda image: cv2.resize(image, size.tolist(), interpolation=cv2.INTER_AREA)
        return cls(reduce(picture), reduce(photo), reduce(known.astype(np.float32)) > 0.99, full_size / size)

    def judge(self, moved: np.ndarray) -> Registration:
        """Return the registration by a given map, [2, 3] at the working size, converted to full-size pixels."""
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
    def identity_comparison(self) -> tuple[np.ndarray, np.ndarray, tracks.Tracks]:
        """The result of `compare` for the identity."""
        return self._compare(self.picture, self.known)

    def compare(self, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray, tracks.Tracks]:
        """Compare the photograph with the picture after the picture is resampled by a map.

        Returns:
            Gain and offset, [3] each, which match the colors of the picture to the photograph's; and the tracks, from
            points of the photograph to the places where the resampled picture shows them.
        """
        if moved is IDENTITY:
            return self.identity_comparison
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
        )  # a plain photograph has too few points of its own, so those of the picture are tracked

    def starts(self) -> Iterator[np.ndarray]:
        """Yield initial maps: the identity, then a map from matched features, which can cover larger displacements."""
        yield IDENTITY
        if (found := _by_features(self.picture, self.photo, self.known)) is not None:
            yield found

    def refine(self, moved: np.ndarray) -> Registration | None:
        """Refine a map by the affine part of the displacements that remain after it, and return its registration.

        Returns:
            None if resizing and cropping cannot produce the refined map, if too few points are tracked, or if the map
            is the identity and needs no refinement.
        """
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
        """Return whether resizing and cropping can produce this map."""
        (a, b), (c, d) = moved[:, :2]
        scales = min(a, d) > LEAST_SCALE and max(a, d) < LARGEST_SCALE
        near = _shift(moved, self.known.shape) < LARGEST_SHIFT * max(self.known.shape)
        return bool(np.isfinite(moved).all() and scales and max(abs(b), abs(c)) < LARGEST_SHEAR and near)


def _is_better(found: Registration, best: Registration) -> bool:
    """Return whether `found` has a larger inlier ratio than `best`, or about the same and smaller displacements."""
    if found.inlier_ratio > best.inlier_ratio + 0.01 or np.isnan(best.inlier_ratio):
        return not np.isnan(found.inlier_ratio)
    return found.inlier_ratio > best.inlier_ratio - 0.01 and found.median_displacement < best.median_displacement


def _compose(first: np.ndarray, then: np.ndarray) -> np.ndarray:
    """Return [2, 3], the map that applies `then` and after it `first`."""
    # `then` leads from the photograph to the resampled picture, `first` from the resampled to the original picture.
    linear = first[:, :2] @ then[:, :2]
    return np.concatenate([linear, (first[:, :2] @ then[:, 2] + first[:, 2])[:, None]], 1)


def _shift(moved: np.ndarray, shape: tuple[int, ...]) -> float:
    """Return the largest distance, in px, by which the map moves a corner of an image of `shape` (height, width)."""
    height, width = shape
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)], np.float64)
    return float(np.linalg.norm(corners @ moved[:, :2].T + moved[:, 2] - corners, axis=1).max())


def _by_features(picture: np.ndarray, photo: np.ndarray, known: np.ndarray) -> np.ndarray | None:
    """Estimate the affine map from SIFT features, matched at `known` photograph pixels; None for too few matches."""
    finder = cv2.SIFT_create(1000)
    gray = lambda image: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    in_photo, of_photo = finder.detectAndCompute(gray(photo), known.astype(np.uint8))
    in_picture, of_picture = finder.detectAndCompute(gray(picture), None)
    if of_photo is None or of_picture is None or min(len(in_photo), len(in_picture)) < tracks.LEAST_PAIRS:
        return None
    pairs = [p for p in cv2.BFMatcher().knnMatch(of_photo, of_picture, k=2) if len(p) == 2]
    pairs = [first for first, second in pairs if first.distance < 0.75 * second.distance]
    if len(pairs) < tracks.LEAST_PAIRS:
        return None
    source = np.array([in_photo[p.queryIdx].pt for p in pairs]) + 0.5
    target = np.array([in_picture[p.trainIdx].pt for p in pairs]) + 0.5
    return tracks.estimate_affine(source, target, 2.0)
