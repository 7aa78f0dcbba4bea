"""Blends tiles front to back, one vector of pixels at a time: one row of eight, or two."""

from __future__ import annotations

import numpy as np

from reffusion.kernels.compiled import empty_aligned, inlined, kernel, parallel_for
from reffusion.kernels.memory import load, prefetch, splat_at, store
from reffusion.kernels.vectors import (
    EXP2,
    LANES,
    ROUND,
    any_lane,
    fma,
    fnma,
    minimum,
    select,
    splat,
    take_ticket,
    times_power,
)
from reffusion.splat.conventions import MAX_ALPHA, MIN_TRANSMITTANCE
from reffusion.splat.layout import (
    AHEAD,
    ANCHOR_U,
    ANCHOR_V,
    ANCHOR_X,
    ANCHOR_Y,
    BLUE,
    CUT,
    DEPTH,
    FOOTPRINT,
    GREEN,
    LEVEL,
    MEMBER,
    RED,
    ROWS,
    SLANT,
    TILE_HEIGHT,
    TILE_WIDTH,
    WHITEN_X,
    WHITEN_Y,
)

STEP_ROWS = LANES // TILE_WIDTH  # pixel rows per vector
STEPS = TILE_HEIGHT // STEP_ROWS  # vectors per tile
LANE_X = np.arange(LANES, dtype=np.float32) % TILE_WIDTH + np.float32(0.5)  # pixel centre of each lane, from the left
_SUMS = 6  # vectors per step before its features: transmittance, red, green, blue, depth, alpha

