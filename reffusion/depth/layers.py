"""Which surface goes on where: a hole is shared out among the surfaces around it, along the edges of a picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components, dijkstra

from reffusion.depth.completion import unit_range
from reffusion.graph_cut import HARD, least_labels

STEP = 0.025  # relative disparity between neighbours from which they belong to two surfaces
LEAST = 0.03  # of the known pixels around a hole: smaller pieces are no surface of their own
COLOR = 0.1  # weight of a pixel's colour against a link to one of its neighbours
ALIKE = 0.05  # least cost of parting neighbours, of that where the picture is even
BINS = 12  # of colour, along each of red, green and blue
ON = 0.02  # relative disparity within which a pixel lies on a plane
NEARLY = 0.04  # median relative disparity from a plane under which a piece beside it is an unevenness of it
BESIDE = 0.03  # of the width: how far around a hole its surfaces meet what goes on in it
TOUCHING = 3  # px within which two pieces beside the hole meet
BEFORE = 1.05  # relative disparity of a piece there over all that it meets, from which it stands before them
SUPPOSED = 0.5  # cost of a pixel that is not of the plane which is supposed to go on there


def shared_out(
    disparity: np.ndarray,
    known: np.ndarray,
    hole: np.ndarray,
    guide: np.ndarray,
    planes: Sequence[np.ndarray] = (),
    supposed: np.ndarray | None = None,
    barred: np.ndarray | None = None,
) -> np.ndarray:
    """The surface that each pixel belongs to, int [H, W]: 1, 2, ... where known or in the hole, 0 elsewhere.

    Known pixels are split into those on a plane, and the rest, where disparity jumps. The hole is cut
    where the picture has edges, there depth may step, and where its colours are those of one surface or of another.

    PAPER leaves open: the completion of depth.

    Args:
        disparity: [H, W], read where known.
        known: bool [H, W], the pixels around (or within) the hole that are continued.
        hole: bool [H, W]; what lies between it and the known pixels belongs to it.
        guide: [H, W, 3] picture, uint8 or [0, 1].
        planes: depth [H, W] of planes that stand around the hole.
        supposed: bool [H, W], those of the known pixels that are only supposed to be of the plane they lie on.
        barred: int [H, W], a surface that a pixel must not be of, numbered as by a call without; 0: it may be of each.
    """
    supposed = np.zeros_like(hole) if supposed is None else supposed & known
    surfaces = pieces(disparity, known & ~supposed, planes, hole)
    count = int(surfaces.max())
    todo = hole & ~(known & ~supposed)
    if count < 2 or not todo.any():
        return np.where(known | hole, 1, 0) if count < 2 else surfaces
    index, beside = np.full(hole.shape, -1), ndimage.binary_dilation(todo, np.ones((3, 3)))
    domain = todo | (beside & (surfaces > 0))
    index[domain] = np.arange(domain.sum())
    colors = ndimage.gaussian_filter(unit_range(guide), (1, 1, 0))
    cost = COLOR * _unlike(colors, surfaces, domain)
    own, of = _at(surfaces, domain) - 1, of_planes(disparity, supposed, surfaces, planes)[domain] - 1
    for k in range(count):
        cost[k] += SUPPOSED * ((of >= 0) & (of != k)) + HARD * ((own >= 0) & (own != k))
        if barred is not None:
            cost[k] += HARD * ((own < 0) & (barred[domain] == k + 1))
    pairs, strength = _links(index, colors)
    start = np.where(own >= 0, own, np.where(of >= 0, of, cost.argmin(0)))
    found = surfaces.copy()
    found[domain] = least_labels(cost, pairs, strength, start) + 1
    return _grown_in(found, surfaces, todo)


def _grown_in(found: np.ndarray, surfaces: np.ndarray, todo: np.ndarray) -> np.ndarray:
    """int [H, W]: the surfaces found, without islands: what is `todo`, bool [H, W], and does not touch what is known of
    its own surface, int [H, W], is of the one around it. A pattern may have the colours of something else."""
    island = np.zeros_like(todo)
    for surface in range(1, int(surfaces.max()) + 1):
        part, _ = ndimage.label(found == surface, np.ones((3, 3)))
        reached = np.isin(part, np.unique(part[surfaces == surface]))
        island |= (part > 0) & ~reached & todo
    if not island.any() or island.all():
        return found
    nearest = ndimage.distance_transform_edt(island | (found == 0), return_distances=False, return_indices=True)
    return np.where(island, found[tuple(nearest)], found)


def _links(index: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs [E, 2] of neighbours among the pixels that `index` [H, W] numbers, and what it costs to part them [E]:
    little across edges of the picture."""
    rows, columns, apart = [], [], []
    for ahead in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here, there = _pairs(index, ahead)
        rows, columns = [*rows, here], [*columns, there]
        apart.append(np.full(len(here), np.hypot(*ahead)))
    pairs, length = np.stack([np.concatenate(rows), np.concatenate(columns)], 1), np.concatenate(apart)
    inside = _at(colors, index >= 0)
    steps = ((inside[pairs[:, 0]] - inside[pairs[:, 1]]) ** 2).sum(-1)
    return pairs, (ALIKE + np.exp(-steps / max(2 * steps.mean(), 1e-12))) / length


