"""Compiled kernels that turn matches into pictures: votes of overlapping patches, sampling, and gradients.

A match is the source patch that a pixel of the hole takes (`matches.Matches`).
"""

from __future__ import annotations

import math

import numpy as np

from reffusion.inpaint.patchmatch.matches import PATCH_RADIUS, match_transform, patch_transform
from reffusion.kernels.compiled import inlined, kernel


@inlined
def _cubic(t):
    """Return the weight of a sample at distance `t`, in px, in bicubic interpolation (Catmull-Rom)."""
    t = abs(t)
    if t < 1:
        return 1.5 * t * t * t - 2.5 * t * t + 1
    return -0.5 * t * t * t + 2.5 * t * t - 4 * t + 2 if t < 2 else 0.0


@kernel
def sample_cubic(values, source, y, x, c):
    """Return channel c of a source image at row y and column x, by bicubic interpolation.

    The value is clamped to the range of the four pixels around, so that interpolation does not overshoot.

    Args:
        values: [K, H, W, C] float32, the features of all sources.
        source: index of the source image.
        y, x: float, row and column.
        c: index of the channel.
    """
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
    """Write into `voted` the weighted mean of all patches that cover each pixel.

    Args:
        todo: [T], indices of the pixels of the hole that are computed.
        matches: `Matches`.
        hole: `Hole`.
        trust: [H, W] float32, weight of a patch, read at the pixel that takes it.
        sources: `Sources`.
        spread: misfit over which the weight of a patch falls by a factor of e.
        voted: [H, W, C] float32, changed in place. Pixels that no patch covers keep their values.
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
            for c in range(channels):
                voted[hole.row[n], hole.column[n], c] = total[c] / mass


@kernel
def upsample_matches(matches, coarse_row, coarse_column, hole, sources):
    """Convert the positions of matches from a coarser level of the pyramid to this level, in place.

    Args:
        matches: `Matches` of the N pixels of this level, copied from the coarser level, with the coarser level's rows
            and columns of patches.
        coarse_row, coarse_column: [N] int64, the pixel of the coarser level from which each match was copied.
        hole: `Hole` of this level.
        sources: `Sources` of this level.
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
    """Sum the color differences between neighboring pixels as the matched patches show them, and sample the patches.

    For each pair of neighbors, each pixel of the pair that lies in the hole adds the difference that its own patch
    shows between the two.

    Args:
        matches: `Matches`.
        hole: `Hole`.
        sources: `Sources`.
        right, below: [H, W, 3] float32, zeros at first; get the sums of the differences from each pixel to the next one
            on the right, and below.
        count_right, count_below: [H, W] float32, zeros at first; get the number of summands.
        own: [H, W, 3] float32; gets the color at the center of each pixel's patch. Pixels that no patch fills keep
            their values.
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
