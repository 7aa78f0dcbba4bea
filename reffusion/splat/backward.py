"""Gradients of blending, tile by tile, front to back with the arithmetic of `forward` (docs/splatting.md).

Each footprint-tile pair leaves one record; the records of a footprint are then added in a fixed order, so the result
does not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np

from reffusion.splat.binning import CUT, TILE_HEIGHT, TILE_WIDTH
from reffusion.splat.compiled import kernel, share
from reffusion.splat.conventions import MAX_ALPHA, MIN_TRANSMITTANCE
from reffusion.splat.forward import aligned, finished, open_tile
from reffusion.splat.projection import (
    AHEAD,
    BLUE,
    DEPTH,
    FOOTPRINT,
    GRAD_FEATURES,
    GREEN,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    RED,
    SLANT,
    WHITEN_X,
    WHITEN_Y,
    next_part,
)
from reffusion.splat.vectors import (
    exp2,
    fma,
    fnma,
    load,
    minimum,
    negative,
    prefetch,
    ramp,
    select,
    some,
    splat,
    store,
    take_ticket,
    total,
    totals,
)

_UPSTREAM = 2  # vectors of a row before the upstream gradients: transmittance, remainder


def blend_backward(footprints, features, bins, used, images, transmittance, gradients):
    """One gradient record per footprint-tile pair.

    Args:
        footprints: [M, FOOTPRINT]; features: [M, C].
        bins: starts, members, rows, slots, see `bin_footprints`.
        images: color [H, W, 3], depth [H, W], alpha [H, W], features [H, W, C] as `blend` returned them.
        used, transmittance: from `blend`.
        gradients: dLoss/d(color, depth, alpha, features), shaped like them.

    Returns:
        [I, columns] float32 ordered by footprint; the first GRAD_FEATURES + C columns are those of `projection`.
    """
    columns = -(-(GRAD_FEATURES + features.shape[1]) // 16) * 16
    records = np.empty((len(bins[1]), columns), np.float32)
    share(_blend_backward, footprints, features, *bins, used, *images, transmittance, *gradients, records)
    return records


@kernel
def _blend_backward(
    tickets,
    footprints,
    features,
    starts,
    members,
    rows,
    slots,
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
):
    channels = features.shape[1]
    stride = (_UPSTREAM + 4 + channels) * TILE_WIDTH
    state = aligned(TILE_HEIGHT * (_UPSTREAM + 4 + channels))
    sums = aligned(channels)
    flat = records.reshape(-1)
    while True:
        tile = take_ticket(tickets)
        if tile >= used.shape[0]:
            return
        _load_tile(
            tile,
            state,
            stride,
            color,
            depth,
            alpha,
            blended,
            transmittance,
            grad_color,
            grad_depth,
            grad_alpha,
            grad_blended,
        )
        _tile_backward(
            tile, footprints, features, starts, members, rows, slots, used, depth.shape[1], state, stride, sums, flat
        )


@kernel
def _load_tile(
    tile, state, stride, color, depth, alpha, blended, transmittance, grad_color, grad_depth, grad_alpha, grad_blended
):
    """Upstream gradients of the blended sums, and the remainder: upstream dotted with all that was blended.

    depth = D / alpha and alpha = 1 - transmittance: D receives grad_depth / alpha, alpha loses depth times that.
    """
    height, width = depth.shape
    channels = blended.shape[2]
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
    state[:] = np.float32(0.0)
    open_tile(state, stride, min(TILE_HEIGHT, height - top), min(TILE_WIDTH, width - left))
    for row in range(min(TILE_HEIGHT, height - top)):
        y = top + row
        for lane in range(min(TILE_WIDTH, width - left)):
            x, place = left + lane, row * stride + lane
            behind = transmittance[y, x]
            g_depth = grad_depth[y, x] / alpha[y, x] if alpha[y, x] > 0 else np.float32(0.0)
            g_alpha = grad_alpha[y, x] - g_depth * depth[y, x]
            remainder = grad_depth[y, x] * depth[y, x] - behind * g_alpha
            for c in range(3):
                state[place + 16 * (_UPSTREAM + c)] = grad_color[y, x, c]
                remainder += grad_color[y, x, c] * color[y, x, c]
            state[place + 16 * (_UPSTREAM + 3)] = g_depth
            for c in range(channels):
                state[place + 16 * (_UPSTREAM + 4 + c)] = grad_blended[y, x, c]
                remainder += grad_blended[y, x, c] * blended[y, x, c]
            state[place + 16] = remainder


@kernel
def _tile_backward(tile, footprints, features, starts, members, rows, slots, used, width, state, stride, sums, records):
    """Write the records of one tile's list."""
    channels = features.shape[1]
    columns_of_record = records.shape[0] // max(1, members.shape[0])
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
    zero, one, cut = splat(0.0), splat(1.0), splat(CUT)
    strongest, least = splat(MAX_ALPHA), splat(MIN_TRANSMITTANCE)
    columns = ramp() + splat(np.float32(left) + np.float32(0.5))
    flat_footprints, last = footprints.reshape(-1), members.shape[0] - 1
    for at in range(starts[tile] + used[tile], starts[tile + 1]):
        records[slots[at] * columns_of_record : (slots[at] + 1) * columns_of_record] = np.float32(0.0)
    for at in range(starts[tile], starts[tile] + used[tile]):
        prefetch(flat_footprints, members[min(at + AHEAD, last)] * FOOTPRINT)
        prefetch(records, slots[min(at + AHEAD, last)] * columns_of_record)
        footprint = footprints[members[at]]
        extra = features[members[at]]
        whiten_x, whiten_y, level = splat(footprint[WHITEN_X]), splat(footprint[WHITEN_Y]), splat(footprint[LEVEL])
        lean = whiten_x * splat(footprint[SLANT])
        across = whiten_x * (columns - splat(footprint[MEAN_X]))
        red, green, blue = splat(footprint[RED]), splat(footprint[GREEN]), splat(footprint[BLUE])
        far = splat(footprint[DEPTH])
        above = np.float32(top) + np.float32(0.5) - footprint[MEAN_Y]
        g_sum = g_u = g_v = g_uu = g_uv = g_vv = zero
        to_red = to_green = to_blue = to_far = zero
        for c in range(channels):
            store(sums, 16 * c, zero)
        for row in range(rows[at] & 255, rows[at] >> 8):
            place = row * stride
            before = load(state, place)
            dy = splat(above + np.float32(row))
            u, v = fnma(lean, dy, across), whiten_y * dy
            power = fnma(u, u, fnma(v, v, level))
            seen = (power >= cut) & (before > zero)
            if not some(seen):
                continue
            raw = exp2(power)
            opacity = minimum(raw, strongest)
            after = fnma(before, opacity, before)
            kept = seen & (after >= least)
            weight = select(kept, before * opacity, zero)
            store(state, place, select(seen, select(kept, after, negative(before)), before))
            up_red, up_green = load(state, place + 32), load(state, place + 48)
            up_blue, up_far = load(state, place + 64), load(state, place + 80)
            shade = fma(far, up_far, fma(blue, up_blue, fma(green, up_green, red * up_red)))
            to_red, to_green = fma(weight, up_red, to_red), fma(weight, up_green, to_green)
            to_blue, to_far = fma(weight, up_blue, to_blue), fma(weight, up_far, to_far)
            for c in range(channels):
                up = load(state, place + 16 * (_UPSTREAM + 4 + c))
                shade = fma(splat(extra[c]), up, shade)
                store(sums, 16 * c, fma(weight, up, load(sums, 16 * c)))
            behind = fnma(weight, shade, load(state, place + 16))
            store(state, place + 16, behind)
            # g = dLoss/d(ln alpha) = alpha (transmittance shade - behind / (1 - alpha))
            g = fnma(behind, opacity / (one - opacity), weight * shade)
            g = select(kept & (raw < strongest), g, zero)
            gu, gv = g * u, g * v
            g_sum, g_u, g_v = g_sum + g, g_u + gu, g_v + gv
            g_uu, g_uv, g_vv = fma(gu, u, g_uu), fma(gu, v, g_uv), fma(gv, v, g_vv)
        first = slots[at] * columns_of_record
        store(records, first, totals((g_sum, g_u, g_v, g_uu, g_uv, g_vv, to_far, to_red, to_green, to_blue)))
        for c in range(channels):
            records[first + GRAD_FEATURES + c] = total(load(sums, 16 * c))


