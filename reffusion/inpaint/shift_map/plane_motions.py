"""Candidates for a hole in a plane whose texture repeats itself: photographs of the plane, moved along the plane.

The motions are those that map the texture onto itself (`plane_symmetry`): shifts, or turns about a center. So joints
between planks continue straight, and circles about the center stay circles. Levels are colors in 0..255. The ring is
the strip of known pixels around the hole, in which candidates are compared with the known picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from reffusion.inpaint.shift_map.assemble import (
    INVALID_COST,
    MAX_COMPARED,
    MAX_DIFFERENCE,
    MAX_PIXELS,
    Assembly,
    HolePixels,
    Samples,
    assemble,
    erode_readable,
    hole_pixels,
    split_detail,
)
from reffusion.inpaint.shift_map.plane_symmetry import PlaneSymmetry
from reffusion.inpaint.source_image import SourceImage

MIN_PHOTO_PIXELS = MAX_PIXELS // 50  # pixels of the plane that a photograph must show to be used
HOMOGRAPHY_PIXELS = 1000  # pixels to which the homography of a photograph is fitted
MAX_CANDIDATES = 48  # motions from which the cut chooses; twice as many are refined
MIN_COVERAGE = 0.1  # share of the hole that a motion must cover
MIN_RING_PIXELS = 60  # pixels of the ring on which a motion must be compared
RING_WINDOW = 25  # px, side of the window within which motions compete for a part of the ring
REFINE_STEPS = (1.0, 0.5, 0.25)  # steps of the refinement, in units of the symmetry's resolution
SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))
BLUR_COST = 12.0  # levels: cost of a pixel per halving of the scale below `FULL_SCALE`
FULL_SCALE = 0.8  # source pixels per pixel of the hole (the scale), below which the pixel is blurred
MIN_SCALE, MAX_SCALE = 0.35, 3.0  # bounds of the scale, along any direction
OTHER_PHOTO_COST = 6.0  # levels: cost of a pixel from another photograph, whose light may differ
# Colors of the pieces have a low weight in the blending, because the surroundings of the hole tell better what the
# plane reflects there than the pieces do.


def fill_plane(
    target: SourceImage, hole: np.ndarray, sources: Sequence[SourceImage], plane: int, symmetry: PlaneSymmetry
) -> Assembly:
    """Fill the part of the hole that lies on one plane, from photographs of the plane that are moved along it.

    Args:
        target: the view; its image is read outside the hole only, its geometry everywhere.
        hole: bool [H, W], the pixels to fill; those on other planes stay unfilled.
        sources: photographs. The first of them that shows enough of the plane, usually the view's own, is preferred.
        plane: index of the plane in the sources and the target.
        symmetry: how the texture of the plane repeats itself.

    Returns:
        The target's picture with the filled pixels changed, and the filled pixels. No pixel is filled if no photograph
        shows enough of the plane, if too little of the plane is known around the hole, or if no motion suits.
    """
    nothing = Assembly(target.image, np.zeros_like(hole))
    on_plane = _without_specks(target.plane == plane)
    pixels = hole_pixels(target, hole, hole & on_plane, on_plane & (target.plane_xy != 0).any(-1))
    photos = [photo for source in sources if (photo := PlanePhoto.of(source, plane)) is not None]
    if not photos or not pixels.in_hole.any() or (~pixels.in_hole).sum() < MIN_RING_PIXELS:
        return nothing
    coarse, _ = pixels.subsample()
    candidates = _select_motions(coarse, PlaneMotions(target, photos, symmetry, []))
    return assemble(target, hole, pixels, candidates, on_plane) if len(candidates) else nothing


@dataclass(frozen=True)
class PlanePhoto:
    """A photograph of the plane.

    Attributes:
        colors, detail: [H, W, 3] float32, see `split_detail`.
        readable: bool [H, W], the pixels of the plane from which pieces may be taken.
        homography: [3, 3], from coordinates on the plane to pixels (x, y) of the photograph.
    """

    colors: np.ndarray
    detail: np.ndarray
    readable: np.ndarray
    homography: np.ndarray

    @classmethod
    def of(cls, source: SourceImage, plane: int) -> PlanePhoto | None:
        """Return the photograph of a plane that a source shows.

        Args:
            source: the image and its surfaces.
            plane: index of the plane.

        Returns:
            None if the source shows fewer than `MIN_PHOTO_PIXELS` usable pixels of the plane, or no homography fits.
        """
        on_plane = source.plane == plane
        readable = erode_readable(source, source.masked) & _without_specks(on_plane)
        rows, columns = np.nonzero(readable & on_plane)
        if len(rows) < MIN_PHOTO_PIXELS:
            return None
        some = np.linspace(0, len(rows) - 1, min(len(rows), HOMOGRAPHY_PIXELS)).astype(int)
        pixels = np.stack([columns[some], rows[some]], 1).astype(np.float64)
        homography, _ = cv2.findHomography(source.plane_xy[rows[some], columns[some]].astype(np.float64), pixels, 0)
        return None if homography is None else cls(*split_detail(source.image, source.masked), readable, homography)


@dataclass(frozen=True)
class Motion:
    """A motion of a photograph along the plane.

    Attributes:
        photo: index of the photograph.
        base: a motion of the symmetry: a shift, [2], or a turn, [1] in radians. The refinement may change a turn.
        shift: [2], in world units, a small shift that is applied after `base`. It refines the motion.
    """

    photo: int
    base: np.ndarray
    shift: np.ndarray


@dataclass(frozen=True)
class PlaneMotions:
    """The candidates: photographs of the plane, each moved by one motion.

    Attributes:
        target: the view with the hole.
        photos: the photographs; the first, usually the view's own, is preferred by a lower cost.
        symmetry: how the texture of the plane repeats itself.
        motions: the motion of each candidate.
    """

    target: SourceImage
    photos: Sequence[PlanePhoto]
    symmetry: PlaneSymmetry
    motions: Sequence[Motion]

    def __len__(self) -> int:
        return len(self.motions)

    def sample(self, k: int, pixels: HolePixels) -> Samples:
        """Return the appearance of candidate k at the pixels."""
        motion = self.motions[k]
        at, photo = self._source_pixels(motion, pixels), self.photos[motion.photo]
        return Samples(_sample(photo.colors, at), _sample(photo.detail, at), _is_set(photo.readable, at))

    def covers(self, motion: Motion, pixels: HolePixels) -> np.ndarray:
        """Return bool [N], True for the pixels at which the moved photograph shows the plane and may be used.

        The photograph's scale is not considered; see `costs`.
        """
        return _is_set(self.photos[motion.photo].readable, self._source_pixels(motion, pixels))

    def detail_difference(self, motion: Motion, pixels: HolePixels) -> tuple[np.ndarray, np.ndarray]:
        """Compare the detail (color minus local mean) of the moved photograph with that of the known picture.

        Args:
            motion: the motion of the photograph.
            pixels: N known pixels.

        Returns:
            The Euclidean difference over the three channels, in levels, [N], at most `MAX_DIFFERENCE`; and bool [N],
            True where the moved photograph shows the plane and may be used.
        """
        at, photo = self._source_pixels(motion, pixels), self.photos[motion.photo]
        difference = np.linalg.norm(_sample(photo.detail, at) - pixels.detail, axis=1)
        return np.minimum(difference, MAX_DIFFERENCE), _is_set(photo.readable, at)

    def costs(self, k: int, pixels: HolePixels) -> np.ndarray:
        """Return [N], the cost of each pixel if candidate k fills it.

        Pixels cost more if they would be blurred, or come from another photograph, whose light may differ. The cost is
        `INVALID_COST` where the candidate does not show the pixel, or shows it far too small or too large.
        """
        motion = self.motions[k]
        at = self._source_pixels(motion, pixels)
        low, high = self._scales(motion, pixels, at)
        cost = BLUR_COST * np.maximum(np.log2(FULL_SCALE / np.maximum(low, 1e-6)), 0)
        cost = cost + OTHER_PHOTO_COST * (motion.photo > 0)
        valid = _is_set(self.photos[motion.photo].readable, at) & (low > MIN_SCALE) & (high < MAX_SCALE)
        return np.where(valid, cost, INVALID_COST)

    def _moved(self, motion: Motion, pixels: HolePixels) -> np.ndarray:
        """Return [N, 2], the coordinates on the plane from which the motion takes each pixel."""
        coordinates = self.target.plane_xy[pixels.rows, pixels.columns].astype(np.float64)
        return self.symmetry.move(coordinates, motion.base) + motion.shift

    def _source_pixels(self, motion: Motion, pixels: HolePixels) -> np.ndarray:
        """Return [N, 2] float32, the position (x, y) in the photograph from which the motion takes each pixel."""
        at = cv2.perspectiveTransform(self._moved(motion, pixels)[None], self.photos[motion.photo].homography)[0]
        return at.clip(-1e6, 1e6).astype(np.float32)

    def _scales(self, motion: Motion, pixels: HolePixels, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and largest number [N] of source pixels, at `at`, that a pixel spans in any direction."""
        moved, homography = self._moved(motion, pixels), self.photos[motion.photo].homography
        weight = moved @ homography[2, :2] + homography[2, 2]
        jacobian = (homography[None, :2, :2] - at[:, :, None] * homography[2, :2]) / weight[:, None, None]
        change = jacobian @ self.symmetry.rotation(motion.base) @ self.target.to_plane[pixels.rows, pixels.columns]
        area, square = np.abs(np.linalg.det(change)), (change**2).sum((1, 2))
        high = np.sqrt((square + np.sqrt(np.maximum(square**2 - 4 * area**2, 0))) / 2)
        return area / np.maximum(high, 1e-12), high


