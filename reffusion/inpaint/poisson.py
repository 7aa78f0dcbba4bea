"""Blending of pieces without seams, by the screened Poisson equation.

The result is the picture whose gradients are nearest to those of the pieces, and whose colors are near to theirs.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

COLOR_WEIGHT = 0.02  # weight of the pieces' colors; gradients have weight 1. Far from the border the colors win.


def blend(
    known: np.ndarray,
    hole: np.ndarray,
    right: np.ndarray,
    below: np.ndarray,
    own: np.ndarray,
    beside: np.ndarray | None = None,
    color_weight: float = COLOR_WEIGHT,
) -> np.ndarray:
    """Compute the blended colors of a hole (Perez et al. 2003).

    Args:
        known: [H, W, 3], the picture outside the hole, which the hole must join without a seam.
        hole: bool [H, W], the N pixels to compute, at least one.
        right, below: [H, W, 3], the desired difference from each pixel to the next one on the right, and below.
        own: [H, W, 3], the desired colors.
        beside: bool [H, W], the pixels outside the hole that the hole must join; None for all.
        color_weight: weight of the squared deviation from the desired colors, if that of the squared deviation from
            the desired differences is 1.

    Returns:
        [N, 3] float64, the colors of the hole's pixels in row-major order.
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
    """Return a copy of an image into which a picture is pasted, after the picture's tone is matched to the image's.

    To match the tone, the median difference image - picture of each channel is added to the picture.

    Args:
        image, picture: uint8 [H, W, 3].
        mask: bool [H, W], the pixels to paste.
        both: bool [H, W], the pixels at which image and picture show the same; the difference is taken there.
            If there are none, the tone is not changed.

    Returns:
        uint8 [H, W, 3].
    """
    difference = image[both].astype(np.float64) - picture[both]
    tone = np.median(difference, 0) if len(difference) else np.zeros(3)
    result = image.copy()
    result[mask] = (picture[mask] + tone).clip(0, 255).round()
    return result
