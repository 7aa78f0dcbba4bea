"""Does a completed view that another tool wrote show its view? It is moved onto its photograph, and both are compared.

Pictures are uint8 [H, W, 3] of one size; affine maps are as in `tracks`. Only pixels outside the object are compared.
A picture of this view, redrawn by an autoencoder too, shows each place where the photograph does. Another view shows
places displaced by parallax, which no affine map explains; another scene does not show them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from reffusion.references import tracks
from reffusion.references.color import match_colors, recolor

WORKING = 512  # px, the longer side at which pictures are compared: no autoencoder redraws what is seen there
QUICK = 256  # px, the same where many views are compared
MARGIN = 0.01  # of the picture's width: pixels nearer to the object are not compared, its blurred edge lies there
IN_PLACE = 0.001  # of the longer side: a place displaced by less is where the photograph has it
LEAST_IN_PLACE = 0.5  # px of the working size, where that is less: flow is no finer
FEWEST = 20  # places; with fewer nothing can be said
ACCEPTED = 0.7  # share of the places that must be in place
SURE = 0.95  # share from which no other map is tried
REFINEMENTS = 3  # times that an affine map is estimated from what is left of the displacements
AS_WELL = 0.2  # px of the working size: a map that moves no corner further is the identity
UNTOUCHED = 1.5  # levels of 255: a median difference up to which a picture is the photograph outside the hole
SMALLEST, LARGEST = 0.8, 1.25  # scales a map may have: people resize and crop, they do not zoom
TURNED = 0.05  # radians of rotation and shear a map may have
FAR = 0.02  # of the longer side: a map that moves a corner by less may be another tool's shift
CLEARLY = 0.1  # share of places by which another view must be better
FARTHEST = 0.15  # of the longer side: by how far a map may move a corner

IDENTITY = np.eye(2, 3)


@dataclass(frozen=True)
class Registration:
    """How a picture lies over its photograph.

    Attributes:
        moved: [2, 3] affine map, from the photograph's pixels to the picture's; None where it lies as it should.
        shift: px, by how far the corner that moves most does.
        gain, offset: [3] each, colours in [0, 1]: photograph = gain * picture + offset; 1 and 0 where none is needed.
        places: number of places that were compared.
        in_place: share in [0, 1] of them that the picture shows where the photograph does; NaN with too few.
        displaced: px, median displacement of the places found; NaN where none was.
        untouched: it is the photograph outside the hole, to rounding.
    """

    moved: np.ndarray | None
    shift: float
    gain: np.ndarray
    offset: np.ndarray
    places: int
    in_place: float
    displaced: float
    untouched: bool

    @property
    def fits(self) -> bool:
        """Is it a picture of this view? Yes where nothing can be said."""
        return not self.in_place < ACCEPTED

    @property
    def misfit(self) -> str:
        """How badly it fits, in words."""
        moved = f"moved by up to {self.shift:.0f} px" if self.moved is not None else "as it lies"
        displaced = (
            "none of the others is found in it"
            if np.isnan(self.displaced)
            else f"the median displacement is {self.displaced:.1f} px"
        )
        return (
            f"{moved}, it shows {self.in_place:.0%} of {self.places} places around the hole where the photograph has "
            f"them (at least {ACCEPTED:.0%} must; {displaced})"
        )

    def __str__(self) -> str:
        if np.isnan(self.in_place):
            return "what it shows around the hole is too plain to be compared"
        moved = f"moved by up to {self.shift:.1f} px" if self.moved is not None else "not moved"
        brighter = (self.gain.mean() + self.offset.mean() - 1) * 100
        colors = f"colours matched ({brighter:+.0f} %)" if (self.gain != 1).any() or self.offset.any() else "as exposed"
        return (
            f"{moved}, {colors}; {self.in_place:.0%} of {self.places} places around the hole lie as in the photograph"
        )


def register(picture: np.ndarray, photo: np.ndarray, hidden: np.ndarray, working: int = WORKING) -> Registration:
    """Where the picture lies over the photograph, and its colours; as it lies, where that fits as well.

    Args:
        picture: the completed view, resized to the photograph's size.
        hidden: bool [H, W], where the object stands in the photograph.
        working: px, the longer side at which both are compared, where they are larger.
    """
    known = ~_widened(hidden, MARGIN)
    untouched = known.any() and np.median(np.abs(picture.astype(np.int16) - photo)[known]) <= UNTOUCHED
    pair = _Pair.at(picture, photo, known, working)
    best = as_it_lies = pair.judge(IDENTITY)
    if untouched and best.fits:
        return replace(best, moved=None, gain=np.ones(3), offset=np.zeros(3), untouched=True)
    for start in pair.starts():
        found = pair.refine(start)
        best = found if found is not None and _is_better(found, best) else best
        if best.in_place > SURE:
            break
    return best if best.shift > AS_WELL * pair.every.max() else replace(as_it_lies, moved=None)


def closer_view(
    picture: np.ndarray, found: Registration, others: Iterable[tuple[str, np.ndarray, np.ndarray]]
) -> tuple[str, float] | None:
    """The view that the picture shows rather than its own, and its share of places in place; None for no other.

    Args:
        found: how the picture lies over its own photograph.
        others: of other views the name, the photograph, and bool [H, W] where the object stands in it; likely ones
            first.
    """
    best: tuple[str, float] | None = None
    own = 0.0 if np.isnan(found.in_place) else found.in_place
    is_far = found.shift > FAR * max(picture.shape)
    for name, photo, hidden in others:
        size = (photo.shape[1], photo.shape[0])
        image = picture if picture.shape == photo.shape else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        there = register(image, photo, hidden, QUICK)
        # Of a plane other views show the same places, all displaced alike: then the one that need not be moved.
        as_well = is_far and there.in_place > own - 0.05 and there.shift < found.shift / 2
        if there.in_place >= ACCEPTED and (there.in_place > own + CLEARLY or as_well):
            best = (name, there.in_place) if best is None or there.in_place > best[1] else best
            if there.in_place > SURE:
                break
    return best


def warp(picture: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The picture as the photograph lies, and bool [H, W]: pixels that it has."""
    height, width = picture.shape[:2]
    linear, shift = moved[:, :2], moved[:, 2] + (moved[:, :2] - np.eye(2)) @ (0.5, 0.5)
    matrix = np.concatenate([linear, shift[:, None]], 1)  # OpenCV counts from the centre of the first pixel
    read = cv2.warpAffine(picture, matrix, (width, height), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
                          borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).astype(np.float32)
    at = pixels @ linear.T.astype(np.float32) + moved[:, 2].astype(np.float32)
    return read, ((at >= 0) & (at <= (width, height))).all(-1)


