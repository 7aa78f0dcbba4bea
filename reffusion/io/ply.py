"""Reads and writes Gaussians as files, in the layout of 3DGS and related ones, and coloured points as PLY."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reffusion.io import compressed
from reffusion.io.compressed import PACKED
from reffusion.io.files import BadInput, reading
from reffusion.io.ply_table import load_header, load_vertices, save_vertices
from reffusion.io.quantized import save_splat
from reffusion.io.splat_rows import Rows
from reffusion.io.splats import (
    ANTIALIASED,
    BLOCK,
    DC,
    FORMATS,
    POSITION,
    RED_GREEN_BLUE,
    ROTATION,
    SCALES,
    load_splats,
    summarize_splats,
)

if TYPE_CHECKING:
    from reffusion.types import Gaussians, Similarity

NORMAL = ("nx", "ny", "nz")


def save_ply(
    path: Path, gaussians: Gaussians, similarity: Similarity | None = None, properties: Sequence[str] = ()
) -> None:
    """Write Gaussians in the standard 3DGS layout (binary, little endian).

    Properties: x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3. `f_rest` holds the coefficients of red,
    then green, then blue; opacity is a logit, scales are logarithms, rotations wxyz.

    Args:
        similarity: with it, positions and sizes are converted (in float64) to the scene's own frame. Positions are then
            written as doubles only where floats would move them by more than 1e-5 of the normalised extent
            (geo-referenced scenes); viewers that insist on floats read all others.
        properties: another order of these, without normals where it has none (`load_property_names` a file to match).
    """
    array = lambda name: getattr(gaussians, name).detach().cpu().numpy()
    means, log_scales, sh, position_type = array("means").astype(np.float64), array("log_scales"), array("sh"), "f4"
    if similarity is not None:
        means = similarity.invert(means)
        log_scales = log_scales.astype(np.float64) - np.log(similarity.scale)
        rounding = np.abs(means - means.astype(np.float32)).max(initial=0.0)
        position_type = "f8" if rounding * similarity.scale > 1e-5 else "f4"
    count, higher = len(gaussians), sh.shape[1] - 1
    blocks = (
        (POSITION, means),
        (NORMAL, np.zeros((1, 3), np.float32)),
        (DC, sh[:, 0]),
        *((tuple(f"f_rest_{c * higher + k}" for k in range(higher)), sh[:, 1:, c]) for c in range(3)),
        (("opacity",), array("opacity_logits")[:, None]),
        (SCALES, log_scales),
        (ROTATION, array("quaternions")),
    )
    comments = [ANTIALIASED] if gaussians.antialiased else []
    found = {name: column for names, values in blocks for name, column in zip(names, values.T, strict=True)}
    columns = [name for name in properties or found if name in found]
    columns += [name for name in found if name not in columns and name not in NORMAL]
    table = np.empty(count, [(name, position_type if name in POSITION else "f4") for name in columns])
    for start in range(0, count, BLOCK):  # so that a row is in the processor's cache until its last property is written
        rows = slice(start, start + BLOCK)
        for name in columns:
            table[name][rows] = found[name] if name in NORMAL else found[name][rows]
    save_vertices(path, table, comments)


def check_can_save(path: Path) -> None:
    """BadInput where `save_splats` cannot write this file: unknown ending, missing library, or missing folder."""
    name = Path(path).name.lower()
    if not name.endswith(FORMATS):
        raise BadInput(f"{path}: {Path(path).suffix or 'no ending'} is not written; one of {', '.join(FORMATS)} is")
    if name.endswith((".compressed.ply", ".spz")):
        compressed.check_gsply(path)
    if Path(path).is_dir() or not (parent := Path(path).absolute().parent).is_dir():
        raise BadInput(f"{path}: a folder; name a file" if Path(path).is_dir() else f"{parent}: no such folder")


def save_splats(path: Path, gaussians: Gaussians, similarity: Similarity, properties: Sequence[str] = ()) -> None:
    """Write Gaussians in the scene's own frame, in the format of the file's ending, see `splats.FORMATS`.

    Args:
        properties: for a plain .ply, their order, as in `save_ply`.
    """
    name = Path(path).name.lower()
    if name.endswith((".spz", ".splat")):
        means, *others = (getattr(gaussians, field.name).detach().cpu().numpy() for field in fields(Rows))
        rows = Rows(means.astype(np.float64), *others)
        sizes = (rows.log_scales - np.log(similarity.scale)).astype(np.float32)
        rows = replace(rows, means=similarity.invert(rows.means), log_scales=sizes)
        (compressed.save_spz if name.endswith(".spz") else save_splat)(path, rows)
    elif name.endswith(".compressed.ply"):
        compressed.save_compressed(path, gaussians, similarity)
    else:
        save_ply(path, gaussians, similarity, properties)


def load_ply(path: Path, similarity: Similarity | None = None, device: str = "cpu") -> Gaussians:
    """Read the Gaussians of a .ply, compressed .ply, .spz or .splat (see `splats.load_splats`), float32 on `device`.

    Args:
        similarity: with it, the file is in the scene's own frame and the result is in the normalised one.

    Raises:
        BadInput: naming the file, where properties are missing (e.g. a plain point cloud), the number of `f_rest`
            properties belongs to no degree, or most rows are not finite.
    """
    gaussians = load_splats(path).gaussians(similarity)
    if not (gaussians.means.isfinite().all() and gaussians.log_scales.isfinite().all()):
        raise BadInput(f"{path}: positions or sizes are too large for 32 bits")
    return gaussians.map(lambda p: p.to(device))


def save_points(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Write [P, 3] float64 positions and [P, 3] uint8 colours."""
    types = [(name, "f8") for name in POSITION] + [(name, "u1") for name in RED_GREEN_BLUE]
    table = np.empty(len(points), dtype=types)
    for names, values in ((POSITION, points), (RED_GREEN_BLUE, colors)):
        for name, column in zip(names, np.asarray(values).T, strict=True):
            table[name] = column
    save_vertices(path, table)


def load_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """[P, 3] float64 positions and [P, 3] uint8 colours (mid grey where the file has none) of a point cloud."""
    path = Path(path)
    header = load_header(path)
    if PACKED in header.vertices()[1]:
        rows = load_splats(path).rows
        return rows.means, np.full((len(rows), 3), 128, np.uint8)
    table = load_vertices(path, header)
    with reading(path, "a readable PLY file of points"):
        return _points(path, table)


def _points(path: Path, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if any(name not in table.dtype.names for name in POSITION):
        raise BadInput(f"{path}: its vertices have no x, y, z")
    points = np.stack([table[n] for n in POSITION], axis=1).astype(np.float64)
    if all(name in table.dtype.names for name in RED_GREEN_BLUE):
        colors = np.stack([table[n] for n in RED_GREEN_BLUE], axis=1)
        if np.issubdtype(colors.dtype, np.floating):
            colors = np.round(np.clip(colors, 0.0, 1.0) * 255.0)
        return points, colors.astype(np.uint8)
    return points, np.full((len(points), 3), 128, np.uint8)


def load_property_names(path: Path) -> tuple[str, ...]:
    """The names of the vertices' properties, in order; empty for a quantised file."""
    return summarize_splats(path).properties
