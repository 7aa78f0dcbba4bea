"""The stage `poses`: undistorted pictures, cameras and sparse points in the normalized frame, and roles of the views.

A role says whether a view is a training or a test view, clean (without the object), or a camera without pixels.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from reffusion import trace
from reffusion.capture import normalized_frame, sfm
from reffusion.capture.checks.sanity import find_odd_photographs
from reffusion.capture.layouts.capture import Capture
from reffusion.capture.lenses import save_lenses
from reffusion.capture.own_splats import OwnSplats, load_own_splats
from reffusion.capture.preparation import (
    SEED,
    adjust_views,
    choose_size,
    complete_points,
    place_gaussians_only,
    read_capture,
)
from reffusion.capture.roles import Roles
from reffusion.capture.scene_folder import is_gaussians_only
from reffusion.capture.undistort import (
    describe_transparency,
    resized_lens,
    save_ignored_pixels,
    save_undistorted_view,
)
from reffusion.io.arrays import save_json, save_labels
from reffusion.io.images import image_size
from reffusion.io.ply import save_ply
from reffusion.io.scene import load_views, save_scene, save_warnings
from reffusion.io.splats import Splats
from reffusion.params.poses import Params
from reffusion.types import Scene

SFM_FACTS = "sfm.json"  # file with the `facts` of `sfm.Reconstruction`


def run(params: Params, out: Path, *, scene: Path) -> None:
    """Run the stage: undistort the pictures, normalize the frame, and check the cameras.

    Writes:

    - images/<view>.png, the undistorted pictures, for each view that has one;
    - ignored/<view>.png, the pixels of these pictures that the scene ignores, if it has masks of such pixels;
    - sparse/0/ (cameras and points, COLMAP), transform.json (normalized frame), views.json (roles) and lenses.json;
    - sfm.json, if poses are estimated by structure from motion;
    - refine.json, if cameras are compared with optical flow and adjusted to it where needed;
    - gaussians.ply (normalized frame), if the scene brings Gaussians;
    - deleted.npy, bool [N], if it also brings a file from which a user deleted some of them: True for the deleted ones;
    - scattered.npy, bool [N], if some of the deleted ones stood alone and leave no hole: True for these;
    - cropped.npy, bool [N], if Gaussians around the scene were deleted, too: they stay until the result is written;
    - added.ply (normalized frame), if the file has Gaussians that the scene had not;
    - movement.json, if the user also scaled, turned or shifted the scene;
    - warnings.json, if something looks wrong.

    Args:
        out: folder of this stage.
        scene: folder of the scene.

    Raises:
        BadInput: the scene cannot be used; the message names the file and the remedy.
    """
    own_splats = load_own_splats(params, scene)  # first, so that errors in these files are found before the work
    if is_gaussians_only(params, scene):
        assert own_splats is not None  # a scene without photographs has `cleaned`, which requires `gaussians`
        _save_gaussians_only(params, out, scene, own_splats)
        return
    capture, roles, messages = read_capture(params, scene)
    messages += [*capture.warnings, *(own_splats.notes if own_splats else ())]
    messages += describe_transparency([*roles.train, *roles.test], capture)
    sizes = {name: image_size(path, upright=capture.upright) for name, path in capture.pictures.items()}
    if capture.poses is None:
        everyone, capture = sorted(capture.pictures), _run_sfm(params, out, capture, roles)
        if lost := [name for name in everyone if name not in capture.pictures]:
            messages.append(f"{len(lost)} views were not placed and are left out: {', '.join(lost)}")
        roles = roles.restrict(set(capture.pictures))
    views, longest = sorted({*roles.train, *roles.test}), choose_size(params, capture, roles)
    lenses, pinholes = {}, {}
    for k in trace.progress(len(views), "poses"):
        lenses[views[k]], pinholes[views[k]] = save_undistorted_view(out, views[k], capture, longest)
        save_ignored_pixels(out, views[k], roles, lenses[views[k]])
    for name in roles.camera_only:
        lenses[name], pinholes[name] = resized_lens(name, capture, longest)
    assert capture.poses is not None
    normalized = normalized_frame.normalize_scene(capture.poses, pinholes, roles.train, roles.test, roles.clean)
    normalized = replace(normalized, camera_only=roles.camera_only)
    normalized, contradictions, residuals = adjust_views(params, roles, normalized, partial(load_views, out))
    if residuals:
        save_json(out / "refine.json", residuals)
    views = [name for name in views if name in normalized.cameras]
    lenses, pinholes = ({n: each[n] for n in each if n in normalized.cameras} for each in (lenses, pinholes))
    save_lenses(out, lenses, capture.upright, {name: sizes[name] for name in lenses})
    load_one = lambda name: load_views(out, [name])[name]
    save_warnings(out, [*messages, *contradictions, *find_odd_photographs(normalized, load_one)])
    normalized = complete_points(normalized, capture.poses, pinholes, partial(load_views, out))
    save_scene(out, normalized)
    if own_splats is not None:
        _save_own_splats(out, normalized, own_splats)


def _save_own_splats(out: Path, placed: Scene, own_splats: OwnSplats) -> None:
    """Write gaussians.ply in the normalized frame, and what the user did to it."""
    # The properties have the order of the scene's file.
    save_ply(out / "gaussians.ply", own_splats.splats.gaussians(placed.similarity), properties=own_splats.properties)
    if (edit := own_splats.edit) is None:
        return
    save_labels(out / "deleted.npy", edit.deleted)
    for name, labels in (("scattered", edit.scattered), ("cropped", edit.cropped)):
        if labels.any():
            save_labels(out / f"{name}.npy", labels)
    if edit.added is not None:
        save_ply(out / "added.ply", Splats(edit.added, False, ()).gaussians(placed.similarity))
    if not edit.movement.is_still:
        save_json(out / "movement.json", {key: np.asarray(each).tolist() for key, each in vars(edit.movement).items()})


def _save_gaussians_only(params: Params, out: Path, scene: Path, own_splats: OwnSplats) -> None:
    """Write the stage's files, but no pictures, for a scene of Gaussians with a deleted object and no photographs."""
    placed, pinholes, messages = place_gaussians_only(params, scene, own_splats)
    save_lenses(out, pinholes, False, {n: (each.width, each.height) for n, each in pinholes.items()})
    save_warnings(out, messages)
    save_scene(out, placed)
    _save_own_splats(out, placed, own_splats)


def _run_sfm(params: Params, out: Path, capture: Capture, roles: Roles) -> Capture:
    """Estimate the poses by structure from motion, leave out views that could not be placed, and write sfm.json."""
    found = sfm.reconstruct(capture.pictures, params.longest, out / "sfm", SEED, roles.ignore)
    facts = found.facts()
    print(facts["summary"], flush=True)
    save_json(out / SFM_FACTS, facts)
    return replace(capture, pictures={name: capture.pictures[name] for name in found.poses.lenses}, poses=found.poses)
