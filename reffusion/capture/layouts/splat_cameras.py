"""Reads cameras.json, in which the trainer of 3D Gaussian Splatting writes the cameras of its training pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reffusion.capture.layouts.capture import Capture, Correction, invert_pose
from reffusion.capture.layouts.placed import PictureCamera, read_placed
from reffusion.capture.lens import Lens
from reffusion.io.arrays import load_json
from reffusion.io.files import BadInput, as_bad_input, is_file

NAME = "cameras.json"
KEYS = (b"img_name", b"position", b"rotation")  # of each camera, by which the file is known


def find(folder: Path) -> Path | None:
    """Return cameras.json of a scene folder; None without it, and for the files of this name of other programs."""
    if not is_file(path := folder / NAME):
        return None
    beginning = path.read_bytes()[:4000]
    return path if all(b'"%s"' % key in beginning for key in KEYS) else None


def read(folder: Path, source: Path, images: str | None, correction: Correction) -> Capture:
    """Read the capture. `source`: cameras.json; `images`, `correction`: as in `read_placed`.

    Raises:
        BadInput: the file is of another form, or has two cameras of one picture; or as for `read_placed`.
    """
    record = load_json(source)
    with as_bad_input(source, "cameras of 3D Gaussian Splatting"):
        names = [str(each["img_name"]) for each in record]
        placed = {name: _parse_camera(each) for name, each in zip(names, record, strict=True)}
    if len(placed) < len(names):
        raise BadInput(f"{source}: {len(names)} cameras of {len(placed)} pictures; keep one camera for each picture")
    return read_placed(folder, images, "3dgs", source, placed, correction)


def _parse_camera(values: dict) -> PictureCamera:
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3], camera_to_world[:3, 3] = values["rotation"], values["position"]
    width, height = int(values["width"]), int(values["height"])
    lens = Lens(width, height, float(values["fx"]), float(values["fy"]), width / 2, height / 2)
    return PictureCamera(invert_pose(camera_to_world), lambda _: lens)
