"""Reads a reconstruction of Bundler: bundle.out, and the list of its pictures, one a line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from reffusion.capture.layouts.capture import Capture, Correction, PointCloud
from reffusion.capture.layouts.placed import PictureCamera, read_placed
from reffusion.capture.lens import Lens
from reffusion.io.files import BadInput, is_file, reading

HEAD = b"# Bundle file"  # beginning of a file, which other programs write under a name of their own
PLACES = ("bundle.out", "bundle/bundle.out")
FLIP = np.diag([1.0, -1.0, -1.0])  # from the axes of Bundler's cameras (y up, looking along -z) to ours
FOCAL_LENGTH = re.compile(r"\s+0\s+[\d.eE+-]+$")  # at the end of a line of a list: a zero and the focal length of EXIF


def find(folder: Path) -> Path | None:
    """Return the file bundle.out of a scene folder, else a file *.out that begins with `HEAD`; None without one."""
    usual = [folder / name for name in PLACES if is_file(folder / name)]
    others = [path for pattern in ("*.out", "*/*.out") for path in sorted(folder.glob(pattern))]
    return next(iter(usual + [path for path in others if path.is_file() and _is_of_bundler(path)]), None)


def _is_of_bundler(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(len(HEAD)) == HEAD


def read(folder: Path, source: Path, images: str | None, correction: Correction) -> Capture:
    """Read the capture. `source`: bundle.out; `images`, `correction`: as in `read_placed`.

    Cameras of focal length 0 are left out.

    Raises:
        BadInput: a file is damaged, or no list of as many pictures as cameras lies beside it; or as for `read_placed`.
    """
    with reading(source, "cameras of Bundler"):
        lines = source.read_text(encoding="utf-8", errors="replace").splitlines()
        rows = [line.split() for line in lines if line.strip() and not line.startswith("#")]
        count, at = int(rows[0][0]), 1
        numbers = np.array([row[:3] for row in rows[at : at + 5 * count]], np.float64).reshape(count, 5, 3)
        points = _read_points(rows[at + 5 * count :], int(rows[0][1]))
    names = _list_pictures(folder, source, count)
    placed = {name: _placed(each) for name, each in zip(names, numbers, strict=True) if each[0, 0] > 0}
    return read_placed(folder, images, "bundler", source, placed, correction, points)


def _placed(numbers: np.ndarray) -> PictureCamera:
    """Return the camera of `numbers` [5, 3]: focal length with two radial coefficients; rotation; translation."""
    (focal, k1, k2), world_to_camera = (float(n) for n in numbers[0]), np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = FLIP @ numbers[1:4], FLIP @ numbers[4]
    at = lambda size: Lens(*size, focal, focal, size[0] / 2, size[1] / 2, radial=(k1, k2), model="RADIAL")
    return PictureCamera(world_to_camera, at)


def _read_points(rows: list[list[str]], count: int) -> PointCloud:
    """Return the points: each has a row of its position, one of its color, and one of the views that show it."""
    positions = np.array([row[:3] for row in rows[: 3 * count : 3]], np.float64).reshape(count, 3)
    colors = np.array([row[:3] for row in rows[1 : 3 * count : 3]], np.float64).reshape(count, 3)
    return positions, np.clip(colors, 0, 255).astype(np.uint8)


def _list_pictures(folder: Path, source: Path, count: int) -> list[str]:
    """Return the paths in the first list of `count` pictures beside `source` or in `folder`; BadInput without one."""
    for place in dict.fromkeys((source.parent, folder)):
        for path in sorted({*place.glob("*list*.txt"), *place.glob("*.lst")}):
            with reading(path, "a list of pictures"):
                lines = path.read_text(encoding="utf-8-sig").splitlines()
            names = [FOCAL_LENGTH.sub("", line.strip()) for line in lines if line.strip()]
            if len(names) == count == len(set(names)):
                return names
    raise BadInput(
        f"{source}: {count} cameras, and no list of {count} pictures beside it; add list.txt, one picture a line, in "
        "the order of the cameras"
    )