# ------------------------------------------------------------------------------------------------------- the parts


@dataclass(frozen=True)
class _Pair:
    """Both pictures at the working size.

    Attributes:
        picture, photo: uint8 [h, w, 3]; known: bool [h, w], pixels of the photograph without the object.
        every: [2] pixels of the given pictures from one of these to the next, across and down.
    """

    picture: np.ndarray
    photo: np.ndarray
    known: np.ndarray
    every: np.ndarray

    @classmethod
    def at(cls, picture: np.ndarray, photo: np.ndarray, known: np.ndarray, working: int) -> _Pair:
        given = np.array(photo.shape[1::-1])
        size = np.maximum(1, np.rint(given * min(1.0, working / given.max()))).astype(int)
        if (size == given).all():
            return cls(picture, photo, known, np.ones(2))
        reduce = lambda image: cv2.resize(image, size.tolist(), interpolation=cv2.INTER_AREA)
        return cls(reduce(picture), reduce(photo), reduce(known.astype(np.float32)) > 0.99, given / size)

    def judge(self, moved: np.ndarray) -> Registration:
        """What a map makes of the picture."""
        gain, offset, found = self.compare(moved)
        limit = max(IN_PLACE * max(self.known.shape), LEAST_IN_PLACE)
        places = len(found.points)
        in_place = float((found.lengths < limit).mean()) if places >= FEWEST else float("nan")
        displaced = float(np.median(found.lengths[found.tracked])) if found.tracked.any() else float("nan")
        every = self.every
        full = np.concatenate([moved[:, :2] * every[:, None] / every, (moved[:, 2] * every)[:, None]], 1)
        shift, displaced = (each * float(every.max()) for each in (_shift(moved, self.known.shape), displaced))
        return Registration(full, shift, gain, offset, places, in_place, displaced, untouched=False)

    @cached_property
    def as_it_lies(self) -> tuple[np.ndarray, np.ndarray, tracks.Tracks]:
        """`compare`, where the picture is not moved."""
        return self._compare(self.picture, self.known)

    def compare(self, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray, tracks.Tracks]:
        """(Gain, offset of the moved picture's colours, where it shows the places of the photograph)."""
        if moved is IDENTITY:
            return self.as_it_lies
        read, inside = warp(self.picture, moved)
        return self._compare(read, self.known & inside)

    def _compare(self, read: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray, tracks.Tracks]:
        gain, offset = match_colors(read, self.photo, known)
        there, here = (tracks.low_pass(_grey(image)) for image in (self.photo, recolor(read, gain, offset)))
        here = np.where(known, here, there)  # the hole and what is cropped off move nothing
        points = tracks.find_places(there, known)
        if len(points) >= FEWEST:
            return gain, offset, tracks.track(there, here, points)
        return gain, offset, tracks.track(here, there, tracks.find_places(here, known))  # of a plain photograph

    def starts(self) -> Iterator[np.ndarray]:
        """Maps to begin with: as it lies, then by features that look alike, for larger displacements."""
        yield IDENTITY
        if (found := _by_features(self.picture, self.photo, self.known)) is not None:
            yield found

    def refine(self, moved: np.ndarray) -> Registration | None:
        """The map with the affine part of what is left of the displacements; None for one that people do not make, and
        where nothing has to be moved."""
        for _ in range(REFINEMENTS):
            left = self.compare(moved)[2].affine()
            if left is None or (moved is IDENTITY and _shift(left, self.known.shape) < AS_WELL):
                return None
            moved = _compose(moved, left)
            if not self.is_plausible(moved):
                return None
            if _shift(left, self.known.shape) < AS_WELL / 4:
                break
        return self.judge(moved)

    def is_plausible(self, moved: np.ndarray) -> bool:
        """Is it a map that resizing and cropping makes?"""
        (a, b), (c, d) = moved[:, :2]
        scales = min(a, d) > SMALLEST and max(a, d) < LARGEST
        near = _shift(moved, self.known.shape) < FARTHEST * max(self.known.shape)
        return bool(np.isfinite(moved).all() and scales and max(abs(b), abs(c)) < TURNED and near)