# Constants for every vector of pixels, each in all lanes, then the row of each pixel of a tile. Loops read them from
# memory, which costs nothing as an operand of arithmetic. There are not enough registers for all, and constants in the
# code would take two instructions each, more than the arithmetic itself.
AT_CUT, AT_ROUND, _AT_SERIES, AT_MAX_ALPHA, _AT_MIN_TRANSMITTANCE, AT_ROW = 0, 1, 2, 8, 9, 10
_CONSTANTS = np.concatenate(
    [
        np.repeat(np.array([CUT, ROUND, *EXP2[::-1], MAX_ALPHA, MIN_TRANSMITTANCE], np.float32), LANES),
        (np.arange(TILE_HEIGHT * TILE_WIDTH) // TILE_WIDTH).astype(np.float32),
    ]
)


def blend(footprints, features, background, bins, width, height):
    """Blend every tile's list.

    Args:
        footprints: [>= N, FOOTPRINT] flat; features: [N, C]; background: [3]; bins: see `binning`.

    Returns:
        color [H, W, 3], depth [H, W], alpha [H, W], features [H, W, C], transmittance [H, W], all float32, and used
        [tiles] int64: number of entries of a tile's list that were processed before all its pixels were finished.
    """
    color, blended = empty_aligned(height, width, 3), empty_aligned(height, width, features.shape[1])
    depth = empty_aligned(height, width)
    alpha = empty_aligned(height, width)
    transmittance = empty_aligned(height, width)
    used = np.empty(len(bins.starts) - 1, np.int64)
    outputs = color, depth, alpha, blended, transmittance, used
    parallel_for(_blend, footprints, or_none(features), background, bins, *outputs)
    return outputs


def or_none(features):
    """`features`, or None without channels, for which kernels are compiled separately."""
    return features if features.shape[1] else None


@kernel
def allocate_vectors(vectors):
    """Memory for a number of vectors, aligned to cache lines."""
    memory = np.empty(vectors * LANES + 16, np.float32)
    first = (-memory.ctypes.data // 4) % 16
    return memory[first : first + vectors * LANES]


@kernel
def load_constants():
    """A copy of _CONSTANTS whose values the compiler does not know."""
    constants = allocate_vectors(len(_CONSTANTS) // LANES)
    constants[:] = _CONSTANTS
    return constants


@kernel
def next_tile(tickets, tiles):
    """The next tile, or -1 when all are taken; tiles are taken in turn from as many parts of the image as threads.

    Threads at neighbouring tiles would write to the same cache lines (images, records of a footprint).
    """
    parts = tickets[1]
    length = (tiles + parts - 1) // parts
    while True:
        ticket = take_ticket(tickets)
        if ticket >= parts * length:
            return -1
        tile = ticket % parts * length + ticket // parts
        if tile < tiles:
            return tile


@inlined
def tile_corner(tile, width):
    """Left column and top row of a tile in the image."""
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    return (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT


@inlined
def init_transmittance(state, stride, rows, columns):
    """Set the transmittance, the first vector of each step's `stride` floats: 1, or -1 (finished) outside the image."""
    for step in range(STEPS):
        for lane in range(LANES):
            inside = step * STEP_ROWS + lane // TILE_WIDTH < rows and lane % TILE_WIDTH < columns
            state[step * stride + lane] = np.float32(1.0 if inside else -1.0)


@inlined
def is_finished(state, stride):
    """Are all pixels of the tile finished?"""
    for step in range(STEPS):
        if any_lane(load(state, step * stride) > splat(0.0)):
            return False
    return True


@inlined
def footprint_in_tile(footprints, base, left, top, middle):
    """A footprint in the coordinates of a tile: u = u_middle - lean j, v = v_middle + whiten_y j, j = row - middle.

    Returns:
        u_middle, lean, v_middle, whiten_y, level: equal in all lanes except u_middle.
    """
    whiten_x, whiten_y = footprints[base + WHITEN_X], splat_at(footprints, base + WHITEN_Y)
    lean = splat(whiten_x * footprints[base + SLANT])
    dy = splat(np.float32(top) + middle + np.float32(0.5) - footprints[base + ANCHOR_Y])
    dx = load(LANE_X, 0) + (np.float32(left) - footprints[base + ANCHOR_X])
    u = fnma(lean, dy, fma(splat(whiten_x), dx, splat_at(footprints, base + ANCHOR_U)))
    v = fma(whiten_y, dy, splat_at(footprints, base + ANCHOR_V))
    return u, lean, v, whiten_y, splat_at(footprints, base + LEVEL)


@inlined
def log_alpha(footprint, j):
    """log2(alpha) before clamping at the pixels of a step."""
    u_middle, lean, v_middle, whiten_y, level = footprint
    u, v = fnma(lean, j, u_middle), fma(whiten_y, j, v_middle)
    return fnma(u, u, fnma(v, v, level))


@inlined
def exp2(x, constants):
    """2^x for x in [-126, 127], relative error below 2e-7; undefined (without a trap) outside.

    A polynomial in the remainder of x after rounding.
    """
    rounded = x + load(constants, AT_ROUND * LANES)
    part = x - (rounded - load(constants, AT_ROUND * LANES))
    value = load(constants, _AT_SERIES * LANES)
    value = fma(value, part, load(constants, (_AT_SERIES + 1) * LANES))
    value = fma(value, part, load(constants, (_AT_SERIES + 2) * LANES))
    value = fma(value, part, load(constants, (_AT_SERIES + 3) * LANES))
    value = fma(value, part, load(constants, (_AT_SERIES + 4) * LANES))
    value = fma(value, part, load(constants, (_AT_SERIES + 5) * LANES))
    return times_power(value, rounded)


@inlined
def blend_pixels(power, is_above_cut, before, constants):
    """Blend a footprint of log2(alpha) = `power` into pixels of transmittance `before` (negative: finished).

    Returns:
        raw alpha (undefined below the cut), alpha, weight, transmittance afterwards.
    """
    raw = exp2(power, constants)
    alpha = select(is_above_cut, minimum(raw, load(constants, AT_MAX_ALPHA * LANES)), np.float32(0.0))
    after = fnma(before, alpha, before)
    is_blended = after >= load(constants, _AT_MIN_TRANSMITTANCE * LANES)
    weight = select(is_blended, before * alpha, np.float32(0.0))
    return raw, alpha, weight, select(is_blended, after, minimum(before, splat(0.0) - before))


@kernel
def _blend(tickets, footprints, features, background, bins, color, depth, alpha, blended, transmittance, used):
    stride = (_SUMS + blended.shape[2]) * LANES
    state, constants = allocate_vectors(STEPS * (_SUMS + blended.shape[2])), load_constants()
    while True:
        tile = next_tile(tickets, used.shape[0])
        if tile < 0:
            return
        used[tile] = _blend_tile(tile, footprints, features, bins, depth.shape, state, constants)
        _write_tile(tile, state, stride, background, color, depth, alpha, blended, transmittance)


@kernel
def _blend_tile(tile, footprints, features, bins, size, state, constants):
    """Blend one tile into `state`; returns the number of processed entries of its list."""
    stride = _SUMS * LANES
    if features is not None:
        stride += features.shape[1] * LANES
    left, top = tile_corner(tile, size[1])
    state[:] = np.float32(0.0)
    init_transmittance(state, stride, size[0] - top, size[1] - left)
    start, stop = bins.starts[tile], bins.starts[tile + 1]
    for at in range(start, stop):
        if (at - start) % 32 == 31 and is_finished(state, stride):
            return at - start
        prefetch(footprints, bins.entries[min(at + AHEAD, stop - 1), MEMBER] * FOOTPRINT)
        member, rows = bins.entries[at, MEMBER], bins.entries[at, ROWS]
        base = member * FOOTPRINT
        footprint = footprint_in_tile(footprints, base, left, top, np.float32(0.0))
        red, green = splat_at(footprints, base + RED), splat_at(footprints, base + GREEN)
        blue, depth = splat_at(footprints, base + BLUE), splat_at(footprints, base + DEPTH)
        for step in range((rows & 255) // STEP_ROWS, ((rows >> 8) + STEP_ROWS - 1) // STEP_ROWS):
            place = step * stride
            before = load(state, place)
            power = log_alpha(footprint, load(constants, (AT_ROW + step) * LANES))
            is_above_cut = power >= load(constants, AT_CUT * LANES)
            if not any_lane(is_above_cut & (before > splat(0.0))):
                continue
            _, _, weight, after = blend_pixels(power, is_above_cut, before, constants)
            store(state, place, after)
            store(state, place + LANES, fma(weight, red, load(state, place + LANES)))
            store(state, place + 2 * LANES, fma(weight, green, load(state, place + 2 * LANES)))
            store(state, place + 3 * LANES, fma(weight, blue, load(state, place + 3 * LANES)))
            store(state, place + 4 * LANES, fma(weight, depth, load(state, place + 4 * LANES)))
            store(state, place + 5 * LANES, load(state, place + 5 * LANES) + weight)
            if features is not None:
                for c in range(features.shape[1]):
                    here = place + (_SUMS + c) * LANES
                    store(state, here, fma(weight, splat(features[member, c]), load(state, here)))
    return stop - start


@kernel
def _write_tile(tile, state, stride, background, color, depth, alpha, blended, transmittance):
    """Write a blended tile into the images."""
    height, width = depth.shape
    left, top = tile_corner(tile, width)
    for row in range(min(TILE_HEIGHT, height - top)):
        y = top + row
        for lane in range(min(TILE_WIDTH, width - left)):
            x, place = left + lane, row // STEP_ROWS * stride + row % STEP_ROWS * TILE_WIDTH + lane
            behind, covered = abs(state[place]), state[place + 5 * LANES]
            transmittance[y, x] = behind
            alpha[y, x] = covered  # not 1 - behind, which has few digits for small alpha
            for c in range(3):
                color[y, x, c] = state[place + (1 + c) * LANES] + behind * background[c]
            depth[y, x] = state[place + 4 * LANES] / max(covered, np.float32(1e-30))
            for c in range(blended.shape[2]):
                blended[y, x, c] = state[place + (_SUMS + c) * LANES]
