"""Reads the CSV file "Internal/External camera parameters" of RealityCapture and RealityScan.

A row holds the position of a camera (x, y, alt), its orientation in degrees, and its lens. Heading, pitch and roll of 0
mean a camera that looks down the axis of alt, with the top of its picture towards y. The heading turns it clockwise as
seen from above; pitch and roll turn it about its own x and y axis. The focal length and the principal point, an offset
from the picture's center, are in mm for a picture whose longer side is 36 mm, as other readers of this file take them.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from reffusion.capture.layouts.capture import Capture, Correction, invert_pose
from reffusion.capture.layouts.placed import PictureCamera, read_placed
from reffusion.capture.lens import Lens
from reffusion.io.files import BadInput, as_bad_input, reading

# The other columns may be missing. Some versions write yaw for heading.
COLUMNS = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
FLIP = np.diag([1.0, -1.0, -1.0])  # from the axes of a camera of the file (y up, looking along -z) to ours


def find(folder: Path) -> Path | None:
    """Return the first CSV file in the scene's folder that has the columns `COLUMNS`; None without such a file."""
    return next((path for path in sorted(folder.glob("*.csv")) if path.is_file() and _columns(path)[1]), None)


def _columns(path: Path) -> tuple[int, list[str]]:
    """Return the line, 1 or 2, of the column names, and these in lower case, yaw as heading; else (0, [])."""
    with open(path, encoding="utf-8-sig", errors="replace", newline="") as file:
        # a line with the number of cameras may stand before the names
        for number in (1, 2):
            names = [name.strip().lstrip("#").lower() for name in file.readline(10_000).split(",")]
            names = ["heading" if name == "yaw" else name for name in names]
            if set(COLUMNS) <= set(names):
                return number, names
    return 0, []


def read(folder: Path, source: Path, images: str | None, correction: Correction) -> Capture:
    """Read the capture. `source`: the CSV file; `images`, `correction`: as in `read_placed`.

    Raises:
        BadInput: the file is damaged, or another one lies beside it; or as for `read_placed`.
    """
    if others := [path for path in sorted(folder.glob("*.csv")) if path != source and _columns(path)[1]]:
        raise BadInput(f"{others[0]}: cameras of RealityCapture, as in {source.name} beside it; keep one of both files")
    head, names = _columns(source)
    with reading(source, "cameras of RealityCapture"), open(source, encoding="utf-8-sig", newline="") as file:
        lines = list(csv.reader(file))[head:]
    placed = {}
    for number, cells in enumerate(lines, start=head + 1):
        if cells:
            row = dict(zip(names, cells, strict=False))
            if row["name"] in placed:
                raise BadInput(f"{source}: line {number}: another camera of '{row['name']}'; keep one")
            placed[row["name"]] = _parse_row(row, source, number)
    return read_placed(folder, images, "realitycapture", source, placed, correction)


def _parse_row(row: dict[str, str], source: Path, line: int) -> PictureCamera:
    with as_bad_input(source, f"readable in line {line}"):
        number = lambda name: float(row.get(name) or 0.0)
        focal, center = float(row["f"]), (number("px"), number("py"))
        radial, tangential = [number(f"k{k}") for k in (1, 2, 3, 4)], (number("t1"), number("t2"))
        camera_to_world = np.eye(4)
        camera_to_world[:3, :3] = _rotation(*(float(row[name]) for name in ("heading", "pitch", "roll"))) @ FLIP
        camera_to_world[:3, 3] = [float(row[name]) for name in ("x", "y", "alt")]

    def lens(size: tuple[int, int]) -> Lens:
        (width, height), px_per_mm = size, max(size) / 36
        f, cx, cy = focal * px_per_mm, width / 2 + center[0] * px_per_mm, height / 2 + center[1] * px_per_mm
        return Lens(width, height, f, f, cx, cy, tuple(radial), tangential=tangential, model="RealityCapture")

    return PictureCamera(invert_pose(camera_to_world), lens)


def _rotation(heading: float, pitch: float, roll: float) -> np.ndarray:
    """Return the rotation [3, 3] from the camera (y up, looking along -z) to the world, for angles in degrees."""
    (sh, sp, sr), (ch, cp, cr) = (each(np.radians((heading, pitch, roll))) for each in (np.sin, np.cos))
    turned = np.array([[ch, sh, 0], [-sh, ch, 0], [0, 0, 1]])
    pitched = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    rolled = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    return turned @ pitched @ rolled
