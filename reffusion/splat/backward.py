"""Gradients of blending, tile by tile, front to back with the arithmetic of `forward` (docs/splatting.md).

Each footprint-tile pair leaves one record; records of a footprint are then added in a fixed order, so the result does
not depend on the number of threads.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from reffusion.splat.binning import CUT, TILE_HEIGHT, TILE_WIDTH
from reffusion.splat.conventions import MAX_ALPHA, MIN_TRANSMITTANCE
from reffusion.splat.projection import (
    BLUE,
    DEPTH,
    GRAD_BLUE,
    GRAD_DEPTH,
    GRAD_FEATURES,
    GRAD_GREEN,
    GRAD_RED,
    GREEN,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    PARALLEL,
    RED,
    SERIAL,
    SLANT,
    SUM_G,
    SUM_U,
    SUM_UU,
    SUM_UV,
    SUM_V,
    SUM_VV,
    WHITEN_X,
    WHITEN_Y,
)

_MAX_ALPHA = np.float32(MAX_ALPHA)
_MIN_TRANSMITTANCE = np.float32(MIN_TRANSMITTANCE)


@njit(**PARALLEL)
def blend_backward(footprints, features, starts, members, rows, slots, used, upstream, remainder, transmittance):
    """One gradient record per footprint-tile pair.

    Args:
        used, transmittance: from `blend`; transmittance gives the image size.
        upstream: [H, W, 4 + C] gradients of the blended (not normalised) colour, depth and features.
        remainder: [H, W] upstream dotted with what was blended and lies behind.

    Returns:
        [I, GRAD_FEATURES + C] float32, ordered by footprint.
    """
    records = np.zeros((members.shape[0], GRAD_FEATURES + features.shape[1]), np.float32)
    for tile in prange(starts.shape[0] - 1):
        _blend_tile_backward(
            tile, footprints, features, starts, members, rows, slots, used, upstream, remainder, transmittance, records
        )
    return records


@njit(**SERIAL)
def _blend_tile_backward(
    tile, footprints, features, starts, members, rows, slots, used, upstream, remainder, transmittance, records
):
    f = np.float32
    height, width = transmittance.shape
    channels = features.shape[1]
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
    tile_rows, tile_columns = min(TILE_HEIGHT, height - top), min(TILE_WIDTH, width - left)
    state = np.full((TILE_HEIGHT, TILE_WIDTH), f(-1.0))
    state[:tile_rows, :tile_columns] = f(1.0)
    rest = np.zeros((TILE_HEIGHT, TILE_WIDTH), np.float32)
    rest[:tile_rows, :tile_columns] = remainder[top : top + tile_rows, left : left + tile_columns]
    for at in range(starts[tile], starts[tile] + used[tile]):
        splat = footprints[members[at]]
        extra = features[members[at]]
        record = records[slots[at]]
        for row in range(rows[at] & 255, rows[at] >> 8):
            dy = f(top + row) + f(0.5) - splat[MEAN_Y]
            v = splat[WHITEN_Y] * dy
            level = splat[LEVEL] - v * v
            middle = splat[MEAN_X] + splat[SLANT] * dy
            for lane in range(TILE_WIDTH):
                before = state[row, lane]
                u = splat[WHITEN_X] * (f(left + lane) + f(0.5) - middle)
                power = level - u * u
                if before <= 0 or power < CUT:
                    continue
                raw = f(math.exp2(power))
                alpha = min(raw, _MAX_ALPHA)
                after = before * (f(1.0) - alpha)
                if after < _MIN_TRANSMITTANCE:
                    state[row, lane] = -before
                    continue
                weight = before * alpha
                state[row, lane] = after
                up = upstream[top + row, left + lane]
                shade = splat[RED] * up[0] + splat[GREEN] * up[1] + splat[BLUE] * up[2] + splat[DEPTH] * up[3]
                record[GRAD_RED] += weight * up[0]
                record[GRAD_GREEN] += weight * up[1]
                record[GRAD_BLUE] += weight * up[2]
                record[GRAD_DEPTH] += weight * up[3]
                for c in range(channels):
                    shade += extra[c] * up[4 + c]
                    record[GRAD_FEATURES + c] += weight * up[4 + c]
                behind = rest[row, lane] - weight * shade
                rest[row, lane] = behind
                if raw < _MAX_ALPHA:
                    g = weight * shade - behind * alpha / (f(1.0) - alpha)
                    record[SUM_G] += g
                    record[SUM_U] += g * u
                    record[SUM_V] += g * v
                    record[SUM_UU] += g * u * u
                    record[SUM_UV] += g * u * v
                    record[SUM_VV] += g * v * v


@njit(**PARALLEL)
def add_records(records, first_slots):
    """[M, columns]: the sum of each footprint's records, in their order."""
    count, columns = first_slots.shape[0] - 1, records.shape[1]
    sums = np.zeros((count, columns), np.float32)
    for m in prange(count):
        for slot in range(first_slots[m], first_slots[m + 1]):
            for c in range(columns):
                sums[m, c] += records[slot, c]
    return sums


