"""Multi-view stereo for a few photographs: depth from sparse points, refined and cross-checked between views.

Smooth surfaces have few sparse points. Some points lie on surfaces that a photograph does not show, for example on the
far side of an object, which other photographs show. So the depth is first interpolated between the sparse points, and
then refined by PatchMatch stereo. A pixel is *confirmed* if another view finds the same surface. Confirmed pixels
replace the sparse points that they contradict, and the depth of the remaining pixels is interpolated anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from reffusion import geometry, seeding
from reffusion.depth import patchmatch
from reffusion.depth.sparse_to_dense import (
    REFERENCE_WIDTH,
    DepthSamples,
    SparsePoints,
    interpolate_depth,
    visible_samples,
)
from reffusion.kernels.compiled import map_in_threads
from reffusion.types import Camera

MAX_NEIGHBORS, MAX_ANGLE_DEG = (
    3,
    70.0,
)  # number of other views that a view is compared with, and largest angle between their optical axes and its own
SEEN_PAST = 0.05  # relative depth by which another view must see farther to refute a surface
GRID_SPACING = 3  # of the grid of confirmed pixels that become samples, in px of a picture `REFERENCE_WIDTH` wide


@dataclass(frozen=True)
class MultiviewDepth:
    """The depth of a view, checked against other views.

    Attributes:
        depth: [H, W] float64 camera z.
        confirmed: bool [H, W], True where another view finds the same surface.
        refuted: bool [H, W], True at pixels that are not confirmed and whose surface is contradicted: a confirmed pixel
            of another view sees past the surface.
    """

    depth: np.ndarray
    confirmed: np.ndarray
    refuted: np.ndarray


def estimate_multiview_depth(
    points: SparsePoints,
    cameras: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    hidden: Mapping[str, np.ndarray],
    seed: int,
) -> dict[str, MultiviewDepth]:
    """Estimate the depth of each view in which enough sparse points are visible.

    Args:
        points: The scene's sparse points with normals.
        cameras: The cameras of the views.
        images: View name -> photograph, uint8 [H, W, 3]. All have the same exposure.
        hidden: View name -> bool [H, W], True at pixels that are never confirmed. A view without an entry has none.
        seed: Seed of PatchMatch.

    Returns:
        View name -> depth. Views with fewer than `sparse_to_dense.MIN_POINTS` visible points have no entry.
    """
    samples = {camera.name: visible_samples(points, camera, images[camera.name]) for camera in cameras}
    interpolate = lambda camera: interpolate_depth(samples[camera.name], camera, images[camera.name])
    found = zip(samples, map_in_threads(interpolate, cameras), strict=True)
    initial = {name: depth for name, depth in found if depth is not None}
    views = [camera for camera in cameras if camera.name in initial]
    planes = {view.name: _refine_planes(view, views, images, initial[view.name], seed) for view in views}
    depth = {view.name: 1 / (planes[view.name] * geometry.pixel_rays(view)).sum(-1) for view in views}
    confirmed = {
        view.name: _confirmed_pixels(view, depth, views) & np.logical_not(hidden.get(view.name, False))
        for view in views
    }
    complete = lambda view: _complete_depth(
        view, images[view.name], samples[view.name], planes[view.name], depth[view.name], confirmed[view.name]
    )
    depth = dict(zip(depth, map_in_threads(complete, views), strict=True))
    return {
        view.name: MultiviewDepth(
            depth[view.name], confirmed[view.name], _refuted_pixels(view, depth, confirmed, views)
        )
        for view in views
    }


def _refine_planes(
    view: Camera, views: Sequence[Camera], images: Mapping[str, np.ndarray], initial: np.ndarray, seed: int
) -> np.ndarray:
    """Return [H, W, 3], the plane of each pixel: the initial depth, refined by stereo with the most similar views."""
    # The most similar views are those with the smallest angle between their optical axes and that of the view.
    axis_cosine = lambda other: float(view.world_to_camera[2, :3] @ other.world_to_camera[2, :3])
    near = [
        other for other in views if other.name != view.name and axis_cosine(other) > np.cos(np.radians(MAX_ANGLE_DEG))
    ]
    others = [(other, images[other.name]) for other in sorted(near, key=axis_cosine, reverse=True)[:MAX_NEIGHBORS]]
    if not others:
        return patchmatch.tangent_planes(1 / initial, geometry.pixel_rays(view))
    generator = np.random.default_rng(seeding.seed_for(seed, "agreed", view.name))
    return patchmatch.estimate_planes(view, images[view.name], others, initial, generator)


def _confirmed_pixels(view: Camera, depth: Mapping[str, np.ndarray], views: Sequence[Camera]) -> np.ndarray:
    """Return bool [H, W], the pixels of a view at which another view finds the same surface."""
    result = np.zeros(depth[view.name].shape, bool)
    for other_depth, z, inside, _ in _compare_views(view, depth, depth, views):
        result |= inside & (np.abs(other_depth - z) < geometry.SAME_IF_MEASURED * z)
    return result


def _refuted_pixels(
    view: Camera, depth: Mapping[str, np.ndarray], confirmed: Mapping[str, np.ndarray], views: Sequence[Camera]
) -> np.ndarray:
    """Return bool [H, W], the unconfirmed pixels whose surface is contradicted by a confirmed pixel of another view."""
    result = np.zeros(depth[view.name].shape, bool)
    for other_depth, z, inside, other_confirmed in _compare_views(view, depth, confirmed, views):
        result |= inside & other_confirmed & (other_depth > z * (1 + SEEN_PAST))
    return result & ~confirmed[view.name]


def _compare_views(
    view: Camera, depth: Mapping[str, np.ndarray], values: Mapping[str, np.ndarray], views: Sequence[Camera]
):
    """Yield, for each other view, four arrays [H, W] about the places where a view's surface points project to."""
    points = geometry.unproject(depth[view.name], view)
    for other in views:
        if other.name != view.name:
            uv, z = geometry.project(points, other)
            other_depth, inside = geometry.sample_nearest(depth[other.name], uv)
            # They are the other view's depth where a pixel's surface point projects to, the depth of the point in the
            # other view, whether the point is in its frame, and its `values` where the point projects to.
            yield other_depth, z, inside & (z > 0), geometry.sample_nearest(values[other.name], uv)[0]


def _complete_depth(
    view: Camera, image: np.ndarray, samples: DepthSamples, planes: np.ndarray, depth: np.ndarray, confirmed: np.ndarray
) -> np.ndarray:
    """Return the depth [H, W] of a view in which the unconfirmed pixels are interpolated anew."""
    if not confirmed.any():
        return depth
    columns, rows = samples.pixels.astype(int).T
    refuted = confirmed[rows, columns]  # such a point contradicts the confirmed pixel, or adds nothing to it
    spacing = max(1, round(GRID_SPACING * view.width / REFERENCE_WIDTH))
    grid = np.zeros(confirmed.shape, bool)
    grid[::spacing, ::spacing] = True
    grid_pixels = np.argwhere(confirmed & grid)
    dense = DepthSamples(grid_pixels[:, ::-1] + 0.5, planes[tuple(grid_pixels.T)], 1 / depth[tuple(grid_pixels.T)])
    # Unconfirmed pixels are interpolated from confirmed ones and from the sparse points that project to unconfirmed
    # ones.
    completed = interpolate_depth(samples.select(~refuted).concatenate(dense), view, image)
    return depth if completed is None else np.where(confirmed, depth, completed)
