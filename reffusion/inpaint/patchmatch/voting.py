"""Kernels that show what the patches of a hole's pixels say."""

from __future__ import annotations

import math

import numpy as np

from reffusion.inpaint.patchmatch.matches import PATCH, carried, carried_match
from reffusion.kernels.compiled import inlined, kernel


@inlined
def _cubic(t):
    t = abs(t)
    if t < 1:
        return 1.5 * t * t * t - 2.5 * t * t + 1
    return -0.5 * t * t * t + 2.5 * t * t - 4 * t + 2 if t < 2 else 0.0


@kernel
def sampled(values, picture, y, x, c):
    """A picture's channel between pixels: cubic, within the range of the four around."""
    height, width = values.shape[1:3]
    i, j = math.floor(y), math.floor(x)
    total, low, high = 0.0, 1e9, -1e9
    for dy in range(-1, 3):
        for dx in range(-1, 3):
            value = values[picture, min(max(i + dy, 0), height - 1), min(max(j + dx, 0), width - 1), c]
            total += _cubic(y - i - dy) * _cubic(x - j - dx) * value
            if 0 <= dy <= 1 and 0 <= dx <= 1:
                low, high = min(low, value), max(high, value)
    return min(max(total, low), high)


@kernel
def vote(todo, match, hole, trust, pictures, spread, voted):
    """What the patches that cover a pixel show there, mean by weight, into `voted` [H, W, C].

    Args:
        trust: [H, W] float32, of the patches' middles. spread: misfit over which their weight falls by a factor of e.
    """
    height, width, channels = voted.shape
    total = np.empty(channels)
    for n in todo:
        total[:], mass = 0.0, 0.0
        for dy in range(-PATCH, PATCH + 1):
            for dx in range(-PATCH, PATCH + 1):
                row, column = hole.row[n] + dy, hole.column[n] + dx
                if row < 0 or column < 0 or row >= height or column >= width:
                    continue
                m = hole.index[row, column]
                if m < 0 or match.picture[m] < 0:
                    continue
                w = trust[row, column] * math.exp(-match.misfit[m] / spread) + 1e-9
                _, xx, xy, yx, yy = carried_match(hole, m, pictures, match)
                y, x = match.row[m] - yx * dx - yy * dy, match.column[m] - xx * dx - xy * dy
                for c in range(channels):
                    total[c] += w * sampled(pictures.values, match.picture[m], y, x, c)
                mass += w
        if mass > 0:
            voted[hole.row[n], hole.column[n]] = total / mass


@kernel
def carried_down(match, coarse_row, coarse_column, hole, pictures):
    """Patches of a coarser level at this one: [N] match whose rows and columns are the coarser one's, changed in place.

    Args:
        coarse_row, coarse_column: [N] int64, the coarser pixel that each was taken from.
    """
    height, width = pictures.surface.shape[1:]
    for n in range(len(hole.row)):
        y, x = 2 * match.row[n] + np.float32(0.5), 2 * match.column[n] + np.float32(0.5)
        row, column = min(max(int(y), 0), height - 1), min(max(int(x), 0), width - 1)
        _, xx, xy, yx, yy = carried(hole, n, pictures, match.planar[n], match.picture[n], row, column, match.angle[n])
        dy, dx = hole.row[n] - (2 * coarse_row[n] + 0.5), hole.column[n] - (2 * coarse_column[n] + 0.5)
        match.row[n], match.column[n] = y + yx * dx + yy * dy, x + xx * dx + xy * dy


@kernel
def steps(match, hole, pictures, right, below, count_right, count_below, own):
    """How colours change from pixel to pixel, as the patches taken say.

    Args:
        right, below: [H, W, 3] float32 zeros, to which the change to the next pixel is added by each of the two that
            lies in the hole; count_right, count_below: [H, W] float32 zeros, by how many.
        own: [H, W, 3] float32, gets the colours at the patches' middles.
    """
    height, width = own.shape[:2]
    for n in range(len(hole.row)):
        if match.picture[n] < 0:
            continue
        row, column = hole.row[n], hole.column[n]
        _, xx, xy, yx, yy = carried_match(hole, n, pictures, match)
        y, x, picture = match.row[n], match.column[n], match.picture[n]
        for c in range(3):
            here = sampled(pictures.values, picture, y, x, c)
            own[row, column, c] = here
            if column + 1 < width:
                right[row, column, c] += sampled(pictures.values, picture, y + yx, x + xx, c) - here
            if column > 0:
                right[row, column - 1, c] += here - sampled(pictures.values, picture, y - yx, x - xx, c)
            if row + 1 < height:
                below[row, column, c] += sampled(pictures.values, picture, y + yy, x + xy, c) - here
            if row > 0:
                below[row - 1, column, c] += here - sampled(pictures.values, picture, y - yy, x - xy, c)
        count_right[row, max(column - 1, 0) : column + 1] += 1
        count_below[max(row - 1, 0) : row + 1, column] += 1
