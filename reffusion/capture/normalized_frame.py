"""The normalized frame of a scene: the similarity into this frame, which follows from estimates of the scene's depth.

For scenes with few sparse points, random points are added.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from reffusion.capture.lens import Lens
from reffusion.io.files import BadInput

if TYPE_CHECKING:
    from torch import Generator

    from reffusion.capture.layouts.capture import Poses
    from reffusion.types import Camera, Scene, Similarity


def depth_ranges(
    world_to_camera: np.ndarray, lenses: Sequence[Lens], points: np.ndarray, bounds: np.ndarray | None
) -> np.ndarray:
    """Estimate the near, typical and far camera depth of each view.

    Each view takes the first of these estimates that is available:
    - If at least 10 points lie inside its picture: the 1st, 50th and 99th percentile of their depths.
    - If there are LLFF bounds: near and far as given. The typical depth is their mean in disparity.
    - From all cameras: the typical depth is the depth of the point nearest to all optical axes. If these are parallel
      or meet behind the cameras, the typical depth is three times the spread of the cameras (root mean square distance
      of their centers from the mean center). Near and far are a third of the typical depth and four times as much.
    - If all cameras are at one place: the median over the views that have enough points.

    Args:
        world_to_camera: [V, 4, 4].
        lenses: V lenses; their distortion is ignored.
        points: [P, 3] sparse points.
        bounds: [V, 2] near and far depth of each view; None if the capture has none.

    Returns:
        [V, 3] float64: near, typical and far, all positive, in the scene's units.

    Raises:
        BadInput: no view has 10 points, there are no bounds, and all cameras are at one place.
    """
    guess = _axis_intersection_depths(world_to_camera) if bounds is None else None
    ranges = np.empty((len(lenses), 3))
    for k, (pose, lens) in enumerate(zip(world_to_camera, lenses, strict=True)):
        z = depths_in_view(points, pose, lens)
        if len(z) >= 10:
            ranges[k] = np.percentile(z, (1, 50, 99))
        elif bounds is not None:
            near, far = bounds[k]
            ranges[k] = near, 2.0 / (1.0 / near + 1.0 / far), far
        else:
            ranges[k] = np.nan if np.isnan(guess[k]) else guess[k] * np.array([1 / 3, 1.0, 4.0])
    known = ~np.isnan(ranges[:, 1])
    if not known.any():
        raise BadInput("no points, no bounds and all cameras at one place: nothing tells how far the scene is")
    ranges[~known] = np.median(ranges[known], axis=0)
    return ranges


def depths_in_view(points: np.ndarray, world_to_camera: np.ndarray, lens: Lens) -> np.ndarray:
    """Return the camera depths [Q] of those Q of the points [P, 3] that project into the picture.

    Distortion is ignored.
    """
    at = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    at = at[at[:, 2] > 0]
    uv = at[:, :2] / at[:, 2:] * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    return at[((uv >= 0) & (uv <= (lens.width, lens.height))).all(axis=1), 2]


def nearest_depths(cells: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Return [P], for each point the smallest depth of all points in the same cell.

    Args:
        cells: int [P], any number that identifies the point's cell of the picture.
        depths: [P], camera depths of the points.
    """
    order = np.argsort(depths)
    found, first = np.unique(cells[order], return_index=True)
    return depths[order][first][np.searchsorted(found, cells)]


def camera_centers(world_to_camera: np.ndarray) -> np.ndarray:
    """Return the camera centers [V, 3] of world-to-camera poses [V, 4, 4]."""
    return -np.einsum("vji,vj->vi", world_to_camera[:, :3, :3], world_to_camera[:, :3, 3])


def _axis_intersection_depths(world_to_camera: np.ndarray) -> np.ndarray:
    """Return the camera depth [V] of the point nearest to all optical axes; NaN if all cameras are at one place."""
    centers, axes = camera_centers(world_to_camera), world_to_camera[:, 2, :3]
    perpendicular = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = centers.mean(axis=0)
    matrix = perpendicular.mean(axis=0)
    intersection = middle
    if np.linalg.eigvalsh(matrix)[0] > 1e-3:  # mean squared sine of about 2 degrees between the axes
        intersection = middle + np.linalg.solve(
            matrix, np.einsum("vij,vj->i", perpendicular, centers - middle) / len(centers)
        )
    depths = np.einsum("vi,vi->v", intersection - centers, axes)
    spread = np.sqrt(((centers - middle) ** 2).sum(axis=1).mean())
    if np.median(depths) > 0.2 * spread:
        return np.maximum(depths, 0.2 * np.median(depths))
    # the axes are parallel or meet behind the cameras
    return np.full(len(centers), 3.0 * spread if spread > 0 else np.nan)


def normalizing_similarity(world_to_camera: np.ndarray, typical: np.ndarray) -> Similarity:
    """Return the similarity into the normalized frame.

    In this frame the middle of the scene is at the origin, and the typical distance of the cameras from it is 1. The
    scale is one over the median of the typical depths. The offset is the median, axis by axis, of the points at typical
    depth on the optical axes. So for photographs from one side the object is near the origin, and the cameras are at a
    distance of about 1. For photographs from all around, the cameras lie on a ring of radius about 1. A scaled or
    translated scene has the same normalized frame. There is no rotation. All numbers are float64, so coordinates that
    are offset by a million times the scene's extent (geo-referenced ones) keep ten digits.

    Args:
        world_to_camera: [V, 4, 4] in the scene's own frame.
        typical: [V], typical depth of each view, see `depth_ranges`.
    """
    from reffusion.types import Similarity

    looked_at = camera_centers(world_to_camera) + typical[:, None] * world_to_camera[:, 2, :3]
    return Similarity(float(1.0 / np.median(typical)), np.median(looked_at, axis=0))