def _select_motions(pixels: HolePixels, candidates: PlaneMotions) -> PlaneMotions:
    """Select and refine the motions that match the ring best; the motions of `candidates` are ignored."""
    ring = pixels.select(~pixels.in_hole).spread(MAX_COMPARED)
    inside = pixels.select(pixels.in_hole).spread(MAX_COMPARED)
    motions = [
        Motion(number, motion, np.zeros(2))
        for number in range(len(candidates.photos))
        for motion in candidates.symmetry.motions
    ]
    motions = [motion for motion in motions if candidates.covers(motion, inside).mean() >= MIN_COVERAGE]
    # each motion may match another part of the ring
    motions = _best_motions(ring, motions, candidates, 2 * MAX_CANDIDATES)
    motions = [_refine_motion(ring, motion, candidates) for motion in motions]
    return replace(candidates, motions=_best_motions(ring, motions, candidates, MAX_CANDIDATES))


def _refine_motion(ring: HolePixels, motion: Motion, candidates: PlaneMotions) -> Motion:
    """Shift the motion a little, and turn it a little about the center if there is one, to match the ring best."""
    symmetry = candidates.symmetry

    def misfit(motion: Motion) -> float:
        difference, valid = candidates.detail_difference(motion, ring)
        return float(difference[valid].mean()) if valid.sum() >= MIN_RING_PIXELS / 2 else np.inf

    radius = 1.0
    if symmetry.center is not None:
        from_center = candidates.target.plane_xy[ring.rows, ring.columns] - symmetry.center
        radius = float(np.median(np.linalg.norm(from_center, axis=1)))
    least = misfit(motion)
    for step in REFINE_STEPS:
        size = step * symmetry.resolution
        for _ in range(2):
            tried = [Motion(motion.photo, motion.base, motion.shift + size * np.array(to)) for to in SIDES]
            if symmetry.center is not None:
                turned = [motion.base + turn * size / radius for turn in (-1, 1)]
                tried += [Motion(motion.photo, each, motion.shift) for each in turned]
            misfits = [misfit(each) for each in tried]
            if min(misfits) < least:
                least, motion = min(misfits), tried[int(np.argmin(misfits))]
    return motion


