"""Reads reconstruction.json of OpenSfM and OpenDroneMap."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from reffusion.capture.layouts.capture import Capture, Correction, PointCloud
from reffusion.capture.layouts.placed import PictureCamera, read_placed
from reffusion.capture.lens import Lens
from reffusion.io.arrays import load_json
from reffusion.io.files import BadInput, as_bad_input, is_file, shorten

NAME = "reconstruction.json"
PERSPECTIVE = ("perspective", "simple_radial", "radial", "brown")
FISHEYE = ("fisheye", "fisheye_opencv")


def find(folder: Path) -> Path | None:
    """Return reconstruction.json in a scene folder, or in its sub-folder opensfm (OpenDroneMap); None without one."""
    return next((path for path in (folder / NAME, folder / "opensfm" / NAME) if is_file(path)), None)


def read(folder: Path, source: Path, images: str | None, correction: Correction) -> Capture:
    """Read the capture. `source`: the file; `images`, `correction`: as in `read_placed`.

    The file may hold several reconstructions. The one with most shots is read.

    Raises:
        BadInput: the file is of another form, or has a camera that is neither perspective nor a fisheye; or as for
            `read_placed`.
    """
    record = load_json(source)
    with as_bad_input(source, "a reconstruction of OpenSfM"):
        best = max(record, key=lambda each: len(each["shots"]))
        lenses = {name: _parse_lens(values, name, source) for name, values in best["cameras"].items()}
        placed = {name: _place(shot, lenses[shot["camera"]]) for name, shot in best["shots"].items()}
        points = _parse_points(best.get("points") or {})
    return read_placed(folder, images, "opensfm", source, placed, correction, points)


def _place(shot: dict[str, Any], lens: Lens) -> PictureCamera:
    """Return the camera of a shot, whose rotation is a vector: an axis, as long as the angle in radians."""
    import cv2

    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = cv2.Rodrigues(np.array(shot["rotation"], np.float64))[0]
    world_to_camera[:3, 3] = shot["translation"]
    return PictureCamera(world_to_camera, lambda _: lens)


def _parse_lens(values: dict[str, Any], name: str, source: Path) -> Lens:
    """Return the lens of a camera. Its focal lengths and principal point are in units of the longer side."""
    kind = values.get("projection_type", "perspective")
    if kind not in (*PERSPECTIVE, *FISHEYE):
        known = ", ".join((*PERSPECTIVE, *FISHEYE))
        raise BadInput(f"{source}: the camera '{name}' is {shorten(kind)}, which is not understood; one of {known} is")
    width, height = int(values["width"]), int(values["height"])
    number = lambda key: float(values.get(key, 0.0))
    focal, longer = ("focal_x", "focal_y") if "focal_x" in values else ("focal", "focal"), max(width, height)
    return Lens(
        width,
        height,
        number(focal[0]) * longer,
        number(focal[1]) * longer,
        width / 2 + number("c_x") * longer,
        height / 2 + number("c_y") * longer,
        radial=tuple(number(f"k{k}") for k in range(1, 5)),
        tangential=(number("p1"), number("p2")),
        fisheye=kind in FISHEYE,
        model=f"OpenSfM {kind}",
    )


def _parse_points(points: dict[str, Any]) -> PointCloud:
    positions = np.array([each["coordinates"] for each in points.values()], np.float64).reshape(-1, 3)
    colors = np.array([each["color"] for each in points.values()], np.float64).reshape(-1, 3)
    return positions, np.clip(colors, 0, 255).astype(np.uint8)
