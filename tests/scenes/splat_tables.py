"""PLY files of splats as structured arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement


def read_rows(path: Path) -> np.ndarray:
    """Return the element `vertex` of a PLY file as a structured array."""
    return PlyData.read(str(path), mmap=False)["vertex"].data


def write_rows(path: Path, table: np.ndarray, text: bool = False, byte_order: str = "<") -> None:
    """Write a structured array as the element `vertex` of a PLY file.

    Args:
        text: True for an ASCII file, False for a binary file.
        byte_order: byte order of a binary file, "<" (little-endian) or ">" (big-endian).
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    table = table if text else table.astype(table.dtype.newbyteorder(byte_order))
    element = PlyElement.describe(table, "vertex")
    PlyData([element], text=text, byte_order="=" if text else byte_order).write(str(path))


def replace_columns(table: np.ndarray, columns: dict[str, np.ndarray], leave_out: tuple[str, ...] = ()) -> np.ndarray:
    """Return a copy of the table with these columns added or replaced, without the columns in `leave_out`."""
    kept = [name for name in table.dtype.names if name not in (*columns, *leave_out)]
    made = np.empty(
        len(table), [(name, table.dtype[name]) for name in kept] + [(n, c.dtype) for n, c in columns.items()]
    )
    for name in kept:
        made[name] = table[name]
    for name, column in columns.items():
        made[name] = column
    return made
