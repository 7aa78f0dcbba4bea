"""Reads a scene folder in one of four layouts: SPIn-NeRF/LLFF, COLMAP, nerfstudio's transforms.json, or photographs
only.

Every layout is read into a `Capture`: pictures by view name and, if the folder holds poses, lenses and poses in the
scene's own frame. Of pictures only headers are read, except for a few, whose colours are compared with the colours of
the sparse points.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from reffusion.capture.layouts import colmap, llff, photos, transforms
from reffusion.capture.layouts.capture import AS_GIVEN, Capture, Correction
from reffusion.capture.lens import Lens
from reffusion.io.files import BadInput, as_bad_input, is_file
from reffusion.io.images import image_size

LAYOUTS = ("llff", "colmap", "transforms", "photos")
LONGEST = 1600  # px, longer side of the pictures in the paper


def load_capture(
    folder: Path,
    layout: str | None = None,
    images: str | None = None,
    longest: int = LONGEST,
    references: frozenset[Path] = frozenset(),
    correction: Correction = AS_GIVEN,
) -> Capture:
    """Read a scene folder: its pictures and, if it holds poses, its cameras and sparse points.

    Args:
        layout: one of LAYOUTS; None to detect the layout.
        images: folder of pictures, relative to the scene; None for the layout's usual folders.
        longest: requested longer side of the pictures in pixels. The layout "llff" may hold the same pictures in
            several sizes; the smallest size that is large enough is taken, else the largest size.
        references: files of references (inpainted views). They may lie among the photographs, but are not views.
        correction: what is changed in the poses. Views whose pose is lost are left out.

    Raises:
        BadInput: the folder is no capture, two pictures share a view name, a picture is unreadable, a pose is not
            finite or not a rotation, or the files contradict each other. The message names the file and the remedy.
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
        if layout == "photos":
            return photos.read(folder, images, references)
        if layout == "llff":
            capture = llff.read(folder, images, longest, references, correction)
        else:
            reader = transforms if layout == "transforms" else colmap
            capture = reader.read(folder, images, correction)
    pictures = {name: path for name, path in capture.pictures.items() if name in capture.poses.lenses}
    turned = any(_fits_turned_only(path, capture.poses.lenses[name]) for name, path in pictures.items())
    return replace(capture, pictures=pictures, upright=turned or correction.upright)


def _fits_turned_only(picture: Path, lens: Lens) -> bool:
    """Return whether a lens has the size of the picture turned by its EXIF orientation, and not of the stored one."""
    size = lens.width, lens.height
    return image_size(picture) != size and image_size(picture, upright=True) == size


def _source(folder: Path, layout: str) -> Path:
    """Return the file or folder from which a layout's poses are read, for messages."""
    known = {"llff": "poses_bounds.npy", "transforms": "transforms.json"}
    return folder / known[layout] if layout in known else folder


def detect_layout(folder: Path) -> str:
    """Return the layout of a folder, one of LAYOUTS, from the files it holds.

    The first match decides: "llff" for poses_bounds.npy, or for a COLMAP model with masks in images_4/label (a scene of
    SPIn-NeRF without its poses_bounds.npy); "transforms" for transforms.json or Blender's transforms_train.json;
    "colmap" for a COLMAP model; else "photos".
    """
    if is_file(folder / "poses_bounds.npy"):
        return "llff"
    if (folder / "images_4" / "label").is_dir() and colmap.find_model(folder) is not None:
        return "llff"
    if transforms.split_files(folder):
        return "transforms"
    return "colmap" if colmap.find_model(folder) is not None else "photos"
