"""Components of textures: tileable noise, coordinates, color ramps.

Pictures are [N, N] or [N, N, 3] arrays of floats, float32 or float64. A *tile* is the whole picture; coordinates in
tiles run from 0 to 1. A *cell* is one of the equal parts into which a pattern divides the tile, e.g. the place of a
brick.
"""

from __future__ import annotations

import cv2
import numpy as np


def noise(rng, size, rows, columns):
    """Return smooth tileable noise [size, size] in about [-1, 1], interpolated from rows x columns random values.

    `rows` and `columns` must divide `size`; otherwise the noise is not tileable.
    """
    nodes = np.pad(rng.random((rows, columns), dtype=np.float32) * 2 - 1, 2, mode="wrap")
    high, wide = size // rows, size // columns
    big = cv2.resize(nodes, (nodes.shape[1] * wide, nodes.shape[0] * high), interpolation=cv2.INTER_CUBIC)
    return big[2 * high : 2 * high + size, 2 * wide : 2 * wide + size]


def fbm(rng, size, rows, columns, octaves=5, gain=0.55):
    """Return tileable noise [size, size] summed over several scales, with mean 0 and standard deviation 1.

    Args:
        rows: random values along y at the coarsest scale.
        columns: random values along x at the coarsest scale.
        octaves: number of scales, each twice as fine as the scale before; scales too fine for `size` are omitted.
        gain: amplitude of a scale over that of the coarser scale before.
    """
    total, weight = np.zeros((size, size), np.float32), 1.0
    rows, columns = min(rows, size // 2), min(columns, size // 2)
    for _ in range(octaves):
        if max(rows, columns) > size // 2:
            break
        total += weight * noise(rng, size, rows, columns)
        rows, columns, weight = 2 * rows, 2 * columns, weight * gain
    return (total - total.mean()) / total.std()


def grid(size):
    """Return the coordinates (x, y) of the pixel centers, [size, size] each, in (0, 1)."""
    line = (np.arange(size, dtype=np.float32) + 0.5) / size
    return np.meshgrid(line, line)


def step(edge0, edge1, x):
    """Return a smooth step from 0 at x = edge0 to 1 at x = edge1; a falling one if edge0 > edge1."""
    t = np.clip((x - edge0) / (edge1 - edge0), 0, 1)
    return t * t * (3 - 2 * t)


def ramp(t, *colors):
    """Return colors [N, N, 3] in [0, 1], interpolated along a palette at t [N, N].

    Args:
        t: place in the palette: 0 is its first color, 1 its last; values outside [0, 1] get these colors.
        colors: the palette, evenly spaced colors in bytes.
    """
    palette = np.asarray(colors, np.float32) / 255
    return np.stack([np.interp(t, np.linspace(0, 1, len(palette)), palette[:, c]) for c in range(3)], -1)


def blend(a, b, t):
    """Return the mixture of two colors or pictures [N, N, 3]: a where t [N, N] is 0, b where t is 1."""
    return a + (b - a) * t[..., None]


def shift(image, x, y):
    """Return the values [N, N] of a tileable picture [N, N] at the coordinates (x, y), by bilinear interpolation.

    Args:
        x: [N, N] horizontal coordinates in tiles; any number, as the picture repeats.
        y: [N, N] vertical coordinates, likewise.
    """
    size = np.float32(image.shape[0])
    return cv2.remap(
        image,
        (x % 1).astype(np.float32) * size - 0.5,
        (y % 1).astype(np.float32) * size - 0.5,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )


def srgb(color):
    """Return a color [3] in [0, 1] as float32 from a color in bytes."""
    return np.asarray(color, np.float32) / 255


def cell(t):
    """Return the cell of each coordinate t, in units of cells: (floor(t) as int, position t - floor(t) in the cell)."""
    number = np.floor(t).astype(int)
    return number, t - number


def rim(t):
    """Return the distance of a position t within a unit cell, in [0, 1), to the nearer end of the cell."""
    return np.minimum(t, 1 - t)


def random_per_cell(rng, rows, columns, row, column):
    """Draw three random values in [0, 1) for each cell of a pattern, and return them as three pictures.

    Args:
        rows: number of cells along y.
        columns: number of cells along x.
        row: [N, N] index of the cell's row at each pixel.
        column: [N, N] index of the cell's column at each pixel.
    """
    return tuple(rng.random((rows, columns)).astype(np.float32)[row, column] for _ in range(3))
