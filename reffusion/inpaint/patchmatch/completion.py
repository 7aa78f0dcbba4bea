"""A hole completed from patches of photographs, coarse to fine.

PatchMatch with votes (after Wexler et al. 2007, Barnes et al. 2009, Newson et al. 2017), patches carried along planes
(after Huang et al. 2014), blended by their gradients. Nothing new is invented, and nothing is downloaded.

PAPER leaves open: who inpaints the reference (it shows results of several tools, and of people).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage

from reffusion import seeding
from reffusion.inpaint.classical import blanked, telea
from reffusion.inpaint.patchmatch import search, voting
from reffusion.inpaint.patchmatch.matches import NONE, PATCH, Choice, Compared, Hole, Match, Pictures
from reffusion.inpaint.plane_frames import inverse
from reffusion.inpaint.poisson import blended
from reffusion.inpaint.source_image import Shown

COARSEST = 40.0  # px that the hole may be wide at the coarsest level: there its parts are laid out
SMALL = 16.0  # px: a wider hole has two levels at least
ROUGHNESS = 2.0  # weight of the local mean gradient beside the colours: what tells gravel from a wall of its colour
APART = 50.0  # difference of two planes beside that of colours
BEFORE = 75.0  # the same, of what stands before the rest
LIES = 40.0  # the same, of normals, by their difference
CHANNELS, VOTED = 9, 5  # of what is compared, and the first of them, which patches say; the others are known
AROUND = 15  # px, a side of the window of that mean
FADING = 1.2  # factor by which trust falls with each pixel from the hole's border
LEAST_TRUST = 0.02
CLEAR = 1.5  # times PATCH: how far from what is masked a patch's middle must lie
FEWEST = 200  # places for patches: with fewer there is no coarser level, or Telea's method instead
RINGS, TRIES = (3, 60), 20  # rounds and tries anywhere of the first layout, and tries of what follows
ROUNDS = (8, 5, 3)  # of search and vote: at the coarsest level, between, at the finest


@dataclass(frozen=True)
class Completed:
    """A picture with its hole filled, uint8 [H, W, 3], and how badly its patches fit on the whole: of several, the one
    with the least is the best to look at, mostly."""

    image: np.ndarray
    misfit: float


def complete(
    target: Shown, hole: np.ndarray, sources: Sequence[Shown], smooth: Sequence[int] = (), seed: int = 0
) -> Completed:
    """The target with its hole filled by patches of the sources, which may be the target itself.

    Args:
        target: its image is read outside the hole only. hole: bool [H, W].
        smooth: numbers of the planes along which patches are carried; on rough ground that would smear grass.
        seed: of the search.
    """
    if not hole.any():
        return Completed(target.image.copy(), 0.0)
    target = replace(target, image=blanked(target.image, hole))
    levels = _levels(target, hole, sources, smooth)
    if not levels:
        return Completed(telea(target.image, hole), float(NONE))
    state = np.array([seeding.seed_for(seed, "texture") | 1], np.uint64)
    match = before = None
    for k, (now, mask, pictures) in enumerate(levels):
        first, last = k == 0, k == len(levels) - 1
        pixels = _pixels(target, mask, 2 ** (len(levels) - 1 - k), smooth, pictures)
        of = Compared(pixels, pictures, now, _trust(mask))
        choice = _choice(pictures, int(pixels.surface.max()))
        if first:
            match = _laid_out(of, mask, choice, state)
        else:
            match = _from_coarser(match, before, of)
            _voted(of, match, of.weight, 1e12)
        rounds, todo = ROUNDS[0] if first else ROUNDS[2] if last else ROUNDS[1], np.arange(len(pixels.row))
        for turn in range(rounds):
            search.search(todo, 2, TRIES if first else TRIES // 5, match, of, choice, state)
            if not last or turn < rounds - 1:
                _voted(of, match, of.weight, max(float(np.median(match.misfit)), 1.0))
        before = pixels
    weight = of.weight[pixels.row, pixels.column] * (match.misfit < NONE)
    fitted = float((match.misfit * weight).sum() / max(weight.sum(), 1e-6))
    return Completed(_finished(target.image, hole, of, match), fitted)


def _finished(image: np.ndarray, hole: np.ndarray, of: Compared, match: Match) -> np.ndarray:
    """uint8 [H, W, 3]: what the patches show at their middles, without seams, and no colour beyond theirs and those
    outside the hole."""
    own = of.now[..., :3].copy()
    right, below = np.zeros_like(own), np.zeros_like(own)
    beside, under = np.zeros(hole.shape, np.float32), np.zeros(hole.shape, np.float32)
    voting.steps(match, of.hole, of.pictures, right, below, beside, under, own)
    right, below = right / np.maximum(beside, 1)[..., None], below / np.maximum(under, 1)[..., None]
    low, high = own.min((0, 1)), own.max((0, 1))
    picture = image.copy()
    picture[hole] = blended(of.now[..., :3], hole, right, below, own).clip(low, high).round().astype(np.uint8)
    return picture


def _levels(target: Shown, hole: np.ndarray, sources: Sequence[Shown], smooth: Sequence[int]) -> list:
    """Coarsest first: the target's values [h, w, C], its hole, and the sources; none where there is too little to take
    patches from."""
    width = 2 * _depth(hole).max()
    count = 1 + int(np.ceil(np.log2(max(width / COARSEST, 2.0 if width > SMALL else 1.0))))
    now, mask, scale = _values(target.image, hole), hole, 1
    seen = [(_values(source.image, source.masked), source.masked) for source in sources]
    levels = []
    for _ in range(count):
        marked = [_marked(values, each, smooth, scale) for (values, _), each in zip(seen, sources, strict=True)]
        pictures = _pictures(marked, [masked for _, masked in seen], sources, scale)
        if (pictures.surface >= 0).sum() < FEWEST:
            break
        levels.append((_marked(now, target, smooth, scale), mask, pictures))
        now, mask = _halved(now, mask)
        seen = [_halved(values, masked) for values, masked in seen]
        scale *= 2
    return levels[::-1]


def _values(image: np.ndarray, masked: np.ndarray) -> np.ndarray:
    """[H, W, 5] float32: colours, and the local mean of the grey picture's change along x and y. What is masked shows
    what is next to it."""
    if masked.any() and not masked.all():
        nearest = ndimage.distance_transform_edt(masked, return_distances=False, return_indices=True)
        image = image[tuple(nearest)]
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    known = cv2.erode((~masked).astype(np.float32), np.ones((3, 3)))
    window = (AROUND, AROUND)
    mass = np.maximum(cv2.blur(known, window), 1e-3)
    change = [cv2.blur(np.abs(cv2.Scharr(grey, -1, *way)) / 16 * known, window) / mass for way in ((1, 0), (0, 1))]
    return np.concatenate([image.astype(np.float32), ROUGHNESS * np.stack(change, -1)], -1)


def _marked(values: np.ndarray, shown: Shown, smooth: Sequence[int], scale: int) -> np.ndarray:
    """[H, W, 9], the plane, and what stands before the rest, in one channel more: where two meet, patches must show the
    same edge. Then how the surface lies."""
    of = np.zeros(max([*smooth, int(shown.surface.max())]) + 1, np.float32)
    of[list(smooth)] = APART * np.arange(1, len(smooth) + 1)
    marks = of[shown.surface] + BEFORE * shown.layer.astype(np.float32)
    marks, lies = cv2.medianBlur(marks, 5)[..., None], LIES * shown.normal
    return np.concatenate([values, *(each[::scale, ::scale] for each in (marks, lies))], -1)


def _halved(values: np.ndarray, masked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both at half the size, rounded up; a pixel is masked that holds any masked one."""
    even = lambda a: np.pad(a, [(0, a.shape[0] % 2), (0, a.shape[1] % 2)] + [(0, 0)] * (a.ndim - 2), mode="edge")
    values, known = even(values), even((~masked).astype(np.float32))
    size = (known.shape[1] // 2, known.shape[0] // 2)
    share = cv2.resize(known, size, interpolation=cv2.INTER_AREA)
    small = cv2.resize(values * known[..., None], size, interpolation=cv2.INTER_AREA)
    return small / np.maximum(share, 1e-3)[..., None], share < 0.999


def _pictures(
    marked: Sequence[np.ndarray], masks: Sequence[np.ndarray], sources: Sequence[Shown], scale: int
) -> Pictures:
    """The sources at 1 / `scale` of their size; `marked` values [h, w, C] and `masks` [h, w] have it already."""
    height, width = (max(masked.shape[axis] for masked in masks) for axis in (0, 1))
    shape = (len(masks), height, width)
    found = Pictures(
        np.zeros((*shape, CHANNELS), np.float32), np.full(shape, -1, np.int32), np.zeros((*shape, 4), np.float32),
        np.ones(shape, np.float32),
    )  # fmt: skip
    for k, (values, masked, source) in enumerate(zip(marked, masks, sources, strict=True)):
        here = (k, slice(masked.shape[0]), slice(masked.shape[1]))
        every = (slice(None, None, scale),) * 2
        clear = ndimage.distance_transform_edt(np.pad(~masked, 1))[1:-1, 1:-1] > CLEAR * PATCH
        found.values[here] = values
        found.surface[here] = np.where(clear & source.usable[every], source.surface[every], -1)
        found.to_pixels[here] = inverse(scale * source.to_plane[every]).reshape(*masked.shape, 4)
        found.size[here] = scale * source.size[every]
    return found


def _pixels(target: Shown, mask: np.ndarray, scale: int, smooth: Sequence[int], pictures: Pictures) -> Hole:
    """The hole's pixels at 1 / `scale` of the target's size. Along planes that hardly any source shows nothing is
    carried."""
    rows, columns = np.nonzero(mask)
    index = np.full(mask.shape, -1)
    index[rows, columns] = np.arange(len(rows))
    at = np.minimum(rows * scale, target.surface.shape[0] - 1), np.minimum(columns * scale, target.surface.shape[1] - 1)
    surface = target.surface[at].astype(np.int32)
    carried = [k for k in smooth if (pictures.surface == k).sum() >= FEWEST]
    to_plane = (scale * target.to_plane[at]).reshape(-1, 4).astype(np.float32)
    size = (scale * target.size[at]).astype(np.float32)
    return Hole(rows, columns, index, surface, np.isin(surface, carried), to_plane, size)


def _choice(pictures: Pictures, most: int) -> Choice:
    """All places, then those of each plane up to number `most`."""
    places = np.argwhere(pictures.surface >= 0).astype(np.int32)
    surface = pictures.surface[tuple(places.T)]
    parts = [places] + [places[surface == k] for k in range(1, most + 1)]
    return Choice(np.concatenate(parts), np.cumsum([0] + [len(part) for part in parts]))


def _trust(mask: np.ndarray) -> np.ndarray:
    """[H, W] float32: 1 where known, falling from the hole's border inwards."""
    return np.where(mask, np.maximum(FADING ** -_depth(mask), LEAST_TRUST), 1).astype(np.float32)


def _laid_out(of: Compared, mask: np.ndarray, choice: Choice, state: np.ndarray) -> Match:
    """The first patches, from the hole's border inwards: each ring is compared with what is known outside it."""
    row, column, trust = of.hole.row, of.hole.column, of.weight
    count = len(row)
    zeros = lambda kind: np.zeros(count, kind)
    picture = np.full(count, -1, np.int32)
    unfit = np.full(count, NONE, np.float32)
    match = Match(picture, zeros(np.float32), zeros(np.float32), zeros(np.float32), zeros(bool), unfit)
    of = of._replace(weight=np.where(mask, 0, 1).astype(np.float32))
    ring = np.ceil(_depth(mask))[row, column]
    for k in range(1, int(ring.max()) + 1):
        todo = np.flatnonzero(ring == k)
        search.search(todo, *RINGS, match, of, choice, state)
        _voted(of, match, trust, max(2 * float(np.percentile(match.misfit[todo], 75)), 1.0), todo)
        of.weight[row[todo], column[todo]] = trust[row[todo], column[todo]]
    return match


def _from_coarser(match: Match, before: Hole, of: Compared) -> Match:
    """The patches of a coarser level, `before`, for the pixels of this one."""
    (height, width), pixels = before.index.shape, of.hole
    row, column = np.minimum(pixels.row // 2, height - 1), np.minimum(pixels.column // 2, width - 1)
    parent = before.index[row, column]
    taken = Match(*(each[parent].copy() for each in match))
    taken = taken._replace(planar=taken.planar & pixels.planar)
    voting.carried_down(taken, before.row[parent], before.column[parent], pixels, of.pictures)
    return taken


def _voted(of: Compared, match: Match, trust: np.ndarray, spread: float, todo: np.ndarray | None = None) -> None:
    """`of.now` with its hole, or the pixels `todo` of it, as the patches say; but surfaces, which are known."""
    todo, voted = np.arange(len(of.hole.row)) if todo is None else todo, of.now.copy()
    voting.vote(todo, match, of.hole, trust, of.pictures, spread, voted)
    of.now[..., :VOTED] = voted[..., :VOTED]


def _depth(mask: np.ndarray) -> np.ndarray:
    """[H, W]: how far inside the mask, in pixels; the picture's border counts as one of it."""
    return ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