def add_records(records, first_slots, columns):
    """[M, columns]: the sum of each footprint's records, in their order."""
    sums = np.empty((len(first_slots) - 1, columns), np.float32)
    share(_add_records, records, first_slots, sums)
    return sums


@kernel
def _add_records(tickets, records, first_slots, sums):
    columns = sums.shape[1]
    while True:
        begin, end = next_part(tickets, sums.shape[0])
        if begin < 0:
            return
        for m in range(begin, end):
            sums[m] = np.float32(0.0)
            for slot in range(first_slots[m], first_slots[m + 1]):
                for c in range(columns):
                    sums[m, c] += records[slot, c]


def gather_values(footprints, bins, values, count):
    """[I, C] per footprint-tile pair, ordered by footprint: pixel sums of weight x value (`count`: of value)."""
    records = np.empty((len(bins[1]), values.shape[2]), np.float32)
    share(_gather_values, footprints, *bins, values, count, records)
    return records


@kernel
def _gather_values(tickets, footprints, starts, members, rows, slots, values, count, records):
    height, width, channels = values.shape
    stride = (1 + channels) * TILE_WIDTH
    state = aligned(TILE_HEIGHT * (1 + channels))
    sums = aligned(channels)
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    while True:
        tile = take_ticket(tickets)
        if tile >= starts.shape[0] - 1:
            return
        left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
        tile_rows, tile_columns = min(TILE_HEIGHT, height - top), min(TILE_WIDTH, width - left)
        state[:] = np.float32(0.0)
        open_tile(state, stride, tile_rows, tile_columns)
        for row in range(tile_rows):
            for lane in range(tile_columns):
                for c in range(channels):
                    state[row * stride + 16 * (1 + c) + lane] = values[top + row, left + lane, c]
        _gather_tile(
            left,
            top,
            footprints,
            starts[tile],
            starts[tile + 1],
            members,
            rows,
            slots,
            count,
            state,
            stride,
            sums,
            records,
        )


