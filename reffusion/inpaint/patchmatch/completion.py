"""Completion of a hole with patches of photographs, from coarse to fine.

The method is PatchMatch with voting (after Wexler et al. 2007, Barnes et al. 2009, Newson et al. 2017). Patches follow
the perspective of planes (after Huang et al. 2014), and are blended by their gradients. Every color comes from a
source image; no weights are needed.

PAPER leaves open: who inpaints the reference (it shows results of several tools, and of people).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage

from reffusion import seeding
from reffusion.inpaint.classical import blank_hole, telea
from reffusion.inpaint.patchmatch import search, voting
from reffusion.inpaint.patchmatch.matches import NO_MATCH, PATCH_RADIUS, Hole, Matches, Positions, PyramidLevel, Sources
from reffusion.inpaint.plane_frames import invert_2x2
from reffusion.inpaint.poisson import blend
from reffusion.inpaint.source_image import SourceImage
from reffusion.io.images import to_gray
from reffusion.morphology import nearest_known

COARSEST_WIDTH = 40.0  # px, largest width of the hole at the coarsest level, where its content is laid out
SINGLE_LEVEL_WIDTH = 16.0  # px: a wider hole has at least two levels
# Weights of the features by which patches are compared, beside the colors in levels of 255
ROUGHNESS_WEIGHT = 2.0  # of the local mean gradient, which distinguishes gravel from a wall of the same color
PLANE_FEATURE = 50.0  # levels by which two smooth planes differ
CHANNELS, VOTED = 6, 5  # features; the first ones, on which patches vote, since the others are known in the hole too
ROUGHNESS_WINDOW = 15  # px, side of the window of the local mean gradient
TRUST_FALLOFF = 1.2  # factor by which trust falls with each pixel inwards from the hole's border
MIN_TRUST = 0.02
MASK_MARGIN = 1.5  # in units of PATCH_RADIUS: distance that the center of a patch keeps from masked pixels
MIN_PLACES = 200  # patches that the sources must offer at a level; if the finest has fewer, Telea's method is used
FIRST_ROUNDS, FIRST_TRIES = 3, 60  # rounds of search, and random tries per pixel, of the first layout
TRIES = 20  # random tries per pixel at the coarsest level; a fifth of it at all others
ROUNDS = (8, 5, 3)  # rounds of search and vote at the coarsest level, at the levels between, and at the finest
NO_SPREAD = 1e12  # spread of misfit with which all patches vote alike


@dataclass(frozen=True)
class Completion:
    """An image with its hole filled.

    Attributes:
        image: uint8 [H, W, 3].
        misfit: how badly the patches fit on the whole: the mean of their misfits (`search.misfit`), in which pixels
            near the hole's border weigh most and pixels without a patch are left out. Of several completions of one
            hole, the one with the least misfit mostly looks best. The value is `NO_MATCH` if there were too few patches
            and Telea's method filled the hole, or if no pixel has a patch, and 0 if the hole is empty.
    """

    image: np.ndarray
    misfit: float


def complete(
    target: SourceImage, hole: np.ndarray, sources: Sequence[SourceImage], smooth: Sequence[int] = (), seed: int = 0
) -> Completion:
    """Fill the hole of a view with patches of source images.

    Args:
        target: the view; its image is read outside the hole only.
        hole: bool [H, W], the pixels to fill.
        sources: images from which patches are taken, at least one; the view's own photograph may be among them.
        smooth: indices of the smooth planes, whose perspective patches follow. On rough ground this would smear grass.
        seed: seed of the random search.
    """
    if not hole.any():
        return Completion(target.image.copy(), 0.0)
    target = replace(target, image=blank_hole(target.image, hole))
    pyramid = _build_pyramid(target, hole, sources, smooth)
    if not pyramid:
        return Completion(telea(target.image, hole), float(NO_MATCH))
    state = np.array([seeding.seed_for(seed, "texture") | 1], np.uint64)
    matches: Matches | None = None
    coarser: Hole | None = None
    for k, (current, mask, level_sources) in enumerate(pyramid):
        first, last = k == 0, k == len(pyramid) - 1
        hole_pixels = _gather_hole(target, mask, 2 ** (len(pyramid) - 1 - k), smooth, level_sources)
        level = PyramidLevel(hole_pixels, level_sources, current, _trust(mask))
        positions = _patch_positions(level_sources, int(hole_pixels.plane.max()))
        if matches is None or coarser is None:  # the coarsest level
            matches = _first_layout(level, mask, positions, state)
        else:
            matches = _from_coarser(matches, coarser, level)
            _vote(level, matches, level.weight, NO_SPREAD)
        rounds, todo = ROUNDS[0] if first else ROUNDS[2] if last else ROUNDS[1], np.arange(len(hole_pixels.row))
        for turn in range(rounds):
            search.search(todo, 2, TRIES if first else TRIES // 5, matches, level, positions, state)
            if not last or turn < rounds - 1:
                _vote(level, matches, level.weight, max(float(np.median(matches.misfit)), 1.0))
        coarser = hole_pixels
    assert matches is not None
    weight = level.weight[hole_pixels.row, hole_pixels.column] * (matches.misfit < NO_MATCH)
    misfit = float((matches.misfit * weight).sum() / weight.sum() if weight.any() else NO_MATCH)
    return Completion(_blend_patches(target.image, hole, level, matches), misfit)


def _blend_patches(image: np.ndarray, hole: np.ndarray, level: PyramidLevel, matches: Matches) -> np.ndarray:
    """Return the image, uint8 [H, W, 3], with the hole filled without seams by the patches' gradients."""
    own = level.current[..., :3].copy()  # becomes the color at the center of each pixel's patch
    right, below = np.zeros_like(own), np.zeros_like(own)
    count_right, count_below = np.zeros(hole.shape, np.float32), np.zeros(hole.shape, np.float32)
    voting.gather_gradients(matches, level.hole, level.sources, right, below, count_right, count_below, own)
    right, below = right / np.maximum(count_right, 1)[..., None], below / np.maximum(count_below, 1)[..., None]
    # the range of the colors at the centers of the patches and outside the hole
    low, high = own.min((0, 1)), own.max((0, 1))
    picture = image.copy()
    colors = blend(level.current[..., :3], hole, right, below, own)
    picture[hole] = colors.clip(low, high).round().astype(np.uint8)
    return picture


