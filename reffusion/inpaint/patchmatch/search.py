"""Kernels of the patch search: where in the photographs it looks as it does around each pixel of a hole.

A patch is compared in the frame of the surface that it lies on: one on a plane is carried along the plane, and may be
turned in it, so that planks run on in their own perspective; any other is shifted, and scaled by its distance.
"""

from __future__ import annotations

import math

import numpy as np

from reffusion.inpaint.patchmatch.matches import FARTHEST, NEAREST, NONE, PATCH, TURN, carried, carried_match
from reffusion.kernels.compiled import FREE_ROUNDING, inlined, kernel

ELSEWHERE = 1.5  # times that a patch of another surface counts, or of one much nearer or farther
BEFORE = 1.25  # scale from which a patch is so much nearer that it would have been seen
FOREIGN = 4.0  # times that such a patch counts besides, or one of another plane


@inlined
def _uniform(state):
    """In [0, 1); xorshift64."""
    x = state[0]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    state[0] = x
    return np.float32((x >> np.uint64(40)) / np.float64(1 << 24))


@inlined
def _price(hole, n, surface, size):
    """How many times the difference to a patch of a surface (number, and the world's length of a pixel) counts."""
    ratio, same = hole.size[n] / size, surface == hole.surface[n]
    price = np.float32(1) if same and FARTHEST < ratio < NEAREST else np.float32(ELSEWHERE)
    foreign = ratio > BEFORE or (not same and surface > 0 and hole.surface[n] > 0)
    return price * np.float32(FOREIGN) if foreign else price


def misfit(n, planar, picture, y, x, angle, limit, of):
    """Mean squared difference by weight between the patch around pixel n and the one at (y, x) of a picture, times its
    price; `NONE` where that must not be, or exceeds `limit`. `of`: see `Compared`."""
    hole, pictures = of.hole, of.pictures
    row, column = math.floor(y + 0.5), math.floor(x + 0.5)
    height, width, channels = pictures.values.shape[1:]
    if row < 0 or column < 0 or row >= height or column >= width:
        return NONE
    surface = pictures.surface[picture, row, column]
    if surface < 0 or (planar and surface != hole.surface[n]):
        return NONE
    if hole.planar[n] and not planar and surface == hole.surface[n]:  # shifted, planks seen at a slant are stripes
        return NONE
    ok, xx, xy, yx, yy = carried(hole, n, pictures, planar, picture, row, column, angle)
    if not ok:
        return NONE
    middle_row, middle_column = hole.row[n], hole.column[n]
    top, bottom = max(-PATCH, -middle_row), min(PATCH, of.now.shape[0] - 1 - middle_row)
    left, right = max(-PATCH, -middle_column), min(PATCH, of.now.shape[1] - 1 - middle_column)
    total, mass = np.float32(0), np.float32(1e-6)
    for dy in range(top, bottom + 1):
        for dx in range(left, right + 1):
            mass += of.weight[middle_row + dy, middle_column + dx]
    price = _price(hole, n, surface, pictures.size[picture, row, column])
    most = limit * mass / price
    for dy in range(top, bottom + 1):
        for dx in range(left, right + 1):
            w = of.weight[middle_row + dy, middle_column + dx]
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
                off = above * (1 - v) + below * v - of.now[middle_row + dy, middle_column + dx, c]
                error += off * off
            total += w * error
        if total > most:
            return NONE
    return price * total / mass


misfit = kernel(misfit, FREE_ROUNDING)


@inlined
def _tried(match, n, planar, picture, y, x, angle, of):
    """Pixel n takes a patch that fits better than the one that it has."""
    found = misfit(n, planar, picture, y, x, angle, match.misfit[n], of)
    if found < match.misfit[n]:
        match.picture[n], match.row[n], match.column[n] = picture, y, x
        match.angle[n], match.planar[n], match.misfit[n] = angle, planar, found


@inlined
def _propagated(match, n, of):
    """What the neighbours take, moved along with the pixel."""
    hole, (height, width) = of.hole, of.now.shape[:2]
    for side in range(4):
        dy, dx = (-1, 1, 0, 0)[side], (0, 0, -1, 1)[side]
        row, column = hole.row[n] + dy, hole.column[n] + dx
        if row < 0 or column < 0 or row >= height or column >= width:
            continue
        m = hole.index[row, column]
        if m < 0 or match.picture[m] < 0 or (match.planar[m] and hole.surface[m] != hole.surface[n]):
            continue
        _, xx, xy, yx, yy = carried_match(hole, m, of.pictures, match)
        y, x = match.row[m] - yx * dx - yy * dy, match.column[m] - xx * dx - xy * dy
        _tried(match, n, match.planar[m], match.picture[m], y, x, match.angle[m], of)


@inlined
def _nearby(match, n, span, of, state):
    """Places near the one taken, from `span` pixels around on, each time half as far."""
    while span >= 1 and match.picture[n] >= 0:
        y = match.row[n] + (2 * _uniform(state) - 1) * span
        x = match.column[n] + (2 * _uniform(state) - 1) * span
        angle = match.angle[n]
        if match.planar[n]:
            angle += (2 * _uniform(state) - 1) * TURN * min(1.0, span / 16)
            angle = min(max(angle, -TURN), TURN)
        else:
            y, x = math.floor(y + 0.5), math.floor(x + 0.5)
        _tried(match, n, match.planar[n], match.picture[n], y, x, angle, of)
        span //= 2


@inlined
def _anywhere(match, n, of, choice, state):
    """A place anywhere; on the pixel's own plane every second time, where patches are carried along it."""
    planar = of.hole.planar[n] and _uniform(state) < 0.5
    surface = of.hole.surface[n] if planar else 0
    first, count = choice.starts[surface], choice.starts[surface + 1] - choice.starts[surface]
    if count > 0:
        place = choice.places[first + min(int(_uniform(state) * count), count - 1)]
        angle = (2 * _uniform(state) - 1) * TURN if planar else np.float32(0)
        _tried(match, n, planar, place[0], place[1], place[2], angle, of)


@kernel
def search(todo, rounds, tries, match, of, choice, state):
    """Better patches for the pixels `todo`, as in PatchMatch: propagation, places nearby, and `tries` anywhere.

    Args:
        todo: [T] numbers of pixels in reading order; every second round goes backwards.
        match: is changed in place. of: see `Compared`.
        state: [1] uint64 of the random numbers, is changed.
    """
    span = max(of.pictures.values.shape[1], of.pictures.values.shape[2]) // 3
    for turn in range(rounds):
        for at in range(len(todo)):
            n = todo[at] if turn % 2 == 0 else todo[len(todo) - 1 - at]
            now = NONE
            if match.picture[n] >= 0:
                where = match.row[n], match.column[n], match.angle[n]
                now = misfit(n, match.planar[n], match.picture[n], *where, NONE, of)
            match.misfit[n] = now
            _propagated(match, n, of)
            _nearby(match, n, span, of, state)
            for _ in range(tries):
                _anywhere(match, n, of, choice, state)