def _is_better(found: Registration, best: Registration) -> bool:
    """Does it show more places where the photograph does, or as many, but nearer?"""
    if found.in_place > best.in_place + 0.01 or np.isnan(best.in_place):
        return not np.isnan(found.in_place)
    return found.in_place > best.in_place - 0.01 and found.displaced < best.displaced


def _compose(first: np.ndarray, then: np.ndarray) -> np.ndarray:
    """[2, 3] of `first` after `then`: photograph -> moved picture -> picture."""
    linear = first[:, :2] @ then[:, :2]
    return np.concatenate([linear, (first[:, :2] @ then[:, 2] + first[:, 2])[:, None]], 1)


def _shift(moved: np.ndarray, shape: tuple[int, ...]) -> float:
    height, width = shape
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)], np.float64)
    return float(np.linalg.norm(corners @ moved[:, :2].T + moved[:, 2] - corners, axis=1).max())


def _by_features(picture: np.ndarray, photo: np.ndarray, known: np.ndarray) -> np.ndarray | None:
    """A map by SIFT features that look alike; None where there are few."""
    finder = cv2.SIFT_create(1000)
    grey = lambda image: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    there, of_photo = finder.detectAndCompute(grey(photo), known.astype(np.uint8))
    here, of_picture = finder.detectAndCompute(grey(picture), None)
    if of_photo is None or of_picture is None or min(len(there), len(here)) < tracks.FEWEST_PAIRS:
        return None
    pairs = [p for p in cv2.BFMatcher().knnMatch(of_photo, of_picture, k=2) if len(p) == 2]
    pairs = [first for first, second in pairs if first.distance < 0.75 * second.distance]
    if len(pairs) < tracks.FEWEST_PAIRS:
        return None
    source = np.array([there[p.queryIdx].pt for p in pairs]) + 0.5
    target = np.array([here[p.trainIdx].pt for p in pairs]) + 0.5
    return tracks.estimate_affine(source, target, 2.0)


def _grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)


def _widened(mask: np.ndarray, fraction: float) -> np.ndarray:
    reach = max(1, round(fraction * mask.shape[1]))
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
