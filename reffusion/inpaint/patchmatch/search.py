"""Compiled kernels of the patch search (PatchMatch): for each pixel of a hole, the most similar patch of the sources.

Patches are compared on their surface. On a plane the perspective of source and target is taken into account, and the
patch may be turned in the plane, so that planks continue in their own perspective. Elsewhere a patch is only shifted,
and scaled by its distance.
"""

from __future__ import annotations

import math

import numpy as np

from reffusion.inpaint.patchmatch.matches import (
    MAX_SCALE,
    MAX_TURN,
    MIN_SCALE,
    NO_MATCH,
    PATCH_RADIUS,
    match_transform,
    patch_transform,
)
from reffusion.kernels.compiled import FREE_ROUNDING, inlined, kernel

OTHER_SURFACE_PENALTY = 1.5  # factor on the misfit of a patch from another surface, or much nearer or farther away
MUCH_NEARER = 1.25  # scale above which a patch's surface is so near that other views would have seen it in the hole
FOREIGN_PENALTY = 4.0  # further factor on the misfit of such a patch, and of a patch from a different plane


@inlined
def _random(state):
    """Draw a random number in [0, 1), float32, by xorshift64, and advance `state`, [1] uint64."""
    x = state[0]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    state[0] = x
    return np.float32((x >> np.uint64(40)) / np.float64(1 << 24))


@inlined
def _penalty(hole, n, plane, size):
    """Return the misfit factor at pixel n of a patch on `plane` (0: none) whose pixels have world length `size`."""
    ratio, same = hole.pixel_size[n] / size, plane == hole.plane[n]
    penalty = np.float32(1) if same and MIN_SCALE < ratio < MAX_SCALE else np.float32(OTHER_SURFACE_PENALTY)
    foreign = ratio > MUCH_NEARER or (not same and plane > 0 and hole.plane[n] > 0)
    return penalty * np.float32(FOREIGN_PENALTY) if foreign else penalty


def misfit(n, along_plane, source, y, x, angle, limit, level):
    """Compute how badly a patch of a source fits the patch around a pixel of the hole.

    Args:
        n: index of the pixel of the hole.
        along_plane: whether the patch follows the perspective of the pixel's plane.
        source, y, x: index of the source image, and row and column of the patch's center.
        angle: radians by which the patch is turned in its plane.
        limit: the largest misfit of interest, for example that of the present patch.
        level: `PyramidLevel`.

    Returns:
        The squared Euclidean difference of the features, as a weighted mean over the patch's pixels, times the penalty
        for another surface. `NO_MATCH` if the pixel must not take this patch, or if the misfit exceeds `limit`.
    """
    hole, sources = level.hole, level.sources
    row, column = math.floor(y + 0.5), math.floor(x + 0.5)
    height, width, channels = sources.values.shape[1:]
    if row < 0 or column < 0 or row >= height or column >= width:
        return NO_MATCH
    plane = sources.plane[source, row, column]
    if plane < 0 or (along_plane and plane != hole.plane[n]):
        return NO_MATCH
    if hole.along_plane[n] and not along_plane and plane == hole.plane[n]:  # a shift would keep a wrong perspective
        return NO_MATCH
    ok, xx, xy, yx, yy = patch_transform(hole, n, sources, along_plane, source, row, column, angle)
    if not ok:
        return NO_MATCH
    middle_row, middle_column = hole.row[n], hole.column[n]
    top, bottom = max(-PATCH_RADIUS, -middle_row), min(PATCH_RADIUS, level.current.shape[0] - 1 - middle_row)
    left, right = max(-PATCH_RADIUS, -middle_column), min(PATCH_RADIUS, level.current.shape[1] - 1 - middle_column)
    total, mass = np.float32(0), np.float32(1e-6)
    for dy in range(top, bottom + 1):
        for dx in range(left, right + 1):
            mass += level.weight[middle_row + dy, middle_column + dx]
    penalty = _penalty(hole, n, plane, sources.pixel_size[source, row, column])
    most = limit * mass / penalty
    for dy in range(top, bottom + 1):
        for dx in range(left, right + 1):
            w = level.weight[middle_row + dy, middle_column + dx]
            if w <= 0:
                continue
            source_x, source_y = x + xx * dx + xy * dy, y + yx * dx + yy * dy
            j, i = math.floor(source_x), math.floor(source_y)
            if j < 0 or i < 0 or j >= width - 1 or i >= height - 1:
                return NO_MATCH
            u, v = source_x - j, source_y - i
            error = np.float32(0)
            for c in range(channels):
                above = sources.values[source, i, j, c] * (1 - u) + sources.values[source, i, j + 1, c] * u
                below = sources.values[source, i + 1, j, c] * (1 - u) + sources.values[source, i + 1, j + 1, c] * u
                off = above * (1 - v) + below * v - level.current[middle_row + dy, middle_column + dx, c]
                error += off * off
            total += w * error
        if total > most:
            return NO_MATCH
    return penalty * total / mass


