"""Fills a hole in a view with texture of the photographs, along the surfaces that continue into the hole.

Mirror images of things beside the object come first, then planes that repeat themselves, then large pieces of the
view's own photograph, and patches for the rest.
"""

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
from reffusion.depth.layers import segment_foreground, segment_surfaces
from reffusion.inpaint.normals import mean_normals
from reffusion.inpaint.patchmatch.completion import Completion, complete
from reffusion.inpaint.plane_frames import MAX_DISTANCE, label_planes, plane_coordinates, plane_jacobians
from reffusion.inpaint.poisson import paste
from reffusion.inpaint.shift_map.photo_offsets import fill_from_photo
from reffusion.inpaint.shift_map.plane_motions import fill_plane
from reffusion.inpaint.shift_map.plane_symmetry import MIN_CELLS, PlanePixels, PlaneSymmetry, find_symmetry
from reffusion.inpaint.source_image import SourceImage
from reffusion.morphology import convex_hull, dilate, disk, to_pixels
from reffusion.types import Camera

OTHER_PHOTOS = 3  # photographs beside the view's own that patches are taken from
RING = 0.12  # of the image's width: how far around the object foreground layers are separated
SOURCE_REACH = 4.0  # radii of the object around its middle within which patches are taken
RIM_WIDTH = 0.006  # of the image's width: the rim of the mask that is painted, too
MIN_KEPT_RADIUS = 0.02  # of the image's width: observed parts of C that no disk of this radius fits in are painted, too
MASK_MARGIN = 0.008  # of the image's width: so near to its mask a photograph mixes object and background
PLANE_SAMPLE_DISTANCE = 0.06  # relative depth up to which a pixel counts in the roughness of a plane
PLANE_SAMPLE_REACH = 2.5  # radii of the object around its middle within which it counts
MIN_PLANE_PIXELS = 200  # of a view that count, for the view to count
SMOOTH = 0.01  # roughness up to which a plane is smooth: not grass, nor rock
SMOOTH_IF_REPEATING = 0.02  # the same, of a plane that repeats itself as planks and tiles do, and grass does not
MIN_LAYER_SHARE = 0.02  # of the hole that a foreground layer must continue into, or it is ignored: it ends beside it


def mask_to_paint(hidden: np.ndarray, unknown: np.ndarray) -> np.ndarray:
    """bool [H, W], the pixels of a view to paint: `unknown`, narrow observed strips between its parts, and the rim.

    Args:
        hidden: bool [H, W], C. unknown: bool [H, W], the pixels of C that must be painted.
    """
    observed = hidden & ~unknown
    reach = to_pixels(MIN_KEPT_RADIUS, hidden.shape[1])
    free = np.pad((~hidden | observed).astype(np.uint8), reach, constant_values=1)
    broad = cv2.morphologyEx(free, cv2.MORPH_OPEN, disk(reach))[reach:-reach, reach:-reach] > 0
    return add_rim(hidden & ~(broad & observed), hidden)


