"""Reads raw data of Polycam: keyframes/images and keyframes/cameras/<name>.json, or both as Polycam corrected them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reffusion.capture.layouts.capture import Capture, Correction, has_pictures, invert_pose
from reffusion.capture.layouts.placed import PictureCamera, read_placed
from reffusion.capture.lens import Lens
from reffusion.io.arrays import load_json
from reffusion.io.files import as_bad_input

CORRECTED, CAPTURED = "corrected_", ""  # beginnings of the names of the folders; corrected ones are preferred
OFF_CENTER = 0.1  # of the width: principal points of phones are less far from the middle
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # from the axes of ARKit's cameras (y up, looking along -z) to ours


def find(folder: Path) -> Path | None:
    """Return the folder of cameras in raw data of Polycam, preferably corrected ones; None in other folders."""
    for kind in (CORRECTED, CAPTURED):
        cameras = folder / "keyframes" / f"{kind}cameras"
        if any(cameras.glob("*.json")) and has_pictures(_image_folder(cameras)):
            return cameras
    return None


def _image_folder(cameras: Path) -> Path:
    return cameras.with_name(cameras.name.removesuffix("cameras") + "images")


def read(folder: Path, source: Path, images: str | None, correction: Correction) -> Capture:
    """Read the capture. `source`: the folder of cameras; `images`, `correction`: as in `read_placed`.

    Raises:
        BadInput: the file of a camera is damaged; or as for `read_placed`.
    """
    files = {path.stem: path for path in sorted(source.glob("*.json")) if not path.name.startswith(".")}
    usual = _image_folder(source).relative_to(folder).as_posix()
    placed = {name: _load_camera(path) for name, path in files.items()}
    return read_placed(folder, images, "polycam", source, placed, correction, usual=(usual,))


def _load_camera(path: Path) -> PictureCamera:
    values = load_json(path)
    with as_bad_input(path, "a camera of Polycam"):
        camera_to_world = np.eye(4)
        camera_to_world[:3] = [[float(values[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]
        fx, fy, cx, cy = (float(values[key]) for key in ("fx", "fy", "cx", "cy"))
        centered = round(2 * cx), round(2 * cy)
        stored = (int(values["width"]), int(values["height"])) if "width" in values else None

    def lens_at(size: tuple[int, int]) -> Lens:
        # A file without a size is for the picture's own, unless its center is far off: then the picture was scaled.
        is_scaled = abs(centered[0] / size[0] - 1) > OFF_CENTER
        return Lens(*(stored or (centered if is_scaled else size)), fx, fy, cx, cy)

    return PictureCamera(invert_pose(camera_to_world @ FLIP), lens_at)
