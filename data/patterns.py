"""Components of textures: tileable noise, coordinates, colour ramps. Pictures are [N, N] or [N, N, 3] float32."""

from __future__ import annotations

import cv2
import numpy as np


def noise(rng, size, rows, columns):
    """Smooth tileable noise [N, N] with rows x columns random nodes, about -1..1."""
    nodes = np.pad(rng.random((rows, columns), dtype=np.float32) * 2 - 1, 2, mode="wrap")
    high, wide = size // rows, size // columns
    big = cv2.resize(nodes, (nodes.shape[1] * wide, nodes.shape[0] * high), interpolation=cv2.INTER_CUBIC)
    return big[2 * high : 2 * high + size, 2 * wide : 2 * wide + size]


def fbm(rng, size, rows, columns, octaves=5, gain=0.55):
    """Noise at several scales, each twice as fine; zero mean, unit deviation."""
    total, weight = np.zeros((size, size), np.float32), 1.0
    rows, columns = min(rows, size // 2), min(columns, size // 2)
    for _ in range(octaves):
        if max(rows, columns) > size // 2:
            break
        total += weight * noise(rng, size, rows, columns)
        rows, columns, weight = 2 * rows, 2 * columns, weight * gain
    return (total - total.mean()) / total.std()


def grid(size):
    """(x, y) of the pixel centres in tiles, [N, N] each."""
    line = (np.arange(size, dtype=np.float32) + 0.5) / size
    return np.meshgrid(line, line)


def step(edge0, edge1, x):
    t = np.clip((x - edge0) / (edge1 - edge0), 0, 1)
    return t * t * (3 - 2 * t)


def ramp(t, *colors):
    """Colours [N, N, 3] along a palette, t in [0, 1]."""
    palette = np.asarray(colors, np.float32) / 255
    return np.stack([np.interp(t, np.linspace(0, 1, len(palette)), palette[:, c]) for c in range(3)], -1)


def blend(a, b, t):
    return a + (b - a) * t[..., None]


def shift(image, x, y):
    """A tileable picture [N, N] read at (x, y) in tiles."""
    size = np.float32(image.shape[0])
    return cv2.remap(
        image,
        (x % 1).astype(np.float32) * size - 0.5,
        (y % 1).astype(np.float32) * size - 0.5,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )


def srgb(color):
    """[3] float32 in [0, 1] of bytes."""
    return np.asarray(color, np.float32) / 255


def cell(t):
    """(number of the unit cell, place within it in [0, 1)) of a coordinate."""
    number = np.floor(t).astype(int)
    return number, t - number


def rim(t):
    """Distance to the nearer end of the unit cell."""
    return np.minimum(t, 1 - t)


def random_per_cell(rng, rows, columns, row, column):
    """Three random values in [0, 1) for each of rows x columns pieces, at the pixels of piece (row, column)."""
    return tuple(rng.random((rows, columns)).astype(np.float32)[row, column] for _ in range(3))