def _build_pyramid(
    target: SourceImage, hole: np.ndarray, sources: Sequence[SourceImage], smooth: Sequence[int]
) -> list[tuple[np.ndarray, np.ndarray, Sources]]:
    """Return for each level, coarsest first, features, hole and sources; [] if the finest level has few patches."""
    width = 2 * _distance_inside(hole).max()
    count = 1 + int(np.ceil(np.log2(max(width / COARSEST_WIDTH, 2.0 if width > SINGLE_LEVEL_WIDTH else 1.0))))
    current, mask, scale = _color_features(target.image, hole), hole, 1
    images = [(_color_features(source.image, source.masked), source.masked) for source in sources]
    pyramid = []
    for _ in range(count):
        values = [
            _with_geometry(each, source, smooth, scale) for (each, _), source in zip(images, sources, strict=True)
        ]
        level_sources = _stack_sources(values, [masked for _, masked in images], sources, scale)
        if (level_sources.plane >= 0).sum() < MIN_PLACES:
            break
        pyramid.append((_with_geometry(current, target, smooth, scale), mask, level_sources))
        current, mask = _halve(current, mask)
        images = [_halve(values, masked) for values, masked in images]
        scale *= 2
    return pyramid[::-1]


def _color_features(image: np.ndarray, masked: np.ndarray) -> np.ndarray:
    """Return colors and roughness along x and y, float32 [H, W, 5]; masked pixels take the nearest color."""
    if masked.any() and not masked.all():
        image = image[nearest_known(~masked)]
    gray = to_gray(image)
    known = cv2.erode((~masked).astype(np.float32), np.ones((3, 3)))
    window = (ROUGHNESS_WINDOW, ROUGHNESS_WINDOW)
    mass = np.maximum(cv2.blur(known, window), 1e-3)
    # roughness is the local mean of the absolute gradient of the gray image
    gradient = [cv2.blur(np.abs(cv2.Scharr(gray, -1, *way)) / 16 * known, window) / mass for way in ((1, 0), (0, 1))]
    return np.concatenate([image.astype(np.float32), ROUGHNESS_WEIGHT * np.stack(gradient, -1)], -1)


