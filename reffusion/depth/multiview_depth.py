"""The depth of a few photographs, where they agree on it: sparse points begin, the photographs correct them.

Sparse points are few on what is smooth, and some lie on what a photograph does not show: the far side of a thing, seen
in others. Each photograph's depth between them is corrected by PatchMatch stereo; where another one finds the same
surface, both are right; what they are right about speaks for the pixels beside it, and against sparse points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from reffusion import geometry, seeding
from reffusion.depth import patchmatch
from reffusion.depth.sparse_to_dense import UNIT, Known, SparsePoints, depth_between, known
from reffusion.kernels.compiled import side_by_side
from reffusion.types import Camera

COMPARED, APART = 3, 70.0  # so many others, whose axes differ by less than so many degrees
CONFIRMED = 0.01  # relative depth within which two photographs' surfaces are the same
CONTRADICTED = 0.05  # relative depth by which another photograph sees farther
SPACING = 3  # px of a picture `UNIT` wide: the grid of what photographs agree on that others ask


@dataclass(frozen=True)
class Agreed:
    """What is known of a view's depth.

    Attributes:
        depth: [H, W] float64 camera z. sure: bool [H, W], another photograph shows the same surface there.
        wrong: bool [H, W], not sure, and another photograph that is sees past it.
    """

    depth: np.ndarray
    sure: np.ndarray
    wrong: np.ndarray


def agreed(
    points: SparsePoints,
    cameras: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    hidden: Mapping[str, np.ndarray],
    seed: int,
) -> dict[str, Agreed]:
    """View name -> its depth, of the views that show enough points.

    Args:
        images: view name -> uint8 [H, W, 3], as bright as each other.
        hidden: view name -> bool [H, W], pixels of which nothing is sure.
    """
    said = {camera.name: known(points, camera, images[camera.name]) for camera in cameras}
    between = lambda camera: depth_between(said[camera.name], camera, images[camera.name])
    believed = dict(zip(said, side_by_side(between, cameras), strict=True))
    views = [camera for camera in cameras if believed[camera.name] is not None]
    planes = {view.name: _planes(view, views, images, believed[view.name], seed) for view in views}
    depth = {view.name: _depth(planes[view.name], view) for view in views}
    sure = {view.name: _confirmed(view, depth, views) & np.logical_not(hidden.get(view.name, False)) for view in views}
    rest = lambda view: _beside(
        view, images[view.name], said[view.name], planes[view.name], depth[view.name], sure[view.name]
    )
    depth = dict(zip(depth, side_by_side(rest, views), strict=True))
    return {
        view.name: Agreed(depth[view.name], sure[view.name], _contradicted(view, depth, sure, views)) for view in views
    }


def _planes(
    view: Camera, views: Sequence[Camera], images: Mapping[str, np.ndarray], believed: np.ndarray, seed: int
) -> np.ndarray:
    alike = lambda other: float(view.world_to_camera[2, :3] @ other.world_to_camera[2, :3])
    near = [other for other in views if other.name != view.name and alike(other) > np.cos(np.radians(APART))]
    others = [(other, images[other.name]) for other in sorted(near, key=alike, reverse=True)[:COMPARED]]
    if not others:
        return patchmatch.tangents(1 / believed, geometry.pixel_rays(view))
    noise = np.random.default_rng(seeding.seed_for(seed, "agreed", view.name))
    return patchmatch.fitted(view, images[view.name], others, believed, noise)


def _depth(planes: np.ndarray, view: Camera) -> np.ndarray:
    return 1 / (planes * geometry.pixel_rays(view)).sum(-1)


def _confirmed(view: Camera, depth: Mapping[str, np.ndarray], views: Sequence[Camera]) -> np.ndarray:
    """bool [H, W]: pixels whose surface another view shows, too."""
    result = np.zeros(depth[view.name].shape, bool)
    for there, z, inside, _ in _elsewhere(view, depth, depth, views):
        result |= inside & (np.abs(there - z) < CONFIRMED * z)
    return result


def _contradicted(
    view: Camera, depth: Mapping[str, np.ndarray], sure: Mapping[str, np.ndarray], views: Sequence[Camera]
) -> np.ndarray:
    """bool [H, W]: pixels not sure of themselves, which another view is sure to see past."""
    result = np.zeros(depth[view.name].shape, bool)
    for there, z, inside, certain in _elsewhere(view, depth, sure, views):
        result |= inside & certain & (there > z * (1 + CONTRADICTED))
    return result & ~sure[view.name]


def _elsewhere(view: Camera, depth: Mapping[str, np.ndarray], told: Mapping[str, np.ndarray], views: Sequence[Camera]):
    """Of each other view, for all pixels of this one [H, W]: its depth where they lie in it, theirs, whether they do,
    and what it tells there."""
    points = geometry.unproject(depth[view.name], view)
    for other in views:
        if other.name != view.name:
            uv, z = geometry.project(points, other)
            there, inside = geometry.sample_nearest(depth[other.name], uv)
            yield there, z, inside & (z > 0), geometry.sample_nearest(told[other.name], uv)[0]


def _beside(
    view: Camera, image: np.ndarray, said: Known, planes: np.ndarray, depth: np.ndarray, sure: np.ndarray
) -> np.ndarray:
    """[H, W]: the depth where it is sure, and elsewhere what lies between that and the points it does not refute."""
    if not sure.any():
        return depth
    columns, rows = said.pixels.astype(int).T
    refuted = sure[rows, columns]  # or as good as told by the pixel itself
    spacing = max(1, round(SPACING * view.width / UNIT))
    grid = np.zeros(sure.shape, bool)
    grid[::spacing, ::spacing] = True
    at = np.argwhere(sure & grid)
    found = Known(at[:, ::-1] + 0.5, planes[tuple(at.T)], 1 / depth[tuple(at.T)])
    between = depth_between(said.taken(~refuted).joined(found), view, image)
    return depth if between is None else np.where(sure, depth, between)
