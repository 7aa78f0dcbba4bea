"""Candidates for a hole from the view's own photograph: shifts by which it repeats itself (He and Sun 2012).

The candidates are the photograph, shifted by the most frequent offsets between similar patches. A piece should come
from a surface of about the same orientation and depth as the surface in the hole. Large pieces continue paths and edges
from one side of the hole to the other, and keep grass as sharp as it is. Levels are colors in 0..255.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from reffusion import seeding
from reffusion.inpaint.plane_frames import invert_2x2
from reffusion.inpaint.poisson import interpolate
from reffusion.inpaint.shift_map.assemble import (
    INVALID_COST,
    MAX_COMPARED,
    Assembly,
    HolePixels,
    Options,
    Samples,
    assemble,
    erode_readable,
    hole_pixels,
    split_detail,
)
from reffusion.inpaint.source_image import SourceImage

# Offsets
MAX_PEAKS = 400  # most frequent offsets that are examined
MIN_PATCHES = 400  # patches that the photograph must have; with fewer there are no offsets
MAX_PATCHES, MAX_QUERIES = 12000, 6000  # patches that are compared; those for which a similar patch is sought
QUERY_BATCH = 1500  # queries whose distances to all patches are computed at a time
QUERY_JITTER = 40.0  # px, random amount added to the distance from the hole, by which the queries are ordered
ARM = 3  # px, distance between the nine points at which two patches are compared
MIN_OFFSET_SHARE = 1 / 8  # of the hole's width: nearer patches look alike because they overlap or touch
MIN_OFFSET_PX = 8.0  # px, lower bound of this distance
PEAK_SIGMA, PEAK_WINDOW = 1.5, 9  # px: blur of the histogram of offsets, and side of the window that has one peak
NORMAL_FEATURE = 30.0  # levels: weight of normals in the comparison of patches
MAX_OFFSETS = 60  # candidates of the cut
MIN_COVERAGE = 0.05  # share of the hole that a candidate must cover
# Costs of a pixel, in levels
NORMAL_COST = 20.0  # per squared difference of normals
STRETCH_COST, FREE_STRETCH = 40.0, 0.1  # per change of perspective on the same plane; a change up to the second is free
DEPTH_COST, FREE_OCTAVES = 12.0, 0.3  # per doubling of distance; a change up to the second, in doublings, is free
MAX_GEOMETRY_COST = 40.0  # limit of these three costs together, because the geometry in the hole is itself a guess
OFF_PLANE_COST = 15.0  # if a pixel on a plane is filled from a pixel that is not on this plane
TONE_COST, TONE_SIGMA_PX = 0.2, 6.0  # per difference from the tone around the hole; px, the blur that defines tone
OPTIONS = Options(
    ring_weight=3.0,
    color_weight=0.003,
    max_cost=INVALID_COST,
    max_median_cost=20.0,  # at a higher median cost the photograph shows nothing similar to the hole
)


def fill_from_photo(
    target: SourceImage, hole: np.ndarray, own: SourceImage, smooth: Sequence[int] = (), seed: int = 0
) -> Assembly:
    """Fill the hole of a view with shifted pieces of the view's own photograph, as far as suitable pieces exist.

    Args:
        target: the view. Pieces are copied from its image outside the hole. Its geometry is read everywhere.
        hole: bool [H, W], the pixels to fill.
        own: the view as a source of texture. Only its `usable`, `masked` and `layer` are read: pieces come from pixels
            that are usable and not masked.
        smooth: indices of the smooth planes. A pixel on one of them is not filled from another one.
        seed: seed of the random choice of patches that are compared.

    Returns:
        The picture, and the pixels that could be filled: none if the photograph shows nothing similar.
    """
    nothing = Assembly(target.image, np.zeros_like(hole), 0.0)
    if not hole.any():
        return nothing
    pixels = hole_pixels(target, hole, hole, np.ones_like(hole))
    shifts = _ShiftedPhoto.of(target, hole, own, smooth)
    features = np.concatenate([shifts.colors, NORMAL_FEATURE * target.normal], -1)
    distance = ndimage.distance_transform_edt(~hole)
    found = frequent_offsets(features, shifts.readable, distance, np.sqrt(hole.sum()), seed)
    shifts = shifts.with_offsets(found, pixels)
    if not len(shifts) or pixels.in_hole.all():
        return nothing
    layers = [target.layer == k for k in np.unique(target.layer[hole])]
    return assemble(target, hole, pixels, shifts, layers, OPTIONS)


@dataclass(frozen=True)
class _ShiftedPhoto:
    """The candidates: the view's own photograph, shifted by each of M offsets.

    Attributes:
        target: the view with the hole.
        colors, detail: [H, W, 3] float32, colors and detail of the photograph (`split_detail`).
        tone: [H, W, 3] float32, the blurred colors.
        hole_tone: [H, W, 3] float32, the tone, interpolated across the hole from its surroundings.
        readable: bool [H, W], the pixels of the photograph from which pieces may be taken.
        layer: int [H, W], the foreground layer that each pixel of the photograph shows.
        smooth_plane: int [H, W], the index of the smooth plane that each pixel of the target shows; 0 for none.
        offsets: [M, 2] int (rows, columns), the position from which a pixel is taken minus the pixel's own position.
    """

    target: SourceImage
    colors: np.ndarray
    detail: np.ndarray
    tone: np.ndarray
    hole_tone: np.ndarray
    readable: np.ndarray
    layer: np.ndarray
    smooth_plane: np.ndarray
    offsets: np.ndarray

    @classmethod
    def of(cls, target: SourceImage, hole: np.ndarray, own: SourceImage, smooth: Sequence[int]) -> _ShiftedPhoto:
        """Prepare the photograph, with an empty list of offsets; arguments as of `fill_from_photo`."""
        missing = hole | target.masked
        colors, detail = split_detail(target.image, missing)
        tone = _blur_known(colors, missing)
        readable = erode_readable(own, own.masked | missing)
        smooth_plane = np.where(np.isin(target.plane, smooth), target.plane, 0)
        hole_tone, none = _interpolate_tone(tone, hole, target), np.zeros((0, 2), int)
        return cls(target, colors, detail, tone, hole_tone, readable, own.layer, smooth_plane, none)

    def with_offsets(self, offsets: np.ndarray, pixels: HolePixels) -> _ShiftedPhoto:
        """Return candidates for those of the offsets [M, 2] that cover enough of the hole, at most `MAX_OFFSETS`.

        Args:
            offsets: [M, 2], the most frequent offsets first.
            pixels: pixels of the hole, on which coverage is tested (`MIN_COVERAGE`).
        """
        tried = _ShiftedPhoto(**{**vars(self), "offsets": offsets})
        inside = pixels.select(np.flatnonzero(pixels.in_hole)).spread(MAX_COMPARED)
        covers = [k for k in range(len(tried)) if (tried.costs(k, inside) < INVALID_COST).mean() >= MIN_COVERAGE]
        return _ShiftedPhoto(**{**vars(self), "offsets": offsets[covers[:MAX_OFFSETS]]})

    def __len__(self) -> int:
        return len(self.offsets)

    def sample(self, k: int, pixels: HolePixels) -> Samples:
        source, inside = self._source_pixels(k, pixels)
        return Samples(self.colors[source], self.detail[source], inside & self.readable[source])

    def costs(self, k: int, pixels: HolePixels) -> np.ndarray:
        """Return [N], the cost of each pixel if candidate k fills it.

        It is `INVALID_COST` where the photograph may not be used, or shows another foreground layer or smooth plane
        than the hole.
        """
        target, here = self.target, (pixels.rows, pixels.columns)
        source, valid = self._source_pixels(k, pixels)
        valid &= self.readable[source] & (self.layer[source] == target.layer[here])
        from_plane, to_plane = self.smooth_plane[source], self.smooth_plane[here]
        valid &= (from_plane == 0) | (to_plane == 0) | (from_plane == to_plane)
        geometry = NORMAL_COST * ((target.normal[source] - target.normal[here]) ** 2).sum(1)
        stretch = STRETCH_COST * np.maximum(_stretch(target, source, here) - FREE_STRETCH, 0)
        geometry += np.minimum(stretch, 2 * NORMAL_COST)
        octaves = np.abs(np.log2(target.pixel_size[source] / target.pixel_size[here]))
        cost = np.minimum(geometry + DEPTH_COST * np.maximum(octaves - FREE_OCTAVES, 0), MAX_GEOMETRY_COST)
        cost += OFF_PLANE_COST * ((target.plane[here] > 0) & (target.plane[source] != target.plane[here]))
        cost += TONE_COST * np.abs(self.tone[source] - self.hole_tone[here]).mean(1)
        return np.where(valid, cost, INVALID_COST)

    def _source_pixels(self, k: int, pixels: HolePixels) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Return where candidate k takes the pixels from, clipped to the photograph, and which positions are in it."""
        height, width = self.readable.shape
        row, column = pixels.rows + self.offsets[k][0], pixels.columns + self.offsets[k][1]
        inside = (row >= 0) & (column >= 0) & (row < height) & (column < width)
        return (row.clip(0, height - 1), column.clip(0, width - 1)), inside


