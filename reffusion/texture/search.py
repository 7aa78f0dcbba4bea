"""Kernels of the patch search: where in the photographs it looks as it does around each pixel of a hole.

A patch is compared in the frame of the surface that it lies on: one on a plane is carried along the plane, and may be
turned in it, so that planks run on in their own perspective; any other is shifted, and scaled by its distance.
"""

from __future__ import annotations

import math

import numpy as np

from reffusion.kernels.compiled import FREE_ROUNDING, inlined, kernel
from reffusion.texture.matches import FARTHEST, NEAREST, NONE, PATCH, TURN, carried, carried_match


@inlined
def _uniform(state):
    """In [0, 1); xorshift64."""
    x = state[0]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    state[0] = x
    return np.float32((x >> np.uint64(40)) / np.float64(1 << 24))


BEFORE, FOREIGN = 1.25, 4.0  # a patch that is so much nearer, or on another plane, counts so many times more


def _misfit(n, planar, picture, y, x, angle, limit, hole, picture_now, weight, pictures, elsewhere):
    """Mean squared difference under `weight` between the patch around pixel n and the one at (y, x) of a picture;
    `NONE` where that must not be, or exceeds `limit`. On another surface, or one much nearer or farther, it counts
    1 + `elsewhere` times."""
    row, column = math.floor(y + 0.5), math.floor(x + 0.5)
    height, width, channels = pictures.values.shape[1:]
    if row < 0 or column < 0 or row >= height or column >= width:
        return NONE
    surface = pictures.surface[picture, row, column]
    if surface < 0 or (planar and surface != hole.surface[n]):
        return NONE
    ok, xx, xy, yx, yy = carried(hole, n, pictures, planar, picture, row, column, angle)
    if not ok:
        return NONE
    middle_row, middle_column = hole.row[n], hole.column[n]
    top, bottom = max(-PATCH, -middle_row), min(PATCH, picture_now.shape[0] - 1 - middle_row)
    left, right = max(-PATCH, -middle_column), min(PATCH, picture_now.shape[1] - 1 - middle_column)
    total, mass = np.float32(0), np.float32(1e-6)
    for dy in range(top, bottom + 1):
        for dx in range(left, right + 1):
            mass += weight[middle_row + dy, middle_column + dx]
    ratio = hole.size[n] / pictures.size[picture, row, column]
    alike = surface == hole.surface[n] and FARTHEST < ratio < NEAREST
    factor = np.float32(1) if alike else np.float32(1) + elsewhere
    if ratio > BEFORE or (surface != hole.surface[n] and surface > 0 and hole.surface[n] > 0):
        factor *= FOREIGN
    most = limit * mass / factor
    for dy in range(top, bottom + 1):
        for dx in range(left, right + 1):
            w = weight[middle_row + dy, middle_column + dx]
            if w <= 0:
                continue
            source_x, source_y = x + xx * dx + xy * dy, y + yx * dx + yy * dy
            j, i = math.floor(source_x), math.floor(source_y)
            if j < 0 or i < 0 or j >= width - 1 or i >= height - 1:
                return NONE
            u, v = source_x - j, source_y - i
            error = np.float32(0)
            for c in range(channels):
                above = pictures.values[picture, i, j, c] * (1 - u) + pictures.values[picture, i, j + 1, c] * u
                below = pictures.values[picture, i + 1, j, c] * (1 - u) + pictures.values[picture, i + 1, j + 1, c] * u
                off = above * (1 - v) + below * v - picture_now[middle_row + dy, middle_column + dx, c]
                error += off * off
            total += w * error
        if total > most:
            return NONE
    return factor * total / mass


_misfit = kernel(_misfit, FREE_ROUNDING)


@inlined
def _take(match, n, picture, row, column, angle, planar, misfit):
    match.picture[n], match.row[n], match.column[n] = picture, row, column
    match.angle[n], match.planar[n], match.misfit[n] = angle, planar, misfit


@kernel
def search(todo, rounds, tries, match, hole, picture_now, weight, pictures, choice, elsewhere, state):
    """Better patches for the pixels `todo`, as in PatchMatch: what the neighbours take, moved along; places near the
    one taken; and `tries` places anywhere.

    Args:
        todo: [T] numbers of pixels in reading order; every second round goes backwards.
        match: is changed in place. picture_now: [H, W, C] float32, the picture as it is now.
        weight: [H, W] float32, how much each of its pixels counts. elsewhere: see `_misfit`.
        state: [1] uint64 of the random numbers, is changed.
    """
    height, width = picture_now.shape[:2]
    reach = max(pictures.values.shape[1], pictures.values.shape[2]) // 3
    for turn in range(rounds):
        for at in range(len(todo)):
            n = todo[at] if turn % 2 == 0 else todo[len(todo) - 1 - at]
            best = NONE
            if match.picture[n] >= 0:
                best = _misfit(n, match.planar[n], match.picture[n], match.row[n], match.column[n], match.angle[n],
                               NONE, hole, picture_now, weight, pictures, elsewhere)  # fmt: skip
            match.misfit[n] = best
            for side in range(4):
                dy, dx = (-1, 1, 0, 0)[side], (0, 0, -1, 1)[side]
                row, column = hole.row[n] + dy, hole.column[n] + dx
                if row < 0 or column < 0 or row >= height or column >= width:
                    continue
                m = hole.index[row, column]
                if m < 0 or match.picture[m] < 0 or (match.planar[m] and hole.surface[m] != hole.surface[n]):
                    continue
                _, xx, xy, yx, yy = carried_match(hole, m, pictures, match)
                y, x = match.row[m] - yx * dx - yy * dy, match.column[m] - xx * dx - xy * dy
                found = _misfit(n, match.planar[m], match.picture[m], y, x, match.angle[m], best,
                                hole, picture_now, weight, pictures, elsewhere)  # fmt: skip
                if found < best:
                    best = found
                    _take(match, n, match.picture[m], y, x, match.angle[m], match.planar[m], found)
            span = reach
            while span >= 1 and match.picture[n] >= 0:
                y = match.row[n] + (2 * _uniform(state) - 1) * span
                x = match.column[n] + (2 * _uniform(state) - 1) * span
                angle = match.angle[n]
                if match.planar[n]:
                    angle += (2 * _uniform(state) - 1) * TURN * min(1.0, span / 16)
                    angle = min(max(angle, -TURN), TURN)
                else:
                    y, x = math.floor(y + 0.5), math.floor(x + 0.5)
                found = _misfit(n, match.planar[n], match.picture[n], y, x, angle, best,
                                hole, picture_now, weight, pictures, elsewhere)  # fmt: skip
                if found < best:
                    best = found
                    _take(match, n, match.picture[n], y, x, angle, match.planar[n], found)
                span //= 2
            for _ in range(tries):
                planar = hole.planar[n] and _uniform(state) < 0.5
                surface = hole.surface[n] if planar else 0
                count = choice.starts[surface + 1] - choice.starts[surface]
                if count == 0:
                    continue
                place = choice.places[choice.starts[surface] + min(int(_uniform(state) * count), count - 1)]
                angle = (2 * _uniform(state) - 1) * TURN if planar else np.float32(0)
                found = _misfit(n, planar, place[0], place[1], place[2], angle, best,
                                hole, picture_now, weight, pictures, elsewhere)  # fmt: skip
                if found < best:
                    best = found
                    _take(match, n, place[0], place[1], place[2], angle, planar, found)
