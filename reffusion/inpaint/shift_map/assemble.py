"""Fills a hole with a few large pieces of photographs, each moved by a candidate motion (after He and Sun 2012).

A graph cut chooses one candidate for each pixel, so that pieces meet where they look alike; Poisson blending removes
the seams. Where candidates come from is left to `photo_offsets` (shifts of the view's own photograph) and
`plane_motions` (photographs of a plane, moved by motions that map the plane onto itself).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from scipy import ndimage

from reffusion.inpaint.poisson import blend
from reffusion.inpaint.shift_map.expansion import expand, feature_distance, features, neighbor_pairs
from reffusion.inpaint.source_image import SourceImage

RING = 6  # px around the hole in which candidates are compared with the known picture
MAX_PIXELS = 15000  # that the cut works on: of a larger hole it takes every second, third, ... row and column
MAX_COMPARED = 800  # pixels, at most, in which single candidates are judged before the cut
MASK_MARGIN = 2  # px that a piece keeps away from masked pixels of its photograph
INVALID_COST = 500.0  # of a pixel that a candidate does not show
MAX_DIFFERENCE = 60.0  # levels of detail, a difference above which two pixels do not match at all
DETAIL_SIGMA = 0.015  # of the image's width: what changes over more is tone, which blending evens out


@dataclass(frozen=True)
class HolePixels:
    """N pixels of a hole and of the known ring around it.

    Attributes:
        rows, columns: [N] int.
        in_hole: bool [N].
        colors, detail: [N, 3] float32 of the known picture, see `split_detail`; meaningless in the hole.
    """

    rows: np.ndarray
    columns: np.ndarray
    in_hole: np.ndarray
    colors: np.ndarray
    detail: np.ndarray

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, which: np.ndarray) -> HolePixels:
        """The pixels of a mask, bool [N], or of indices, int [M]."""
        return HolePixels(*(each[which] for each in vars(self).values()))

    def spread(self, most: int) -> HolePixels:
        """At most `most` of the pixels, evenly spaced in reading order."""
        return self.select(np.linspace(0, len(self) - 1, min(len(self), most)).astype(int))

    def subsample(self) -> tuple[HolePixels, int]:
        """Every `stride`-th row and column, so that about `MAX_PIXELS` are left; and the stride, in px."""
        stride = max(1, int(np.ceil(np.sqrt(len(self) / MAX_PIXELS))))
        return self.select((self.rows % stride == 0) & (self.columns % stride == 0)), stride


@dataclass(frozen=True)
class Samples:
    """What a candidate shows at N pixels: colors and detail, [N, 3] float32 each, see `split_detail`; and where its
    photograph may be read, `valid`, bool [N]."""

    colors: np.ndarray
    detail: np.ndarray
    valid: np.ndarray


class Candidates(Protocol):
    """Photographs laid over the hole, each moved by one motion. Index k counts motions."""

    def __len__(self) -> int: ...

    def sample(self, k: int, pixels: HolePixels) -> Samples:
        """What candidate k shows at the pixels."""

    def costs(self, k: int, pixels: HolePixels) -> np.ndarray:
        """[N], cost of taking each pixel from candidate k; `INVALID_COST` where it must not be taken."""


@dataclass(frozen=True)
class Options:
    """How pieces are chosen and blended.

    Attributes:
        ring_weight: of the difference between a candidate and the known picture in the ring.
        color_weight: of the pieces' own colours in the Poisson blending, against their gradients.
        max_cost: pixels that cost as much or more take no candidate.
        max_median_cost: if half of the hole costs more, nothing is filled: no candidate suits it.
    """

    ring_weight: float = 1.0
    color_weight: float = 1e-3
    max_cost: float = np.inf
    max_median_cost: float = np.inf


@dataclass(frozen=True)
class Assembly:
    """A picture with its hole filled from pieces.

    Attributes:
        image: uint8 [H, W, 3].
        filled: bool [H, W], the pixels of the hole that pieces fill.
        cost: per pixel of the hole, in levels: differences along seams and from the ring, and the candidates' costs.
    """

    image: np.ndarray
    filled: np.ndarray
    cost: float


def split_detail(image: np.ndarray, masked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[H, W, 3] float32 each: an image's colours in levels, and their difference from the mean of the unmasked pixels
    around (`DETAIL_SIGMA`)."""
    known, colors = (~masked).astype(np.float32)[..., None], image.astype(np.float32)
    blur = lambda a: cv2.GaussianBlur(a, (0, 0), DETAIL_SIGMA * image.shape[1]).reshape(*a.shape[:2], -1)
    return colors, colors - blur(colors * known) / np.maximum(blur(known), 1e-3)


def erode_readable(source: SourceImage, masked: np.ndarray) -> np.ndarray:
    """bool [H, W], pixels of a source from which pieces may be taken: usable, and `MASK_MARGIN` away from `masked`."""
    return ndimage.binary_erosion(~masked, iterations=MASK_MARGIN) & source.usable


