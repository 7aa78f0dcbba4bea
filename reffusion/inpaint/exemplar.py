"""The surfaces that photographs show around a hole, and that go on in it: along them texture is taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from reffusion import geometry
from reffusion.background.mirrors import MirrorImage, render_mirrors
from reffusion.background.model import Background
from reffusion.background.plane import Plane, remove_reflected_depth
from reffusion.background.visibility import DepthView
from reffusion.depth.inpaint_depth import inpaint_depth
from reffusion.depth.layers import pieces, standing
from reffusion.inpaint.normals import slopes
from reffusion.inpaint.patchmatch.completion import Completed, complete
from reffusion.inpaint.plane_frames import ON, frames_of, labelled, places_of
from reffusion.inpaint.poisson import laid_over
from reffusion.inpaint.shift_map.photo_shifts import shifted
from reffusion.inpaint.shift_map.plane_montage import montage
from reffusion.inpaint.shift_map.plane_symmetry import FEWEST, Repeats, Seen, repeats
from reffusion.inpaint.source_image import Shown
from reffusion.morphology import convex_hull, dilate, to_pixels
from reffusion.types import Camera

OTHERS = 3  # photographs beside the view's own that patches are taken from
RING = 0.12  # of the image's width: how far around the object surfaces are told apart
NEARBY = 4.0  # radii of the object around its middle within which they are taken
RIM = 0.006  # of the image's width, painted anew around what is unknown
NARROW = 0.02  # of it: the radius of a disk that what is decided must have room for, not to be painted over
BESIDE = 0.008  # of the image's width: so near to a mask a photograph shows a mixture
LOOSE = 0.06  # the same, of what is asked whether a plane is smooth
REACH = 2.5  # radii of the object around its middle within which it is
SMOOTH = 0.01  # median distance from it, relative to depth, up to which it is: not grass, nor rock
LAID = 0.02  # the same, where it repeats itself as planks and tiles do, and grass does not
SOME = 200  # pixels of a view that tell
GOES_ON = 0.02  # share of the hole below which what stands before the rest is of no account: it ends beside it


def to_paint(hidden: np.ndarray, unknown: np.ndarray) -> np.ndarray:
    """bool [H, W]: what of a view is painted anew for the pixels that are `unknown`: also what of C (`hidden`) is left
    between them in narrow pieces, and the rim."""
    decided = hidden & ~unknown
    reach = to_pixels(NARROW, hidden.shape[1])
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    wide = np.pad((~hidden | decided).astype(np.uint8), reach, constant_values=1)
    broad = cv2.morphologyEx(wide, cv2.MORPH_OPEN, disk)[reach:-reach, reach:-reach] > 0
    return with_rim(hidden & ~(broad & decided), hidden)


def with_rim(hole: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """The hole, bool [H, W], and the rim of C (`hidden`) beside it, inside and out: what is left there of the object's
    blurred edge would be continued."""
    return hole | dilate(hidden, RIM) & dilate(hole, RIM)


def completions(
    image: np.ndarray, hole: np.ndarray, camera: Camera, hidden: np.ndarray, around: Background, seeds: Sequence[int]
) -> list[Completed]:
    """A training view's picture, uint8 [H, W, 3], with its hole filled from patches of its own photograph, of others
    and of views completed before, once for each seed.

    Args:
        hole: bool [H, W]. hidden: bool [H, W], C: where the photograph shows the object.
    """
    mirrored = render_mirrors(around.mirrors, camera, hidden, around.views)
    target, sources, smooth, how = _told(image, hole, camera, hidden, around, mirrored)
    depth = target.size * camera.fx
    shown = hole & mirrored.is_observed & (mirrored.plausible_depth < (1 + ON) * depth)
    if shown.any():
        beside = ~target.masked & _near(depth, mirrored.depth)
        target = _painted(target, laid_over(target.image, mirrored.picture, shown, beside), shown)
        hole = hole & ~shown
    for plane, each in how.items():
        picture, filled = montage(target, hole, sources, plane, each)
        hole = hole & ~filled
        target = _painted(target, picture, filled)
    return [_completed(target, hole, sources, smooth, seed) for seed in seeds]


def _completed(
    target: Shown, hole: np.ndarray, sources: Sequence[Shown], smooth: Sequence[int], seed: int
) -> Completed:
    """From large pieces of the own photograph; what these do not fill from patches."""
    moved = shifted(target, hole, sources[0], smooth, seed)
    rest = hole & ~moved.filled
    found = complete(_painted(target, moved.image, moved.filled), rest, sources, smooth, seed)
    share = float(rest.sum() / max(hole.sum(), 1))
    return replace(found, misfit=share * found.misfit + (1 - share) * moved.misfit**2)


def _near(depth: np.ndarray, other: np.ndarray) -> np.ndarray:
    """bool [H, W], where a depth map is that of another one, inf where this is not."""
    return np.abs(depth - np.where(np.isfinite(other), other, 0.0)) < ON * depth


def _painted(target: Shown, image: np.ndarray, filled: np.ndarray) -> Shown:
    """The target with a picture of which more is filled, bool [H, W]."""
    return replace(target, image=image, masked=target.masked & ~filled, usable=target.usable | filled)


def _told(
    image: np.ndarray, hole: np.ndarray, camera: Camera, hidden: np.ndarray, around: Background, mirrored: MirrorImage
) -> tuple[Shown, list[Shown], list[int], dict[int, Repeats]]:
    """The view, the pictures that it is filled from, the view's own photograph first, the planes along which patches
    are carried, and how those that repeat themselves do; see `completions`."""
    own = next(view for view in around.views if view.camera.name == camera.name)
    surface, depth, layer = _behind(own, hidden, hole | hidden, around.planes, mirrored)
    within = np.bincount(layer[hole].clip(0), minlength=layer.max() + 1)
    layer[(layer > 0) & (within < GOES_ON * hole.sum())[layer]] = 0
    nearest = _Nearest(geometry.unproject(depth, camera), layer) if layer.max() > 0 else None
    frames, places = (of(surface, camera, around.planes) for of in (frames_of, places_of))
    whole = layer.clip(0) if nearest is None else np.where(layer >= 0, layer, nearest.of(own))
    lies = slopes(depth, np.ones_like(hole), camera)
    target = Shown(image, hole, ~hole, surface, frames, depth / camera.fx, places, whole, lies)
    others = [(view, around.photos[view.camera.name]) for view in _others(own, around.views)]
    first = _source(own, around.photos[camera.name], around, nearest, mirrors=True)
    beside = ndimage.distance_transform_edt(~hole) < np.sqrt(hole.sum())
    sources = [replace(first, usable=first.usable | beside & (own.depth > 0))]
    sources += [_source(*each, around, nearest) for each in (*others, *around.completed)]
    roughness = {k: _roughness(plane, around) for k, plane in enumerate(around.planes, start=1)}
    even = [k for k, rough in roughness.items() if rough < LAID and (surface == k)[hole].any()]
    how = {k: found for k in even if (found := _how_it_repeats(k, sources)) is not None}
    return target, sources, [k for k, rough in roughness.items() if rough < SMOOTH or k in how], how


def _how_it_repeats(plane: int, sources: Sequence[Shown]) -> Repeats | None:
    """By the source that shows most of it."""
    shown = [source.usable & ~source.masked & (source.surface == plane) for source in sources]
    most = int(np.argmax([mask.sum() for mask in shown]))
    rows, columns = np.nonzero(shown[most])
    if len(rows) < FEWEST:
        return None
    return repeats(Seen(np.stack([columns, rows], 1), sources[most].place[rows, columns], sources[most].image))


def _behind(
    own: DepthView, hidden: np.ndarray, asked: np.ndarray, planes: Sequence[Plane], mirrored: MirrorImage
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a view shows without the object: planes' numbers, int [H, W], depth, [H, W] float64, and what stands before
    the rest, int [H, W], see `_drawn`.

    Where it is `asked` for, bool [H, W], C and its rim, the nearest plane that is seen there by others or goes on
    there; where there is none, see `_drawn`.
    """
    shown = remove_reflected_depth(own.depth, own.camera, planes)
    known = (shown > 0) & ~hidden
    depth, layer = _drawn(shown, known, hidden)
    surface, nearest = np.where(hidden, 0, labelled(shown, own.camera, planes)), np.full(hidden.shape, np.inf)
    for k, plane in enumerate(planes, start=1):
        at = plane.depth(own.camera)
        whole = plane.seen | plane.enclosed | plane.continued | plane.reflective
        before = hidden | (at < (1 + ON) * shown)
        there = plane.pixels_on(whole, at, own.camera, asked & before) & (at < nearest)
        surface[there], nearest[there] = k, at[there]
    for k in range(1, len(planes) + 1):
        beside = (surface == k) & ~hidden & (layer >= 0)
        layer[hidden & (surface == k)] = np.bincount(layer[beside]).argmax() if beside.any() else 0
    image = mirrored.plausible_depth < (1 + ON) * nearest  # a plane may cut through a round thing
    if image.any():
        of = known & (layer >= 0) & _near(shown, mirrored.depth)
        layer[image] = np.bincount(layer[of]).argmax() if of.any() else 0
        surface[image], nearest[image] = 0, mirrored.plausible_depth[image]
    return surface, np.where(np.isfinite(nearest), nearest, depth), layer


