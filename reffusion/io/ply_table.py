"""Reading and writing of PLY files whose vertices are a table: a structured numpy array with a field per property."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reffusion.io.files import BadInput, reading, shorten

TYPES: dict[str, np.dtype] = {
    **dict.fromkeys(("char", "int8"), np.dtype("i1")),
    **dict.fromkeys(("uchar", "uint8"), np.dtype("u1")),
    **dict.fromkeys(("short", "int16"), np.dtype("i2")),
    **dict.fromkeys(("ushort", "uint16"), np.dtype("u2")),
    **dict.fromkeys(("int", "int32"), np.dtype("i4")),
    **dict.fromkeys(("uint", "uint32"), np.dtype("u4")),
    **dict.fromkeys(("float", "float32"), np.dtype("f4")),
    **dict.fromkeys(("double", "float64"), np.dtype("f8")),
}
LONGEST_LINE = 1_000_000  # bytes that are read at once of a line of the header


@dataclass(frozen=True)
class Header:
    """The header of a PLY file.

    Attributes:
        text: True if the data is ASCII text, False if it is binary.
        elements: (name, number of rows, properties) of each element, in the order of the file. Properties are pairs
            (type, name); the type of a list is "list".
        comments: the comment lines, without the word `comment`. Words are separated by one blank.
        at: offset in bytes at which the data begins.
    """

    text: bool
    elements: tuple[tuple[str, int, tuple[tuple[str, str], ...]], ...]
    comments: tuple[str, ...]
    at: int

    def least_bytes(self) -> int:
        """Return the smallest size in bytes that the data can have according to this header.

        In text each number takes at least two bytes, a digit and a blank. In binary data a list takes at least one
        byte, for its length. A row without properties counts as one byte, so that a header cannot declare any number of
        rows for a short file.
        """
        size = lambda kind: 2 if self.text else TYPES[kind].itemsize if kind in TYPES else 1
        rows = ((count, max(sum(size(kind) for kind, _ in each), 1)) for _, count, each in self.elements)
        return sum(count * row for count, row in rows) - int(self.text)  # the last line may end without a break

    def vertices(self) -> tuple[int, list[str]]:
        """Return the number of vertices, and the names of their properties that are single numbers (not lists)."""
        count, properties = next((c, p) for name, c, p in self.elements if name == "vertex")
        return count, [name for kind, name in properties if kind in TYPES]


def load_header(path: Path) -> Header:
    """Read the header of a PLY file.

    Raises:
        BadInput: the file cannot be read, has no valid PLY header or no element `vertex` (which may have no rows), or
            is shorter than its header declares.
    """
    with reading(path, "a readable PLY file with vertices"), open(path, "rb") as file:
        if file.readline(8).strip() != b"ply":
            raise BadInput(
                f"{path}: not a PLY file; its first line is not `ply`; export the Gaussians or points as .ply"
            )
        form, elements, comments = "", [], []
        for raw in iter(lambda: file.readline(LONGEST_LINE), b""):
            words = _decode(raw).split()
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
        layout = tuple((name, count, tuple(properties)) for name, count, properties in elements)
        header = Header(form == "ascii", layout, tuple(comments), file.tell())
        if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
            raise BadInput(f"{path}: not a readable PLY file with vertices: its format is '{shorten(form)}'")
        names = [name for name, _, _ in layout]
        if "vertex_0" in names:
            raise BadInput(
                f"{path}: a .ply of reduced-3dgs ({', '.join(names)}) is not read; load it with GaussianModel.load_ply "
                "of that project, and save its Gaussians as a .ply of 3DGS, as gsplat.export_splats writes it"
            )
        if any(count < 0 for _, count, _ in layout) or "vertex" not in names:
            raise BadInput(f"{path}: not a readable PLY file with vertices")
        if header.at + header.least_bytes() > Path(path).stat().st_size:
            raise BadInput(f"{path}: cut off: it is too short for what its header declares")
        return header


def _decode(line: bytes) -> str:
    """Decode a line of the header, which other programs write in UTF-8 or in Latin-1."""
    try:
        return line.decode()
    except UnicodeDecodeError:
        return line.decode("latin-1")


def load_vertices(path: Path, header: Header) -> np.ndarray:
    """Read the N vertices of a PLY file as a structured array [N] with a field per property.

    The array of a binary file whose vertices have no list properties is a memory map of the file, and takes no memory.
    Numbers of a text file may have wider types than the header declares.

    Args:
        header: the header of this file, from `load_header`.

    Raises:
        BadInput: the file cannot be read, or ends before its last vertex.
    """
    from plyfile import PlyData

    with reading(path, "a readable PLY file with vertices"):
        (name, count, properties), *_ = header.elements
        if header.text and name == "vertex" and all(kind in TYPES for kind, _ in properties):
            # numpy reads these forty times faster than plyfile, and nerfstudio writes its points as text
            types = np.dtype([(n, "f8" if TYPES[kind].kind == "f" else "i8") for kind, n in properties])
            with open(path, "rb") as file:
                file.seek(header.at)
                table = np.loadtxt(file, dtype=types, max_rows=count, ndmin=1) if count else np.empty(0, types)
            if len(table) != count:
                raise BadInput(f"{path}: cut off: {len(table)} of {count} vertices")
            return table
        with open(path, "rb") as file:
            start = file.read(header.at)
            if start.isascii():
                return PlyData.read(str(path))["vertex"].data
            # plyfile reads ASCII only. The replaced characters are in comments, so the data is read all the same.
            start = start.decode("ascii", "replace").encode("ascii", "replace")
            return PlyData.read(io.BytesIO(start + file.read()))["vertex"].data


def save_vertices(path: Path, table: np.ndarray, comments: Sequence[str] = ()) -> None:
    """Write a structured array [N] as the vertices of a binary, little-endian PLY file; create its folder."""
    from plyfile import PlyData, PlyElement

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    PlyData([PlyElement.describe(table, "vertex")], byte_order="<", comments=list(comments)).write(str(path))
