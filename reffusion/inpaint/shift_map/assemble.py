"""Assembly of a hole from a few large pieces of photographs (after He and Sun 2012).

A candidate is a photograph that is laid over the hole after a motion, for example a shift. A graph cut chooses one
candidate for each pixel, so that adjacent pieces meet where they look alike. Poisson blending then removes the seams.
The candidates come from `plane_motions`: photographs of a plane, moved by motions that map the plane's texture onto
itself.

Levels are colors in 0..255. The target is the view with the hole. The ring is a strip of known pixels around the hole,
in which candidates are compared with the known picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from reffusion.graph_cut import neighbor_pairs
from reffusion.inpaint.poisson import blend
from reffusion.inpaint.shift_map.expansion import choose_candidates, feature_distance, features
from reffusion.inpaint.source_image import SourceImage
from reffusion.morphology import masked_blur, nearest_known

if TYPE_CHECKING:
    from reffusion.inpaint.shift_map.plane_motions import PlaneMotions

RING = 6  # px, width of the ring
MAX_PIXELS = 15000  # pixels of the graph cut: in a larger hole only every second, third, ... row and column takes part
MAX_COMPARED = 800  # pixels, at most, on which single candidates are judged before the cut
MASK_MARGIN = 2  # px, distance that a piece keeps from masked pixels of its photograph
INVALID_COST = 500.0  # cost of a pixel that a candidate does not show
MAX_DIFFERENCE = 60.0  # levels: larger differences of detail count as this much
COLOR_WEIGHT = 3e-4  # of the pieces' colors in the Poisson blending, in which their gradients have weight 1
DETAIL_SIGMA = 0.015  # of the image's width: blur that separates detail from tone, which blending evens out


@dataclass(frozen=True)
class HolePixels:
    """N pixels of a hole and of the ring of known pixels around it.

    Attributes:
        rows, columns: [N] int, positions in the target.
        in_hole: bool [N], True for pixels of the hole, False for pixels of the ring.
        colors, detail: [N, 3] float32, colors and detail of the target (`split_detail`); meaningless in the hole.
    """

    rows: np.ndarray
    columns: np.ndarray
    in_hole: np.ndarray
    colors: np.ndarray
    detail: np.ndarray

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, which: np.ndarray) -> HolePixels:
        """Return the pixels that `which` selects: a mask, bool [N], or indices, int [M]."""
        return HolePixels(*(each[which] for each in vars(self).values()))

    def spread(self, most: int) -> HolePixels:
        """Return at most `most` of the pixels, evenly spaced in row-major order."""
        return self.select(np.linspace(0, len(self) - 1, min(len(self), most)).astype(int))

    def subsample(self) -> tuple[HolePixels, int]:
        """Return the pixels in every k-th row and column, and k, the stride in px.

        The stride is chosen so that about `MAX_PIXELS` pixels are left; with fewer pixels it is 1, and all are kept.
        """
        stride = max(1, int(np.ceil(np.sqrt(len(self) / MAX_PIXELS))))
        return self.select((self.rows % stride == 0) & (self.columns % stride == 0)), stride


@dataclass(frozen=True)
class Samples:
    """The appearance of a candidate at N pixels.

    Attributes:
        colors, detail: [N, 3] float32, see `split_detail`.
        valid: bool [N], True where the candidate's photograph may be used.
    """

    colors: np.ndarray
    detail: np.ndarray
    valid: np.ndarray


@dataclass(frozen=True)
class Assembly:
    """A picture whose hole is filled from pieces, as far as they suit.

    Attributes:
        image: uint8 [H, W, 3], the target's image, changed at the filled pixels only.
        filled: bool [H, W], the pixels of the hole that pieces fill.
    """

    image: np.ndarray
    filled: np.ndarray


def split_detail(image: np.ndarray, masked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the colors of an image in levels, and their detail, [H, W, 3] float32 each.

    The detail of a pixel is the difference of its color from the mean color of the unmasked pixels around
    (`DETAIL_SIGMA`).

    Args:
        image: uint8 [H, W, 3].
        masked: bool [H, W], pixels that do not count in the mean.
    """
    colors = image.astype(np.float32)
    return colors, colors - masked_blur(colors, ~masked, DETAIL_SIGMA * image.shape[1])