def _drawn(depth: np.ndarray, known: np.ndarray, hidden: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W], drawn across what is `hidden` from what is around it; and int [H, W], what stands before all that
    is around it beside the hidden, 1, 2, ..., the rest, 0, and what is too far away to be told, -1.

    Where it jumps, what is around falls into pieces. A nearer one goes on as far as its convex hull in the picture, so
    that it ends at the straight prolongation of its visible borders; beyond, the farther ones do.
    """
    if not known.any():
        return np.ones(depth.shape), np.zeros(depth.shape, np.int64)
    across = inpaint_depth(depth, known)
    found = np.where(across > 0, across, np.median(depth[known]))
    ring = known & dilate(hidden, RING)
    disparity = geometry.reciprocal(depth)
    piece, before = pieces(disparity, ring, hole=hidden), standing(disparity, ring, hidden)
    layer = np.where(ring, before, np.where(hidden, 0, -1))
    away = lambda k: -float(np.median(depth[piece == k]))
    for nearer, k in enumerate(sorted(range(1, piece.max() + 1), key=away)):
        own = inpaint_depth(depth, piece == k)
        there = hidden & (own > 0) & (convex_hull(piece == k) if nearer else True)
        found[there], layer[there] = own[there], np.bincount(before[piece == k]).argmax()
    return found, layer


class _Nearest:
    """What stands before the rest, as one view tells it, in the world."""

    def __init__(self, points: np.ndarray, layer: np.ndarray):
        """Args: points: [H, W, 3]. layer: int [H, W], -1 where it is not told."""
        told = (layer >= 0) & (np.indices(layer.shape).sum(0) % 2 == 0)
        self._tree, self._layer = cKDTree(points[told]), layer[told]

    def of(self, view: DepthView) -> np.ndarray:
        """int [H, W]: what the nearest point is of; 0 where the view shows nothing."""
        found = np.zeros(view.depth.shape, np.int64)
        shown = view.depth > 0
        found[shown] = self._layer[self._tree.query(geometry.unproject(view.depth, view.camera)[shown])[1]]
        return found


def _source(
    view: DepthView, picture: np.ndarray, around: Background, nearest: _Nearest | None = None, mirrors: bool = False
) -> Shown:
    """A view's picture as a source of patches: what it shows near the object, beside its mask; without its `mirrors`,
    which show something else from elsewhere. `nearest`: of what stands before the rest."""
    depth = remove_reflected_depth(view.depth, view.camera, around.planes)
    points = geometry.unproject(depth, view.camera)
    near = np.linalg.norm(points - around.center, axis=-1) < NEARBY * around.radius
    usable = near & (depth > 0) & (mirrors | (depth == view.depth))
    surface = labelled(depth, view.camera, around.planes)
    size = np.where(depth > 0, depth, 1.0) / view.camera.fx
    frames, places = (of(surface, view.camera, around.planes) for of in (frames_of, places_of))
    layer = np.zeros_like(surface) if nearest is None else nearest.of(view)
    lies = slopes(depth, (depth > 0) & ~view.masked, view.camera)
    return Shown(picture, dilate(view.masked, BESIDE), usable, surface, frames, size, places, layer, lies)


def _others(own: DepthView, views: Sequence[DepthView]) -> list[DepthView]:
    """From near to far, so that what is oblique in one is not in another."""
    away = lambda view: float(np.linalg.norm(view.camera.center - own.camera.center))
    rest = sorted((view for view in views if view is not own), key=away)
    chosen = {int(k) for k in np.linspace(1, len(rest) - 1, OTHERS)} if len(rest) > OTHERS else range(len(rest))
    return [rest[k] for k in sorted(chosen)]


def _roughness(plane: Plane, around: Background) -> float:
    """Median distance of what is seen of a plane from it, relative to depth."""
    found = []
    for view in around.views[:: max(1, len(around.views) // 6)]:
        off = np.abs(view.depth / plane.depth(view.camera) - 1)
        points = geometry.unproject(view.depth, view.camera)
        near = np.linalg.norm(points - around.center, axis=-1) < REACH * around.radius
        mine = near & (view.depth > 0) & ~view.masked & (off < LOOSE)
        if mine.sum() >= SOME:
            found.append(float(np.median(off[mine])))
    return float(np.median(found)) if found else np.inf
