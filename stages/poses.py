"""poses: pictures without distortion, cameras and sparse points in the normalised frame, masks, the split."""

from __future__ import annotations

import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    from reffusion.capture.layouts.capture import Capture
    from reffusion.capture.roles import Roles
    from reffusion.types import Scene

STRICT = ConfigDict(extra="forbid", frozen=True)
# pictures count where they are photographs or masks; depth maps belong to references
NOT_READ = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".npy", ".exr")


class Region(BaseModel):
    model_config = STRICT

    center: tuple[float, float, float] = Field(description="of a box along the axes, in the scene's own frame")
    size: tuple[float, float, float] = Field(description="side lengths in the scene's own units")


class Params(BaseModel):
    model_config = STRICT

    layout: Literal["llff", "colmap", "transforms", "photos"] | None = Field(None, description="None: recognised")
    images: str | None = Field(None, description="folder of pictures, relative to the scene; None: the usual ones")
    masks: str | None = Field(None, description='folder of masks; "none": the scene has none; None: the usual ones')
    test_masks: str | None = Field(None, description="folder of masks of test views, by name or in their order")
    train: list[str] | str | None = Field(None, description='view names, or "every N"; None: all that are not test')
    test: list[str] | str | None = Field(None, description='view names, or "every N"; None: those of the test masks')
    clean: list[str] = Field([], description="training views in which the object is absent")
    gaussians: str | None = Field(None, description=".ply the scene brings in its own frame, 3DGS layout")
    region: Region | None = Field(None, description="3D box that holds the object, or is to be filled")
    longest: int = Field(1600, ge=16, description="larger image side in px; smaller pictures stay as they are")
    # PAPER leaves open: pictures that are blurred or were enlarged. It takes 1600 px; half of them may show as much.
    detail: float = Field(0.0, ge=0, description="pictures of less are halved, see reffusion.capture.support; 0: never")
    refine: bool = Field(False, description="adjust cameras, the principal point of each view too, that flow belies")
    least_points: int = Field(100, ge=0, description="with fewer sparse points, some of optical flow are added to them")
    more_points: int = Field(10_000, ge=1, description="how many at most; random ones, where flow finds too few")
    seed: int = 0


def scene_files(params: Params, scene: Path, files: list[Path]) -> list[Path]:
    """Of the scene's files those that this stage reads, and what it reads elsewhere: the photographs and masks, and
    all that is neither a picture nor a depth map. So a new reference, wherever it lies, reruns nothing here."""
    others = [path for path in files if path.parent != scene or path.name != "scene.yaml"]
    try:
        capture, roles = _read(params, scene)
    except ValueError:  # `preview` refuses it
        return others
    read = {*capture.pictures.values(), *roles.masks.values(), *roles.test_masks.values()}
    read |= {scene / params.gaussians} if params.gaussians is not None else set()
    kept = [path for path in others if path.suffix.lower() not in NOT_READ or path.name == "poses_bounds.npy"]
    return sorted(read | {path for path in kept if path.parent != scene / "painted"})


def preview(params: Params, scene: Path) -> list[str]:
    """What the stage will do, from headers alone. ValueError where it would refuse."""
    from reffusion.capture import lens

    capture, roles = _read(params, scene)
    notes = [f"{len(roles.train)} training and {len(roles.test)} test views, {len(roles.masks)} masks"]
    if capture.poses is None:
        notes.append(f"SfM: {len(capture.pictures)} photos bring no poses")
    else:
        notes.append(f"SfM left out: {capture.brought_by.relative_to(scene)} brings poses")
        shifts = {each: lens.largest_shift(each) for each in set(capture.poses.lenses.values())}
        worst = max(shifts, key=shifts.__getitem__)
        moved = f"{worst.coefficients()} moves the border by up to {shifts[worst]:.1f} px"
        pinhole = shifts[worst] <= lens.PINHOLE_ENOUGH
        notes.append("undistortion left out: the lens is a pinhole" if pinhole else f"undistortion: {moved}")
    return [*notes, *capture.warnings, *roles.warnings]