def add_rim(hole: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """bool [H, W], the hole and the rim of C (`hidden`) beside it, inside and out. The object's blurred edge that is
    left there would be continued into the hole."""
    return hole | dilate(hidden, RIM_WIDTH) & dilate(hole, RIM_WIDTH)


def complete_view(
    image: np.ndarray, hole: np.ndarray, camera: Camera, hidden: np.ndarray, around: Background, seeds: Sequence[int]
) -> list[Completion]:
    """A training view's image, uint8 [H, W, 3], with its hole filled from its own photograph, from others, and from
    views completed before; once for each seed.

    Args:
        hole: bool [H, W].
        camera: of a training view.
        hidden: bool [H, W], C: where the photograph shows the object.
        around: what the photographs show.
    """
    mirrored = render_mirrors(around.mirrors, camera, hidden, around.views)
    target, sources, smooth, symmetries = _find_surfaces(image, hole, camera, hidden, around, mirrored)
    depth = target.pixel_size * camera.fx
    in_mirror = hole & mirrored.is_observed & (mirrored.plausible_depth < (1 + MAX_DISTANCE) * depth)
    if in_mirror.any():
        beside = ~target.masked & _same_depth(depth, mirrored.depth)
        target = _with_filled(target, paste(target.image, mirrored.picture, in_mirror, beside), in_mirror)
        hole = hole & ~in_mirror
    for plane, symmetry in symmetries.items():
        assembly = fill_plane(target, hole, sources, plane, symmetry)
        hole = hole & ~assembly.filled
        target = _with_filled(target, assembly.image, assembly.filled)
    return [_complete_rest(target, hole, sources, smooth, seed) for seed in seeds]


def _complete_rest(
    target: SourceImage, hole: np.ndarray, sources: Sequence[SourceImage], smooth: Sequence[int], seed: int
) -> Completion:
    """The target with its hole filled from large pieces of the own photograph, and from patches where these do not
    suit."""
    assembly = fill_from_photo(target, hole, sources[0], smooth, seed)
    rest = hole & ~assembly.filled
    completion = complete(_with_filled(target, assembly.image, assembly.filled), rest, sources, smooth, seed)
    share = float(rest.sum() / max(hole.sum(), 1))
    return replace(completion, misfit=share * completion.misfit + (1 - share) * assembly.cost**2)


def _same_depth(depth: np.ndarray, other: np.ndarray) -> np.ndarray:
    """bool [H, W], where two depth maps agree; the other is inf where it is empty."""
    return np.abs(depth - np.where(np.isfinite(other), other, 0.0)) < MAX_DISTANCE * depth


def _with_filled(target: SourceImage, image: np.ndarray, filled: np.ndarray) -> SourceImage:
    """The target with another image, in which more of the hole is filled, bool [H, W]."""
    return replace(target, image=image, masked=target.masked & ~filled, usable=target.usable | filled)


def _find_surfaces(
    image: np.ndarray, hole: np.ndarray, camera: Camera, hidden: np.ndarray, around: Background, mirrored: MirrorImage
) -> tuple[SourceImage, list[SourceImage], list[int], dict[int, PlaneSymmetry]]:
    """What a hole is filled from; arguments as of `complete_view`.

    Returns:
        target: the view, with the surfaces that continue into its hole.
        sources: the view's own photograph, others, and views completed before.
        smooth: indices of the planes whose perspective patches follow.
        symmetries: plane index -> how the plane repeats itself, of those in the hole that do.
    """
    own = next(view for view in around.views if view.camera.name == camera.name)
    plane, depth, layer = _surfaces_behind(own, hidden, hole | hidden, around.planes, mirrored)
    counts = np.bincount(layer[hole].clip(0), minlength=layer.max() + 1)
    layer[(layer > 0) & (counts < MIN_LAYER_SHARE * hole.sum())[layer]] = 0
    layers = _LayerLookup(geometry.unproject(depth, camera), layer) if layer.max() > 0 else None
    jacobians, coordinates = (of(plane, camera, around.planes) for of in (plane_jacobians, plane_coordinates))
    all_layers = layer.clip(0) if layers is None else np.where(layer >= 0, layer, layers.in_view(own))
    normals = mean_normals(depth, np.ones_like(hole), camera)
    target = SourceImage(image, hole, ~hole, plane, jacobians, depth / camera.fx, coordinates, all_layers, normals)
    others = [(view, around.photos[view.camera.name]) for view in _choose_others(own, around.views)]
    first = _source_image(own, around.photos[camera.name], around, layers, with_reflections=True)
    beside = ndimage.distance_transform_edt(~hole) < np.sqrt(hole.sum())
    sources = [replace(first, usable=first.usable | beside & (own.depth > 0))]
    sources += [_source_image(*each, around, layers) for each in (*others, *around.completed)]
    roughness = {k: _roughness(each, around) for k, each in enumerate(around.planes, start=1)}
    even = [k for k, rough in roughness.items() if rough < SMOOTH_IF_REPEATING and (plane == k)[hole].any()]
    symmetries = {k: symmetry for k in even if (symmetry := _symmetry_of(k, sources)) is not None}
    smooth = [k for k, rough in roughness.items() if rough < SMOOTH or k in symmetries]
    return target, sources, smooth, symmetries


def _symmetry_of(plane: int, sources: Sequence[SourceImage]) -> PlaneSymmetry | None:
    """How the plane repeats itself, from the source that shows most of it; None where it does not."""
    masks = [source.usable & ~source.masked & (source.plane == plane) for source in sources]
    best = int(np.argmax([mask.sum() for mask in masks]))
    rows, columns = np.nonzero(masks[best])
    if len(rows) < MIN_CELLS:
        return None
    coordinates = sources[best].plane_xy[rows, columns]
    return find_symmetry(PlanePixels(np.stack([columns, rows], 1), coordinates, sources[best].image))


def _surfaces_behind(
    own: DepthView, hidden: np.ndarray, pixels: np.ndarray, planes: Sequence[Plane], mirrored: MirrorImage
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a view would show without the object: plane indices, int [H, W]; depth, [H, W] float64; and foreground
    layers, int [H, W], see `_interpolate_depth`.

    In `pixels`, bool [H, W], C and its rim, it is the nearest plane that other views see there or that
    continues there; where there is none, depth and layer are those of `_interpolate_depth`.
    """
    surface = remove_reflected_depth(own.depth, own.camera, planes)
    known = (surface > 0) & ~hidden
    depth, layer = _interpolate_depth(surface, known, hidden)
    plane, nearest = np.where(hidden, 0, label_planes(surface, own.camera, planes)), np.full(hidden.shape, np.inf)
    for k, each in enumerate(planes, start=1):
        at = each.depth(own.camera)
        cells = each.seen | each.enclosed | each.continued | each.reflective
        possible = hidden | (at < (1 + MAX_DISTANCE) * surface)
        mine = each.pixels_on(cells, at, own.camera, pixels & possible) & (at < nearest)
        plane[mine], nearest[mine] = k, at[mine]
    for k in range(1, len(planes) + 1):
        beside = (plane == k) & ~hidden & (layer >= 0)
        layer[hidden & (plane == k)] = np.bincount(layer[beside]).argmax() if beside.any() else 0
    image = mirrored.plausible_depth < (1 + MAX_DISTANCE) * nearest  # a plane may cut through a round thing
    if image.any():
        thing = known & (layer >= 0) & _same_depth(surface, mirrored.depth)
        layer[image] = np.bincount(layer[thing]).argmax() if thing.any() else 0
        plane[image], nearest[image] = 0, mirrored.plausible_depth[image]
    return plane, np.where(np.isfinite(nearest), nearest, depth), layer


def _interpolate_depth(depth: np.ndarray, known: np.ndarray, hidden: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W], interpolated across the `hidden` pixels from the known ones around; and the foreground layer, int
    [H, W]: 1, 2, ... for things in front of all that they meet beside the hidden pixels, 0 for the rest, -1 beyond the
    ring in which layers are separated.

    The surroundings are split where depth jumps. A nearer piece continues as far as its convex hull in the image, so
    that it ends at the straight prolongation of its visible borders; the farther ones continue beyond.
    """
    if not known.any():
        return np.ones(depth.shape), np.zeros(depth.shape, np.int64)
    across = inpaint_depth(depth, known)
    result = np.where(across > 0, across, np.median(depth[known]))
    ring = known & dilate(hidden, RING)
    disparity = geometry.reciprocal(depth)
    piece, foreground = segment_surfaces(disparity, ring, hole=hidden), segment_foreground(disparity, ring, hidden)
    layer = np.where(ring, foreground, np.where(hidden, 0, -1))
    far_first = lambda k: -float(np.median(depth[piece == k]))
    for position, k in enumerate(sorted(range(1, piece.max() + 1), key=far_first)):
        own = inpaint_depth(depth, piece == k)
        mine = hidden & (own > 0) & (convex_hull(piece == k) if position else True)
        result[mine], layer[mine] = own[mine], np.bincount(foreground[piece == k]).argmax()
    return result, layer


class _LayerLookup:
    """Foreground layers as one view shows them, looked up by points in the world."""

    def __init__(self, points: np.ndarray, layer: np.ndarray):
        """Args: points: [H, W, 3]. layer: int [H, W], -1 where it is not known."""
        known = (layer >= 0) & (np.indices(layer.shape).sum(0) % 2 == 0)
        self._tree, self._layer = cKDTree(points[known]), layer[known]

    def in_view(self, view: DepthView) -> np.ndarray:
        """int [H, W], layer of the nearest point to each pixel of a view; 0 where the view shows nothing."""
        layer = np.zeros(view.depth.shape, np.int64)
        opaque = view.depth > 0
        layer[opaque] = self._layer[self._tree.query(geometry.unproject(view.depth, view.camera)[opaque])[1]]
        return layer


def _source_image(
    view: DepthView,
    image: np.ndarray,
    around: Background,
    layers: _LayerLookup | None = None,
    with_reflections: bool = False,
) -> SourceImage:
    """A view's image as a source: usable is what it shows near the object, beside its mask. `with_reflections`: also
    the mirrors in planes, which show something else to other views."""
    depth = remove_reflected_depth(view.depth, view.camera, around.planes)
    points = geometry.unproject(depth, view.camera)
    near = np.linalg.norm(points - around.center, axis=-1) < SOURCE_REACH * around.radius
    usable = near & (depth > 0) & (with_reflections | (depth == view.depth))
    plane = label_planes(depth, view.camera, around.planes)
    pixel_size = np.where(depth > 0, depth, 1.0) / view.camera.fx
    jacobians, coordinates = (of(plane, view.camera, around.planes) for of in (plane_jacobians, plane_coordinates))
    layer = np.zeros_like(plane) if layers is None else layers.in_view(view)
    normals = mean_normals(depth, (depth > 0) & ~view.masked, view.camera)
    masked = dilate(view.masked, MASK_MARGIN)
    return SourceImage(image, masked, usable, plane, jacobians, pixel_size, coordinates, layer, normals)


def _choose_others(own: DepthView, views: Sequence[DepthView]) -> list[DepthView]:
    """Up to `OTHER_PHOTOS` other views, from near to far, so that what one sees obliquely another does not."""
    distance = lambda view: float(np.linalg.norm(view.camera.center - own.camera.center))
    others = sorted((view for view in views if view is not own), key=distance)
    count = len(others)
    chosen = {int(k) for k in np.linspace(1, count - 1, OTHER_PHOTOS)} if count > OTHER_PHOTOS else range(count)
    return [others[k] for k in sorted(chosen)]


def _roughness(plane: Plane, around: Background) -> float:
    """Median distance of a plane's pixels near the object from the plane, relative to depth; inf where no view shows
    enough of it."""
    medians = []
    for view in around.views[:: max(1, len(around.views) // 6)]:
        off = np.abs(view.depth / plane.depth(view.camera) - 1)
        points = geometry.unproject(view.depth, view.camera)
        near = np.linalg.norm(points - around.center, axis=-1) < PLANE_SAMPLE_REACH * around.radius
        mine = near & (view.depth > 0) & ~view.masked & (off < PLANE_SAMPLE_DISTANCE)
        if mine.sum() >= MIN_PLANE_PIXELS:
            medians.append(float(np.median(off[mine])))
    return float(np.median(medians)) if medians else np.inf
