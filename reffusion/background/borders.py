"""Where a surface ends in unobserved space: its visible borders are extended straight."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve

RIM = 1  # cells: a strip of seen cells that is no wider on either side is blurred by the masks' margin


def extend_borders(unknown: np.ndarray, seen: np.ndarray, free: np.ndarray) -> np.ndarray:
    """[H, W] in [0, 1]: on unknown cells the harmonic function that is 1 next to seen cells and 0 next to free ones.

    Its level set at one half extends the visible border between seen and free cells, straight where it can.
    """
    unknown = unknown | (ndimage.binary_dilation(unknown, iterations=2 * RIM + 1) & ~seen & ~free)
    index = np.full(unknown.shape, -1)
    index[unknown] = np.arange(unknown.sum())
    center, total = index[unknown], np.zeros(int(unknown.sum()))
    right, links = np.zeros_like(total), []
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        shift = lambda cells, axis=axis, step=step: np.roll(np.pad(cells, 1), step, axis)[1:-1, 1:-1][unknown]
        next_seen, next_free = shift(seen), shift(free)
        neighbor = np.roll(np.pad(index, 1, constant_values=-1), step, axis)[1:-1, 1:-1][unknown]
        linked = neighbor >= 0
        total += next_seen | next_free | linked
        right += next_seen
        links.append(sparse.coo_matrix((np.ones(linked.sum()), (center[linked], neighbor[linked])), (len(total),) * 2))
    values = np.zeros(unknown.shape)
    if right.any():
        values[unknown] = spsolve((sparse.diags(total + 1e-9) - sum(links)).tocsc(), right)
    return values
