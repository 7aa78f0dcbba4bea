"""PLY files: Gaussians in the layout 3DGS writes, and plain coloured points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reffusion.io import compressed
from reffusion.io.compressed import PACKED
from reffusion.io.files import BadInput, reading, shortened

if TYPE_CHECKING:
    from reffusion.types import Gaussians, Similarity

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
RED_GREEN_BLUE = ("red", "green", "blue")
ANTIALIASED = "antialiased"  # a comment that says how the Gaussians are meant to be drawn


def save_ply(
    path: Path, gaussians: Gaussians, similarity: Similarity | None = None, properties: Sequence[str] = ()
) -> None:
    """Write Gaussians in the standard 3DGS layout (binary, little endian).

    Properties: x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3; `f_rest` runs through the
    coefficients of red, then green, then blue; opacity as logit, scales as logarithms, rotations wxyz.

    Args:
        similarity: with it, positions and sizes go back through it (in float64) to the scene's own frame.
            Positions are then written as doubles only where floats would move them by more than 1e-5 of the
            normalised extent (geo-referenced scenes); viewers that insist on floats read all others.
        properties: another order of these, normals left out where it has none (`properties_of` a file to be like).
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
    found = {name: column for names, values in blocks for name, column in zip(names, values.T, strict=True)}
    wanted = [name for name in properties or found if name in found]
    wanted += [name for name in found if name not in wanted and name not in NORMAL]
    table = np.empty(count, [(name, position_type if name in POSITION else "f4") for name in wanted])
    for name in wanted:
        table[name] = found[name]
    _write(path, table, comments)


_FIELDS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


def load_ply(path: Path, similarity: Similarity | None = None) -> Gaussians:
    """Read Gaussians from the standard 3DGS layout (binary or ASCII), as float32 on the CPU.

    Args:
        similarity: with it, the file is in the scene's own frame and the result is in the normalised one.

    Raises:
        BadInput: naming the file, where properties are missing (e.g. a plain point cloud), `f_rest` has a
            count that belongs to no degree from 0 to 3, or values are not finite.
    """
    import torch

    from reffusion.types import Gaussians

    table, comments = _read(path)
    with reading(path, "a file of Gaussians"):
        arrays = _arrays(path, table, similarity)
    return Gaussians(*map(torch.from_numpy, arrays), antialiased=ANTIALIASED in comments)


def _arrays(path: Path, table: np.ndarray, similarity: Similarity | None) -> list[np.ndarray]:
    """Of the vertices what `_FIELDS` names, float32."""
    _check_properties(path, table.dtype.names)
    rest_names = [n for n in table.dtype.names if n.startswith("f_rest_")]
    take = lambda names: np.stack([table[n] for n in names], axis=1).astype(np.float64)
    means, log_scales = take(POSITION), take(SCALES)
    if similarity is not None:
        means, log_scales = similarity.apply(means), log_scales + np.log(similarity.scale)
    sh = take(DC)[:, None, :]
    if rest_names:
        rest = take([f"f_rest_{i}" for i in range(len(rest_names))]).reshape(len(table), 3, len(rest_names) // 3)
        sh = np.concatenate([sh, rest.transpose(0, 2, 1)], axis=1)
    arrays = []
    for name, array in zip(_FIELDS, (means, take(ROTATION), log_scales, table["opacity"], sh), strict=True):
        with np.errstate(over="ignore"):
            arrays.append(np.array(array, np.float32, order="C"))
        if not np.isfinite(arrays[-1]).all():
            raise BadInput(f"{path}: {name} holds values that are not finite, or too large for 32 bits")
    return arrays


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
    table, _ = _read(path)
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


def _write(path: Path, table: np.ndarray, comments: Sequence[str] = ()) -> None:
    from plyfile import PlyData, PlyElement

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    PlyData([PlyElement.describe(table, "vertex")], byte_order="<", comments=list(comments)).write(str(path))


@dataclass(frozen=True)
class _Header:
    """What a PLY file says of itself.

    Attributes:
        text: the numbers are written as text.
        elements: name, number of rows, and of each of its properties type and name; of a list ("list", name).
        comments: the lines of comment.
        at: where the data begins, in bytes.
    """

    text: bool
    elements: tuple[tuple[str, int, tuple[tuple[str, str], ...]], ...]
    comments: tuple[str, ...]
    at: int

    def least(self) -> int:
        """Bytes that the data takes at least: a digit and a blank for each number of a text, one for a list's length.

        An element without properties takes none, however many it is said to have: it counts as a byte each."""
        size = lambda kind: 2 if self.text else _TYPES[kind].itemsize if kind in _TYPES else 1
        rows = ((count, max(sum(size(kind) for kind, _ in each), 1)) for _, count, each in self.elements)
        return sum(count * row for count, row in rows) - int(self.text)  # the last line may end without a break


_TYPES: dict[str, np.dtype] = {
    **dict.fromkeys(("char", "int8"), np.dtype("i1")),
    **dict.fromkeys(("uchar", "uint8"), np.dtype("u1")),
    **dict.fromkeys(("short", "int16"), np.dtype("i2")),
    **dict.fromkeys(("ushort", "uint16"), np.dtype("u2")),
    **dict.fromkeys(("int", "int32"), np.dtype("i4")),
    **dict.fromkeys(("uint", "uint32"), np.dtype("u4")),
    **dict.fromkeys(("float", "float32"), np.dtype("f4")),
    **dict.fromkeys(("double", "float64"), np.dtype("f8")),
}


def _header(path: Path) -> _Header:
    """Raises BadInput, where it is none, or where the file is too short for what it declares."""
    with reading(path, "a readable PLY file with vertices"), open(path, "rb") as file:
        if file.readline(8).strip() != b"ply":
            raise BadInput(f"{path}: not a PLY file; its first line is not `ply`")
        form, elements, comments = "", [], []
        for raw in iter(lambda: file.readline(_LONGEST_LINE), b""):
            words = raw.decode("ascii", "replace").split()
            if words[:1] == ["format"]:
                form = words[1]
            elif words[:1] == ["comment"]:
                comments.append(" ".join(words[1:]))
            elif words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:1] == ["property"]:
                elements[-1][2].append((words[1], words[-1]))
            elif words[:1] == ["end_header"]:
                break
        else:
            raise BadInput(f"{path}: cut off within its header")
        held = tuple((name, count, tuple(properties)) for name, count, properties in elements)
        header = _Header(form == "ascii", held, tuple(comments), file.tell())
        if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
            raise BadInput(f"{path}: not a readable PLY file with vertices: its format is '{shortened(form)}'")
        if any(count < 0 for _, count, _ in held) or not any(name == "vertex" for name, _, _ in held):
            raise BadInput(f"{path}: not a readable PLY file with vertices")
        if header.at + header.least() > path.stat().st_size:
            raise BadInput(f"{path}: cut off: it is too short for what its header declares")
        return header


