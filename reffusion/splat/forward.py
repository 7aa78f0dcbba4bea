"""Blending tile by tile, front to back."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from reffusion.splat.binning import CUT, TILE_HEIGHT, TILE_WIDTH
from reffusion.splat.conventions import MAX_ALPHA, MIN_TRANSMITTANCE
from reffusion.splat.projection import (
    BLUE,
    DEPTH,
    GREEN,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    PARALLEL,
    RED,
    SERIAL,
    SLANT,
    WHITEN_X,
    WHITEN_Y,
)

_MAX_ALPHA = np.float32(MAX_ALPHA)
_MIN_TRANSMITTANCE = np.float32(MIN_TRANSMITTANCE)


@njit(**PARALLEL)
def blend(footprints, features, background, starts, members, rows, width, height):
    """Blend every tile's list.

    Args:
        footprints: [M, FOOTPRINT]; features: [M, C]; background: [3]; starts, members, rows: see `bin_footprints`.

    Returns:
        color [H, W, 3], depth [H, W], features [H, W, C], transmittance [H, W], all float32, and used [tiles] int64:
        how many of a tile's list were looked at before all its pixels were finished.
    """
    channels = features.shape[1]
    color = np.empty((height, width, 3), np.float32)
    depth = np.empty((height, width), np.float32)
    blended = np.empty((height, width, channels), np.float32)
    transmittance = np.empty((height, width), np.float32)
    used = np.zeros(starts.shape[0] - 1, np.int64)
    for tile in prange(starts.shape[0] - 1):
        _blend_tile(
            tile, footprints, features, background, starts, members, rows, color, depth, blended, transmittance, used
        )
    return color, depth, blended, transmittance, used


@njit(**SERIAL)
def _blend_tile(
    tile, footprints, features, background, starts, members, rows, color, depth, blended, transmittance, used
):
    f = np.float32
    height, width = depth.shape
    channels = features.shape[1]
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
    tile_rows, tile_columns = min(TILE_HEIGHT, height - top), min(TILE_WIDTH, width - left)
    # per row: transmittance (negative once finished), red, green, blue, depth, features
    state = np.zeros((TILE_HEIGHT, 5 + channels, TILE_WIDTH), np.float32)
    state[:, 0, :] = f(-1.0)
    state[:tile_rows, 0, :tile_columns] = f(1.0)
    at = starts[tile]
    while at < starts[tile + 1]:
        if (at - starts[tile]) % 32 == 31 and state[:, 0, :].max() <= 0:
            break
        splat = footprints[members[at]]
        extra = features[members[at]]
        for row in range(rows[at] & 255, rows[at] >> 8):
            dy = f(top + row) + f(0.5) - splat[MEAN_Y]
            v = splat[WHITEN_Y] * dy
            level = splat[LEVEL] - v * v
            middle = splat[MEAN_X] + splat[SLANT] * dy
            for lane in range(TILE_WIDTH):
                before = state[row, 0, lane]
                u = splat[WHITEN_X] * (f(left + lane) + f(0.5) - middle)
                power = level - u * u
                if before <= 0 or power < CUT:
                    continue
                alpha = min(f(math.exp2(power)), _MAX_ALPHA)
                after = before * (f(1.0) - alpha)
                if after < _MIN_TRANSMITTANCE:
                    state[row, 0, lane] = -before
                    continue
                weight = before * alpha
                state[row, 0, lane] = after
                state[row, 1, lane] += weight * splat[RED]
                state[row, 2, lane] += weight * splat[GREEN]
                state[row, 3, lane] += weight * splat[BLUE]
                state[row, 4, lane] += weight * splat[DEPTH]
                for c in range(channels):
                    state[row, 5 + c, lane] += weight * extra[c]
        at += 1
    used[tile] = at - starts[tile]
    for row in range(tile_rows):
        for lane in range(tile_columns):
            y, x = top + row, left + lane
            behind = abs(state[row, 0, lane])
            transmittance[y, x] = behind
            color[y, x, 0] = state[row, 1, lane] + behind * background[0]
            color[y, x, 1] = state[row, 2, lane] + behind * background[1]
            color[y, x, 2] = state[row, 3, lane] + behind * background[2]
            depth[y, x] = state[row, 4, lane] / (f(1.0) - behind) if behind < 1 else f(0.0)
            for c in range(channels):
                blended[y, x, c] = state[row, 5 + c, lane]
