"""lenses.json of a `poses` folder: what is needed to undistort a picture of one of its views."""

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
    """Write lenses.json: the lenses at the size of the undistorted pictures, and (width, height) of the photographs."""
    views = {name: asdict(lens) for name, lens in lenses.items()}
    save_json(Path(poses_dir) / LENSES, {"upright": upright, "photographs": dict(photographs), "views": views})


def load_lenses(poses_dir: Path) -> tuple[dict[str, Lens], bool]:
    """View name -> its photograph's lens, at the size of the undistorted picture; and whether orientation tags are
    obeyed."""
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
    """View name -> (width, height) of its photograph in the scene's folder."""
    return {name: tuple(size) for name, size in load_json(Path(poses_dir) / LENSES)["photographs"].items()}
