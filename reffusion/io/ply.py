"""PLY files: Gaussians in the layout 3DGS writes, and plain coloured points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

if TYPE_CHECKING:
    from reffusion.types import Gaussians, Similarity

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
RED_GREEN_BLUE = ("red", "green", "blue")
ANTIALIASED = "antialiased"  # a comment that says how the Gaussians are meant to be drawn


def save_ply(path: Path, gaussians: Gaussians, similarity: Similarity | None = None) -> None:
    """Write Gaussians in the standard 3DGS layout (binary, little endian).

    Properties: x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3; `f_rest` runs through the
    coefficients of red, then green, then blue; opacity as logit, scales as logarithms, rotations wxyz.

    Args:
        similarity: with it, positions and sizes go back through it (in float64) to the scene's own frame.
            Positions are then written as doubles only where floats would move them by more than 1e-5 of the
            normalised extent (geo-referenced scenes); viewers that insist on floats read all others.
    """
    columns = {name: getattr(gaussians, name).detach().cpu().double().numpy() for name in _FIELDS}
    means, log_scales, position_type = columns["means"], columns["log_scales"], "f4"
    if similarity is not None:
        means = similarity.invert(means)
        log_scales = log_scales - np.log(similarity.scale)
        rounding = np.abs(means - means.astype(np.float32)).max(initial=0.0)
        position_type = "f8" if rounding * similarity.scale > 1e-5 else "f4"
    count, higher = len(gaussians), columns["sh"].shape[1] - 1
    rest = columns["sh"][:, 1:].transpose(0, 2, 1).reshape(count, 3 * higher)
    blocks = (
        (POSITION, means),
        (NORMAL, np.zeros((count, 3))),
        (DC, columns["sh"][:, 0]),
        (tuple(f"f_rest_{i}" for i in range(3 * higher)), rest),
        (("opacity",), columns["opacity_logits"][:, None]),
        (SCALES, log_scales),
        (ROTATION, columns["quaternions"]),
    )
    comments = [ANTIALIASED] if gaussians.antialiased else []
    types = [(name, position_type if names is POSITION else "f4") for names, _ in blocks for name in names]
    table = np.empty(count, dtype=types)
    for names, values in blocks:
        for name, column in zip(names, values.T, strict=True):
            table[name] = column
    _write(path, table, comments)


_FIELDS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


def load_ply(path: Path, similarity: Similarity | None = None) -> Gaussians:
    """Read Gaussians from the standard 3DGS layout (binary or ASCII), as float32 on the CPU.

    Args:
        similarity: with it, the file is in the scene's own frame and the result is in the normalised one.

    Raises:
        ValueError: naming the file, where properties are missing (e.g. a plain point cloud), `f_rest` has a
            count that belongs to no degree from 0 to 3, or values are not finite.
    """
    import torch

    from reffusion.types import Gaussians

    table = _read(path)
    missing = [n for n in (*POSITION, *DC, "opacity", *SCALES, *ROTATION) if n not in table.dtype.names]
    if missing:
        raise ValueError(f"{path}: not a file of Gaussians, it lacks {', '.join(missing)}")
    rest_names = [n for n in table.dtype.names if n.startswith("f_rest_")]
    if len(rest_names) not in (0, 9, 24, 45):
        raise ValueError(f"{path}: {len(rest_names)} f_rest properties; 0, 9, 24 or 45 belong to degrees 0 to 3")
    take = lambda names: np.stack([table[n] for n in names], axis=1).astype(np.float64)
    means, log_scales = take(POSITION), take(SCALES)
    if similarity is not None:
        means, log_scales = similarity.apply(means), log_scales + np.log(similarity.scale)
    sh = take(DC)[:, None, :]
    if rest_names:
        rest = take([f"f_rest_{i}" for i in range(len(rest_names))]).reshape(len(table), 3, len(rest_names) // 3)
        sh = np.concatenate([sh, rest.transpose(0, 2, 1)], axis=1)
    arrays = (means, take(ROTATION), log_scales, table["opacity"], sh)
    for name, array in zip(_FIELDS, arrays, strict=True):
        if not np.isfinite(array).all():
            raise ValueError(f"{path}: {name} holds values that are not finite")
    tensors = (torch.from_numpy(np.array(array, np.float32)) for array in arrays)
    return Gaussians(*tensors, antialiased=ANTIALIASED in _comments(path))


def save_points(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Write [P, 3] float64 positions and [P, 3] uint8 colours."""
    types = [(name, "f8") for name in POSITION] + [(name, "u1") for name in RED_GREEN_BLUE]
    table = np.empty(len(points), dtype=types)
    for names, values in ((POSITION, points), (RED_GREEN_BLUE, colors)):
        for name, column in zip(names, np.asarray(values).T, strict=True):
            table[name] = column
    _write(path, table)


