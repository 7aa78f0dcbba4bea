"""The borders of a plane in unobserved space, found by extending the plane's visible borders straight.

A plane has a map of square cells (`plane.Plane`). A cell is *seen* where views show the plane, *free* where views see
through the plane, so that it does not exist there, and *unknown* otherwise.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve

RIM = 1  # cells: strips of seen cells up to 2 RIM wide are ignored, because they arise at the margins of the masks


def extend_borders(unknown: np.ndarray, seen: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return the harmonic function on unknown cells that is 1 at adjacent seen cells and 0 at adjacent free cells.

    The function solves Laplace's equation on the cells. Its level set at 1/2 continues the visible border between seen
    and free cells into the unknown cells, straight where possible.

    Args:
        unknown: bool [H, W], the cells to solve for. Cells up to 2 RIM + 1 steps away that are neither seen nor free
            are solved for, too.
        seen: bool [H, W], cells where the plane is seen.
        free: bool [H, W], cells where views see through the plane.

    Returns:
        [H, W] in [0, 1]; 0 on all cells that are not solved for, and everywhere if no seen cell is adjacent.
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
