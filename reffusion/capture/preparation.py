"""Preparation of the views: corrected poses, the size of pictures, views that are left out, and adjusted cameras.

Functions read undistorted pictures by `load`: names of views -> view name -> uint8 [H, W, 3].
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from reffusion import seeding
from reffusion.capture import cameras_around_hole, flow, image_detail, normalized_frame
from reffusion.capture.checks.agreement import judge_poses
from reffusion.capture.checks.pose_check import check_poses, judge
from reffusion.capture.layouts import cameras
from reffusion.capture.layouts.capture import Capture, Poses
from reffusion.capture.lens import Lens, undistortion_map
from reffusion.capture.own_splats import OwnSplats
from reffusion.capture.refine import refine_cameras
from reffusion.capture.roles import Roles
from reffusion.capture.scene_folder import read_scene
from reffusion.capture.undistort import load_resized
from reffusion.capture.views import check_outliers
from reffusion.io.images import fitting_size
from reffusion.params.poses import Params
from reffusion.params.reference import reference_list
from reffusion.splat.conventions import SH0
from reffusion.types import Scene

LEAST_POINTS = 100  # with fewer sparse points, some from optical flow are added
MORE_POINTS = 10_000  # largest number of added points
SEED = 0

Load = Callable[[Iterable[str]], dict[str, np.ndarray]]


def read_capture(params: Params, scene: Path) -> tuple[Capture, Roles, list[str]]:
    """Read a scene folder, and correct poses that the photographs contradict unless `params.trust`.

    The result of the comparison is printed.

    Returns:
        The capture, the roles of its views, and a list with a sentence on the correction, empty without a correction.

    Raises:
        BadInput: as for `read_scene`, or no correction makes poses and photographs agree.
    """
    capture, roles = read_scene(params, scene, params.longest)
    if capture.poses is None or params.trust:
        return capture, roles, []
    agreement = judge_poses(capture)
    print(agreement.summary, flush=True)
    if agreement.correction is None:
        return capture, roles, []
    sentence = agreement.describe(capture.pose_source)
    return *read_scene(params, scene, params.longest, agreement.correction), [sentence]


def choose_size(params: Params, capture: Capture, roles: Roles) -> int:
    """Return the larger image side, px, at which to use the pictures: `params.longest`, or half of their own side.

    Half of the side is taken, and this printed, if the pictures show no more detail than at that size. The detail is
    not tested if `params.min_detail` is 0.
    """
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

    Cameras are adjusted only if `params.refine`, and if the scene brings no Gaussians. A scene with fewer than
    `LEAST_POINTS` points gets points from optical flow. The residuals are printed.

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


def complete_points(scene: Scene, poses: Poses, pinholes: Mapping[str, Lens], load: Load) -> Scene:
    """Add `MORE_POINTS` random points to a scene with fewer than `LEAST_POINTS`, within the depths that its views see.

    Args:
        scene: the scene in the normalized frame.
        poses: the poses of the capture.
        pinholes: view -> its undistorted camera, of all views of the scene.
        load: reads undistorted pictures.
    """
    if len(scene.points) >= LEAST_POINTS:
        return scene
    shows = [name not in scene.camera_only for name in pinholes]
    ranges = normalized_frame.view_depth_ranges(poses, pinholes)[shows] * scene.similarity.scale
    draws = seeding.generator(SEED, "poses", "random points")
    shown = replace(scene, cameras={name: scene.cameras[name] for name in pinholes if name not in scene.camera_only})
    filled = normalized_frame.add_random_points(shown, ranges, MORE_POINTS, draws, lambda v: load([v])[v])
    return replace(filled, cameras=scene.cameras)


def place_gaussians_only(
    params: Params, folder: Path, own_splats: OwnSplats
) -> tuple[Scene, dict[str, Lens], list[str]]:
    """Return the scene of a folder with Gaussians, some of them deleted, and without photographs.

    The cameras are those of the folder. Without any, some are placed around the hole.

    Returns:
        The scene in the normalized frame; view name -> the pinhole of its undistorted picture; sentences for the user.

    Raises:
        BadInput: the cameras of the folder cannot be read, or no place for cameras is found (`place_cameras`).
    """
    rows, found = own_splats.splats.rows, cameras.read(folder)
    assert own_splats.edit is not None
    hole = own_splats.edit.deleted & ~own_splats.edit.scattered
    means, opaque, sizes = rows.means, rows.opacity_logits > 0, np.exp(np.median(rows.log_scales, axis=1))
    poses, source = found or (cameras_around_hole.place_cameras(means, sizes, opaque, hole, params.longest), None)
    # The sparse points are a random sample of opaque Gaussians.
    some = np.flatnonzero(opaque)
    draws = seeding.generator(SEED, "poses", "points of Gaussians")
    some = some[torch.randperm(len(some), generator=draws)[:MORE_POINTS].numpy()]
    colors = (255 * (0.5 + SH0 * rows.sh[some, 0]).clip(0, 1)).round().astype(np.uint8)
    poses = replace(poses, points=means[some], colors=colors)
    at = {n: each.resized(*fitting_size(each.width, each.height, params.longest)) for n, each in poses.lenses.items()}
    pinholes = {name: undistortion_map(lens)[0] for name, lens in at.items()}
    placed = normalized_frame.normalize_scene(poses, pinholes, sorted(pinholes), (), frozenset())
    where = f"the {len(pinholes)} cameras of {source}" if source else f"{len(pinholes)} cameras around the hole"
    sentence = (
        f"no photographs: {where} look at renders of {params.gaussians} instead; what it does not hold, or holds "
        "blurred, stays so: with photographs results are sharper"
    )
    return placed, pinholes, [sentence, *own_splats.notes]


def _adjust_cameras(params: Params, scene: Scene, load: Load) -> tuple[Scene, dict[str, float | None] | None]:
    """Adjust cameras to optical flow if `params.refine`, add points from flow if there are few; as `adjust_views`."""
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
    """Return the scene with up to `MORE_POINTS` more points, triangulated from flow between the training views."""
    views = [scene.cameras[name] for name in scene.train]
    pixels = sum(camera.width * camera.height for camera in views)
    # A view adds points only where no earlier view has any. So four times as many cells as wanted points are used.
    cell = max(2, round((pixels / MORE_POINTS / 4) ** 0.5))
    points, colors = flow.triangulate_points(views, load(scene.train), cell)
    kept = np.arange(len(points))
    if len(points) > MORE_POINTS:
        draws = seeding.generator(SEED, "poses", "flow points")
        kept = torch.randperm(len(points), generator=draws)[:MORE_POINTS].numpy()
    return replace(
        scene,
        points=np.concatenate([scene.points, points[kept]]),
        point_colors=np.concatenate([scene.point_colors, colors[kept]]),
    )