def normalize_pose(world_to_camera: np.ndarray, similarity: Similarity) -> np.ndarray:
    """Convert a world-to-camera pose [4, 4] of the scene's own frame to one of the normalized frame."""
    pose = world_to_camera.copy()
    pose[:3, 3] = similarity.scale * (world_to_camera[:3, :3] @ similarity.offset + world_to_camera[:3, 3])
    return pose


def view_depth_ranges(poses: Poses, pinholes: Mapping[str, Lens]) -> np.ndarray:
    """Return `depth_ranges` [V, 3] of the views in `pinholes`, in the order of `pinholes` and in the scene's units."""
    bounds = np.array([poses.bounds[name] for name in pinholes]) if poses.bounds else None
    return depth_ranges(_stack_poses(poses, pinholes), list(pinholes.values()), poses.points, bounds)


def _stack_poses(poses: Poses, names: Mapping[str, Lens]) -> np.ndarray:
    return np.stack([poses.world_to_camera[name] for name in names])


def normalize_scene(
    poses: Poses, pinholes: Mapping[str, Lens], train: Sequence[str], test: Sequence[str], clean: frozenset[str]
) -> Scene:
    """Return a capture's cameras and sparse points as a Scene in the normalized frame (`normalizing_similarity`).

    Raises BadInput as `depth_ranges` does.

    Args:
        poses: poses and points in the scene's own frame.
        pinholes: view name -> lens of the undistorted picture; only these views are in the scene.
        train, test, clean: names of the training views, the test views, and the training views without the object.
    """
    from reffusion.types import Camera, Scene

    similarity = normalizing_similarity(_stack_poses(poses, pinholes), view_depth_ranges(poses, pinholes)[:, 1])
    cameras = {
        name: Camera(
            name,
            pinhole.width,
            pinhole.height,
            pinhole.fx,
            pinhole.fy,
            pinhole.cx,
            pinhole.cy,
            normalize_pose(poses.world_to_camera[name], similarity),
        )
        for name, pinhole in sorted(pinholes.items())
    }
    return Scene(cameras, tuple(train), tuple(test), clean, similarity.apply(poses.points), poses.colors, similarity)


def add_random_points(
    scene: Scene, ranges: np.ndarray, count: int, generator: Generator, image_of: Callable[[str], np.ndarray]
) -> Scene:
    """Return the scene with `count` more points, drawn at random in the views' frusta (`sample_frustum_points`).

    Each point has the color of the pixel for which it was drawn.

    Args:
        ranges: [V, 3] near, typical and far depth of the views of `scene.cameras` in order, in the normalized frame.
        image_of: function from a view's name to its picture, uint8 [H, W, 3].
    """
    names = list(scene.cameras)
    points, views, pixels = sample_frustum_points(list(scene.cameras.values()), ranges, count, generator)
    colors = np.zeros((len(points), 3), np.uint8)
    for k in np.unique(views):
        mine = views == k
        colors[mine] = image_of(names[k])[pixels[mine, 1], pixels[mine, 0]]
    return replace(
        scene, points=np.concatenate([scene.points, points]), point_colors=np.concatenate([scene.point_colors, colors])
    )


def sample_frustum_points(
    cameras: Sequence[Camera], ranges: np.ndarray, count: int, generator: Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw random points in the views' frusta: uniform over pixels, and over disparity between near and far depth.

    Four times `count` points are drawn. Points inside the pictures of at least two views are kept first, so that few
    points float in front of a single camera.

    Args:
        ranges: [V, 3] near, typical and far depth of each of the V cameras, V > 0.

    Returns:
        points [count, 3]; int [count], the index of the view for which each point was drawn; int [count, 2], the
        (column, row) of its pixel in this view.
    """
    import torch

    from reffusion.geometry import project

    views = np.arange(4 * count) % len(cameras)
    u = torch.rand((4 * count, 3), generator=generator, dtype=torch.float64).numpy()
    of_view = lambda pick: np.array([pick(camera) for camera in cameras], np.float64)[views]
    size, focal = of_view(lambda c: (c.width, c.height)), of_view(lambda c: (c.fx, c.fy))
    near, far = ranges[views, 0], ranges[views, 2]
    pixels = u[:, :2] * size
    z = 1.0 / (u[:, 2] / near + (1.0 - u[:, 2]) / far)
    at = np.concatenate([(pixels - of_view(lambda c: (c.cx, c.cy))) / focal * z[:, None], z[:, None]], axis=1)
    pose = of_view(lambda c: c.world_to_camera)
    points = np.einsum("nji,nj->ni", pose[:, :3, :3], at - pose[:, :3, 3])
    seen = np.zeros(len(points), int)
    for camera in cameras:
        uv, depth = project(points, camera)
        seen += (depth > 0) & ((uv >= 0) & (uv <= (camera.width, camera.height))).all(axis=1)
    chosen = np.sort(np.argsort(seen < 2, kind="stable")[:count])
    return points[chosen], views[chosen], np.minimum(pixels[chosen].astype(int), size[chosen].astype(int) - 1)
