"""The layouts in which captures come: SPIn-NeRF/LLFF, COLMAP, nerfstudio's transforms.json, or photos only.

Every reader gives the same: pictures by view name and, where the folder brings them, lenses and poses in the
scene's own frame. Nothing but headers of pictures is read.
"""

from __future__ import annotations

from pathlib import Path

from reffusion.capture.layouts import colmap, llff, photos, transforms
from reffusion.capture.layouts.capture import Capture, Poses, pictures_in

__all__ = ["LAYOUTS", "Capture", "Poses", "load_capture", "pictures_in", "recognise"]

READERS = {"llff": llff.read, "colmap": colmap.read, "transforms": transforms.read, "photos": photos.read}
LAYOUTS = tuple(READERS)


def load_capture(folder: Path, layout: str | None = None, images: str | None = None) -> Capture:
    """Read a scene folder, recognising its layout unless it is named.

    Args:
        layout: one of LAYOUTS, or None.
        images: the folder of pictures, relative to the scene, where it is not the usual one.

    Raises:
        ValueError: naming the file and the remedy, where the folder is no capture, two pictures share a view name,
            a picture is unreadable, a pose is not finite or no rotation, or the files contradict each other.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder")
    layout = layout or recognise(folder)
    if layout not in READERS:
        raise ValueError(f"{folder}: unknown layout '{layout}'; one of {', '.join(LAYOUTS)}")
    if images is not None and not (folder / images).is_dir():
        raise ValueError(f"{folder / images}: no such folder; correct `images` in scene.yaml")
    return READERS[layout](folder, images)


def recognise(folder: Path) -> str:
    """The layout by the files that are there: poses_bounds.npy, transforms.json, a COLMAP model, else photos."""
    if (folder / "poses_bounds.npy").is_file():
        return "llff"
    if (folder / "transforms.json").is_file():
        return "transforms"
    return "colmap" if colmap.model_folder(folder) is not None else "photos"
