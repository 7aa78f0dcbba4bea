"""Reads and writes lenses.json in the folder of the stage `poses`: lenses for undistorting pictures of its views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from reffusion.capture.lens import Lens
from reffusion.io.arrays import load_json, save_json
from reffusion.io.files import BadInput

LENSES = "lenses.json"


def save_lenses(
    poses_dir: Path, lenses: Mapping[str, Lens], upright: bool, photographs: Mapping[str, tuple[int, int]]
) -> None:
    """Write lenses.json.

    Args:
        poses_dir: the folder that the stage `poses` writes.
        lenses: view name -> lens of its photograph with distortion, at the size of its undistorted picture.
        upright: True if the EXIF orientation tags of photographs are obeyed.
        photographs: view name -> (width, height) of its photograph in the scene's folder, after orientation if
            `upright`.
    """
    views = {name: asdict(lens) for name, lens in lenses.items()}
    save_json(Path(poses_dir) / LENSES, {"upright": upright, "photographs": dict(photographs), "views": views})


def load_lenses(poses_dir: Path) -> tuple[dict[str, Lens], bool]:
    """Read the lenses from lenses.json.

    Returns:
        View name -> lens of its photograph with distortion, at the size of its undistorted picture; and whether the
        EXIF orientation tags of photographs are obeyed.

    Raises:
        BadInput: there is no lenses.json.
    """
    path = Path(poses_dir) / LENSES
    if not path.is_file():
        raise BadInput(f"{path}: missing; {poses_dir} is no finished `poses` folder")
    read = load_json(path)
    tuples = {"radial", "denominator", "tangential"}
    views = {
        name: Lens(**(fields | {key: tuple(fields[key]) for key in fields.keys() & tuples}))
        for name, fields in read["views"].items()
    }
    return views, read["upright"]


def load_photograph_sizes(poses_dir: Path) -> dict[str, tuple[int, int]]:
    """Return view name -> (width, height) of its photograph in the scene's folder, from lenses.json.

    The size is that after orientation, if EXIF orientation tags are obeyed (`load_lenses`).
    """
    return {name: tuple(size) for name, size in load_json(Path(poses_dir) / LENSES)["photographs"].items()}
