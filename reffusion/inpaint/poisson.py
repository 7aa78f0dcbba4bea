"""Patches blended without seams: the picture whose changes from pixel to pixel are nearest to theirs."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

ABSOLUTE = 0.02  # weight of the patches' own colours against their changes: far from the border they hold
LEAST = 1e-9  # of them, so that a hole that nothing lies beside is 0


def blended(
    known: np.ndarray,
    hole: np.ndarray,
    right: np.ndarray,
    below: np.ndarray,
    own: np.ndarray,
    beside: np.ndarray | None = None,
    absolute: float = ABSOLUTE,
) -> np.ndarray:
    """[N, 3], the colours of the hole's pixels in reading order (screened Poisson, as in Perez et al. 2003).

    Args:
        known: [H, W, 3], read beside the hole. hole: bool [H, W].
        right, below: [H, W, 3], wanted change to the next pixel. own: [H, W, 3], wanted colours.
        beside: bool [H, W], which pixels outside the hole go on in it; None: all.
        absolute: weight of the wanted colours against the wanted changes.
    """
    rows, columns = np.nonzero(hole)
    index = np.full(hole.shape, -1)
    index[rows, columns] = np.arange(len(rows))
    total, wanted, links = np.full(len(rows), absolute), absolute * own[rows, columns].astype(np.float64), []
    for down, along, change in ((0, 1, right), (0, -1, right), (1, 0, below), (-1, 0, below)):
        row, column = rows + down, columns + along
        here = np.flatnonzero((row >= 0) & (column >= 0) & (row < hole.shape[0]) & (column < hole.shape[1]))
        if beside is not None:
            here = here[(hole | beside)[row[here], column[here]]]
        row, column = row[here], column[here]
        first = np.minimum(rows[here], row), np.minimum(columns[here], column)
        total[here] += 1
        wanted[here] -= change[first] * (down + along)
        other = index[row, column]
        outside = other < 0
        wanted[here[outside]] += known[row[outside], column[outside]]
        links.append(np.stack([here[~outside], other[~outside]]))
    here, there = np.concatenate(links, 1)
    matrix = sparse.csc_matrix((-np.ones(len(here)), (here, there)), (len(rows),) * 2) + sparse.diags(total)
    return splu(matrix.tocsc()).solve(wanted)


def laid_over(image: np.ndarray, picture: np.ndarray, there: np.ndarray, both: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint8, an image with what is `there`, bool [H, W], of a picture, in the tone that the image has beside
    the picture's where `both` are known, bool [H, W]."""
    apart = image[both].astype(np.float64) - picture[both]
    tone = np.median(apart, 0) if len(apart) else np.zeros(3)
    found = image.copy()
    found[there] = (picture[there] + tone).clip(0, 255).round()
    return found


def evenly(values: np.ndarray, hole: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """[N, 3], what is known `beside` a hole, bool [H, W], drawn evenly across it: at its pixels in reading order."""
    even = np.zeros(values.shape, np.float32)
    return blended(values, hole, even, even, even, beside, LEAST)
