"""Gradients of blending, per tile, front to back with the arithmetic of `forward` (docs/method.md#splatting).

A *footprint* is a Gaussian projected into the image. Each pair of a footprint and a tile that it touches writes one
*record* (see `layout`): its gradients, summed over the pixels of the tile. The records of a footprint are then added in
a fixed order (`footprints.add_records`), so that results do not depend on the number of threads.

A *step* is a vector of LANES pixels of a tile. The *state* of a tile is a float32 array with several vectors for each
step, one after the other; `stride` is the number of floats per step.
"""

from __future__ import annotations

import numpy as np

from reffusion.kernels.compiled import empty_aligned, inlined, kernel, parallel_for
from reffusion.kernels.memory import load, prefetch, splat_at, store, store_totals, total
from reffusion.kernels.vectors import LANES, any_lane, fma, fnma, select, splat
from reffusion.splat.forward import (
    AT_CUT,
    AT_MAX_ALPHA,
    AT_ROW,
    STEP_ROWS,
    STEPS,
    allocate_vectors,
    blend_pixels,
    footprint_in_tile,
    init_transmittance,
    is_finished,
    load_constants,
    log_alpha,
    next_tile,
    or_none,
    tile_corner,
)
from reffusion.splat.layout import (
    AHEAD,
    BLUE,
    DEPTH,
    FOOTPRINT,
    GRAD_FEATURES,
    GREEN,
    MEMBER,
    RED,
    ROWS,
    SLOT,
    TILE_HEIGHT,
    TILE_WIDTH,
)

# Vectors of the state per step, before the upstream gradients of the features: transmittance; remainder (see
# `_load_tile`); upstream gradients of red, green, blue and depth.
_UPSTREAM = 6


def blend_backward(footprints, features, bins, used, images, transmittance, gradients):
    """Compute the gradient records of all I pairs of a footprint and a tile.

    Args:
        footprints: [>= N, FOOTPRINT] flat.
        features: [N, C].
        bins: the tile lists, see `binning.Bins`.
        used: [tiles], number of processed entries of each list, from `forward.blend`.
        images: color [H, W, 3], depth [H, W], alpha [H, W] and features [H, W, C] from `forward.blend`.
        transmittance: [H, W], from `forward.blend`.
        gradients: derivatives of the loss with respect to the four images, of the same shapes.

    Returns:
        records [I, columns] float32, ordered by Gaussian, whose first GRAD_FEATURES + C columns are as in `layout`; and
        written [I] bool, True for the valid records. A pair whose footprint reaches no unfinished pixel writes no
        record, and its row of `records` is undefined.
    """
    columns = record_columns(features.shape[1])
    records, written = empty_aligned(len(bins.entries), columns), np.zeros(len(bins.entries), np.bool_)
    inputs = footprints, or_none(features), bins, used, *images, transmittance, *gradients
    parallel_for(_blend_backward, *inputs, records, written)
    return records, written