@kernel
def _gather_tile(left, top, footprints, start, stop, members, rows, slots, count, state, stride, sums, records):
    """Write the records of one tile's list, its values being in `state`."""
    channels = records.shape[1]
    zero, cut = splat(0.0), splat(CUT)
    strongest, least = splat(MAX_ALPHA), splat(MIN_TRANSMITTANCE)
    columns = ramp() + splat(np.float32(left) + np.float32(0.5))
    done = False
    for at in range(start, stop):
        done = done or ((at - start) % 32 == 31 and finished(state, stride))
        if done:
            records[slots[at]] = np.float32(0.0)
            continue
        footprint = footprints[members[at]]
        whiten_x, whiten_y, level = splat(footprint[WHITEN_X]), splat(footprint[WHITEN_Y]), splat(footprint[LEVEL])
        lean = whiten_x * splat(footprint[SLANT])
        across = whiten_x * (columns - splat(footprint[MEAN_X]))
        above = np.float32(top) + np.float32(0.5) - footprint[MEAN_Y]
        for c in range(channels):
            store(sums, 16 * c, zero)
        for row in range(rows[at] & 255, rows[at] >> 8):
            place = row * stride
            before = load(state, place)
            dy = splat(above + np.float32(row))
            u, v = fnma(lean, dy, across), whiten_y * dy
            power = fnma(u, u, fnma(v, v, level))
            seen = (power >= cut) & (before > zero)
            if not some(seen):
                continue
            opacity = minimum(exp2(power), strongest)
            after = fnma(before, opacity, before)
            kept = seen & (after >= least)
            share_of_one = splat(1.0) if count else before * opacity
            weight = select(kept, share_of_one, zero)
            store(state, place, select(seen, select(kept, after, negative(before)), before))
            for c in range(channels):
                store(sums, 16 * c, fma(weight, load(state, place + 16 * (1 + c)), load(sums, 16 * c)))
        for c in range(channels):
            records[slots[at], c] = total(load(sums, 16 * c))
