"""Which footprints touch which tiles: one sort by depth, then tile lists filled in that order.

The lists do not depend on how the work is shared among threads.
"""

from __future__ import annotations

import math

import numpy as np

from reffusion.splat.compiled import kernel, share
from reffusion.splat.conventions import MIN_ALPHA
from reffusion.splat.projection import CHUNKS, DEPTH, LEVEL, MEAN_X, MEAN_Y, SLANT, WHITEN_X, WHITEN_Y
from reffusion.splat.vectors import take_ticket

TILE_WIDTH = 16
TILE_HEIGHT = 32
CUT = np.float32(math.log2(MIN_ALPHA))  # log2(alpha) below which a pixel is skipped


@kernel
def depth_order(radii, footprints):
    """Sort the Gaussians that have a radius by depth, equal depths by index (radix sort, stable).

    Returns:
        order [M] int32, their indices front to back, and ranks [N] int32, the place of each in it (-1 without radius).
    """
    count = radii.shape[0]
    visible = 0
    for i in range(count):
        visible += radii[i] > 0
    keys = np.empty(visible, np.uint32)
    order = np.empty(visible, np.int32)
    at = 0
    for i in range(count):
        if radii[i] > 0:
            order[at] = i
            at += 1
    depths = np.empty(visible, np.float32)
    for k in range(visible):
        depths[k] = footprints[order[k], DEPTH]
    keys[:] = depths.view(np.uint32)  # positive floats sort like their bits
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
    ranks = np.full(count, -1, np.int32)
    for rank in range(visible):
        ranks[order[rank]] = rank
    return order, ranks


@kernel
def _ellipse(footprint):
    """The alpha >= 1/255 ellipse of a footprint, a little enlarged against rounding.

    Returns:
        half width, half height, slope of the middle line y(dx), squared half-height of a column at dx = 0,
        1 / half width^2, dx where the ellipse is highest.
    """
    level = (footprint[LEVEL] - CUT) * np.float32(1.00002) + np.float32(1e-4)
    across = np.float32(1.0) / (footprint[WHITEN_X] * footprint[WHITEN_X])  # variance of x at fixed y, x log2(e) / 2
    yy = np.float32(1.0) / (footprint[WHITEN_Y] * footprint[WHITEN_Y])
    slant = footprint[SLANT]
    xx = across + slant * slant * yy
    half_width = math.sqrt(level * xx)
    half_height = math.sqrt(level * yy)
    tilt = slant * yy / xx
    column = level * yy * (across / xx)
    return half_width, half_height, tilt, column, np.float32(1.0) / (level * xx), slant * half_height


@kernel
def _column_rows(footprint, ellipse, left, width, height):
    """First and one past the last pixel row of the image that the ellipse can touch in a tile column."""
    half_width, half_height, tilt, column, inverse, peak = ellipse
    first = max(np.float32(left) + np.float32(0.5) - footprint[MEAN_X], -half_width)
    last = min(np.float32(min(left + TILE_WIDTH, width)) - np.float32(0.5) - footprint[MEAN_X], half_width)
    if not first <= last:
        return 0, 0
    at_top = min(max(peak, first), last)
    at_bottom = min(max(-peak, first), last)
    high = tilt * at_top + math.sqrt(max(column * (np.float32(1.0) - at_top * at_top * inverse), np.float32(0.0)))
    low = tilt * at_bottom - math.sqrt(
        max(column * (np.float32(1.0) - at_bottom * at_bottom * inverse), np.float32(0.0))
    )
    margin = np.float32(1e-3) + np.float32(1e-5) * half_height
    begin = math.ceil(max(footprint[MEAN_Y] + low - margin - np.float32(0.5), np.float32(0.0)))
    end = math.floor(min(footprint[MEAN_Y] + high + margin - np.float32(0.5), np.float32(height - 1))) + 1
    return int(begin), int(max(end, begin))


