"""Division of a hole among the surfaces around it, along the edges of a picture.

Each surface can then be continued through its own part of the hole. A *surface* is a set of pixels with an integer
label 1, 2, ...; label 0 means that a pixel has no surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components, dijkstra

from reffusion import geometry, morphology
from reffusion.depth.completion import unit_range
from reffusion.graph_cut import HARD, alpha_expansion, neighbor_pairs, potts_cost

JUMP = 0.025  # relative disparity step between neighbors that separates two surfaces
MIN_SHARE = 0.03  # of the known pixels around a hole: smaller segments are no surfaces
COLOR_WEIGHT = 0.1  # weight of a pixel's color relative to an edge between neighbors
MIN_EDGE_COST = 0.05  # minimum cost of separating neighbors, relative to the cost where the picture is uniform
COLOR_BINS = 12  # bins of a color histogram along each of red, green and blue
MAX_UNEVENNESS = 0.04  # a segment whose median relative disparity from a plane is below this belongs to that plane
BAND_WIDTH = 0.03  # of the width: the band around a hole in which its surfaces are compared
CONTACT_PX = 3  # px within which two segments in the band touch
IN_FRONT_RATIO = 1.05  # a segment whose disparity exceeds that of all it touches by this factor is in the foreground
PLANE_PRIOR_COST = 0.5  # cost of giving a pixel another surface than that of the plane assumed to continue there


def label_surfaces(
    disparity: np.ndarray,
    known: np.ndarray,
    hole: np.ndarray,
    guide: np.ndarray,
    planes: Sequence[np.ndarray] = (),
    assumed: np.ndarray | None = None,
    forbidden: np.ndarray | None = None,
) -> np.ndarray:
    """Return int [H, W], the surface of each pixel around and inside a hole.

    The known pixels are divided into surfaces by `segment_surfaces`: by the planes on which they lie, elsewhere at
    jumps in disparity. A graph cut extends the surfaces into the hole. Its boundaries follow edges of the picture, and
    each pixel prefers a surface of its own color.

    PAPER leaves open: the completion of depth.

    Args:
        disparity: [H, W], read where `known`.
        known: bool [H, W], True at the pixels around or inside the hole that surfaces are continued from, at least one.
        hole: bool [H, W], True at the pixels to label, including any gap between the hole and the known pixels.
        guide: [H, W, 3] picture, uint8 or in [0, 1].
        planes: Depth [H, W] of each plane around the hole, inf where the plane is absent.
        assumed: bool [H, W], True at known pixels whose depth is only an assumption: a plane is assumed to continue
            there. The graph cut may give such a pixel to another surface, at a cost. None if there are no such pixels.
        forbidden: int [H, W], the surface that a pixel of the hole must not get, 0 if it may get any. The numbers are
            those that a call without `forbidden` returns. None allows all surfaces.

    Returns:
        Labels 1, 2, ..., by decreasing size of the surface among the known pixels. The label is 0 at pixels that are
            neither known nor in the hole, and at known pixels whose surface is too small (`MIN_SHARE`). If there are
            fewer than two surfaces, all known pixels and all pixels of the hole have label 1.
    """
    assumed = np.zeros_like(hole) if assumed is None else assumed & known
    surfaces = segment_surfaces(disparity, known & ~assumed, planes, hole)
    count = int(surfaces.max())
    missing = hole & ~(known & ~assumed)
    if count < 2 or not missing.any():
        return np.where(known | hole, 1, 0) if count < 2 else surfaces
    index, near_missing = np.full(hole.shape, -1), ndimage.binary_dilation(missing, np.ones((3, 3)))
    domain = missing | (near_missing & (surfaces > 0))
    index[domain] = np.arange(domain.sum())
    colors = ndimage.gaussian_filter(unit_range(guide), (1, 1, 0))
    cost = COLOR_WEIGHT * _color_cost(colors, surfaces, domain)
    label = surfaces[domain] - 1
    assumed_label = surfaces_on_planes(disparity, assumed, surfaces, planes)[domain] - 1
    for k in range(count):
        cost[k] += PLANE_PRIOR_COST * ((assumed_label >= 0) & (assumed_label != k)) + HARD * (
            (label >= 0) & (label != k)
        )
        if forbidden is not None:
            cost[k] += HARD * ((label < 0) & (forbidden[domain] == k + 1))
    pairs, strength = _weighted_edges(index, colors)
    initial = np.where(label >= 0, label, np.where(assumed_label >= 0, assumed_label, cost.argmin(0)))
    result = surfaces.copy()
    result[domain] = alpha_expansion(cost, pairs, potts_cost(strength), initial) + 1
    return _remove_islands(result, surfaces, missing)


def _remove_islands(labels: np.ndarray, surfaces: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Return the labels, int [H, W], after each island in the hole has taken the nearest label around it."""
    # An island is a connected component of one label that contains no known pixel of this surface (`surfaces` is 0 at
    # unknown pixels). It arises where a pattern in the hole has the colors of another surface.
    island = np.zeros_like(missing)
    for surface in range(1, int(surfaces.max()) + 1):
        found = labels == surface
        island |= found & ~ndimage.binary_propagation(found & (surfaces == surface), np.ones((3, 3)), found) & missing
    if not island.any() or island.all():
        return labels
    return np.where(island, labels[morphology.nearest_known(~island & (labels != 0))], labels)


