"""The stage `raw_masks` before it runs: the files that it reads, checks of them, and the notes that `plan` prints."""

from __future__ import annotations

from pathlib import Path

from reffusion.capture.scene_folder import is_gaussians_only, read_scene
from reffusion.capture.undistort import check_masks
from reffusion.io.annotations import file_of
from reffusion.params.raw_masks import Params


def scene_files(params: Params, scene: Path, files: list[Path]) -> list[Path]:
    """Return the sorted files of the scene that the stage reads: masks, test masks and fill masks.

    Args:
        scene: folder of the scene.
        files: all files of the scene; returned if the scene cannot be read.
    """
    try:
        roles = None if is_gaussians_only(params, scene) else read_scene(params, scene)[1]
    except ValueError:  # `preview` reports this error
        return files
    return sorted({file_of(path) for views in roles.mask_files.values() for path in views.values()}) if roles else []


def scene_facts(params: Params, scene: Path) -> dict[str, object]:
    """Return the facts "masks" and "region", on which the stage depends besides the contents of its files.

    Args:
        scene: folder of the scene.

    Returns:
        "masks": [folder that the stage writes -> view -> file, pixel values that mark the object (empty: white)], left
        out for a scene without photographs; "region": the region that the scene names and whether the scene has masks,
        left out without a region.

    Raises:
        ValueError: the scene cannot be read.
    """
    region: dict[str, object] = {}
    if params.region:
        region["region"] = params.region.model_dump() | {"holds": params.has_masks}
    if is_gaussians_only(params, scene):
        return region
    roles = read_scene(params, scene)[1]
    named = {kind: {name: str(path) for name, path in views.items()} for kind, views in roles.mask_files.items()}
    return {"masks": [named, roles.values.ids], **region}


def preview(params: Params, *, scene: Path, poses: Path | None = None) -> list[str]:
    """Read and check all masks; return their number in words and the scene's warnings, [] without photographs.

    Args:
        scene: folder of the scene.
        poses: not used.

    Raises:
        ValueError: the scene cannot be read, a mask is unreadable, or all masks of a kind are empty or all are full.
    """
    if is_gaussians_only(params, scene):
        return []
    _, roles = read_scene(params, scene)
    for files in roles.masks.values():
        check_masks(files, roles.values)
    check_masks(roles.fill)
    count = sum(len(files) for files in roles.masks.values())
    apart = f" of {', '.join(roles.masks)}" if len(roles.masks) > 1 else ""
    words = f"{count} mask{'' if count == 1 else 's'}{apart}" if count else "no masks"
    return [words, *roles.warnings]
