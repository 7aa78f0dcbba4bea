"""Reading and writing of .splat files, the format of antimatter15's viewer: 32 bytes per splat, without a header.

A record holds the position as three float32, the size as three float32 (standard deviations, not logarithms), color
and opacity in four bytes, and the quaternion wxyz in four bytes. There are no spherical harmonics beyond the color. No
maintained library reads this format without a compiler or the network.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from reffusion.io.files import BadInput, reading
from reffusion.io.splat_rows import Rows
from reffusion.splat.conventions import SH0

RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])


def count_splat(path: Path) -> int:
    """Return the number of splats, from the size of the file.

    Raises:
        BadInput: the file is missing, or its size is no multiple of a record's.
    """
    with reading(path, "a .splat file"):
        size = Path(path).stat().st_size
    if size % RECORD.itemsize:
        raise BadInput(f"{path}: cut off, or no .splat file: {size} bytes are no multiple of {RECORD.itemsize}")
    return size // RECORD.itemsize


def open_splat(path: Path) -> Callable[[slice], Rows]:
    """Return a function that reads the rows of a slice of the file, which `count_splat` must accept.

    A record of 32 zero bytes (padding) gives a row of zeros. An opacity of 0 or 255 gives an infinite logit, and a size
    of 0 a log-scale of minus infinity.
    """
    table = np.memmap(path, RECORD, mode="r") if Path(path).stat().st_size else np.empty(0, RECORD)

    def read(chosen: slice) -> Rows:
        block = np.array(table[chosen])
        empty = ~block.view(np.uint8).reshape(-1, RECORD.itemsize).any(1)
        colors = block["color"] / 255
        with np.errstate(divide="ignore", invalid="ignore"):
            logits = np.log(colors[:, 3]) - np.log1p(-colors[:, 3])
            scales = np.log(block["scale"])
        arrays = (
            block["position"].astype(np.float64),
            ((block["rotation"] - 128.0) / 128).astype(np.float32),
            scales.astype(np.float32),
            logits.astype(np.float32),
            ((colors[:, :3] - 0.5) / SH0).astype(np.float32)[:, None],
        )
        for array in arrays:
            array[empty] = 0
        return Rows(*arrays)

    return read


def save_splat(path: Path, rows: Rows) -> None:
    """Write rows as a .splat file, and create its folder. Spherical harmonics of degree 1 and above are dropped."""
    table = np.empty(len(rows), RECORD)
    in_bytes = lambda values, most: np.clip(np.round(values), 0, most).astype(np.uint8)
    opacities = 1 / (1 + np.exp(-rows.opacity_logits.astype(np.float64)))
    table["position"], table["scale"] = rows.means, np.exp(rows.log_scales)
    table["color"] = in_bytes(255 * np.column_stack([0.5 + SH0 * rows.sh[:, 0], opacities]), 255)
    table["rotation"] = in_bytes(128 * rows.unit_quaternions + 128, 255)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_bytes(table.tobytes())