_LONGEST_LINE = 10_000  # of a header, in bytes


def check_gaussians(path: Path) -> int:
    """How many there are, by the header alone: BadInput where the file is cut off, or its properties are others."""
    count, properties = _vertices(_header(Path(path)))
    if PACKED not in properties:
        _check_properties(path, properties)
    return count


def properties_of(path: Path) -> tuple[str, ...]:
    """The names of its vertices' properties, in order; none of a compressed file."""
    _, properties = _vertices(_header(Path(path)))
    return () if PACKED in properties else tuple(properties)


def _vertices(header: _Header) -> tuple[int, list[str]]:
    """How many, and the names of their properties that are numbers."""
    count, properties = next((c, p) for name, c, p in header.elements if name == "vertex")
    return count, [name for kind, name in properties if kind in _TYPES]


def _check_properties(path: Path, names: Sequence[str]) -> None:
    missing = [n for n in (*POSITION, *DC, "opacity", *SCALES, *ROTATION) if n not in names]
    if missing:
        raise BadInput(f"{path}: not a file of Gaussians, it lacks {', '.join(missing)}")
    count = sum(n.startswith("f_rest_") for n in names)
    if count not in (0, 9, 24, 45) or any(f"f_rest_{k}" not in names for k in range(count)):
        raise BadInput(f"{path}: {count} f_rest properties; 0, 9, 24 or 45 belong to degrees 0 to 3")
    if len(set(names)) < len(names):
        raise BadInput(f"{path}: a property comes twice")


def _read(path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """The vertices, and the comments."""
    from plyfile import PlyData

    path = Path(path)
    header = _header(path)
    if PACKED in _vertices(header)[1]:
        return compressed.load_table(path), header.comments
    with reading(path, "a readable PLY file with vertices"):
        (name, count, properties), *_ = header.elements
        if header.text and name == "vertex" and all(kind in _TYPES for kind, _ in properties):
            # numpy reads these forty times faster than plyfile, and nerfstudio writes its points as text
            types = np.dtype([(n, "f8" if _TYPES[kind].kind == "f" else "i8") for kind, n in properties])
            with open(path, "rb") as file:
                file.seek(header.at)
                table = np.loadtxt(file, dtype=types, max_rows=count, ndmin=1) if count else np.empty(0, types)
            if len(table) != count:
                raise BadInput(f"{path}: cut off: {len(table)} of {count} vertices")
            return table, header.comments
        # mapped: number by number takes seconds
        return np.array(PlyData.read(str(path))["vertex"].data), header.comments
