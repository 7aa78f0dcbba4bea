"""Lists of the footprints (projected Gaussians) that touch each tile, filled in the order of one sort by depth.

The lists do not depend on the number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from reffusion.kernels.compiled import empty_aligned, inlined, kernel, parallel_for
from reffusion.kernels.memory import prefetch, store_whole
from reffusion.kernels.vectors import LANES, ceiling, maximum, minimum, ramp, root, select, splat, take_ticket
from reffusion.splat.layout import (
    AHEAD,
    ANCHOR_U,
    ANCHOR_V,
    ANCHOR_X,
    ANCHOR_Y,
    CHUNKS,
    COLUMN,
    CUT,
    DEPTH,
    ENTRY,
    FOOTPRINT,
    HALF_HEIGHT,
    HALF_WIDTH,
    MEMBER,
    ROWS,
    SLANT,
    SLOT,
    TILE_HEIGHT,
    TILE_WIDTH,
    TILT,
    WHITEN_X,
    WHITEN_Y,
)

_F = np.float32
# Pairs of a footprint and a tile, per footprint, for which memory is allocated first; unused memory costs nothing.
_PAIRS_PER_FOOTPRINT = 16


class Bins(NamedTuple):
    """The tile lists of an image, with I entries in all: one for each pair of a footprint and a tile that it touches.

    Attributes:
        starts: [tiles + 1] int64, index in `entries` at which each tile's list starts; tiles are in row-major order.
        entries: [I, ENTRY] int32, the concatenated lists, each front to back (columns: see `layout`).
        first_slots: [N + 1] int64, index of each Gaussian's first gradient record; records are ordered by Gaussian.
    """

    starts: np.ndarray
    entries: np.ndarray
    first_slots: np.ndarray


@kernel
def depth_order(radii, footprints):
    """Sort the Gaussians with a positive radius by depth, and Gaussians of equal depth by index (stable radix sort).

    Args:
        radii: [N] int32, radii of the footprints, 0 where culled.
        footprints: [>= N, FOOTPRINT] flat.

    Returns:
        [M] int32, the indices of these Gaussians, front to back.
    """
    count = radii.shape[0]
    visible = 0
    for i in range(count):
        visible += radii[i] > 0
    depths, order = np.empty(visible, np.float32), np.empty(visible, np.int32)
    at = 0
    for i in range(count):
        if radii[i] > 0:
            order[at] = i
            depths[at] = footprints[i * FOOTPRINT + DEPTH]
            at += 1
    keys = depths.view(np.uint32)  # positive floats sort like their bits
    other_keys, other_order = np.empty_like(keys), np.empty_like(order)
    for shift in (0, 11, 22):
        starts = np.zeros(2049, np.int64)
        for k in range(visible):
            starts[((keys[k] >> shift) & 2047) + 1] += 1
        for digit in range(2048):
            starts[digit + 1] += starts[digit]
        for k in range(visible):
            digit = (keys[k] >> shift) & 2047
            place = starts[digit]
            starts[digit] = place + 1
            other_keys[place] = keys[k]
            other_order[place] = order[k]
        keys, other_keys = other_keys, keys
        order, other_order = other_order, order
    return order


def bin_footprints(footprints, order, count: int, width: int, height: int) -> Bins:
    """Build the tile lists of an image.

    Args:
        footprints: [>= N, FOOTPRINT] flat.
        order: [M] int32, indices of the visible Gaussians, front to back (from `depth_order`).
        count: N, the number of all Gaussians.
        width, height: size of the image in pixels.
    """
    tiles = -(-width // TILE_WIDTH) * -(-height // TILE_HEIGHT)
    capacity = -(-len(order) // CHUNKS) * _PAIRS_PER_FOOTPRINT
    while True:
        first_slots, offsets = np.zeros(count + 1, np.int64), np.zeros((CHUNKS, tiles), np.int64)
        pairs, needed = empty_aligned(CHUNKS, capacity, 2).view(np.int32), np.zeros(CHUNKS, np.int64)
        parallel_for(
            _find_pairs, footprints, order, width, height, offsets, first_slots, pairs, needed, gaussians=count
        )
        if needed.max() <= capacity:
            break
        capacity = needed.max()
    total = _cumulate_counts(first_slots, offsets)
    starts = np.append(offsets[0], total)
    entries = empty_aligned(total, ENTRY).view(np.int32)
    parallel_for(_fill_lists, order, offsets, first_slots, pairs, entries, gaussians=count)
    return Bins(starts, entries, first_slots)


@inlined
def ellipse(slant, whiten_x, whiten_y, level):
    """Compute the ellipses alpha >= 1/255 of LANES footprints, slightly enlarged to allow for rounding.

    Args:
        slant, whiten_x, whiten_y, level: columns of the footprints (see `layout`), as float32 vectors.

    Returns:
        Four float32 vectors, with dx and dy relative to the 2D mean: half width and half height of the ellipse in
        pixels; slope of the line dy(dx) that halves all its columns; squared half height of its column at dx = 0.
    """
    level = (level - CUT) * 1.00002 + 1e-4
    across = 1.0 / (whiten_x * whiten_x)  # variance of x at fixed y, in units in which log2(alpha) = level - u^2 - v^2
    yy = 1.0 / (whiten_y * whiten_y)
    xx = across + slant * slant * yy
    return root(level * xx), root(level * yy), slant * yy / xx, level * yy * (across / xx)


@inlined
def _mean(footprints, base):
    """Compute the 2D mean of a footprint from its anchor and the whitened coordinates u and v at the anchor."""
    dy = footprints[base + ANCHOR_V] / footprints[base + WHITEN_Y]
    dx = footprints[base + ANCHOR_U] / footprints[base + WHITEN_X] + footprints[base + SLANT] * dy
    return footprints[base + ANCHOR_X] - dx, footprints[base + ANCHOR_Y] - dy


@inlined
def _column_rows(footprints, base, column, width, height, tops, bottoms):
    """Write the first and one past the last pixel row that an ellipse can touch in each of LANES columns of tiles."""
    mean_x, mean_y = _mean(footprints, base)
    half_width = footprints[base + HALF_WIDTH]
    half_height = footprints[base + HALF_HEIGHT]
    tilt = footprints[base + TILT]
    squared, inverse = footprints[base + COLUMN], _F(1.0) / (half_width * half_width)
    peak = footprints[base + SLANT] * half_height  # dx where the ellipse is highest
    left = (ramp() + _F(column)) * _F(TILE_WIDTH)
    first = maximum(left + _F(0.5) - mean_x, -half_width)
    last = minimum(minimum(left + _F(TILE_WIDTH), _F(width)) - _F(0.5) - mean_x, half_width)
    at_top, at_bottom = minimum(maximum(splat(peak), first), last), minimum(maximum(splat(-peak), first), last)
    high = tilt * at_top + root(maximum(squared * (_F(1.0) - at_top * at_top * inverse), _F(0.0)))
    low = tilt * at_bottom - root(maximum(squared * (_F(1.0) - at_bottom * at_bottom * inverse), _F(0.0)))
    margin = _F(1e-3) + _F(1e-5) * half_height
    begin = ceiling(minimum(maximum(low + (mean_y - margin - _F(0.5)), _F(0.0)), _F(height)))
    end = ceiling(minimum(maximum(high + (mean_y + margin - _F(0.5)), _F(0.0)), _F(height)))
    # `tops` and `bottoms`, int32 [LANES], are rows of the image; both are 0 where the ellipse touches none.
    touched = first <= last
    store_whole(tops, 0, select(touched, begin, _F(0.0)))
    store_whole(bottoms, 0, select(touched, end, _F(0.0)))


@inlined
def _columns(mean_x, half_width, tiles_x):
    """Return the first and one past the last column of tiles that an ellipse, in pixels, can touch; (0, 0) if none."""
    first = max(mean_x - half_width - _F(0.5), _F(0.0))
    last = min(mean_x + half_width, _F(tiles_x * TILE_WIDTH - 1))
    if not first <= last:
        return 0, 0
    return int(first) // TILE_WIDTH, int(last) // TILE_WIDTH + 1


@kernel
def _find_pairs(tickets, footprints, order, width, height, counts_by_chunk, first_slots, pairs, needed):
    """Find the pairs of a footprint and a tile that it touches, and count them by tile and by Gaussian."""
    # `counts_by_chunk` [CHUNKS, tiles] and `first_slots` [N + 1] are zeros at first. A ticket is one of CHUNKS parts of
    # `order` [M], the visible Gaussians front to back.
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tops, bottoms = np.empty(LANES, np.int32), np.empty(LANES, np.int32)
    while True:
        ticket = take_ticket(tickets)
        if ticket >= CHUNKS:
            return
        counts, chunk_pairs, position = counts_by_chunk[ticket], pairs[ticket], 0
        stop = (ticket + 1) * len(order) // CHUNKS
        for m in range(ticket * len(order) // CHUNKS, stop):
            prefetch(footprints, order[min(m + AHEAD, stop - 1)] * FOOTPRINT)
            base, begin = order[m] * FOOTPRINT, position
            first, last = _columns(_mean(footprints, base)[0], footprints[base + HALF_WIDTH], tiles_x)
            for start in range(first, last, LANES):
                _column_rows(footprints, base, start, width, height, tops, bottoms)
                for k in range(min(LANES, last - start)):
                    top, bottom = tops[k], bottoms[k]
                    if top >= bottom:
                        continue
                    for tile_row in range(top // TILE_HEIGHT, (bottom - 1) // TILE_HEIGHT + 1):
                        tile, tile_top = tile_row * tiles_x + start + k, tile_row * TILE_HEIGHT
                        if position < chunk_pairs.shape[0]:
                            counts[tile] += 1
                            # A pair is the tile, and first + 256 * (one past the last) of the rows of the tile that the
                            # footprint can touch.
                            chunk_pairs[position, 0] = tile
                            chunk_pairs[position, 1] = max(top - tile_top, 0) + 256 * min(
                                bottom - tile_top, TILE_HEIGHT
                            )
                        position += 1
            first_slots[order[m] + 1] = position - begin  # the number of pairs of Gaussian n is at n + 1
        # The number of pairs may exceed the capacity.
        needed[ticket] = position


@kernel
def _cumulate_counts(first_slots, counts):
    """Turn numbers of pairs into start indices in place, by running sums, and return the number of all pairs."""
    for m in range(first_slots.shape[0] - 1):
        first_slots[m + 1] += first_slots[m]
    total = 0
    # The order of the sum is that of the lists: tile by tile, and within a tile chunk by chunk.
    for tile in range(counts.shape[1]):
        for chunk in range(counts.shape[0]):
            count = counts[chunk, tile]
            counts[chunk, tile] = total
            total += count
    return total


@kernel
def _fill_lists(tickets, order, all_offsets, first_slots, pairs, entries):
    """Write the pairs that `_find_pairs` found into the tile lists `entries`, int32 [I, ENTRY]."""
    while True:
        ticket = take_ticket(tickets)
        if ticket >= CHUNKS:
            return
        offsets, chunk_pairs, position = all_offsets[ticket], pairs[ticket], 0
        stop = (ticket + 1) * len(order) // CHUNKS
        for m in range(ticket * len(order) // CHUNKS, stop):
            prefetch(first_slots, order[min(m + AHEAD, stop - 1)])
            member = order[m]
            # The slots of a Gaussian are the indices of its records.
            for slot in range(first_slots[member], first_slots[member + 1]):
                tile = chunk_pairs[position, 0]
                # `offsets` holds the index of the chunk's next entry in each tile's list.
                target = offsets[tile]
                offsets[tile] = target + 1
                entries[target, MEMBER] = member
                entries[target, ROWS] = chunk_pairs[position, 1]
                entries[target, SLOT] = slot
                position += 1
