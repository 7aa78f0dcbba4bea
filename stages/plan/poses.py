"""The stage `poses` before it runs: the files that it reads, checks of the scene, and the notes that `plan` prints."""

from __future__ import annotations

import re
from pathlib import Path

from reffusion.capture import lens
from reffusion.capture.layouts import cameras
from reffusion.capture.layouts.capture import Capture
from reffusion.capture.roles import capture_views, describe_split
from reffusion.capture.scene_folder import check_gaussian_files, is_gaussians_only, read_scene
from reffusion.capture.undistort import check_ignored
from reffusion.io.annotations import file_of
from reffusion.io.images import ENDINGS, image_size
from reffusion.params.clicks import CLICKS
from reffusion.params.poses import Params
from reffusion.references.files import PAINTED, describe_references, load_reference_files

# Endings of pictures and depth maps. Of such files the stage reads only those of the capture; others are masks or
# references, which later stages read.
NOT_READ = (*ENDINGS, ".npy", ".exr")
REDUCED = re.compile(r"images_\d+")  # folders of pictures at a fraction of their size


def scene_files(params: Params, scene: Path, files: list[Path]) -> list[Path]:
    """Return the sorted files of the scene that the stage reads.

    They are the photographs and depth maps of the capture, the masks of ignored pixels, the Gaussians that the scene
    brings, and all files that are neither pictures nor depth maps, except scene.yaml, the file of clicks and the folder
    of painted references. So the stage does not run again when masks, clicks or references are added. If the scene
    cannot be read, all files but scene.yaml and the clicks are returned.

    Args:
        scene: folder of the scene.
        files: all files of the scene.
    """
    others = [path for path in files if path.parent != scene or path.name not in ("scene.yaml", CLICKS)]
    brought = {scene / name for name in (params.gaussians, params.cleaned) if name is not None}
    try:
        if is_gaussians_only(params, scene):
            return sorted({path for path in others if path.suffix.lower() not in NOT_READ} | brought)
        capture, roles = read_scene(params, scene, params.longest)
    except ValueError:  # `preview` reports this error
        return others
    shown = {path for name, path in capture.pictures.items() if name not in roles.camera_only}
    read = shown | brought | set(capture.depth_maps)
    masks = {file_of(path) for files in roles.mask_files.values() for path in files.values()}
    kept = [path for path in others if path.suffix.lower() not in NOT_READ or path.name == "poses_bounds.npy"]
    read |= {file_of(path) for paths in roles.ignore.values() for path in paths}
    return sorted(read | {path for path in kept if path.parent != scene / PAINTED and path not in masks})


def scene_facts(params: Params, scene: Path) -> dict[str, object]:
    """Return facts about the capture; {} without photographs.

    The facts are "views": [training, test, clean, camera-only], a list of view names each; "brings_poses": whether
    structure from motion is left out; "megapixels": the size of the first view, as it will be used; and, only if there
    are masks of ignored pixels, "ignore": view name -> their files. The stage depends on the roles of views, which may
    depend on the names of masks, while it does not read the masks.

    Args:
        scene: folder of the scene.

    Raises:
        ValueError: the scene cannot be read.
    """
    if is_gaussians_only(params, scene):
        return {}
    capture, roles = read_scene(params, scene, params.longest)
    views = [roles.train, roles.test, sorted(roles.clean), roles.camera_only]
    width, height = capture_views(capture, roles).size_of(next(iter(capture.pictures)))
    reduced = min(1.0, params.longest / max(width, height))
    megapixels = round(width * height * reduced**2 / 1e6, 6)
    ignored = {name: [path.relative_to(scene).as_posix() for path in paths] for name, paths in roles.ignore.items()}
    facts = {"ignore": ignored} if ignored else {}
    return facts | {"views": views, "brings_poses": capture.poses is not None, "megapixels": megapixels}


def preview(params: Params, scene: Path) -> list[str]:
    """Describe what the stage will do, a sentence each. Of pictures and Gaussians only headers are read.

    Args:
        scene: folder of the scene.

    Raises:
        ValueError: the stage would fail; or a reference that the scene brings, which a later stage reads, belongs to
            none of its views.
    """
    if is_gaussians_only(params, scene):
        brought = check_gaussian_files(params, scene)
        found = cameras.read(scene)
        who = f"{len(found[0].lenses)} cameras of {found[1].relative_to(scene)}" if found else "cameras around the hole"
        return [f"no photographs: {who} look at renders of {params.gaussians} instead", *brought]
    capture, roles = read_scene(params, scene, params.longest)
    check_ignored(roles.ignore)
    given = load_reference_files(scene, capture_views(capture, roles), params.reference)
    notes = [describe_split(len(roles.train), len(roles.test))]
    notes += [f"{len(roles.camera_only)} views are camera-only"] if roles.camera_only else []
    notes += [f"parts of {len(roles.ignore)} photographs are ignored"] if roles.ignore else []
    notes += _describe_poses(capture, scene)
    notes += _describe_reduced_pictures(capture, params.longest)
    notes += [f"the scene brings a reference of {describe_references(given)}"] if given else []
    return [*notes, *capture.warnings, *check_gaussian_files(params, scene)]


def _describe_poses(capture: Capture, scene: Path) -> list[str]:
    """Describe in sentences where the poses come from, and whether the pictures need undistortion."""
    if capture.poses is None:
        return [
            f"the poses of {len(capture.pictures)} photographs are computed from the pictures (structure from motion)"
        ]
    shifts = {each: lens.largest_shift(each) for each in set(capture.poses.lenses.values())}
    worst = max(shifts, key=shifts.__getitem__)
    moved = f"{worst.coefficients()} moves the border by up to {shifts[worst]:.1f} px"
    pinhole = shifts[worst] <= lens.PINHOLE_ENOUGH
    return [
        f"the poses come from {capture.pose_source.relative_to(scene)}",
        "the photographs need no undistortion: the lens is a pinhole" if pinhole else f"undistortion: {moved}",
    ]


def _describe_reduced_pictures(capture: Capture, longest: int) -> list[str]:
    """Say at which size the scene runs if its pictures are a reduced copy (`images_4`) with fewer than `longest` px."""
    picture = next(iter(capture.pictures.values()))
    size, folder = image_size(picture), picture.parent.name
    if max(size) >= longest or not REDUCED.fullmatch(folder):
        return []
    return [
        f"the scene runs at {size[0]}x{size[1]} px, the size of {folder}, not at the {longest} px of poses.longest: "
        "it brings no larger pictures"
    ]