misfit = kernel(misfit, FREE_ROUNDING)


@inlined
def _try_match(matches, n, along_plane, source, y, x, angle, level):
    """Give pixel n the patch if this patch fits better than the present one; arguments as of `misfit`."""
    # as `matches` stores them; besides, the kernel is compiled for one type only
    y, x, angle = np.float32(y), np.float32(x), np.float32(angle)
    value = misfit(n, along_plane, source, y, x, angle, matches.misfit[n], level)
    if value < matches.misfit[n]:
        matches.source[n], matches.row[n], matches.column[n] = source, y, x
        matches.angle[n], matches.along_plane[n], matches.misfit[n] = angle, along_plane, value


@inlined
def _propagate(matches, n, level):
    """Try for pixel n the patches of its four neighbors in the hole, moved by one pixel."""
    hole, (height, width) = level.hole, level.current.shape[:2]
    for side in range(4):
        dy, dx = (-1, 1, 0, 0)[side], (0, 0, -1, 1)[side]
        row, column = hole.row[n] + dy, hole.column[n] + dx
        if row < 0 or column < 0 or row >= height or column >= width:
            continue
        m = hole.index[row, column]
        if m < 0 or matches.source[m] < 0 or (matches.along_plane[m] and hole.plane[m] != hole.plane[n]):
            continue
        _, xx, xy, yx, yy = match_transform(hole, m, level.sources, matches)
        y, x = matches.row[m] - yx * dx - yy * dy, matches.column[m] - xx * dx - xy * dy
        _try_match(matches, n, matches.along_plane[m], matches.source[m], y, x, matches.angle[m], level)


@inlined
def _search_nearby(matches, n, span, level, state):
    """Try for pixel n random places near its present patch, first within `span` pixels, then half as far each time."""
    while span >= 1 and matches.source[n] >= 0:
        y = matches.row[n] + (2 * _random(state) - 1) * span
        x = matches.column[n] + (2 * _random(state) - 1) * span
        angle = matches.angle[n]
        if matches.along_plane[n]:
            angle += (2 * _random(state) - 1) * MAX_TURN * min(1.0, span / 16)
            angle = min(max(angle, -MAX_TURN), MAX_TURN)
        else:
            y, x = math.floor(y + 0.5), math.floor(x + 0.5)
        _try_match(matches, n, matches.along_plane[n], matches.source[n], y, x, angle, level)
        span //= 2


@inlined
def _search_anywhere(matches, n, level, positions, state):
    """Try for pixel n one random place in the sources, half of the time on its plane if patches may follow it."""
    along_plane = level.hole.along_plane[n] and _random(state) < 0.5
    plane = level.hole.plane[n] if along_plane else 0
    first, count = positions.starts[plane], positions.starts[plane + 1] - positions.starts[plane]
    if count > 0:
        place = positions.places[first + min(int(_random(state) * count), count - 1)]
        angle = (2 * _random(state) - 1) * MAX_TURN if along_plane else np.float32(0)
        _try_match(matches, n, along_plane, place[0], place[1], place[2], angle, level)


@kernel
def search(todo, rounds, tries, matches, level, positions, state):
    """Improve the matches of pixels of the hole, in place.

    The misfit of a pixel's present patch is computed anew. Then the patches of its neighbors, random places near its
    present patch, and `tries` random places anywhere are tried, and the best one is kept.

    Args:
        todo: [T], indices of the pixels, in row-major order; every second round goes backwards.
        rounds: number of passes over the pixels.
        tries: number of random places anywhere, per pixel and round.
        matches: `Matches`, changed in place.
        level: `PyramidLevel`.
        positions: `Positions`, the places from which random places are drawn.
        state: [1] uint64, state of the random numbers, changed in place.
    """
    span = max(level.sources.values.shape[1], level.sources.values.shape[2]) // 3
    for turn in range(rounds):
        for at in range(len(todo)):
            n = todo[at] if turn % 2 == 0 else todo[len(todo) - 1 - at]
            current = NO_MATCH
            if matches.source[n] >= 0:
                place = matches.row[n], matches.column[n], matches.angle[n]
                current = misfit(n, matches.along_plane[n], matches.source[n], *place, NO_MATCH, level)
            matches.misfit[n] = current
            _propagate(matches, n, level)
            _search_nearby(matches, n, span, level, state)
            for _ in range(tries):
                _search_anywhere(matches, n, level, positions, state)