@njit(**PARALLEL)
def upstream_of_blending(
    color, depth, blended, transmittance, grad_color, grad_depth, grad_alpha, grad_blended, channels
):
    """Gradients of the outputs -> gradients of the blended sums and the remainder that `blend_backward` starts from.

    depth = D / alpha and alpha = 1 - transmittance: D receives grad_depth / alpha, alpha loses depth times that.
    """
    f = np.float32
    height, width = depth.shape
    upstream = np.empty((height, width, 4 + channels), np.float32)
    remainder = np.empty((height, width), np.float32)
    for y in prange(height):
        for x in range(width):
            behind = transmittance[y, x]
            g_depth = grad_depth[y, x] / (f(1.0) - behind) if behind < 1 else f(0.0)
            g_alpha = grad_alpha[y, x] - g_depth * depth[y, x]
            total = -behind * g_alpha + grad_depth[y, x] * depth[y, x]
            for c in range(3):
                upstream[y, x, c] = grad_color[y, x, c]
                total += grad_color[y, x, c] * color[y, x, c]
            upstream[y, x, 3] = g_depth
            for c in range(channels):
                upstream[y, x, 4 + c] = grad_blended[y, x, c]
                total += grad_blended[y, x, c] * blended[y, x, c]
            remainder[y, x] = total
    return upstream, remainder


@njit(**PARALLEL)
def gather_values(footprints, starts, members, rows, slots, values, count):
    """[I, C] per footprint-tile pair, ordered by footprint: pixel sums of weight x value (`count`: of value)."""
    records = np.zeros((members.shape[0], values.shape[2]), np.float32)
    for tile in prange(starts.shape[0] - 1):
        _gather_tile(tile, footprints, starts, members, rows, slots, values, count, records)
    return records


@njit(**SERIAL)
def _gather_tile(tile, footprints, starts, members, rows, slots, values, count, records):
    f = np.float32
    height, width, channels = values.shape
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
    tile_rows, tile_columns = min(TILE_HEIGHT, height - top), min(TILE_WIDTH, width - left)
    state = np.full((TILE_HEIGHT, TILE_WIDTH), f(-1.0))
    state[:tile_rows, :tile_columns] = f(1.0)
    for at in range(starts[tile], starts[tile + 1]):
        splat = footprints[members[at]]
        record = records[slots[at]]
        for row in range(rows[at] & 255, rows[at] >> 8):
            dy = f(top + row) + f(0.5) - splat[MEAN_Y]
            v = splat[WHITEN_Y] * dy
            level = splat[LEVEL] - v * v
            middle = splat[MEAN_X] + splat[SLANT] * dy
            for lane in range(TILE_WIDTH):
                before = state[row, lane]
                u = splat[WHITEN_X] * (f(left + lane) + f(0.5) - middle)
                power = level - u * u
                if before <= 0 or power < CUT:
                    continue
                alpha = min(f(math.exp2(power)), _MAX_ALPHA)
                after = before * (f(1.0) - alpha)
                if after < _MIN_TRANSMITTANCE:
                    state[row, lane] = -before
                    continue
                state[row, lane] = after
                weight = f(1.0) if count else before * alpha
                for c in range(channels):
                    record[c] += weight * values[top + row, left + lane, c]