def _unlike(colors: np.ndarray, surfaces: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """[K, P]: how unlike each of the K surfaces the colours [P, 3] asked are: -log of its share, were all as large."""
    cells = (colors * BINS).astype(np.int64).clip(0, BINS - 1)
    counts = np.zeros((int(surfaces.max()), BINS, BINS, BINS))
    for k in range(len(counts)):
        np.add.at(counts[k], tuple(cells[surfaces == k + 1].T), 1.0)
        counts[k] = ndimage.gaussian_filter(counts[k] / counts[k].sum(), 1, mode="constant")
    told = counts[:, *cells[asked].T] + 1e-4
    return -np.log(told / told.sum(0))


def of_planes(
    disparity: np.ndarray, asked: np.ndarray, surfaces: np.ndarray, planes: Sequence[np.ndarray]
) -> np.ndarray:
    """int [H, W]: for the pixels asked, the surface that is made of their plane; 0 where none is."""
    found = np.zeros_like(surfaces)
    for depth in planes:
        of = surfaces[_on(disparity, depth) & (surfaces > 0)]
        if of.size:
            found[asked & _on(disparity, depth) & (found == 0)] = np.bincount(of).argmax()
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


def pieces(
    disparity: np.ndarray, known: np.ndarray, planes: Sequence[np.ndarray] = (), hole: np.ndarray | None = None
) -> np.ndarray:
    """int [H, W]: the known pixels' pieces, 1, 2, ... from the largest on; 0: too small.

    A piece is what lies on one of the planes (depth [H, W] each), or else is connected without jumps. A plinth is
    connected with the lawn at its foot; where it stands before all that is around it beside the hole, bool [H, W],
    it is a piece of its own.
    """
    index = np.full(known.shape, -1)
    index[known] = np.arange(known.sum())
    values, on = disparity[known], np.zeros(int(known.sum()), np.int64)
    for k, depth in enumerate(planes, start=1):
        on[(on == 0) & _on(disparity, depth)[known]] = k
    here, there = _smooth_pairs(index, values)
    joined = lambda pairs: sparse.csr_matrix((np.ones(pairs.sum()), (here[pairs], there[pairs])), shape=(len(on),) * 2)
    smooth = joined((on[here] == 0) & (on[there] == 0))
    _, piece = connected_components(smooth, directed=False)
    if hole is not None and hole.any():
        before = _standing(smooth, disparity, known, hole)
        piece = np.where(before > 0, piece.max() + before, piece)
    for k, depth in enumerate(planes, start=1):
        off = np.abs(values * np.where(np.isfinite(depth), depth, 0)[known] - 1)
        middle = ndimage.median(off, piece, np.arange(piece.max() + 1))
        on[(on == 0) & (middle < NEARLY)[piece]] = k
    piece = np.where(on > 0, len(on) + on, piece)  # a plane is one piece, however it is cut up
    piece = np.unique(piece, return_inverse=True)[1]
    counts = np.bincount(piece, minlength=1)
    order = np.argsort(-counts, kind="stable")
    number = np.zeros(len(counts), np.int64)
    large = order[counts[order] >= LEAST * max(len(on), 1)]
    number[large] = np.arange(1, len(large) + 1)
    found = np.zeros(known.shape, np.int64)
    found[known] = number[piece]
    return found


def standing(disparity: np.ndarray, known: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """int [H, W]: the things, 1, 2, ..., that stand before all that they meet beside the hole, see `pieces`; 0: the
    rest, and what is not known."""
    found, index = np.zeros(known.shape, np.int64), np.full(known.shape, -1)
    index[known] = np.arange(known.sum())
    if known.any() and hole.any():
        here, there = _smooth_pairs(index, disparity[known])
        links = sparse.csr_matrix((np.ones(len(here)), (here, there)), shape=(int(known.sum()),) * 2)
        found[known] = _standing(links, disparity, known, hole)
    return found


def _smooth_pairs(index: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of neighbours, among the pixels that `index` [H, W] numbers, whose disparities [P] are alike."""
    rows, columns = [], []
    for ahead in ((0, 1), (1, 0)):
        here, there = _pairs(index, ahead)
        near = np.abs(values[here] - values[there]) < STEP * np.maximum(values[here], values[there])
        rows, columns = [*rows, here[near]], [*columns, there[near]]
    return np.concatenate(rows), np.concatenate(columns)


def _standing(smooth: sparse.csr_matrix, disparity: np.ndarray, known: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """[P], for each known pixel: of the things that stand before all that they meet beside the hole, 1, 2, ..., the one
    that it belongs to, being smoothly connected to it and nearer to it than to anything else there; or 0."""
    beside = known & (ndimage.distance_transform_edt(~hole) <= BESIDE * hole.shape[1])
    band = np.flatnonzero(beside[known])
    _, part = connected_components(smooth[band][:, band], directed=False)
    sizes = np.bincount(part, minlength=1)
    large = np.flatnonzero(sizes >= LEAST * len(band))
    seeds = [band[part == k] for k in large]
    masks, places = np.zeros((len(seeds), *known.shape), bool), np.argwhere(known)
    for mask, seed in zip(masks, seeds, strict=True):
        mask[tuple(places[seed].T)] = True
    wide = [ndimage.binary_dilation(mask, np.ones((3, 3)), TOUCHING) for mask in masks]
    first = [k for k in range(len(seeds)) if _stands_before(k, masks, wide, disparity)]
    of = np.zeros(smooth.shape[0] + 1, np.int64)
    if not first:
        return of[:-1]
    for number, k in enumerate(first, start=1):
        of[seeds[k]] = number
    _, _, source = dijkstra(smooth, False, np.concatenate(seeds), return_predecessors=True, min_only=True)
    return of[np.where(source >= 0, source, smooth.shape[0])]


def _stands_before(k: int, masks: np.ndarray, wide: Sequence[np.ndarray], disparity: np.ndarray) -> bool:
    """Is the k-th of the masks, bool [K, H, W], nearer than every other where they meet, and does it meet any? `wide`:
    each with what it touches."""
    met = [j for j in range(len(masks)) if j != k and (wide[k] & masks[j]).any() and (wide[j] & masks[k]).any()]
    steps = [np.median(disparity[masks[k] & wide[j]]) / np.median(disparity[masks[j] & wide[k]]) for j in met]
    return bool(met) and min(steps) > BEFORE


def _on(disparity: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """bool [H, W]: the pixels on a surface of this depth [H, W], inf where it is not."""
    return np.isfinite(depth) & (np.abs(disparity * np.where(np.isfinite(depth), depth, 0) - 1) < ON)
