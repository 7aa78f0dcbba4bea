"""Kernels that turn matches into pictures: votes of overlapping patches, sampling, and gradients."""

from __future__ import annotations

import math

import numpy as np

from reffusion.inpaint.patchmatch.matches import PATCH_RADIUS, match_transform, patch_transform
from reffusion.kernels.compiled import inlined, kernel


@inlined
def _cubic(t):
    t = abs(t)
    if t < 1:
        return 1.5 * t * t * t - 2.5 * t * t + 1
    return -0.5 * t * t * t + 2.5 * t * t - 4 * t + 2 if t < 2 else 0.0


@kernel
def sample_cubic(values, source, y, x, c):
    """Channel c of a source at (y, x), bicubic, clamped to the range of the four pixels around."""
    height, width = values.shape[1:3]
    i, j = math.floor(y), math.floor(x)
    total, low, high = 0.0, 1e9, -1e9
    for dy in range(-1, 3):
        for dx in range(-1, 3):
            value = values[source, min(max(i + dy, 0), height - 1), min(max(j + dx, 0), width - 1), c]
            total += _cubic(y - i - dy) * _cubic(x - j - dx) * value
            if 0 <= dy <= 1 and 0 <= dx <= 1:
                low, high = min(low, value), max(high, value)
    return min(max(total, low), high)


@kernel
def vote(todo, matches, hole, trust, sources, spread, voted):
    """Writes the weighted mean of all patches that cover a pixel into `voted` [H, W, C], at the pixels `todo`.

    Args:
        todo: [T] indices of pixels of the hole.
        trust: [H, W] float32, weight of the patches by their middles.
        spread: misfit over which a patch's weight falls by a factor of e.
    """
    height, width, channels = voted.shape
    total = np.empty(channels)
    for n in todo:
        total[:], mass = 0.0, 0.0
        for dy in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
            for dx in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
                row, column = hole.row[n] + dy, hole.column[n] + dx
                if row < 0 or column < 0 or row >= height or column >= width:
                    continue
                m = hole.index[row, column]
                if m < 0 or matches.source[m] < 0:
                    continue
                w = trust[row, column] * math.exp(-matches.misfit[m] / spread) + 1e-9
                _, xx, xy, yx, yy = match_transform(hole, m, sources, matches)
                y, x = matches.row[m] - yx * dx - yy * dy, matches.column[m] - xx * dx - xy * dy
                for c in range(channels):
                    total[c] += w * sample_cubic(sources.values, matches.source[m], y, x, c)
                mass += w
        if mass > 0:
            voted[hole.row[n], hole.column[n]] = total / mass


@kernel
def upsample_matches(matches, coarse_row, coarse_column, hole, sources):
    """Moves matches of a coarser level to this level, in place.

    Args:
        matches: N of them, whose rows and columns are those of the coarser level.
        coarse_row, coarse_column: [N] int64, the coarser pixel that each was copied from.
    """
    height, width = sources.plane.shape[1:]
    for n in range(len(hole.row)):
        y, x = 2 * matches.row[n] + np.float32(0.5), 2 * matches.column[n] + np.float32(0.5)
        row, column = min(max(int(y), 0), height - 1), min(max(int(x), 0), width - 1)
        _, xx, xy, yx, yy = patch_transform(
            hole, n, sources, matches.along_plane[n], matches.source[n], row, column, matches.angle[n]
        )
        dy, dx = hole.row[n] - (2 * coarse_row[n] + 0.5), hole.column[n] - (2 * coarse_column[n] + 0.5)
        matches.row[n], matches.column[n] = y + yx * dx + yy * dy, x + xx * dx + xy * dy


@kernel
def gather_gradients(matches, hole, sources, right, below, count_right, count_below, own):
    """Adds up the colour gradients of the matched patches, and samples their middles.

    Args:
        right, below: [H, W, 3] float32 zeros, to which each hole pixel of a pair adds its patch's change of colour to
            the next pixel.
        count_right, count_below: [H, W] float32 zeros, to which the number of these is added.
        own: [H, W, 3] float32, gets the colours at the patches' middles.
    """
    height, width = own.shape[:2]
    for n in range(len(hole.row)):
        if matches.source[n] < 0:
            continue
        row, column = hole.row[n], hole.column[n]
        _, xx, xy, yx, yy = match_transform(hole, n, sources, matches)
        y, x, source = matches.row[n], matches.column[n], matches.source[n]
        for c in range(3):
            here = sample_cubic(sources.values, source, y, x, c)
            own[row, column, c] = here
            if column + 1 < width:
                right[row, column, c] += sample_cubic(sources.values, source, y + yx, x + xx, c) - here
            if column > 0:
                right[row, column - 1, c] += here - sample_cubic(sources.values, source, y - yx, x - xx, c)
            if row + 1 < height:
                below[row, column, c] += sample_cubic(sources.values, source, y + yy, x + xy, c) - here
            if row > 0:
                below[row - 1, column, c] += here - sample_cubic(sources.values, source, y - yy, x - xy, c)
        count_right[row, max(column - 1, 0) : column + 1] += 1
        count_below[max(row - 1, 0) : row + 1, column] += 1