def erode_readable(source: SourceImage, masked: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the usable pixels of a source, without a margin of `MASK_MARGIN` px around `masked`.

    The same margin is left along the image's border. Pieces may be taken from the resulting pixels.

    Args:
        source: the source.
        masked: bool [H, W].
    """
    return ndimage.binary_erosion(~masked, iterations=MASK_MARGIN) & source.usable


def hole_pixels(target: SourceImage, hole: np.ndarray, area: np.ndarray, allowed: np.ndarray) -> HolePixels:
    """Select the pixels to fill and the ring around them.

    Args:
        target: the view with the hole.
        hole: bool [H, W].
        area: bool [H, W], the part of the hole to fill.
        allowed: bool [H, W], the pixels that may be selected.

    Returns:
        The allowed pixels within `RING` px of the area that lie in the hole or are not masked.
    """
    near = ndimage.distance_transform_edt(~area) <= RING if area.any() else area
    rows, columns = np.nonzero(near & allowed & (hole | ~target.masked))
    values = split_detail(target.image, hole | target.masked)
    return HolePixels(rows, columns, *(each[rows, columns] for each in (hole, *values)))


def assemble(
    target: SourceImage,
    hole: np.ndarray,
    pixels: HolePixels,
    candidates: PlaneMotions,
    region: np.ndarray,
) -> Assembly:
    """Fill the hole of the target from the candidates.

    Args:
        target: the view; its image is read outside the hole only.
        hole: bool [H, W].
        pixels: the pixels of the hole to fill, and pixels of its ring, at least one of each.
        candidates: the photographs from which pieces are taken, at least one.
        region: bool [H, W], the surface to fill. Colors of pixels beside it do not enter the blending.
    """
    coarse, stride = pixels.subsample()
    labels = _choose(coarse, candidates, hole.shape, stride)
    grid = np.full(hole.shape, -1)
    grid[coarse.rows, coarse.columns] = labels
    labels = grid[nearest_known(grid >= 0)][pixels.rows, pixels.columns]
    return Assembly(*_blend(target, hole, pixels, labels, candidates, region))


def _choose(pixels: HolePixels, candidates: PlaneMotions, shape: tuple[int, int], stride: int) -> np.ndarray:
    """Return each pixel's candidate, chosen by a graph cut."""
    grid = pixels.rows, pixels.columns
    costs, looks = [], []
    for k in range(len(candidates)):
        samples = candidates.sample(k, pixels)
        costs.append(candidates.costs(k, pixels))
        looks.append(features(*grid, samples.colors, samples.detail, shape, stride))
    cost, look = np.array(costs), np.array(looks)
    known = features(*grid, pixels.colors, pixels.detail, shape, stride)
    off = np.minimum(feature_distance(look, known), 2 * MAX_DIFFERENCE)
    cost += np.where(pixels.in_hole | (cost >= INVALID_COST), 0, off)
    index = np.full(shape, -1)
    index[grid] = np.arange(len(pixels))
    pairs, _ = neighbor_pairs(index, ((0, stride), (stride, 0)))
    return choose_candidates(cost, look, pairs)


def _blend(
    target: SourceImage,
    hole: np.ndarray,
    pixels: HolePixels,
    labels: np.ndarray,
    candidates: PlaneMotions,
    region: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the picture with the chosen pieces blended by their gradients, and the pixels that were filled."""
    window = tuple(slice(side.min(), side.max() + 1) for side in (pixels.rows, pixels.columns))
    at = tuple(side - part.start for side, part in zip((pixels.rows, pixels.columns), window, strict=True))
    inner = hole[window]
    own, covered = target.image[window].astype(np.float32), np.zeros_like(inner)
    gradients, counts = np.zeros((2, *own.shape), np.float32), np.zeros((2, *inner.shape), np.float32)
    for k in np.unique(labels):
        samples = candidates.sample(k, pixels)
        piece, valid, mine = np.zeros_like(own), np.zeros_like(inner), np.zeros_like(inner)
        piece[at], valid[at], mine[at] = samples.colors, samples.valid, samples.valid & (labels == k)
        own[mine & inner], covered = piece[mine & inner], covered | mine
        for axis, (down, right) in enumerate(((0, 1), (1, 0))):
            before = (slice(None, -down or None), slice(None, -right or None))
            after = (slice(down, None), slice(right, None))
            for pixel in (mine[before], mine[after]):  # where two pieces meet, their gradients are averaged
                both = pixel & valid[before] & valid[after]
                gradients[axis][before][both] += (piece[after] - piece[before])[both]
                counts[axis][before] += both
    steps = gradients / np.maximum(counts, 1)[..., None]
    image, filled = target.image.copy(), np.zeros_like(hole)
    mine = inner & region[window] & covered
    if mine.any():
        beside = ~inner & region[window] & ~target.masked[window]
        colors = blend(own, mine, *steps, own, beside, COLOR_WEIGHT)
        image[window][mine] = colors.clip(0, 255).round().astype(np.uint8)
        filled[window] |= mine
    return image, filled
