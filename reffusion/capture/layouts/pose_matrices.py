"""Reads pose matrices from JSON: 3x4 or 4x4, or 16 numbers in a row, by rows or by columns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from reffusion.io.files import BadInput, as_bad_input

LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])  # of every rigid 4x4 matrix


def read_matrices(values: Sequence[object], names: Sequence[str], source: Path) -> tuple[np.ndarray, bool]:
    """Return the pose matrices of a file as [N, 4, 4] float64, and whether the file holds them transposed.

    Matrices are transposed if the last column of all, instead of their last row, is 0 0 0 1. In the result they are not
    transposed.

    Args:
        values: N > 0 matrices as JSON has them: nested lists of 3x4 or 4x4 numbers, or flat lists of 16.
        names: the N pictures of the matrices, for messages.
        source: the file, for messages.

    Raises:
        BadInput: a matrix is not of numbers or has another shape; or some matrices are transposed, others not.
    """
    matrices = np.stack([_read_matrix(value, name, source) for value, name in zip(values, names, strict=True)])
    by_rows = np.isclose(matrices[:, 3], LAST_ROW, atol=1e-6).all(axis=1)
    by_columns = np.isclose(matrices[:, :, 3], LAST_ROW, atol=1e-6).all(axis=1)
    transposed = by_columns & ~by_rows
    if not transposed.any():
        return matrices, False
    if not by_columns.all():
        first, other = names[int(transposed.argmax())], names[int(by_columns.argmin())]
        raise BadInput(f"{source}: the matrix of '{first}' is transposed, that of '{other}' is not; write all alike")
    return matrices.transpose(0, 2, 1), True


def _read_matrix(value: object, name: str, source: Path) -> np.ndarray:
    """Return a matrix [4, 4] as it is stored; a last row that is missing is added."""
    with as_bad_input(source, f"a number in each place of the matrix of '{name}'"):
        matrix = np.array(value)
        if matrix.dtype.kind not in "fiu":
            raise BadInput(f"{source}: the matrix of '{name}' is no 4x4 matrix of numbers")
        matrix = matrix.astype(np.float64)
    if matrix.shape == (16,):
        return matrix.reshape(4, 4)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise BadInput(f"{source}: the matrix of '{name}' is no 4x4 matrix")
    return matrix if len(matrix) == 4 else np.vstack([matrix, LAST_ROW])
