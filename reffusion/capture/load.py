"""Reads captures in the layouts they come in: SPIn-NeRF/LLFF, COLMAP, nerfstudio's transforms.json, or photographs
only.

Every reader returns the same: pictures by view name and, where the folder has them, lenses and poses in the scene's own
frame. Of pictures only headers are read.
"""

from __future__ import annotations

from pathlib import Path

from reffusion.capture.layouts import colmap, llff, photos, transforms
from reffusion.capture.layouts.capture import Capture
from reffusion.io.files import BadInput, as_bad_input, is_file

LAYOUTS = ("llff", "colmap", "transforms", "photos")
LONGEST = 1600  # px: the paper's


def load_capture(
    folder: Path,
    layout: str | None = None,
    images: str | None = None,
    longest: int = LONGEST,
    references: frozenset[Path] = frozenset(),
) -> Capture:
    """Read a scene folder, detecting its layout unless it is given.

    Args:
        layout: one of LAYOUTS, or None.
        images: the folder of pictures, relative to the scene, where it is not the usual one.
        longest: requested size of the larger image side in px; chooses among folders of the same pictures (LLFF).
        references: pictures that may lie among the photographs and are none.

    Raises:
        BadInput: naming the file and the remedy, where the folder is no capture, two pictures share a view name, a
            picture is unreadable, a pose is not finite or no rotation, or the files contradict each other.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInput(f"{folder}: no such folder")
    layout = layout or detect_layout(folder)
    if layout not in LAYOUTS:
        raise BadInput(f"{folder}: unknown layout '{layout}'; one of {', '.join(LAYOUTS)}")
    if images is not None and not (folder / images).is_dir():
        raise BadInput(f"{folder / images}: no such folder; correct `images` in scene.yaml")
    with as_bad_input(_source(folder, layout), "a capture that can be read"):
        if layout == "llff":
            return llff.read(folder, images, longest, references)
        if layout == "transforms":
            return transforms.read(folder, images)
        return colmap.read(folder, images) if layout == "colmap" else photos.read(folder, images, references)


def _source(folder: Path, layout: str) -> Path:
    """The file or folder that the poses come from, for messages."""
    known = {"llff": "poses_bounds.npy", "transforms": "transforms.json"}
    return folder / known[layout] if layout in known else folder


def detect_layout(folder: Path) -> str:
    """Detect the layout from the files of a folder.

    The first of: poses_bounds.npy; transforms.json, or Blender's transforms_train.json; a COLMAP model; else photos. A
    COLMAP model beside masks of `images_4` is a scene of SPIn-NeRF, which does not need its poses_bounds.npy then.
    """
    if is_file(folder / "poses_bounds.npy"):
        return "llff"
    if (folder / "images_4" / "label").is_dir() and colmap.find_model(folder) is not None:
        return "llff"
    if transforms.split_files(folder):
        return "transforms"
    return "colmap" if colmap.find_model(folder) is not None else "photos"