def _best_motions(ring: HolePixels, motions: Sequence[Motion], candidates: PlaneMotions, most: int) -> list[Motion]:
    """Choose greedily up to `most` motions that together match the ring best."""
    top, left = ring.rows.min(), ring.columns.min()
    shape = (ring.rows.max() - top + 1, ring.columns.max() - left + 1)
    at = ring.rows - top, ring.columns - left
    blur = lambda a: cv2.blur(a, (RING_WINDOW, RING_WINDOW), borderType=cv2.BORDER_CONSTANT)[at]
    means = []
    for motion in motions:
        difference, valid = candidates.detail_difference(motion, ring)
        if valid.sum() < MIN_RING_PIXELS:
            difference[:] = MAX_DIFFERENCE
        total, count = np.zeros((2, *shape), np.float32)
        total[at], count[at] = np.where(valid, difference, MAX_DIFFERENCE), 1
        means.append(blur(total) / np.maximum(blur(count), 1e-6))
    chosen: list[int] = []
    local, least = np.array(means), np.full(len(ring), MAX_DIFFERENCE)
    for _ in range(min(most, len(motions))):
        # a motion gains wherever it matches a window of the ring better than all motions chosen before
        gain = np.maximum(least - local, 0).sum(1) - 1e-3 * local.mean(1)
        gain[chosen] = -np.inf
        chosen.append(int(gain.argmax()))
        least = np.minimum(least, local[chosen[-1]])
    return [motions[k] for k in chosen]


def _without_specks(mask: np.ndarray) -> np.ndarray:
    """Return the mask, bool [H, W], without specks and gaps of a pixel or two."""
    return cv2.medianBlur(mask.astype(np.uint8), 5) > 0


def _is_set(mask: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the mask at the pixels nearest to (x, y), [N]; False outside and on its outermost pixels."""
    height, width = mask.shape
    column, row = np.round(at).astype(int).T
    inside = (row >= 1) & (column >= 1) & (row < height - 1) & (column < width - 1)
    inside[inside] = mask[row[inside], column[inside]]
    return inside


def _sample(picture: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return [N, 3], the values of a picture at positions (x, y), float32 [N, 2], by bicubic interpolation."""
    grid = np.full((-(-len(at) // 1024) * 1024, 2), -1, np.float32)  # cv2.remap takes no side above 32767
    grid[: len(at)] = at
    x, y = (np.ascontiguousarray(grid[:, axis]).reshape(-1, 1024) for axis in (0, 1))
    return cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).reshape(-1, 3)[: len(at)]
