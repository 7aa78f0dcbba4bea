"""Preparation of the views: the size at which pictures are used, views that are left out, and adjusted cameras.

Functions read undistorted pictures by `load`: names of views -> view name -> uint8 [H, W, 3].
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import torch

from reffusion import seeding
from reffusion.capture import flow, image_detail
from reffusion.capture.checks.pose_check import check_poses, judge
from reffusion.capture.layouts.capture import Capture
from reffusion.capture.refine import refine_cameras
from reffusion.capture.roles import Roles
from reffusion.capture.undistort import load_resized
from reffusion.capture.views import check_outliers
from reffusion.params.poses import Params
from reffusion.params.reference import reference_list
from reffusion.types import Scene

LEAST_POINTS = 100  # with fewer sparse points, some from optical flow are added
MORE_POINTS = 10_000  # largest number of added points
SEED = 0

Load = Callable[[Iterable[str]], dict[str, np.ndarray]]


def choose_size(params: Params, capture: Capture, roles: Roles) -> int:
    """Return the larger image side, px, at which to use the pictures: `params.longest`, or half if that is as sharp."""
    if params.min_detail == 0:
        return params.longest
    # Up to 15 training views are tested. Pictures that are blurred or were enlarged are halved.
    chosen = roles.train[:: max(1, len(roles.train) // 8)]
    images = [load_resized(capture.pictures[name], params.longest, capture.upright) for name in chosen]
    if not image_detail.is_enlarged(images, params.min_detail):
        return params.longest
    side = max(max(image.shape[:2]) for image in images)
    print(f"pictures of {side} px show no more than {side // 2} px would: taken at that size", flush=True)
    return side // 2


def adjust_views(
    params: Params, roles: Roles, scene: Scene, load: Load
) -> tuple[Scene, list[str], dict[str, float | None] | None]:
    """Leave out views that contradict their poses, and adjust the cameras of the others to optical flow.

    Returns:
        The scene; sentences about views that are left out or doubtful; and the residuals of the cameras, px, "before"
        and "after" their adjustment (None: nothing matched, or none was needed), or None if they were not compared.

    Raises:
        BadInput: scene.yaml uses a view that is left out, e.g. for a reference.
    """
    # The check compares views at shared points. A scene with too few sparse points gets points from optical flow first.
    is_adjusted = len(scene.points) < LEAST_POINTS
    connected, residuals = _adjust_cameras(params, scene, load) if is_adjusted else (scene, None)
    shown = [camera for name, camera in connected.cameras.items() if name not in connected.camera_only]
    check = check_poses(shown, connected.points, lambda name: load([name])[name])
    verdict = judge(check, connected, roles.keep, params.exclude)
    check_outliers("reference", [each.view for each in reference_list(params.reference)], verdict.outliers)
    check_outliers("clicks", params.clicks or (), verdict.outliers)
    if params.region is not None and params.region.view is not None:
        check_outliers("region", [params.region.view], verdict.outliers)
    if verdict.outliers or not is_adjusted:
        connected, residuals = _adjust_cameras(params, verdict.apply(scene), load)
    return replace(connected, suspects=verdict.suspects), list(verdict.sentences), residuals


def _adjust_cameras(params: Params, scene: Scene, load: Load) -> tuple[Scene, dict[str, float | None] | None]:
    """Adjust the cameras to optical flow if `params.refine`, and add points from flow if the scene has few points."""
    residuals = None
    if params.refine and params.gaussians is None:  # Gaussians that the scene brings were fitted with its cameras
        scene, residuals = _refine_cameras(scene, load)
    return (scene if len(scene.points) >= LEAST_POINTS else _add_flow_points(scene, load)), residuals


def _refine_cameras(scene: Scene, load: Load) -> tuple[Scene, dict[str, float | None]]:
    """Adjust the cameras to optical flow if it shows a need; print and return the residuals, px."""
    # Test views are adjusted too, as in structure from motion.
    shown = {name: camera for name, camera in scene.cameras.items() if name not in scene.camera_only}
    found = refine_cameras(list(shown.values()), load(shown))
    if np.isnan(found.before):
        print("cameras as given: optical flow matches nothing between the views", flush=True)
    elif found.after is None:
        print(f"cameras as given: the views miss each other by {found.before:.2f} px", flush=True)
    else:
        print(f"cameras adjusted: views missed each other by {found.before:.2f} px, now {found.after:.2f}", flush=True)
    before = None if np.isnan(found.before) else found.before
    return replace(scene, cameras=scene.cameras | found.cameras), {"before": before, "after": found.after}


def _add_flow_points(scene: Scene, load: Load) -> Scene:
    """Add up to `MORE_POINTS` points, triangulated from optical flow between the training views."""
    cameras = [scene.cameras[name] for name in scene.train]
    pixels = sum(camera.width * camera.height for camera in cameras)
    # A view adds points only where no earlier view has any. So four times as many cells as wanted points are used.
    cell = max(2, round((pixels / MORE_POINTS / 4) ** 0.5))
    points, colors = flow.triangulate_points(cameras, load(scene.train), cell)
    kept = np.arange(len(points))
    if len(points) > MORE_POINTS:
        draws = seeding.generator(SEED, "poses", "flow points")
        kept = torch.randperm(len(points), generator=draws)[:MORE_POINTS].numpy()
    return replace(
        scene,
        points=np.concatenate([scene.points, points[kept]]),
        point_colors=np.concatenate([scene.point_colors, colors[kept]]),
    )
