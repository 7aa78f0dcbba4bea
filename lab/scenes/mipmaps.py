"""Textures with all their mip levels, and the color of a face at a point."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lab.scenes.compiled import kernel


class Textures(NamedTuple):
    """K square tileable textures with all their mip levels, in one array of texels.

    Level 0 is the full texture; each further level has half the side, at least 1 px. All textures have the same number
    of levels.

    Attributes:
        texels: [total, 3] uint8 sRGB, all levels of all textures.
        start: [K, levels] index in `texels` of the first texel of each level.
        side: [K] pixels along a side at level 0.
        mean: [K, 3] mean color, linear.
        linear: [256] linear intensity of each sRGB byte.
    """

    texels: np.ndarray
    start: np.ndarray
    side: np.ndarray
    mean: np.ndarray
    linear: np.ndarray


def build_mipmaps(pictures: dict[str, np.ndarray]) -> tuple[Textures, dict[str, int]]:
    """Build the mip levels of all textures, averaged in linear light.

    Args:
        pictures: name -> [N, N, 3] sRGB, N a power of two; values outside [0, 1] are clipped.

    Returns:
        The textures in the order of `pictures`, and {name: index of the texture}.
    """
    linear = (np.arange(256) / 255.0) ** 2.2
    levels = max(int(np.log2(p.shape[0])) for p in pictures.values()) + 1
    texels, start, side, mean, total = [], [], [], [], 0
    for p in pictures.values():
        level = np.clip(p, 0, 1).astype(np.float32) ** 2.2
        starts = []
        side.append(p.shape[0])
        mean.append(level.mean((0, 1)))
        for _ in range(levels):
            starts.append(total)
            texels.append(np.round(level ** (1 / 2.2) * 255).astype(np.uint8).reshape(-1, 3))
            total += len(texels[-1])
            if level.shape[0] > 1:
                level = 0.25 * (level[::2, ::2] + level[1::2, ::2] + level[::2, 1::2] + level[1::2, 1::2])
        start.append(starts)
    arrays = Textures(np.concatenate(texels), np.array(start), np.array(side), np.array(mean, np.float64), linear)
    return arrays, {name: k for k, name in enumerate(pictures)}


@kernel()
def _texel(textures, k, level, a, b, out, weight):
    """Add `weight` times a bilinear sample of mip `level` of texture k, at (a, b) in tiles, to `out` [3] (linear)."""
    side = max(textures.side[k] >> level, 1)
    x, y = (a - math.floor(a)) * side - 0.5, (b - math.floor(b)) * side - 0.5
    i, j = math.floor(x), math.floor(y)
    fx, fy = x - i, y - j
    start = textures.start[k, level]
    for dj in range(2):
        row = start + ((j + dj) & (side - 1)) * side
        wy = weight * (fy if dj else 1.0 - fy)
        for di in range(2):
            n = row + ((i + di) & (side - 1))
            w = wy * (fx if di else 1.0 - fx)
            for ch in range(3):
                out[ch] += w * textures.linear[textures.texels[n, ch]]


@kernel()
def albedo(faces, textures, face, u, v, footprint, out):
    """Write the linear color of a face at the point (u, v) to `out` [3], averaged over about `footprint` metres.

    The color is that of the texture times the face's tint, without light. u and v are metres on the face. The two mip
    levels around the footprint are interpolated.
    """
    if faces.swap[face]:
        u, v = v, u
    k = faces.texture[face]
    su, sv = faces.mapping[face, 0], faces.mapping[face, 1]
    level = math.log2(max(footprint * max(su, sv) * textures.side[k], 1.0))
    last = textures.start.shape[1] - 1
    low = min(int(level), last)
    rest = min(level - low, 1.0) if low < last else 0.0
    out[:] = 0.0
    a, b = u * su + faces.mapping[face, 2], v * sv + faces.mapping[face, 3]
    _texel(textures, k, low, a, b, out, 1.0 - rest)
    if rest > 0.0:
        _texel(textures, k, low + 1, a, b, out, rest)
    for ch in range(3):
        out[ch] *= faces.tint[face, ch]
