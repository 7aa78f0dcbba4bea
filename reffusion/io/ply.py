"""Writing of Gaussians in every format (`save_splats`), reading to tensors; colored points as PLY."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reffusion.io import compressed
from reffusion.io.compressed import MIP_COMMENT, PACKED
from reffusion.io.files import BadInput, reading
from reffusion.io.glb import save_glb
from reffusion.io.ply_table import load_header, load_vertices, save_vertices
from reffusion.io.splat_format import save_splat
from reffusion.io.splat_rows import Rows
from reffusion.io.splats import (
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
    """Write Gaussians as a binary, little-endian PLY file in the standard layout of 3DGS.

    The properties are x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3. `f_rest` holds the coefficients of
    red, then green, then blue. The opacity is a logit, scales are logarithms, and rotations are wxyz. Normals are zero.

    Args:
        similarity: from the scene's own frame to the normalized frame of `gaussians`. If given, positions and sizes are
            converted (in float64) to the scene's own frame. Positions are then written as doubles if rounding to floats
            would move one by more than 1e-5 of the normalized extent, as in geo-referenced scenes. In all other cases
            they are floats, because some viewers read floats only.
        properties: names of properties in the order in which they are written, such as `load_property_names` of a file
            to match. Missing ones are appended, except normals; unknown ones are ignored. Empty: the order above.
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
    comments = [MIP_COMMENT] if gaussians.antialiased else []
    found = {name: column for names, values in blocks for name, column in zip(names, values.T, strict=True)}
    columns = [name for name in properties or found if name in found]
    columns += [name for name in found if name not in columns and name not in NORMAL]
    table = np.empty(count, [(name, position_type if name in POSITION else "f4") for name in columns])
    for start in range(0, count, BLOCK):  # in blocks: rows stay in the processor's cache until they are complete
        rows = slice(start, start + BLOCK)
        for name in columns:
            table[name][rows] = found[name] if name in NORMAL else found[name][rows]
    save_vertices(path, table, comments)


def check_can_save(path: Path) -> None:
    """Raise BadInput if `save_splats` cannot write this file.

    The ending may be unknown, the library for this format or the folder of the file may be missing, or the path may be
    a folder.
    """
    name = Path(path).name.lower()
    if not name.endswith(FORMATS):
        raise BadInput(f"{path}: {Path(path).suffix or 'no ending'} is not written; one of {', '.join(FORMATS)} is")
    if name.endswith((".compressed.ply", ".spz")):
        compressed.check_gsply(path)
    if Path(path).is_dir() or not (parent := Path(path).absolute().parent).is_dir():
        raise BadInput(f"{path}: a folder; name a file" if Path(path).is_dir() else f"{parent}: no such folder")


def save_splats(path: Path, gaussians: Gaussians, similarity: Similarity, properties: Sequence[str] = ()) -> None:
    """Write Gaussians in the scene's own frame, in the format that the file's ending names (see `splats.FORMATS`).

    All formats but .splat store `Gaussians.antialiased`; that of a .glb only this project reads. The file's folder is
    created.

    Args:
        gaussians: in the normalized frame.
        similarity: from the scene's own frame to the normalized frame.
        properties: order of the properties of a plain .ply, as in `save_ply`; other formats ignore it.

    Raises:
        ValueError: the ending is unknown, a library is missing, or the scene is too large for the format (BadInput).
    """
    name = Path(path).name.lower()
    if name.endswith((".spz", ".splat", ".glb")):
        means, *others = (getattr(gaussians, field.name).detach().cpu().numpy() for field in fields(Rows))
        rows = Rows(means.astype(np.float64), *others)
        sizes = (rows.log_scales - np.log(similarity.scale)).astype(np.float32)
        rows = replace(rows, means=similarity.invert(rows.means), log_scales=sizes)
        if name.endswith(".spz"):
            compressed.save_spz(path, rows, gaussians.antialiased)
        elif name.endswith(".glb"):
            save_glb(path, rows, gaussians.antialiased)
        else:
            save_splat(path, rows)
    elif name.endswith(".compressed.ply"):
        compressed.save_compressed(path, gaussians, similarity)
    elif name.endswith(".ply"):
        save_ply(path, gaussians, similarity, properties)
    else:
        raise ValueError(f"{path}: Gaussians are written as {', '.join(FORMATS)}")


def load_ply(path: Path, similarity: Similarity | None = None, device: str = "cpu") -> Gaussians:
    """Read the Gaussians of a file as float32 on `device`, see `splats.load_splats`.

    Args:
        similarity: from the scene's own frame, in which the file then is, to the normalized frame, in which the result
            then is. None keeps the file's frame.

    Raises:
        BadInput: the file is unreadable, properties are missing (e.g. in a plain point cloud), the number of `f_rest`
            properties belongs to no degree, most rows are not finite, or a value exceeds float32. The message names the
            file.
    """
    gaussians = load_splats(path).gaussians(similarity)
    if not (gaussians.means.isfinite().all() and gaussians.log_scales.isfinite().all()):
        raise BadInput(f"{path}: positions or sizes are too large for 32 bits")
    return gaussians.map(lambda p: p.to(device))


def save_points(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Write a point cloud as PLY: positions [P, 3] as doubles, and colors [P, 3] uint8."""
    types = [(name, "f8") for name in POSITION] + [(name, "u1") for name in RED_GREEN_BLUE]
    table = np.empty(len(points), dtype=types)
    for names, values in ((POSITION, points), (RED_GREEN_BLUE, colors)):
        for name, column in zip(names, np.asarray(values).T, strict=True):
            table[name] = column
    save_vertices(path, table)


def load_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a point cloud from a PLY file, or the positions of a compressed .ply of Gaussians.

    Returns:
        positions: [P, 3] float64.
        colors: [P, 3] uint8, scaled from [0, 1] if they are floats; mid gray if the file has no red, green and blue.

    Raises:
        BadInput: the file is unreadable, or its vertices have no x, y, z.
    """
    path = Path(path)
    header = load_header(path)
    if PACKED in header.vertices()[1]:
        rows = load_splats(path).rows
        return rows.means, np.full((len(rows), 3), 128, np.uint8)
    table = load_vertices(path, header)
    with reading(path, "a readable PLY file of points"):
        return _points(path, table)


def _points(path: Path, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and colors of a vertex table, as `load_points`."""
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
    """Return the vertex properties of a plain .ply, in order; () for other formats. Raises as `summarize_splats`."""
    return summarize_splats(path).properties
