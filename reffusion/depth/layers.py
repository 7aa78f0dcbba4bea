"""Which surface goes on where: a hole is shared out among the surfaces around it, along the edges of a picture."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components, dijkstra

from reffusion.depth.completion import unit_range

STEP = 0.025  # relative disparity between neighbours from which they belong to two surfaces
LEAST = 0.03  # of the known pixels around a hole: smaller pieces are no surface of their own
EDGE = 40.0  # px that a step of 1 in the picture's colour is worth on the way to a surface


def shared_out(disparity: np.ndarray, known: np.ndarray, hole: np.ndarray, guide: np.ndarray) -> np.ndarray:
    """The surface that each pixel belongs to, int [H, W]: 1, 2, ... where known or in the hole, 0 elsewhere.

    Known pixels are split where disparity jumps. A pixel of the hole goes to the surface that is nearest to it by a way
    that crosses few edges of the picture: there, depth may step.

    PAPER leaves open: the completion of depth.

    Args:
        disparity: [H, W], read where known.
        known: bool [H, W], the pixels around (or within) the hole that are continued.
        hole: bool [H, W].
        guide: [H, W, 3] picture, uint8 or [0, 1].
    """
    surfaces = pieces(disparity, known)
    todo = hole & ~known
    if surfaces.max() < 2 or not todo.any():
        return np.where(known | hole, 1, 0) if surfaces.max() < 2 else surfaces
    colors = ndimage.gaussian_filter(unit_range(guide), (1, 1, 0))
    domain = todo | (surfaces > 0)
    index = np.full(domain.shape, -1)
    index[domain] = np.arange(domain.sum())
    rows, columns, lengths = [], [], []
    for ahead in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here, there = _pairs(index, ahead)
        steps = np.abs(_at(colors, domain)[here] - _at(colors, domain)[there]).max(-1)
        rows, columns = [*rows, here], [*columns, there]
        lengths.append(np.hypot(*ahead) + EDGE * steps)
    size = int(domain.sum())
    graph = sparse.csr_matrix(
        (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))), shape=(size, size)
    )
    seeds = np.flatnonzero(_at(surfaces, domain))
    _, _, nearest = dijkstra(graph, directed=False, indices=seeds, min_only=True, return_predecessors=True)
    found = surfaces.copy()
    reached = nearest >= 0
    labels = np.zeros(size, np.int64)
    labels[reached] = _at(surfaces, domain)[nearest[reached]]
    found[domain] = np.where(_at(surfaces, domain) > 0, _at(surfaces, domain), labels)
    return found


def _at(values: np.ndarray, domain: np.ndarray) -> np.ndarray:
    return values[domain]


def _pairs(index: np.ndarray, ahead: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the pixels, and of their neighbours one step `ahead` (row, column), where both have one."""
    height, width = index.shape
    down, right = ahead
    left = max(0, -right)
    here = index[: height - down, left : width - max(0, right)]
    there = index[down:, left + right : left + right + here.shape[1]]
    both = (here >= 0) & (there >= 0)
    return here[both], there[both]


def pieces(disparity: np.ndarray, known: np.ndarray) -> np.ndarray:
    """int [H, W]: the known pixels' connected pieces without jumps, 1, 2, ... from the largest on; 0: too small."""
    index = np.full(known.shape, -1)
    index[known] = np.arange(known.sum())
    values, rows, columns = disparity[known], [], []
    for ahead in ((0, 1), (1, 0)):
        here, there = _pairs(index, ahead)
        near = np.abs(values[here] - values[there]) < STEP * np.maximum(values[here], values[there])
        rows, columns = [*rows, here[near]], [*columns, there[near]]
    size = len(values)
    joined = sparse.csr_matrix(
        (np.ones(sum(map(len, rows))), (np.concatenate(rows), np.concatenate(columns))), shape=(size, size)
    )
    _, piece = connected_components(joined, directed=False)
    counts = np.bincount(piece, minlength=1)
    order = np.argsort(-counts, kind="stable")
    number = np.zeros(len(counts), np.int64)
    large = order[counts[order] >= LEAST * max(size, 1)]
    number[large] = np.arange(1, len(large) + 1)
    found = np.zeros(known.shape, np.int64)
    found[known] = number[piece]
    return found