def run(params: Params, out: Path, *, scene: Path) -> None:
    from reffusion import seeding, trace
    from reffusion.capture import frame
    from reffusion.capture.undistorted import check_masks, save_lenses, save_undistorted
    from reffusion.io.arrays import save_json
    from reffusion.io.ply import load_ply, save_ply
    from reffusion.io.scene import load_views, save_scene

    capture, roles = _read(params, scene)
    for warning in (*capture.warnings, *roles.warnings):
        warnings.warn(warning, stacklevel=1)
    check_masks(roles.masks)
    if capture.poses is None:
        capture = _place(params, out, capture)
        roles = roles.among(set(capture.pictures))
    views, longest = sorted({*roles.train, *roles.test}), _supported_size(params, capture, roles)
    lenses, pinholes = {}, {}
    for k in trace.progress(len(views), "poses"):
        lenses[views[k]], pinholes[views[k]] = save_undistorted(out, views[k], capture, roles, longest)
    save_lenses(out, lenses, capture.upright)
    shutil.rmtree(out / "sfm", ignore_errors=True)
    normalised = frame.normalised(capture.poses, pinholes, roles.train, roles.test, roles.clean)
    if params.refine and params.gaussians is None:  # Gaussians that the scene brings were fitted with its cameras
        normalised = _refined(normalised, out)
    if len(normalised.points) < max(params.least_points, 1):
        normalised = _with_flow_points(params, normalised, out)
    if len(normalised.points) < max(params.least_points, 1):
        ranges = frame.ranges_of(capture.poses, pinholes) * normalised.similarity.scale
        draws = seeding.generator(params.seed, "poses", "random points")
        normalised = frame.filled_up(normalised, ranges, params.more_points, draws, lambda v: load_views(out, [v])[v])
    save_scene(out, normalised)
    similarity = normalised.similarity
    if params.gaussians is not None:
        save_ply(out / "gaussians.ply", load_ply(scene / params.gaussians, similarity))
    if params.region is not None:
        center = similarity.apply(params.region.center).tolist()
        size = [side * similarity.scale for side in params.region.size]
        save_json(out / "region.json", {"center": center, "size": size})


def _supported_size(params: Params, capture: Capture, roles: Roles) -> int:
    """The larger image side that the training views' pictures support, at most `longest`."""
    from reffusion.capture import support
    from reffusion.capture.undistorted import load_at

    if params.detail == 0:
        return params.longest
    chosen = roles.train[:: max(1, len(roles.train) // 8)]
    images = [load_at(capture.pictures[name], params.longest, capture.upright) for name in chosen]
    if not support.enlarged(images, params.detail):
        return params.longest
    side = max(images[0].shape[:2])
    print(f"pictures of {side} px show no more than {side // 2} px would: taken at that size", flush=True)
    return side // 2


def _refined(scene: Scene, out: Path) -> Scene:
    """The scene with cameras that agree with optical flow; test views too, as they are in structure from motion."""
    from reffusion.capture.refine import refined
    from reffusion.io.arrays import save_json
    from reffusion.io.scene import load_views

    found = refined(list(scene.cameras.values()), load_views(out, scene.cameras))
    if found.after is None:
        print(f"cameras as given: the views miss each other by {found.before:.2f} px", flush=True)
    else:
        print(f"cameras adjusted: views missed each other by {found.before:.2f} px, now {found.after:.2f}", flush=True)
    save_json(out / "refine.json", {"before": found.before, "after": found.after})
    return replace(scene, cameras=found.cameras)


def _with_flow_points(params: Params, scene: Scene, out: Path) -> Scene:
    """The scene with points that its training views' optical flow shows."""
    import numpy as np
    import torch

    from reffusion import seeding
    from reffusion.capture import stereo
    from reffusion.io.scene import load_views

    cameras = [scene.cameras[name] for name in scene.train]
    pixels = sum(camera.width * camera.height for camera in cameras)
    cell = max(2, round((pixels / params.more_points / 4) ** 0.5))  # most views' points were seen by another already
    points, colors = stereo.dense_points(cameras, load_views(out, scene.train), cell)
    kept = np.arange(len(points))
    if len(points) > params.more_points:
        draws = seeding.generator(params.seed, "poses", "flow points")
        kept = torch.randperm(len(points), generator=draws)[: params.more_points].numpy()
    return replace(
        scene,
        points=np.concatenate([scene.points, points[kept]]),
        point_colors=np.concatenate([scene.point_colors, colors[kept]]),
    )


def _place(params: Params, out: Path, capture: Capture) -> Capture:
    """The capture with poses by structure from motion, its pictures upright and at their final size."""
    from reffusion.capture import sfm
    from reffusion.capture.undistorted import load_at
    from reffusion.io.images import save_image

    work = out / "sfm"
    prepared = {name: work / "images" / f"{name}.png" for name in capture.pictures}
    for name, path in prepared.items():
        save_image(path, load_at(capture.pictures[name], params.longest, upright=True))
    poses = sfm.solve(prepared, capture.pictures, work / "colmap", params.seed)
    lost = sorted(set(prepared) - set(poses.lenses))
    if lost:
        warnings.warn(f"{len(lost)} views were not placed and are left out: {', '.join(lost)}", stacklevel=1)
    return replace(capture, pictures={name: prepared[name] for name in poses.lenses}, poses=poses)


def _read(params: Params, scene: Path) -> tuple[Capture, Roles]:
    """The capture and its views' roles, checked before any work."""
    from reffusion.capture.load import load_capture
    from reffusion.capture.roles import load_roles

    capture = load_capture(scene, params.layout, params.images)
    roles = load_roles(
        scene,
        capture,
        masks=params.masks,
        test_masks=params.test_masks,
        train=params.train,
        test=params.test,
        clean=params.clean,
        region=params.region is not None,
    )
    if params.gaussians is not None and not (scene / params.gaussians).is_file():
        raise ValueError(f"{scene / params.gaussians}: no such file; correct `gaussians` in scene.yaml")
    return capture, roles