def load_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """[P, 3] float64 positions and [P, 3] uint8 colours (mid grey where the file has none) of a point cloud."""
    table = _read(path)
    if any(name not in table.dtype.names for name in POSITION):
        raise ValueError(f"{path}: its vertices have no x, y, z")
    points = np.stack([table[n] for n in POSITION], axis=1).astype(np.float64)
    if all(name in table.dtype.names for name in RED_GREEN_BLUE):
        colors = np.stack([table[n] for n in RED_GREEN_BLUE], axis=1)
        if np.issubdtype(colors.dtype, np.floating):
            colors = np.round(np.clip(colors, 0.0, 1.0) * 255.0)
        return points, colors.astype(np.uint8)
    return points, np.full((len(points), 3), 128, np.uint8)


def _write(path: Path, table: np.ndarray, comments: Sequence[str] = ()) -> None:
    from plyfile import PlyData, PlyElement

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    PlyData([PlyElement.describe(table, "vertex")], byte_order="<", comments=list(comments)).write(str(path))


def _comments(path: Path) -> list[str]:
    """Of a file that could be read."""
    found = []
    with open(path, "rb") as file:
        for line in iter(file.readline, b"end_header\n"):
            if line.startswith(b"comment "):
                found.append(line[8:].decode("ascii", "replace").strip())
            elif not line or line.rstrip() == b"end_header":
                break
    return found


def _read(path: Path) -> np.ndarray:
    from plyfile import PlyData, PlyParseError

    try:
        with open(path, "rb") as file:
            lines = _ascii_vertices(file)
            if lines is not None:
                types, count = lines
                return np.loadtxt(file, dtype=types, max_rows=count, ndmin=1) if count else np.empty(0, types)
        return np.array(PlyData.read(str(path))["vertex"].data)  # mapped: number by number takes seconds
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file") from None
    except (PlyParseError, KeyError, ValueError) as error:
        raise ValueError(f"{path}: not a readable PLY file with vertices ({error})") from error


def _ascii_vertices(file: BinaryIO) -> tuple[np.dtype, int] | None:
    """Type and number of the vertices of a text file that begins with them, its header consumed; else None.

    numpy reads these forty times faster than plyfile, and nerfstudio writes its points as text.
    """
    types, count = [], 0
    for raw in iter(file.readline, b""):
        words = raw.decode("ascii", "replace").split()
        if words[:1] == ["format"] and words[1:2] != ["ascii"]:
            return None
        if words[:1] == ["element"]:
            if count or types or words[1:2] != ["vertex"]:
                break
            count = int(words[2])
        if words[:1] == ["property"]:
            if words[1] not in _ASCII_TYPES:
                return None
            types.append((words[2], _ASCII_TYPES[words[1]]))
        if words[:1] == ["end_header"]:
            return np.dtype(types), count
    return None


_ASCII_TYPES = {
    **{name: "f8" for name in ("float", "float32", "double", "float64")},
    **{name: "i8" for name in ("char", "int8", "uchar", "uint8", "short", "int16", "ushort", "uint16")},
    **{name: "i8" for name in ("int", "int32", "uint", "uint32")},
}