def _stretch(target: SourceImage, source: tuple[np.ndarray, ...], here: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return how much a plane's perspective differs between two pixels, [N]; inf if the plane is seen edge on."""
    stretch = np.zeros(len(here[0]))
    on = (target.plane[here] > 0) & (target.plane[here] == target.plane[source])
    with np.errstate(invalid="ignore"):
        # Maps the same small step on the plane from one pixel to the other: the identity for the same perspective.
        change = invert_2x2(target.to_plane[source[0][on], source[1][on]]) @ target.to_plane[here[0][on], here[1][on]]
        stretch[on] = np.linalg.norm(change - np.eye(2), axis=(1, 2))
    return np.where(np.isfinite(stretch), stretch, np.inf)


def _blur_known(colors: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Return [H, W, 3], the tone: the mean of the colors around each pixel, without `missing` pixels, bool [H, W]."""
    known = (~missing).astype(np.float32)
    blur = lambda a: cv2.GaussianBlur(a, (0, 0), TONE_SIGMA_PX).reshape(*missing.shape, -1)
    return blur(colors * known[..., None]) / np.maximum(blur(known), 1e-3)


def _interpolate_tone(tone: np.ndarray, hole: np.ndarray, target: SourceImage) -> np.ndarray:
    """Return the tone [H, W, 3], interpolated across the hole in each foreground layer from the layer's own pixels."""
    result = tone.copy()
    for k in np.unique(target.layer[hole]):
        mine, beside = hole & (target.layer == k), ~hole & ~target.masked & (target.layer == k)
        if beside.any():
            result[mine] = interpolate(tone, mine, beside)
    return result


def frequent_offsets(
    features: np.ndarray, readable: np.ndarray, distance: np.ndarray, width: float, seed: int
) -> np.ndarray:
    """Find the most frequent offsets between similar patches of a picture.

    For patches near the hole the most similar other patch is sought, and the offsets to these are counted. Each offset
    is also counted in the opposite direction.

    Args:
        features: [H, W, C], the values by which patches are compared, in levels.
        readable: bool [H, W], the pixels that patches may cover.
        distance: [H, W], the distance of each pixel from the hole, in px.
        width: px, width of the hole. Patches nearer to each other than `MIN_OFFSET_SHARE` of it, or than
            `MIN_OFFSET_PX`, are not compared.
        seed: seed of the random choice of patches near the hole.

    Returns:
        [M, 2] int (rows, columns), the most frequent offset first; M = 0 if there are too few patches, or if
        all are too near to each other.
    """
    draws = np.random.default_rng(seeding.seed_for(seed, "offsets"))
    rows, columns = np.nonzero(ndimage.binary_erosion(readable, iterations=ARM + 1))
    if len(rows) < MIN_PATCHES:
        return np.zeros((0, 2), int)
    stride = max(1, int(np.sqrt(len(rows) / MAX_PATCHES)))
    some = (rows % stride == 0) & (columns % stride == 0)
    rows, columns = rows[some], columns[some]
    small = cv2.blur(features.astype(np.float32), (ARM, ARM))
    points = (-ARM, 0, ARM)
    patches = np.concatenate([small[rows + down, columns + right] for down in points for right in points], 1)
    order = distance[rows, columns] + draws.uniform(0, QUERY_JITTER, len(rows))
    queries = np.argsort(order, kind="stable")[:MAX_QUERIES]
    least = max(MIN_OFFSET_SHARE * width, MIN_OFFSET_PX)
    square, offsets = (patches**2).sum(1), []
    for batch in np.array_split(queries, -(-len(queries) // QUERY_BATCH)):
        difference = square - 2 * patches[batch] @ patches.T
        too_near = (rows[batch][:, None] - rows) ** 2 + (columns[batch][:, None] - columns) ** 2 < least**2
        difference[too_near] = np.inf
        comparable = ~too_near.all(1)
        compared, nearest = batch[comparable], difference.argmin(1)[comparable]
        offsets.append(np.stack([rows[nearest] - rows[compared], columns[nearest] - columns[compared]], 1))
    return _histogram_peaks(np.concatenate(offsets), readable.shape)


def _histogram_peaks(offsets: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the most frequent of the offsets (rows, columns) and of their opposites, most frequent first, [M, 2]."""
    height, width = shape
    count = np.zeros((2 * height + 1, 2 * width + 1), np.float32)
    np.add.at(count, (offsets[:, 0] + height, offsets[:, 1] + width), 1)
    count = cv2.GaussianBlur(count + count[::-1, ::-1], (0, 0), PEAK_SIGMA)
    row, column = np.nonzero((count == cv2.dilate(count, np.ones((PEAK_WINDOW, PEAK_WINDOW)))) & (count > 0))
    first = np.argsort(-count[row, column], kind="stable")[:MAX_PEAKS]
    return np.stack([row[first] - height, column[first] - width], 1)