def hole_pixels(target: SourceImage, hole: np.ndarray, area: np.ndarray, allowed: np.ndarray) -> HolePixels:
    """Pixels of the hole and the unmasked ones around an `area` in it, bool [H, W], that are `allowed`, bool [H, W]."""
    near = ndimage.distance_transform_edt(~area) <= RING if area.any() else area
    rows, columns = np.nonzero(near & allowed & (hole | ~target.masked))
    values = split_detail(target.image, hole | target.masked)
    return HolePixels(rows, columns, *(each[rows, columns] for each in (hole, *values)))


def assemble(
    target: SourceImage,
    hole: np.ndarray,
    pixels: HolePixels,
    candidates: Candidates,
    regions: Sequence[np.ndarray],
    options: Options,
) -> Assembly:
    """The target with its hole, bool [H, W], filled from the candidates.

    Args:
        target: its image is read outside the hole only.
        pixels: of the hole and its ring, some of each.
        regions: bool [H, W] each, which cover the hole; no tone is blended from one into another.
    """
    coarse, stride = pixels.subsample()
    labels, cost = _choose(coarse, candidates, hole.shape, stride, options)
    grid = np.full(hole.shape, -1)
    grid[coarse.rows, coarse.columns] = labels
    nearest = ndimage.distance_transform_edt(grid < 0, return_distances=False, return_indices=True)
    labels = grid[tuple(nearest[:, pixels.rows, pixels.columns])]
    return Assembly(*_blend(target, hole, pixels, labels, candidates, regions, options.color_weight), cost)


def _choose(
    pixels: HolePixels, candidates: Candidates, shape: tuple[int, int], stride: int, options: Options
) -> tuple[np.ndarray, float]:
    """[N], the candidate that each pixel takes, `len(candidates)` for none; and the cost per pixel of the hole."""
    grid = pixels.rows, pixels.columns
    costs, looks = [], []
    for k in range(len(candidates)):
        samples = candidates.sample(k, pixels)
        costs.append(candidates.costs(k, pixels))
        looks.append(features(*grid, samples.colors, samples.detail, shape, stride))
    cost, look = np.array(costs), np.array(looks)
    known = features(*grid, pixels.colors, pixels.detail, shape, stride)
    off = options.ring_weight * np.minimum(feature_distance(look, known), 2 * MAX_DIFFERENCE)
    cost += np.where(pixels.in_hole | (cost >= INVALID_COST), 0, off)
    pairs = neighbor_pairs(*grid, shape, stride)
    labels = expand(cost, look, pairs)
    first, second = pairs.T
    seams = sum(feature_distance(look[labels[first], at], look[labels[second], at]).sum() for at in (first, second))
    paid = cost[labels, np.arange(len(labels))]
    unsuitable = np.median(paid[pixels.in_hole]) > options.max_median_cost
    labels = np.where((paid < options.max_cost) & ~unsuitable, labels, len(candidates))
    return labels, float((paid.sum() + seams) / pixels.in_hole.sum())


def _blend(
    target: SourceImage,
    hole: np.ndarray,
    pixels: HolePixels,
    labels: np.ndarray,
    candidates: Candidates,
    regions: Sequence[np.ndarray],
    color_weight: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The picture, uint8 [H, W, 3], whose gradients are nearest to those of the pieces, and the filled pixels, bool
    [H, W]. `labels`: [N], the candidate that each pixel takes."""
    window = tuple(slice(side.min(), side.max() + 1) for side in (pixels.rows, pixels.columns))
    at = tuple(side - part.start for side, part in zip((pixels.rows, pixels.columns), window, strict=True))
    inner = hole[window]
    own, covered = target.image[window].astype(np.float32), np.zeros_like(inner)
    gradients, counts = np.zeros((2, *own.shape), np.float32), np.zeros((2, *inner.shape), np.float32)
    for k in np.unique(labels[labels < len(candidates)]):
        samples = candidates.sample(k, pixels)
        piece, valid, mine = np.zeros_like(own), np.zeros_like(inner), np.zeros_like(inner)
        piece[at], valid[at], mine[at] = samples.colors, samples.valid, samples.valid & (labels == k)
        own[mine & inner], covered = piece[mine & inner], covered | mine
        for axis, (down, right) in enumerate(((0, 1), (1, 0))):
            before = (slice(None, -down or None), slice(None, -right or None))
            after = (slice(down, None), slice(right, None))
            for pixel in (mine[before], mine[after]):  # where two pieces meet, the mean of their gradients
                both = pixel & valid[before] & valid[after]
                gradients[axis][before][both] += (piece[after] - piece[before])[both]
                counts[axis][before] += both
    steps = gradients / np.maximum(counts, 1)[..., None]
    image, filled = target.image.copy(), np.zeros_like(hole)
    for region in regions:
        mine = inner & region[window] & covered
        if mine.any():
            beside = ~inner & region[window] & ~target.masked[window]
            colors = blend(own, mine, *steps, own, beside, color_weight)
            image[window][mine] = colors.clip(0, 255).round().astype(np.uint8)
            filled[window] |= mine
    return image, filled
