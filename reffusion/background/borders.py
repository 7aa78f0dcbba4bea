"""Where a surface ends in space that nobody saw: its visible borders go on straight."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve

RIM = 1  # cells on either side: what is seen in a thinner strip is blurred by the masks' margin


def between(unknown: np.ndarray, seen: np.ndarray, free: np.ndarray) -> np.ndarray:
    """[H, W] in [0, 1], on the unknown cells the harmonic function that is 1 where they meet seen cells and 0
    where they meet free ones: at a half the borders that are visible go on through them, straight where they can."""
    unknown = unknown | (ndimage.binary_dilation(unknown, iterations=2 * RIM + 1) & ~seen & ~free)
    index = np.full(unknown.shape, -1)
    index[unknown] = np.arange(unknown.sum())
    centre, total = index[unknown], np.zeros(int(unknown.sum()))
    right, links = np.zeros_like(total), []
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        moved = lambda cells, axis=axis, step=step: np.roll(np.pad(cells, 1), step, axis)[1:-1, 1:-1][unknown]
        next_seen, next_free = moved(seen), moved(free)
        next_one = np.roll(np.pad(index, 1, constant_values=-1), step, axis)[1:-1, 1:-1][unknown]
        linked = next_one >= 0
        total += next_seen | next_free | linked
        right += next_seen
        links.append(sparse.coo_matrix((np.ones(linked.sum()), (centre[linked], next_one[linked])), (len(total),) * 2))
    found = np.zeros(unknown.shape)
    if right.any():
        found[unknown] = spsolve((sparse.diags(total + 1e-9) - sum(links)).tocsc(), right)
    return found
