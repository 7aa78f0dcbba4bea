"""Exemplar-based inpainting: fills a hole in a view with texture of the photographs.

Textures follow the surfaces that continue into the hole. The hole is filled in three steps, each of which fills what
the steps before it left: mirror images of symmetric things beside the object, planes whose texture repeats itself, and
small patches of all sources. C is the consistent mask, the object's pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy import ndimage

from reffusion import geometry
from reffusion.background.mirrors import MirrorImage, render_mirrors
from reffusion.background.model import Background
from reffusion.background.plane import Plane, remove_reflected_depth
from reffusion.background.visibility import DepthView
from reffusion.depth.inpaint_depth import inpaint_depth
from reffusion.depth.layers import segment_surfaces
from reffusion.inpaint.patchmatch.completion import Completion, complete
from reffusion.inpaint.plane_frames import label_planes, plane_coordinates, plane_jacobians
from reffusion.inpaint.poisson import paste
from reffusion.inpaint.shift_map.plane_motions import fill_plane
from reffusion.inpaint.shift_map.plane_symmetry import MIN_CELLS, PlanePixels, PlaneSymmetry, find_symmetry
from reffusion.inpaint.source_image import SourceImage
from reffusion.kernels.compiled import map_in_threads
from reffusion.morphology import convex_hull, dilate, disk, to_pixels
from reffusion.types import Camera

OTHER_PHOTOS = 3  # photographs, besides the view's own, from which patches are taken
RING = 0.12  # of the image's width: width of the ring around the object whose surfaces are continued
SOURCE_REACH = 4.0  # patches are taken within this many radii of the object around its middle
RIM_WIDTH = 0.006  # of the image's width: width of the mask's rim, which is painted too
MIN_KEPT_RADIUS = 0.02  # of the image's width: observed parts of C too narrow for a disk of this radius are painted too
MASK_MARGIN = 0.008  # of the image's width: nearer to its mask than this, a photograph mixes object and background
# The roughness of a plane is measured on pixels whose depth differs from the plane's by at most PLANE_SAMPLE_DISTANCE
# (relative), and whose points lie within PLANE_SAMPLE_REACH radii of the object around its middle.
PLANE_SAMPLE_DISTANCE = 0.06
PLANE_SAMPLE_REACH = 2.5
MIN_PLANE_PIXELS = 200  # pixels of this kind that a view must have to take part in the roughness of a plane
SMOOTH = 0.01  # roughness up to which a plane is smooth; grass and rock are rougher
SMOOTH_IF_REPEATING = 0.02  # the same for a plane whose texture repeats itself, as planks and tiles do, not grass


def mask_to_paint(hidden: np.ndarray, unknown: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the pixels of a view to paint.

    These are the unknown pixels; the observed parts of C that are too narrow for a disk of radius `MIN_KEPT_RADIUS`;
    and the rim around both (`add_rim`).

    Args:
        hidden: bool [H, W], C.
        unknown: bool [H, W], the pixels of C that must be painted.
    """
    observed = hidden & ~unknown
    reach = to_pixels(MIN_KEPT_RADIUS, hidden.shape[1])
    free = np.pad((~hidden | observed).astype(np.uint8), reach, constant_values=1)
    broad = cv2.morphologyEx(free, cv2.MORPH_OPEN, disk(reach))[reach:-reach, reach:-reach] > 0
    return add_rim(hidden & ~(broad & observed), hidden)


