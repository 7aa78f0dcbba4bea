"""Reads the cameras of a capture without photographs, for a scene of Gaussians whose renders replace photographs."""

from __future__ import annotations

from pathlib import Path

from reffusion.capture.layouts import colmap, transforms
from reffusion.capture.layouts.capture import Poses
from reffusion.capture.layouts.intrinsics import check_intrinsics
from reffusion.io.files import BadInput
from reffusion.io.images import ENDINGS

FOLDERS = ("images", "images_2", "images_4", "images_8", "photos", "input", "rgb", "keyframes", "dense")
LEAST = 3  # smallest number of cameras


def has_pictures(folder: Path, but: frozenset[str] = frozenset()) -> bool:
    """Return whether a scene folder holds photographs, in the places where a layout looks for them.

    Any file there with the ending of a picture counts, also a mask.

    Args:
        but: names of files in the scene's own folder that are not photographs (references).
    """
    if transforms.split_files(folder) and transforms.has_pictures(folder):
        return True
    beside = (path for path in folder.iterdir() if path.name not in but and not path.name.startswith("."))
    within = (path for name in FOLDERS for path in (folder / name).rglob("*"))
    return any(path.suffix.lower() in ENDINGS for paths in (beside, within) for path in paths)


def read(folder: Path) -> tuple[Poses, Path] | None:
    """Read the lenses and poses of a scene folder without photographs.

    Returns:
        The cameras, without points, and the file or folder from which they were read: the first transforms file or,
        without such files, the folder of the COLMAP model. None if the scene has neither.

    Raises:
        BadInput: a file or lens is wrong, as for a capture with pictures; or there are fewer than three cameras.
    """
    model = colmap.find_model(folder)
    if sources := transforms.split_files(folder):
        poses, source = transforms.read_cameras(folder), next(iter(sources.values()))
    elif model is not None:
        poses, source = colmap.read_cameras(model), model
    else:
        return None
    if len(poses.lenses) < LEAST:
        raise BadInput(f"{source}: {len(poses.lenses)} cameras; at least {LEAST} are needed")
    check_intrinsics(poses.lenses, source)
    return poses, source