def record_columns(channels: int) -> int:
    """Return the number of floats of a gradient record with `channels` features, rounded up to whole cache lines."""
    return -(-(GRAD_FEATURES + channels) // 16) * 16


@kernel
def _blend_backward(
    tickets,
    footprints,
    features,
    bins,
    used,
    color,
    depth,
    alpha,
    blended,
    transmittance,
    grad_color,
    grad_depth,
    grad_alpha,
    grad_blended,
    records,
    written,
):
    """Write the records of all tiles; arguments as for `blend_backward`, features None without channels."""
    channels = blended.shape[2]
    state = allocate_vectors(STEPS * (_UPSTREAM + channels))
    sums = allocate_vectors(channels)
    constants = load_constants()
    flat = records.reshape(-1)
    images = color, depth, alpha, blended, transmittance
    gradients = grad_color, grad_depth, grad_alpha, grad_blended
    while True:
        tile = next_tile(tickets, used.shape[0])
        if tile < 0:
            return
        left, top = tile_corner(tile, depth.shape[1])
        _load_tile(left, top, state, (_UPSTREAM + channels) * LANES, images, gradients)
        start = bins.starts[tile]
        _tile_backward(
            left, top, start, start + used[tile], footprints, features, bins, state, sums, constants, flat, written
        )


@kernel
def _load_tile(left, top, state, stride, images, gradients):
    """Fill a tile's state with the transmittance before the first footprint, upstream gradients and remainder."""
    color, depth, alpha, blended, transmittance = images
    grad_color, grad_depth, grad_alpha, grad_blended = gradients
    height, width = depth.shape
    state[:] = np.float32(0.0)
    # `stride` is the number of floats per step. Pixels of the tile that lie outside the image are marked as finished.
    init_transmittance(state, stride, height - top, width - left)
    for row in range(min(TILE_HEIGHT, height - top)):
        y = top + row
        for lane in range(min(TILE_WIDTH, width - left)):
            x, place = left + lane, row // STEP_ROWS * stride + row % STEP_ROWS * TILE_WIDTH + lane
            behind = transmittance[y, x]
            # Upstream gradients are derivatives of the loss with respect to the blended sums of color, depth and
            # features. The rendered depth is D / alpha, where D is the blended sum. So the derivative with respect to D
            # is grad_depth / alpha, and -depth * grad_depth / alpha is added to grad_alpha.
            g_depth = grad_depth[y, x] / alpha[y, x] if alpha[y, x] > 0 else np.float32(0.0)
            g_alpha = grad_alpha[y, x] - g_depth * depth[y, x]
            # The remainder is the numerator sum_{j>k} w_j a_j + B of docs/method.md#splatting before the first
            # footprint: the dot product of the upstream gradients with the rendered pixel, minus the final
            # transmittance times the derivative with respect to alpha.
            remainder = grad_depth[y, x] * depth[y, x] - behind * g_alpha
            for c in range(3):
                state[place + (2 + c) * LANES] = grad_color[y, x, c]
                remainder += grad_color[y, x, c] * color[y, x, c]
            state[place + 5 * LANES] = g_depth
            for c in range(blended.shape[2]):
                state[place + (_UPSTREAM + c) * LANES] = grad_blended[y, x, c]
                remainder += grad_blended[y, x, c] * blended[y, x, c]
            state[place + LANES] = remainder


@kernel
def _tile_backward(left, top, start, stop, footprints, features, bins, state, sums, constants, records, written):
    """Write `records` [I * columns] and `written` [I] of the processed entries `start` to `stop` - 1 of a tile."""
    # `state` comes from `_load_tile` and is updated from footprint to footprint, `constants` comes from
    # `forward.load_constants`, and `sums` is memory for C vectors.
    columns = records.shape[0] // max(1, written.shape[0])
    stride = _UPSTREAM * LANES
    if features is not None:
        stride += features.shape[1] * LANES
    for at in range(start, stop):
        upcoming = min(at + AHEAD, stop - 1)
        prefetch(footprints, bins.entries[upcoming, MEMBER] * FOOTPRINT)
        prefetch(records, bins.entries[upcoming, SLOT] * columns)
        member, rows, slot = bins.entries[at, MEMBER], bins.entries[at, ROWS], bins.entries[at, SLOT]
        if features is not None:
            sums[:] = np.float32(0.0)
        is_touched, to_all = _rows_backward(
            member, rows, left, top, footprints, features, state, stride, sums, constants
        )
        written[slot] = is_touched
        if not is_touched:
            continue
        store_totals(records, slot * columns, to_all)
        if features is not None:
            for c in range(features.shape[1]):
                records[slot * columns + GRAD_FEATURES + c] = total(load(sums, c * LANES))


@inlined
def _rows_backward(member, rows, left, top, footprints, features, state, stride, sums, constants):
    """Return whether a footprint reaches unfinished pixels, and the first 10 columns of its record, summed per lane."""
    zero = splat(0.0)
    # `rows` is first + 256 * (one past the last) of the rows of the tile that the footprint can touch.
    base, first_row, end_row = member * FOOTPRINT, rows & 255, rows >> 8
    middle = np.float32((first_row + end_row) // 2)
    # `footprint` decides which pixels blend, with the same bits as in the forward pass. Moments are computed from
    # `centered_footprint`, relative to the middle row, where rounding loses least.
    footprint = footprint_in_tile(footprints, base, left, top, np.float32(0.0))
    centered_footprint = footprint_in_tile(footprints, base, left, top, middle)
    red, green = splat_at(footprints, base + RED), splat_at(footprints, base + GREEN)
    blue, depth = splat_at(footprints, base + BLUE), splat_at(footprints, base + DEPTH)
    g_0 = g_1 = g_2 = to_red = to_green = to_blue = to_depth = zero
    is_touched = False
    for step in range(first_row // STEP_ROWS, (end_row + STEP_ROWS - 1) // STEP_ROWS):
        place = step * stride
        before = load(state, place)
        row = load(constants, (AT_ROW + step) * LANES)
        power = log_alpha(footprint, row)
        is_above_cut = power >= load(constants, AT_CUT * LANES)
        if not any_lane(is_above_cut & (before > zero)):
            continue
        is_touched = True
        raw, alpha, weight, after = blend_pixels(power, is_above_cut, before, constants)
        store(state, place, after)
        up_red, up_green = load(state, place + 2 * LANES), load(state, place + 3 * LANES)
        up_blue, up_depth = load(state, place + 4 * LANES), load(state, place + 5 * LANES)
        shade = fma(depth, up_depth, fma(blue, up_blue, fma(green, up_green, red * up_red)))
        to_red, to_green = fma(weight, up_red, to_red), fma(weight, up_green, to_green)
        to_blue, to_depth = fma(weight, up_blue, to_blue), fma(weight, up_depth, to_depth)
        if features is not None:
            for c in range(features.shape[1]):
                up = load(state, place + (_UPSTREAM + c) * LANES)
                shade = fma(splat(features[member, c]), up, shade)
                # The gradients of the features, summed per lane.
                store(sums, c * LANES, fma(weight, up, load(sums, c * LANES)))
        behind = fnma(weight, shade, load(state, place + LANES))
        store(state, place + LANES, behind)
        # g = dLoss/d(ln alpha) = alpha (transmittance * shade - behind / (1 - alpha)); 0 where alpha is clamped or the
        # footprint is not blended.
        g = fnma(behind, alpha / (splat(1.0) - alpha), weight * shade)
        g = select((after > zero) & (raw < load(constants, AT_MAX_ALPHA * LANES)), g, zero)
        j = row - splat(middle)
        gj = g * j
        g_0, g_1, g_2 = g_0 + g, g_1 + gj, fma(gj, j, g_2)
    return is_touched, (*_moments(centered_footprint, g_0, g_1, g_2), to_depth, to_red, to_green, to_blue)


@inlined
def _moments(footprint, g_0, g_1, g_2):
    """Convert the sums of g, g j and g j^2 per lane to the sums of g, g u, g v, g u^2, g u v and g v^2."""
    # In a column of pixels u and v are affine functions of the row j, with the coefficients in `footprint` (see
    # `footprint_in_tile`).
    u_middle, lean, v_middle, whiten_y, _ = footprint
    g_u, g_uj = fnma(lean, g_1, u_middle * g_0), fnma(lean, g_2, u_middle * g_1)
    g_v, g_vj = fma(whiten_y, g_1, v_middle * g_0), fma(whiten_y, g_2, v_middle * g_1)
    g_uu, g_uv = fnma(lean, g_uj, u_middle * g_u), fnma(lean, g_vj, u_middle * g_v)
    return g_0, g_u, g_v, g_uu, g_uv, fma(whiten_y, g_vj, v_middle * g_v)


def gather_values(footprints, bins, values, count):
    """Sum blending weight x value of the pixel over the pixels of each pair of a footprint and a tile.

    Args:
        footprints: [>= N, FOOTPRINT] flat.
        bins: the tile lists, see `binning.Bins`.
        values: [H, W, C], the values of the pixels.
        count: True takes weight 1 at each pixel that blends the footprint, instead of the blending weight.

    Returns:
        records [I, columns] float32, ordered by Gaussian, with the sums in the first C columns; and written [I] bool,
        True for the valid records.
    """
    columns = -(-values.shape[2] // 16) * 16
    records, written = np.zeros((len(bins.entries), columns), np.float32), np.zeros(len(bins.entries), np.bool_)
    parallel_for(_gather_values, footprints, bins, values, count, records, written)
    return records, written


@kernel
def _gather_values(tickets, footprints, bins, values, count, records, written):
    """Write the records of all tiles for `gather_values`; the state of a step is its transmittance and its values."""
    height, width, channels = values.shape
    stride = (1 + channels) * LANES
    state = allocate_vectors(STEPS * (1 + channels))
    sums, constants = allocate_vectors(channels), load_constants()
    while True:
        tile = next_tile(tickets, bins.starts.shape[0] - 1)
        if tile < 0:
            return
        left, top = tile_corner(tile, width)
        state[:] = np.float32(0.0)
        init_transmittance(state, stride, height - top, width - left)
        for row in range(min(TILE_HEIGHT, height - top)):
            for lane in range(min(TILE_WIDTH, width - left)):
                place = row // STEP_ROWS * stride + row % STEP_ROWS * TILE_WIDTH + lane
                for c in range(channels):
                    state[place + (1 + c) * LANES] = values[top + row, left + lane, c]
        _gather_tile(left, top, tile, footprints, bins, count, channels, state, sums, constants, records, written)


@kernel
def _gather_tile(left, top, tile, footprints, bins, count, channels, state, sums, constants, records, written):
    """Write the records of one tile's list; `state` holds the transmittance and the values of the tile's pixels."""
    start, stop, stride = bins.starts[tile], bins.starts[tile + 1], (1 + channels) * LANES
    zero = splat(0.0)
    for at in range(start, stop):
        if (at - start) % 32 == 31 and is_finished(state, stride):
            return
        member, rows, slot = bins.entries[at, MEMBER], bins.entries[at, ROWS], bins.entries[at, SLOT]
        footprint = footprint_in_tile(footprints, member * FOOTPRINT, left, top, np.float32(0.0))
        for c in range(channels):
            store(sums, c * LANES, zero)
        is_touched = False
        for step in range((rows & 255) // STEP_ROWS, ((rows >> 8) + STEP_ROWS - 1) // STEP_ROWS):
            place = step * stride
            before = load(state, place)
            power = log_alpha(footprint, load(constants, (AT_ROW + step) * LANES))
            is_above_cut = power >= load(constants, AT_CUT * LANES)
            if not any_lane(is_above_cut & (before > zero)):
                continue
            is_touched = True
            _, _, weight, after = blend_pixels(power, is_above_cut, before, constants)
            store(state, place, after)
            if count:
                weight = select(weight > zero, splat(1.0), zero)
            for c in range(channels):
                store(sums, c * LANES, fma(weight, load(state, place + (1 + c) * LANES), load(sums, c * LANES)))
        written[slot] = is_touched
        if is_touched:
            for c in range(channels):
                records[slot, c] = total(load(sums, c * LANES))