def add_rim(hole: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the hole and all pixels within `RIM_WIDTH` both of the hole and of C (`hidden`).

    So the hole grows inside C on all sides, and beyond C's border, where a pixel may still show the object's blurred
    edge, which would be continued into the hole.
    """
    return hole | dilate(hidden, RIM_WIDTH) & dilate(hole, RIM_WIDTH)


def complete_view(
    image: np.ndarray, hole: np.ndarray, camera: Camera, hidden: np.ndarray, around: Background, seeds: Sequence[int]
) -> Iterator[Completion]:
    """Fill the hole of a training view from its own photograph, other photographs, and views completed before.

    Args:
        image: uint8 [H, W, 3], the view; read outside the hole only.
        hole: bool [H, W], the pixels to fill.
        camera: the camera of the view. Its name must be that of a view in `around`.
        hidden: bool [H, W], C: the pixels at which the photograph shows the object.
        around: the photographs, the view's own among them, the views completed before (`completed`), and the surfaces
            around the object.
        seeds: seeds of the random searches.

    Yields:
        One completion of the view for each seed, in the order of the seeds.
    """
    mirrored = render_mirrors(around.mirrors, camera, hidden, around.views)
    target, sources, smooth, symmetries = _find_surfaces(image, hole, camera, hidden, around, mirrored)
    depth = target.pixel_size * camera.fx
    in_mirror = hole & mirrored.is_observed & (mirrored.plausible_depth < (1 + geometry.OTHER_SURFACE) * depth)
    if in_mirror.any():
        beside = ~target.masked & _same_depth(depth, mirrored.depth)
        target = _with_filled(target, paste(target.image, mirrored.picture, in_mirror, beside), in_mirror)
        hole = hole & ~in_mirror
    for plane, symmetry in symmetries.items():
        assembly = fill_plane(target, hole, sources, plane, symmetry)
        hole = hole & ~assembly.filled
        target = _with_filled(target, assembly.image, assembly.filled)
    yield from map_in_threads(lambda seed: complete(target, hole, sources, smooth, seed), seeds)


def _same_depth(depth: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return bool [H, W], True where two depths may belong to one surface; False where `other` is inf."""
    return np.abs(depth - np.where(np.isfinite(other), other, 0.0)) < geometry.OTHER_SURFACE * depth


def _with_filled(target: SourceImage, image: np.ndarray, filled: np.ndarray) -> SourceImage:
    """Return the target with a new image, in which the pixels `filled`, bool [H, W], are no longer a hole."""
    return replace(target, image=image, masked=target.masked & ~filled, usable=target.usable | filled)


def _find_surfaces(
    image: np.ndarray, hole: np.ndarray, camera: Camera, hidden: np.ndarray, around: Background, mirrored: MirrorImage
) -> tuple[SourceImage, list[SourceImage], list[int], dict[int, PlaneSymmetry]]:
    """Return the target, the sources, the indices of smooth planes, and plane index -> symmetry of its texture."""
    own = next(view for view in around.views if view.camera.name == camera.name)
    plane, depth = _surfaces_behind(own, hidden, hole | hidden, around.planes, mirrored)
    jacobians, coordinates = (of(plane, camera, around.planes) for of in (plane_jacobians, plane_coordinates))
    target = SourceImage(image, hole, ~hole, plane, jacobians, depth / camera.fx, coordinates)
    others = [(view, around.photos[view.camera.name]) for view in _choose_others(own, around.views)]
    first = _source_image(own, around.photos[camera.name], around, with_reflections=True)
    # The view's own photograph is also used beside the hole, however far the surface is from the object.
    beside = ndimage.distance_transform_edt(~hole) < np.sqrt(hole.sum())
    sources = [replace(first, usable=first.usable | beside & (own.depth > 0))]
    sources += [_source_image(*each, around) for each in (*others, *around.completed)]
    roughness = {k: _roughness(each, around) for k, each in enumerate(around.planes, start=1)}
    even = [k for k, rough in roughness.items() if rough < SMOOTH_IF_REPEATING and (plane == k)[hole].any()]
    symmetries = {k: symmetry for k in even if (symmetry := _symmetry_of(k, sources)) is not None}
    # perspective patches follow these planes
    smooth = [k for k, rough in roughness.items() if rough < SMOOTH or k in symmetries]
    return target, sources, smooth, symmetries


def _symmetry_of(plane: int, sources: Sequence[SourceImage]) -> PlaneSymmetry | None:
    """Return the symmetry of a plane's texture in the source that shows most of it; None if none is found."""
    masks = [source.usable & ~source.masked & (source.plane == plane) for source in sources]
    best = int(np.argmax([mask.sum() for mask in masks]))
    rows, columns = np.nonzero(masks[best])
    if len(rows) < MIN_CELLS:
        return None
    coordinates = sources[best].plane_xy[rows, columns]
    return find_symmetry(PlanePixels(np.stack([columns, rows], 1), coordinates, sources[best].image))


def _surfaces_behind(
    own: DepthView, hidden: np.ndarray, pixels: np.ndarray, planes: Sequence[Plane], mirrored: MirrorImage
) -> tuple[np.ndarray, np.ndarray]:
    """Return the plane index (0: none) and the depth [H, W] that a view would show without the object."""
    # `hidden` is C; `pixels` is C and the hole, which includes C's rim.
    surface = remove_reflected_depth(own.depth, own.camera, planes)
    known = (surface > 0) & ~hidden
    depth = _interpolate_depth(surface, known, hidden)
    plane, nearest = np.where(hidden, 0, label_planes(surface, own.camera, planes)), np.full(hidden.shape, np.inf)
    # A pixel shows the nearest plane that other views see there or that continues there, or a mirror image. If there is
    # neither, its depth is interpolated from the surroundings.
    for k, each in enumerate(planes, start=1):
        at = each.depth(own.camera)
        cells = each.seen | each.enclosed | each.continued | each.reflective
        possible = hidden | (at < (1 + geometry.OTHER_SURFACE) * surface)
        mine = each.pixels_on(cells, at, own.camera, pixels & possible) & (at < nearest)
        plane[mine], nearest[mine] = k, at[mine]
    # A mirror image wins if it is nearer, or about as near: a plane may cut through a round thing.
    image = mirrored.plausible_depth < (1 + geometry.OTHER_SURFACE) * nearest
    plane[image], nearest[image] = 0, mirrored.plausible_depth[image]
    return plane, np.where(np.isfinite(nearest), nearest, depth)


def _interpolate_depth(depth: np.ndarray, known: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Return depth [H, W], in which hidden pixels continue the surroundings; 1 everywhere if nothing is known."""
    if not known.any():
        return np.ones(depth.shape)
    across = inpaint_depth(depth, known)
    result = np.where(across > 0, across, np.median(depth[known]))
    ring = known & dilate(hidden, RING)
    piece = segment_surfaces(geometry.reciprocal(depth), ring, hole=hidden)
    far_first = lambda k: -float(np.median(depth[piece == k]))
    # Each piece of the surroundings, which are split where depth jumps, is continued by itself. A nearer piece reaches
    # as far as its convex hull in the image, so that it ends at the straight continuation of its visible borders.
    for position, k in enumerate(sorted(range(1, piece.max() + 1), key=far_first)):
        own = inpaint_depth(depth, piece == k)
        mine = hidden & (own > 0) & (convex_hull(piece == k) if position else True)
        result[mine] = own[mine]
    return result


def _source_image(
    view: DepthView, image: np.ndarray, around: Background, with_reflections: bool = False
) -> SourceImage:
    """Convert a view to a source of texture near the object, reflections on planes only if `with_reflections`."""
    depth = remove_reflected_depth(view.depth, view.camera, around.planes)
    points = geometry.unproject(depth, view.camera)
    near = np.linalg.norm(points - around.center, axis=-1) < SOURCE_REACH * around.radius
    # Other views see other reflections, so only those of the view's own photograph suit (`with_reflections`).
    usable = near & (depth > 0) & (with_reflections | (depth == view.depth))
    plane = label_planes(depth, view.camera, around.planes)
    pixel_size = np.where(depth > 0, depth, 1.0) / view.camera.fx
    jacobians, coordinates = (of(plane, view.camera, around.planes) for of in (plane_jacobians, plane_coordinates))
    masked = dilate(view.masked, MASK_MARGIN)
    return SourceImage(image, masked, usable, plane, jacobians, pixel_size, coordinates)


def _choose_others(own: DepthView, views: Sequence[DepthView]) -> list[DepthView]:
    """Choose up to `OTHER_PHOTOS` other views, evenly spread in the order of their distance."""
    distance = lambda view: float(np.linalg.norm(view.camera.center - own.camera.center))
    others = sorted((view for view in views if view is not own), key=distance)
    count = len(others)
    # So a surface that one view sees obliquely is seen less obliquely by another. The nearest view is left out, because
    # it shows nearly the same as the view itself.
    chosen = {int(k) for k in np.linspace(1, count - 1, OTHER_PHOTOS)} if count > OTHER_PHOTOS else range(count)
    return [others[k] for k in sorted(chosen)]


def _roughness(plane: Plane, around: Background) -> float:
    """Return the median over some views of the median relative distance of pixels near a plane; inf if too few."""
    medians = []
    for view in around.views[:: max(1, len(around.views) // 6)]:
        off = np.abs(view.depth / plane.depth(view.camera) - 1)
        points = geometry.unproject(view.depth, view.camera)
        near = np.linalg.norm(points - around.center, axis=-1) < PLANE_SAMPLE_REACH * around.radius
        mine = near & (view.depth > 0) & ~view.masked & (off < PLANE_SAMPLE_DISTANCE)
        if mine.sum() >= MIN_PLANE_PIXELS:
            medians.append(float(np.median(off[mine])))
    return float(np.median(medians)) if medians else np.inf