def _weighted_edges(index: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of neighboring pixels, [E, 2], and the cost [E] of giving a pair's pixels different labels."""
    # A pair consists of two numbers of `index`; pixels whose number is -1 take no part.
    pairs, length = neighbor_pairs(index)
    flat_colors = colors[index >= 0]
    steps = ((flat_colors[pairs[:, 0]] - flat_colors[pairs[:, 1]]) ** 2).sum(-1)
    # The cost is low across edges of the picture.
    return pairs, (MIN_EDGE_COST + np.exp(-steps / max(2 * steps.mean(), 1e-12))) / length


def _color_cost(colors: np.ndarray, surfaces: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return [K, P], the cost -log p(surface | color) of each of the surfaces 1 to K at each of P pixels."""
    cells = (colors * COLOR_BINS).astype(np.int64).clip(0, COLOR_BINS - 1)
    # The probabilities come from a color histogram of each surface; all surfaces are equally probable a priori.
    counts = np.zeros((int(surfaces.max()), COLOR_BINS, COLOR_BINS, COLOR_BINS))
    for k in range(len(counts)):
        np.add.at(counts[k], tuple(cells[surfaces == k + 1].T), 1.0)
        counts[k] = ndimage.gaussian_filter(counts[k] / counts[k].sum(), 1, mode="constant")
    likelihood = counts[:, *cells[pixels].T] + 1e-4
    return -np.log(likelihood / likelihood.sum(0))


def surfaces_on_planes(
    disparity: np.ndarray, pixels: np.ndarray, surfaces: np.ndarray, planes: Sequence[np.ndarray]
) -> np.ndarray:
    """Return int [H, W], for each of `pixels` the surface that lies on the same plane; 0 at all other pixels.

    If several surfaces have pixels on a plane, the one with the most pixels counts.

    Args:
        disparity: [H, W].
        pixels: bool [H, W], True at the pixels to label.
        surfaces: int [H, W], the surface of each pixel, 0 where there is none.
        planes: Depth [H, W] of each plane, inf where the plane is absent. If a pixel lies on several planes, the first
            that has a surface counts.
    """
    labels = np.zeros_like(surfaces)
    for depth in planes:
        nearby = surfaces[_is_on_plane(disparity, depth) & (surfaces > 0)]
        if nearby.size:
            labels[pixels & _is_on_plane(disparity, depth) & (labels == 0)] = np.bincount(nearby).argmax()
    return labels


def segment_surfaces(
    disparity: np.ndarray, known: np.ndarray, planes: Sequence[np.ndarray] = (), hole: np.ndarray | None = None
) -> np.ndarray:
    """Return int [H, W], the surfaces of the known pixels, numbered 1, 2, ... by decreasing size.

    All pixels on one of the `planes` are one surface, even if they are not connected. The remaining pixels are divided
    into segments that are connected without jumps in disparity. A segment that deviates little from a plane joins the
    plane's surface.

    An object that stands on the ground is connected with the ground at its foot, without a jump in disparity. Therefore
    a segment that is nearer than everything it touches in a band around the hole is separated from everything behind
    the segment (see `_label_foreground`).

    Args:
        disparity: [H, W], read where `known`.
        known: bool [H, W], with at least one True pixel.
        planes: Depth [H, W] of each plane, inf where the plane is absent.
        hole: bool [H, W]. If None, objects in front are not separated.

    Returns:
        0 at unknown pixels, and at pixels of segments with less than `MIN_SHARE` of the known pixels.
    """
    index = np.full(known.shape, -1)
    index[known] = np.arange(known.sum())
    values, plane_index = disparity[known], np.zeros(int(known.sum()), np.int64)
    for k, depth in enumerate(planes, start=1):
        plane_index[(plane_index == 0) & _is_on_plane(disparity, depth)[known]] = k
    first, second = neighbor_pairs(index, ((0, 1), (1, 0)))[0].T
    is_close = np.abs(values[first] - values[second]) < JUMP * np.maximum(values[first], values[second])
    first, second = first[is_close], second[is_close]  # neighbors without a jump in disparity between them
    link = lambda pairs: sparse.csr_matrix(
        (np.ones(pairs.sum()), (first[pairs], second[pairs])), shape=(len(plane_index),) * 2
    )
    smooth = link((plane_index[first] == 0) & (plane_index[second] == 0))
    _, piece = connected_components(smooth, directed=False)
    if hole is not None and hole.any():
        foreground = _label_foreground(smooth, disparity, known, hole)
        piece = np.where(foreground > 0, piece.max() + foreground, piece)
    for k, depth in enumerate(planes, start=1):
        deviation = np.abs(values * np.where(np.isfinite(depth), depth, 0)[known] - 1)
        median = ndimage.median(deviation, piece, np.arange(piece.max() + 1))
        plane_index[(plane_index == 0) & (median < MAX_UNEVENNESS)[piece]] = k
    piece = np.where(
        plane_index > 0, len(plane_index) + plane_index, piece
    )  # a plane is one segment, even if its pixels are not connected
    piece = np.unique(piece, return_inverse=True)[1]
    counts = np.bincount(piece, minlength=1)
    order = np.argsort(-counts, kind="stable")
    label = np.zeros(len(counts), np.int64)
    large = order[counts[order] >= MIN_SHARE * max(len(plane_index), 1)]
    label[large] = np.arange(1, len(large) + 1)
    result = np.zeros(known.shape, np.int64)
    result[known] = label[piece]
    return result


def _label_foreground(
    smooth: sparse.csr_matrix, disparity: np.ndarray, known: np.ndarray, hole: np.ndarray
) -> np.ndarray:
    """Return int [P], for each known pixel the number of the foreground object to which it belongs, or 0."""
    # The known pixels in a band around the hole are divided into segments without jumps in disparity. `smooth` [P, P]
    # is nonzero for neighboring known pixels without a jump.
    in_band = known & (ndimage.distance_transform_edt(~hole) <= BAND_WIDTH * hole.shape[1])
    band = np.flatnonzero(in_band[known])
    _, component = connected_components(smooth[band][:, band], directed=False)
    sizes = np.bincount(component, minlength=1)
    large = np.flatnonzero(sizes >= MIN_SHARE * len(band))
    seeds = [band[component == k] for k in large]
    masks, coordinates = np.zeros((len(seeds), *known.shape), bool), np.argwhere(known)
    for mask, seed in zip(masks, seeds, strict=True):
        mask[tuple(coordinates[seed].T)] = True
    dilated = [ndimage.binary_dilation(mask, np.ones((3, 3)), CONTACT_PX) for mask in masks]
    # A segment that is nearer than all segments it touches is a foreground object.
    foreground = [k for k in range(len(seeds)) if _is_in_front(k, masks, dilated, disparity)]
    label = np.zeros(smooth.shape[0] + 1, np.int64)
    if not foreground:
        return label[:-1]
    for number, k in enumerate(foreground, start=1):
        label[seeds[k]] = number
    # Every known pixel belongs to the segment that is nearest along the links of `smooth`.
    _, _, nearest_seed = dijkstra(smooth, False, np.concatenate(seeds), return_predecessors=True, min_only=True)
    return label[np.where(nearest_seed >= 0, nearest_seed, smooth.shape[0])]


def _is_in_front(k: int, masks: np.ndarray, dilated: Sequence[np.ndarray], disparity: np.ndarray) -> bool:
    """Return True if the k-th mask touches others and is nearer than each of them at the contact."""
    # `dilated` has each mask dilated by the distance within which two segments touch.
    touching = [
        j for j in range(len(masks)) if j != k and (dilated[k] & masks[j]).any() and (dilated[j] & masks[k]).any()
    ]
    ratios = [
        np.median(disparity[masks[k] & dilated[j]]) / np.median(disparity[masks[j] & dilated[k]]) for j in touching
    ]
    return bool(touching) and min(ratios) > IN_FRONT_RATIO


def _is_on_plane(disparity: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return the pixels, bool [H, W], whose disparity agrees with that of a plane of depth [H, W], inf where absent."""
    return np.isfinite(depth) & (np.abs(disparity * np.where(np.isfinite(depth), depth, 0) - 1) < geometry.SAME_SURFACE)
