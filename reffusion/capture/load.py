"""The layouts in which captures come: SPIn-NeRF/LLFF, COLMAP, nerfstudio's transforms.json, or photos only.

Every reader gives the same: pictures by view name and, where the folder brings them, lenses and poses in the
scene's own frame. Nothing but headers of pictures is read.
"""

from __future__ import annotations

from pathlib import Path

from reffusion.capture.layouts import colmap, llff, photos, transforms
from reffusion.capture.layouts.capture import Capture, Poses, pictures_in
from reffusion.io.files import BadInput, there, understood

__all__ = ["LAYOUTS", "Capture", "Poses", "load_capture", "pictures_in", "recognise"]

LAYOUTS = ("llff", "colmap", "transforms", "photos")
LONGEST = 1600  # px: the paper's


def load_capture(
    folder: Path,
    layout: str | None = None,
    images: str | None = None,
    longest: int = LONGEST,
    references: frozenset[Path] = frozenset(),
) -> Capture:
    """Read a scene folder, recognising its layout unless it is named.

    Args:
        layout: one of LAYOUTS, or None.
        images: the folder of pictures, relative to the scene, where it is not the usual one.
        longest: larger image side in px that is asked for; chooses among folders of the same pictures (LLFF).
        references: pictures that may lie among the photographs and are none.

    Raises:
        BadInput: naming the file and the remedy, where the folder is no capture, two pictures share a view name,
            a picture is unreadable, a pose is not finite or no rotation, or the files contradict each other.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInput(f"{folder}: no such folder")
    layout = layout or recognise(folder)
    if layout not in LAYOUTS:
        raise BadInput(f"{folder}: unknown layout '{layout}'; one of {', '.join(LAYOUTS)}")
    if images is not None and not (folder / images).is_dir():
        raise BadInput(f"{folder / images}: no such folder; correct `images` in scene.yaml")
    with understood(_source(folder, layout), "a capture that can be read"):
        if layout == "llff":
            return llff.read(folder, images, longest, references)
        if layout == "transforms":
            return transforms.read(folder, images)
        return colmap.read(folder, images) if layout == "colmap" else photos.read(folder, images, references)


def _source(folder: Path, layout: str) -> Path:
    """What brings the poses, for messages."""
    known = {"llff": "poses_bounds.npy", "transforms": "transforms.json"}
    return folder / known[layout] if layout in known else folder


def recognise(folder: Path) -> str:
    """The layout by the files that are there: poses_bounds.npy, transforms.json (or Blender's transforms_train.json), a
    COLMAP model, else photos.

    A COLMAP model beside masks of `images_4` is SPIn-NeRF's, whose poses_bounds.npy is not needed then."""
    if there(folder / "poses_bounds.npy"):
        return "llff"
    if (folder / "images_4" / "label").is_dir() and colmap.model_folder(folder) is not None:
        return "llff"
    if transforms.split_files(folder):
        return "transforms"
    return "colmap" if colmap.model_folder(folder) is not None else "photos"
