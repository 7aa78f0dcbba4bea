"""Blends pieces without seams: finds the picture whose gradients are nearest to theirs (screened Poisson equation)."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

COLOR_WEIGHT = 0.02  # of the pieces' own colours against their gradients: far from the border the colours win
TINY_WEIGHT = 1e-9  # of them, so that a hole without known neighbours is zero, not singular


def blend(
    known: np.ndarray,
    hole: np.ndarray,
    right: np.ndarray,
    below: np.ndarray,
    own: np.ndarray,
    beside: np.ndarray | None = None,
    color_weight: float = COLOR_WEIGHT,
) -> np.ndarray:
    """[N, 3] float64, the blended colours of the hole's pixels in reading order (Perez et al. 2003).

    Args:
        known: [H, W, 3], read beside the hole. hole: bool [H, W].
        right, below: [H, W, 3], the gradients wanted, to the next pixel. own: [H, W, 3], the colours wanted.
        beside: bool [H, W], the pixels outside the hole that it must join without a seam; None: all.
        color_weight: of the colours against the gradients.
    """
    rows, columns = np.nonzero(hole)
    index = np.full(hole.shape, -1)
    index[rows, columns] = np.arange(len(rows))
    diagonal, rhs = np.full(len(rows), color_weight), color_weight * own[rows, columns].astype(np.float64)
    links = []
    for down, along, gradient in ((0, 1, right), (0, -1, right), (1, 0, below), (-1, 0, below)):
        row, column = rows + down, columns + along
        here = np.flatnonzero((row >= 0) & (column >= 0) & (row < hole.shape[0]) & (column < hole.shape[1]))
        if beside is not None:
            here = here[(hole | beside)[row[here], column[here]]]
        row, column = row[here], column[here]
        first = np.minimum(rows[here], row), np.minimum(columns[here], column)
        diagonal[here] += 1
        rhs[here] -= gradient[first] * (down + along)
        other = index[row, column]
        outside = other < 0
        rhs[here[outside]] += known[row[outside], column[outside]]
        links.append(np.stack([here[~outside], other[~outside]]))
    here, other = np.concatenate(links, 1)
    matrix = sparse.csc_matrix((-np.ones(len(here)), (here, other)), (len(rows),) * 2) + sparse.diags(diagonal)
    return splu(matrix.tocsc()).solve(rhs)


def paste(image: np.ndarray, picture: np.ndarray, mask: np.ndarray, both: np.ndarray) -> np.ndarray:
    """uint8 [H, W, 3], the image with a picture pasted into a mask, bool [H, W], in the image's tone: the median
    difference of the two is added, where `both` are known, bool [H, W]."""
    difference = image[both].astype(np.float64) - picture[both]
    tone = np.median(difference, 0) if len(difference) else np.zeros(3)
    result = image.copy()
    result[mask] = (picture[mask] + tone).clip(0, 255).round()
    return result


def interpolate(values: np.ndarray, hole: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """Fill a hole by the Laplace equation.

    Args:
        values: [H, W, 3].
        hole: bool [H, W], the pixels to fill. beside: bool [H, W], the pixels whose values are continued.

    Returns:
        [N, 3] float64, the hole's pixels in reading order.
    """
    even = np.zeros(values.shape, np.float32)
    return blend(values, hole, even, even, even, beside, TINY_WEIGHT)
