"""Blending of tiles front to back, one vector of LANES pixels at a time: one row of eight pixels, or two rows.

A *step* is such a vector of pixels of a tile. The *state* of a tile is a float32 array with several vectors for each
step, one after the other: `stride` is the number of floats per step, and the first vector is the transmittance. A
negative transmittance marks a finished pixel, whose transmittance is its absolute value.
"""

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
LANE_X = np.arange(LANES, dtype=np.float32) % TILE_WIDTH + np.float32(0.5)  # pixel center of each lane, from the left
_SUMS = 6  # vectors of the state per step, before features: transmittance, red, green, blue, depth, alpha

# Constants, each as a vector with the same value in all lanes; then, for each step, the row of each of its pixels in
# the tile. The names are indices of vectors. Loops read these constants from memory, which costs nothing extra for an
# operand of arithmetic. There are not enough registers for all, and constants in the code would take two instructions
# each, more than the arithmetic itself.
AT_CUT, AT_ROUND, _AT_SERIES, AT_MAX_ALPHA, _AT_MIN_TRANSMITTANCE, AT_ROW = 0, 1, 2, 8, 9, 10
_CONSTANTS = np.concatenate(
    [
        np.repeat(np.array([CUT, ROUND, *EXP2[::-1], MAX_ALPHA, MIN_TRANSMITTANCE], np.float32), LANES),
        (np.arange(TILE_HEIGHT * TILE_WIDTH) // TILE_WIDTH).astype(np.float32),
    ]
)


def blend(footprints, features, background, bins, width, height):
    """Blend the footprints of every tile's list, front to back, into images.

    Args:
        footprints: [>= N, FOOTPRINT] flat.
        features: [N, C].
        background: [3], the color behind everything.
        bins: the tile lists, see `binning.Bins`.
        width, height: size of the image in pixels.

    Returns:
        color [H, W, 3], depth [H, W], alpha [H, W], features [H, W, C] and transmittance [H, W], all float32; and used
        [tiles] int64, the number of entries of each tile's list that were processed: all, or fewer if all pixels of
        the tile were finished. `depth` is divided by alpha, and `color` includes the background.
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
    """Return the features [N, C], or None if C is 0; kernels are compiled separately for None."""
    return features if features.shape[1] else None


@kernel
def allocate_vectors(vectors):
    """Return an uninitialized float32 array for this number of vectors, aligned to cache lines."""
    memory = np.empty(vectors * LANES + 16, np.float32)
    first = (-memory.ctypes.data // 4) % 16
    return memory[first : first + vectors * LANES]


@kernel
def load_constants():
    """Return a copy of `_CONSTANTS`, whose values the compiler does not know, so that it reads them from memory."""
    constants = allocate_vectors(len(_CONSTANTS) // LANES)
    constants[:] = _CONSTANTS
    return constants


@kernel
def next_tile(tickets, tiles):
    """Return the next tile to process, or -1 if all are taken.

    The tiles are divided into as many parts as there are threads, and tickets take one tile of each part in turn.
    Otherwise threads would work on neighboring tiles at once, and write to the same cache lines (of images, and of the
    records of a footprint).

    Args:
        tickets: [2], the counter of tickets and the number of threads.
        tiles: number of tiles.
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
    """Return the left column and the top row of a tile in an image of this width, in pixels."""
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    return (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT


@inlined
def init_transmittance(state, stride, rows, columns):
    """Set the transmittance of each pixel of a tile: 1, or -1 (finished) for pixels outside the image.

    Args:
        state: output, in the first vector of each step.
        rows, columns: numbers of rows and columns of the image from the tile's upper left pixel on.
    """
    for step in range(STEPS):
        for lane in range(LANES):
            inside = step * STEP_ROWS + lane // TILE_WIDTH < rows and lane % TILE_WIDTH < columns
            state[step * stride + lane] = np.float32(1.0 if inside else -1.0)


@inlined
def is_finished(state, stride):
    """Return whether all pixels of the tile are finished."""
    for step in range(STEPS):
        if any_lane(load(state, step * stride) > splat(0.0)):
            return False
    return True


@inlined
def footprint_in_tile(footprints, base, left, top, middle):
    """Return a footprint in the coordinates of a tile.

    In a pixel of the tile's row `middle` + j the whitened coordinates (see `layout`) are u = u_middle - lean j and
    v = v_middle + whiten_y j.

    Args:
        base: index of the footprint's first number.
        left, top: upper left pixel of the tile.
        middle: row of the tile from which j counts, float32.

    Returns:
        u_middle, lean, v_middle, whiten_y and level, as vectors. Lanes belong to columns of pixels; only u_middle
        differs between them.
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
    """Return log2(alpha), before alpha is clamped, at the pixels of a step.

    Args:
        footprint: from `footprint_in_tile`.
        j: rows of the pixels, counted from its `middle`.
    """
    u_middle, lean, v_middle, whiten_y, level = footprint
    u, v = fnma(lean, j, u_middle), fma(whiten_y, j, v_middle)
    return fnma(u, u, fnma(v, v, level))


@inlined
def exp2(x, constants):
    """Return 2^x for x in [-126, 127], with a relative error of about 2e-7; for other x the result is undefined.

    x is divided into the nearest integer, which becomes the exponent, and a remainder, of which 2^x is a polynomial.
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
    """Blend a footprint into the pixels of a step.

    Args:
        power: log2(alpha), before clamping.
        is_above_cut: mask of the pixels where alpha is at least 1/255.
        before: transmittance in front of the footprint, negative in finished pixels.

    Returns:
        Alpha before clamping (undefined where `is_above_cut` is not set); alpha; blending weight; and transmittance
        behind the footprint. Where the footprint would bring the transmittance below `MIN_TRANSMITTANCE`, the weight is
        0, and the pixel is finished.
    """
    raw = exp2(power, constants)
    alpha = select(is_above_cut, minimum(raw, load(constants, AT_MAX_ALPHA * LANES)), np.float32(0.0))
    after = fnma(before, alpha, before)
    is_blended = after >= load(constants, _AT_MIN_TRANSMITTANCE * LANES)
    weight = select(is_blended, before * alpha, np.float32(0.0))
    return raw, alpha, weight, select(is_blended, after, minimum(before, splat(0.0) - before))


@kernel
def _blend(tickets, footprints, features, background, bins, color, depth, alpha, blended, transmittance, used):
    """Blend all tiles; arguments and outputs as for `blend`, features None without channels."""
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
    """Blend the list of one tile into `state`, and return the number of processed entries of the list."""
    # `size` is (height, width) of the image in pixels; for the layout of `state` see the module and `_SUMS`.
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
    """Write a blended tile from `state` into the images, with the background."""
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