@kernel
def _columns(footprint, half_width, tiles_x):
    """First and one past the last tile column that the ellipse can touch."""
    first = max(footprint[MEAN_X] - half_width - np.float32(0.5), np.float32(0.0))
    last = min(footprint[MEAN_X] + half_width, np.float32(tiles_x * TILE_WIDTH - 1))
    if not first <= last:
        return 0, 0
    return int(first) // TILE_WIDTH, int(last) // TILE_WIDTH + 1


def bin_footprints(footprints, width, height):
    """Tile lists, front to back.

    Args:
        footprints: [M, FOOTPRINT] front to back.
        width, height: the image's size in pixels.

    Returns:
        starts: [tiles + 1] int64, where each tile's list begins; tiles in reading order.
        members: [I] int32, the footprints of each tile, front to back.
        rows: [I] int32, first + 256 * (one past the last) row of the tile that the footprint can touch.
        slots: [I] int64, place of this footprint-tile pair when pairs are ordered by footprint.
        first_slots: [M + 1] int64, where each footprint's pairs begin in that order.
    """
    tiles = -(-width // TILE_WIDTH) * -(-height // TILE_HEIGHT)
    places = np.zeros((CHUNKS, tiles), np.int64)
    first_slots = np.zeros(len(footprints) + 1, np.int64)
    share(_count_pairs, footprints, width, height, places, first_slots)
    total = _counts_to_places(first_slots, places)
    starts = np.append(places[0], total)
    members, rows, slots = np.empty(total, np.int32), np.empty(total, np.int32), np.empty(total, np.int64)
    share(_fill_lists, footprints, width, height, places, first_slots, members, rows, slots)
    return starts, members, rows, slots, first_slots


@kernel
def _count_pairs(tickets, footprints, width, height, places, first_slots):
    """Count pairs by tile and by footprint."""
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    while True:
        ticket = take_ticket(tickets)
        if ticket >= CHUNKS:
            return
        counts = places[ticket]
        for m in range(ticket * len(footprints) // CHUNKS, (ticket + 1) * len(footprints) // CHUNKS):
            footprint = footprints[m]
            ellipse = _ellipse(footprint)
            first, last = _columns(footprint, ellipse[0], tiles_x)
            pairs = 0
            for column in range(first, last):
                top, bottom = _column_rows(footprint, ellipse, column * TILE_WIDTH, width, height)
                if top < bottom:
                    for tile_row in range(top // TILE_HEIGHT, (bottom - 1) // TILE_HEIGHT + 1):
                        counts[tile_row * tiles_x + column] += 1
                        pairs += 1
            first_slots[m + 1] = pairs


@kernel
def _counts_to_places(first_slots, places):
    """Running sums in place: by footprint, and by tile then chunk. Returns the number of pairs."""
    for m in range(first_slots.shape[0] - 1):
        first_slots[m + 1] += first_slots[m]
    total = 0
    for tile in range(places.shape[1]):
        for chunk in range(places.shape[0]):
            here = places[chunk, tile]
            places[chunk, tile] = total
            total += here
    return total


@kernel
def _fill_lists(tickets, footprints, width, height, all_places, first_slots, members, rows, slots):
    """Write the pairs to their places."""
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    while True:
        ticket = take_ticket(tickets)
        if ticket >= CHUNKS:
            return
        places = all_places[ticket]
        for m in range(ticket * len(footprints) // CHUNKS, (ticket + 1) * len(footprints) // CHUNKS):
            footprint = footprints[m]
            ellipse = _ellipse(footprint)
            first, last = _columns(footprint, ellipse[0], tiles_x)
            slot = first_slots[m]
            for column in range(first, last):
                top, bottom = _column_rows(footprint, ellipse, column * TILE_WIDTH, width, height)
                if top < bottom:
                    for tile_row in range(top // TILE_HEIGHT, (bottom - 1) // TILE_HEIGHT + 1):
                        tile, tile_top = tile_row * tiles_x + column, tile_row * TILE_HEIGHT
                        at = places[tile]
                        places[tile] = at + 1
                        members[at] = m
                        rows[at] = max(top - tile_top, 0) + 256 * min(bottom - tile_top, TILE_HEIGHT)
                        slots[at] = slot
                        slot += 1
