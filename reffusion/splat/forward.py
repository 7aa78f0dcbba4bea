"""Blending tile by tile, front to back, sixteen pixels of a row at a time."""

from __future__ import annotations

import numpy as np

from reffusion.splat.binning import CUT, TILE_HEIGHT, TILE_WIDTH
from reffusion.splat.compiled import kernel, share
from reffusion.splat.conventions import MAX_ALPHA, MIN_TRANSMITTANCE
from reffusion.splat.projection import (
    AHEAD,
    BLUE,
    DEPTH,
    FOOTPRINT,
    GREEN,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    RED,
    SLANT,
    WHITEN_X,
    WHITEN_Y,
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
)

_SUMS = 6  # vectors of a row before its features: transmittance, red, green, blue, depth, alpha


def blend(footprints, features, background, starts, members, rows, width, height):
    """Blend every tile's list.

    Args:
        footprints: [M, FOOTPRINT]; features: [M, C]; background: [3]; starts, members, rows: see `bin_footprints`.

    Returns:
        color [H, W, 3], depth [H, W], alpha [H, W], features [H, W, C], transmittance [H, W], all float32, and used
        [tiles] int64: how many of a tile's list were looked at before all its pixels were finished.
    """
    color = np.empty((height, width, 3), np.float32)
    depth, alpha = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    blended = np.empty((height, width, features.shape[1]), np.float32)
    transmittance = np.empty((height, width), np.float32)
    used = np.empty(len(starts) - 1, np.int64)
    outputs = color, depth, alpha, blended, transmittance, used
    share(_blend, footprints, features, background, starts, members, rows, *outputs)
    return outputs


@kernel
def aligned(vectors):
    """Room for so many vectors, on a cache line's border."""
    room = np.empty((vectors + 1) * 16, np.float32)
    first = (-room.ctypes.data // 4) % 16
    return room[first : first + vectors * 16]


@kernel
def open_tile(state, stride, rows, columns):
    """Set the transmittances, first of each row's `stride` floats: 1, or -1 (finished) outside the image."""
    for row in range(TILE_HEIGHT):
        limit = np.float32(columns if row < rows else 0)
        store(state, row * stride, select(ramp() < splat(limit), splat(1.0), splat(-1.0)))


@kernel
def finished(state, stride):
    """Whether no pixel of the tile takes anything more."""
    for row in range(TILE_HEIGHT):
        if some(load(state, row * stride) > splat(0.0)):
            return False
    return True


@kernel
def _blend(
    tickets,
    footprints,
    features,
    background,
    starts,
    members,
    rows,
    color,
    depth,
    alpha,
    blended,
    transmittance,
    used,
):
    channels = features.shape[1]
    stride = (_SUMS + channels) * TILE_WIDTH
    state = aligned(TILE_HEIGHT * (_SUMS + channels))
    while True:
        tile = take_ticket(tickets)
        if tile >= used.shape[0]:
            return
        used[tile] = _blend_tile(tile, footprints, features, starts, members, rows, depth.shape, state, stride)
        _write_tile(tile, state, stride, background, color, depth, alpha, blended, transmittance)


@kernel
def _blend_tile(tile, footprints, features, starts, members, rows, size, state, stride):
    """Blend one tile into `state`; returns how much of its list was used."""
    height, width = size
    channels = features.shape[1]
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
    state[:] = np.float32(0.0)
    open_tile(state, stride, min(TILE_HEIGHT, height - top), min(TILE_WIDTH, width - left))
    zero, cut = splat(0.0), splat(CUT)
    strongest, least = splat(MAX_ALPHA), splat(MIN_TRANSMITTANCE)
    columns = ramp() + splat(np.float32(left) + np.float32(0.5))
    flat_footprints, last = footprints.reshape(-1), members.shape[0] - 1
    for at in range(starts[tile], starts[tile + 1]):
        if (at - starts[tile]) % 32 == 31 and finished(state, stride):
            return at - starts[tile]
        prefetch(flat_footprints, members[min(at + AHEAD, last)] * FOOTPRINT)
        footprint = footprints[members[at]]
        extra = features[members[at]]
        whiten_x, whiten_y, level = splat(footprint[WHITEN_X]), splat(footprint[WHITEN_Y]), splat(footprint[LEVEL])
        lean = whiten_x * splat(footprint[SLANT])
        across = whiten_x * (columns - splat(footprint[MEAN_X]))
        red, green, blue = splat(footprint[RED]), splat(footprint[GREEN]), splat(footprint[BLUE])
        far = splat(footprint[DEPTH])
        above = np.float32(top) + np.float32(0.5) - footprint[MEAN_Y]
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
            weight = select(kept, before * opacity, zero)
            store(state, place, select(seen, select(kept, after, negative(before)), before))
            store(state, place + 16, fma(weight, red, load(state, place + 16)))
            store(state, place + 32, fma(weight, green, load(state, place + 32)))
            store(state, place + 48, fma(weight, blue, load(state, place + 48)))
            store(state, place + 64, fma(weight, far, load(state, place + 64)))
            store(state, place + 80, load(state, place + 80) + weight)
            for c in range(channels):
                place_c = place + 16 * (_SUMS + c)
                store(state, place_c, fma(weight, splat(extra[c]), load(state, place_c)))
    return starts[tile + 1] - starts[tile]


@kernel
def _write_tile(tile, state, stride, background, color, depth, alpha, blended, transmittance):
    """Put a blended tile into the images."""
    height, width = depth.shape
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
    for row in range(min(TILE_HEIGHT, height - top)):
        y = top + row
        for lane in range(min(TILE_WIDTH, width - left)):
            x, place = left + lane, row * stride + lane
            behind, covered = abs(state[place]), state[place + 80]
            transmittance[y, x] = behind
            alpha[y, x] = covered  # not 1 - behind, which has few digits where it is faint
            for c in range(3):
                color[y, x, c] = state[place + 16 * (1 + c)] + behind * background[c]
            depth[y, x] = state[place + 64] / max(covered, np.float32(1e-30))
            for c in range(blended.shape[2]):
                blended[y, x, c] = state[place + 16 * (_SUMS + c)]
