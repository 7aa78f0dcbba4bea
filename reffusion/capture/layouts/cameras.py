"""Reads a capture's cameras without its photographs, for a scene that brings Gaussians whose renders stand for them."""

from __future__ import annotations

from pathlib import Path

from reffusion.capture.layouts import colmap, transforms
from reffusion.capture.layouts.capture import Poses
from reffusion.io.files import BadInput
from reffusion.io.images import ENDINGS

FOLDERS = ("images", "images_2", "images_4", "images_8", "photos", "input")
LEAST = 3  # cameras that are needed


def has_pictures(folder: Path, but: frozenset[str] = frozenset()) -> bool:
    """Is there a photograph where a layout looks for one? `but`: names of pictures in the folder that are no
    photographs."""
    if transforms.split_files(folder) and transforms.has_pictures(folder):
        return True
    beside = (path for path in folder.iterdir() if path.name not in but and not path.name.startswith("."))
    within = (path for name in FOLDERS for path in (folder / name).rglob("*"))
    return any(path.suffix.lower() in ENDINGS for paths in (beside, within) for path in paths)


def read(folder: Path) -> tuple[Poses, Path] | None:
    """Lenses and poses, and the file they come from; None where the folder has neither transforms.json nor a COLMAP
    model.

    Raises:
        BadInput: as for a capture with pictures; or there are fewer than three cameras.
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
    return poses, source