def _with_geometry(values: np.ndarray, source: SourceImage, smooth: Sequence[int], scale: int) -> np.ndarray:
    """Append a channel for the plane to features [h, w, 5] at full size divided by `scale`."""
    of_plane = np.zeros(max([*smooth, int(source.plane.max())]) + 1, np.float32)
    of_plane[list(smooth)] = PLANE_FEATURE * np.arange(1, len(smooth) + 1)
    # A patch that covers the edge between two surfaces must show the same edge.
    marks = cv2.medianBlur(of_plane[source.plane], 5)[..., None]
    return np.concatenate([values, marks[::scale, ::scale]], -1)


def _halve(values: np.ndarray, masked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Halve features, averaged over pixels that are not masked, and a mask, True where any part was; sizes round up."""
    even = lambda a: np.pad(a, [(0, a.shape[0] % 2), (0, a.shape[1] % 2)] + [(0, 0)] * (a.ndim - 2), mode="edge")
    values, known = even(values), even((~masked).astype(np.float32))
    size = (known.shape[1] // 2, known.shape[0] // 2)
    share = cv2.resize(known, size, interpolation=cv2.INTER_AREA)
    small = cv2.resize(values * known[..., None], size, interpolation=cv2.INTER_AREA)
    return small / np.maximum(share, 1e-3)[..., None], share < 0.999


def _stack_sources(
    values: Sequence[np.ndarray], masks: Sequence[np.ndarray], sources: Sequence[SourceImage], scale: int
) -> Sources:
    """Collect the sources of one level, full size divided by `scale`, in common arrays."""
    height, width = (max(masked.shape[axis] for masked in masks) for axis in (0, 1))
    shape = (len(masks), height, width)
    stack = Sources(
        np.zeros((*shape, CHANNELS), np.float32), np.full(shape, -1, np.int32), np.zeros((*shape, 4), np.float32),
        np.ones(shape, np.float32),
    )  # fmt: skip
    for k, (features, masked, source) in enumerate(zip(values, masks, sources, strict=True)):
        here = (k, slice(masked.shape[0]), slice(masked.shape[1]))
        every = (slice(None, None, scale),) * 2
        clear = ndimage.distance_transform_edt(np.pad(~masked, 1))[1:-1, 1:-1] > MASK_MARGIN * PATCH_RADIUS
        stack.values[here] = features
        stack.plane[here] = np.where(clear & source.usable[every], source.plane[every], -1)
        stack.to_pixels[here] = invert_2x2(scale * source.to_plane[every]).reshape(*masked.shape, 4)
        stack.pixel_size[here] = scale * source.pixel_size[every]
    return stack


def _gather_hole(target: SourceImage, mask: np.ndarray, scale: int, smooth: Sequence[int], sources: Sources) -> Hole:
    """Collect the pixels of the hole at one level, full size divided by `scale`, with their geometry."""
    rows, columns = (np.ascontiguousarray(each) for each in np.nonzero(mask))
    index = np.full(mask.shape, -1)
    index[rows, columns] = np.arange(len(rows))
    at = np.minimum(rows * scale, target.plane.shape[0] - 1), np.minimum(columns * scale, target.plane.shape[1] - 1)
    plane = target.plane[at].astype(np.int32)
    # patches follow the smooth planes of which the sources show enough
    followed = [k for k in smooth if (sources.plane == k).sum() >= MIN_PLACES]
    to_plane = (scale * target.to_plane[at]).reshape(-1, 4).astype(np.float32)
    pixel_size = (scale * target.pixel_size[at]).astype(np.float32)
    return Hole(rows, columns, index, plane, np.isin(plane, followed), to_plane, pixel_size)


def _patch_positions(sources: Sources, last_plane: int) -> Positions:
    """List all places at which patches may have their center, then those on each plane up to index `last_plane`."""
    places = np.argwhere(sources.plane >= 0).astype(np.int32)
    plane = sources.plane[tuple(places.T)]
    parts = [places] + [places[plane == k] for k in range(1, last_plane + 1)]
    places = np.ascontiguousarray(np.concatenate(parts))
    return Positions(places, np.cumsum([0] + [len(part) for part in parts]))


def _trust(mask: np.ndarray) -> np.ndarray:
    """Return the weight of each pixel in comparisons and votes: 1 outside the hole, falling inwards from its border."""
    return np.where(mask, np.maximum(TRUST_FALLOFF ** -_distance_inside(mask), MIN_TRUST), 1).astype(np.float32)


def _first_layout(level: PyramidLevel, mask: np.ndarray, positions: Positions, state: np.ndarray) -> Matches:
    """Find the matches at the coarsest level and fill `level.current` in place, ring by ring from the hole's border."""
    row, column, trust = level.hole.row, level.hole.column, level.weight
    count = len(row)
    zeros = lambda kind: np.zeros(count, kind)
    source, misfit = np.full(count, -1, np.int32), np.full(count, NO_MATCH, np.float32)
    matches = Matches(source, zeros(np.float32), zeros(np.float32), zeros(np.float32), zeros(bool), misfit)
    # the patches of a ring are compared only with pixels outside it, which are known or already filled
    level = level._replace(weight=np.where(mask, 0, 1).astype(np.float32))
    ring = np.ceil(_distance_inside(mask))[row, column]
    for k in range(1, int(ring.max()) + 1):
        todo = np.flatnonzero(ring == k)
        search.search(todo, FIRST_ROUNDS, FIRST_TRIES, matches, level, positions, state)
        _vote(level, matches, trust, max(2 * float(np.percentile(matches.misfit[todo], 75)), 1.0), todo)
        level.weight[row[todo], column[todo]] = trust[row[todo], column[todo]]
    return matches


def _from_coarser(matches: Matches, coarser: Hole, level: PyramidLevel) -> Matches:
    """Convert the matches of the coarser level to this level: each pixel inherits the match of its coarser pixel."""
    (height, width), hole = coarser.index.shape, level.hole
    row, column = np.minimum(hole.row // 2, height - 1), np.minimum(hole.column // 2, width - 1)
    parent = coarser.index[row, column]
    result = Matches(*(each[parent].copy() for each in matches))
    result = result._replace(along_plane=result.along_plane & hole.along_plane)
    voting.upsample_matches(result, coarser.row[parent], coarser.column[parent], hole, level.sources)
    return result


def _vote(
    level: PyramidLevel, matches: Matches, trust: np.ndarray, spread: float, todo: np.ndarray | None = None
) -> None:
    """Vote on the first `VOTED` channels of the hole pixels `todo` (None: all), and write them to `level.current`."""
    todo, voted = np.arange(len(level.hole.row)) if todo is None else todo, level.current.copy()
    # the weight of a patch falls by a factor of e per `spread` of misfit
    voting.vote(todo, matches, level.hole, trust, level.sources, spread, voted)
    level.current[..., :VOTED] = voted[..., :VOTED]  # the geometry is known in the hole too


def _distance_inside(mask: np.ndarray) -> np.ndarray:
    """Return the distance of each masked pixel from the outside of the mask, px; beyond the image is outside."""
    return ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
