"""Textures of procedural surfaces: brick, planks, tiles, stripes, fabric, dots, plaster, and the noise in them."""

from __future__ import annotations

import colorsys
from collections.abc import Callable

import cv2
import numpy as np

Field = np.ndarray  # [H, W] float32
Texture = Callable[[Field, Field], np.ndarray]  # surface coordinates in texels -> [H, W, 3] in [0, 1]


# ---------------------------------------------------------------------------------------------- noise and color


def noise_tile(rng: np.random.Generator, slope: float, stretch: float = 1.0, size: int = 256) -> Field:
    """Draw a periodic random field with power falling as frequency^-slope, deviation 1, longer along x by `stretch`."""
    fy, fx = np.meshgrid(np.fft.fftfreq(size) * size, np.fft.rfftfreq(size) * size, indexing="ij")
    frequency = np.sqrt((fx * stretch) ** 2 + fy**2)
    amplitude = np.where(frequency > 0, np.maximum(frequency, 1) ** (-slope / 2), 0)
    phase = np.exp(2j * np.pi * rng.random(frequency.shape))
    field = np.fft.irfft2(amplitude * phase * rng.rayleigh(1.0, frequency.shape), s=(size, size))
    return (field / field.std()).astype(np.float32)


def sample(tile: Field, u: Field, v: Field, scale: float) -> Field:
    """Return the periodic `tile` at surface coordinates (u, v), `scale` tile texels per surface texel."""
    n = tile.shape[0]
    x, y = np.mod(u * scale, n).astype(np.float32), np.mod(v * scale, n).astype(np.float32)
    return cv2.remap(tile, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def color(rng: np.random.Generator, saturation: float = 0.6) -> np.ndarray:
    """One random color [3], muted more often than vivid."""
    hue = rng.random() if rng.random() < 0.5 else rng.normal(0.08, 0.05) % 1
    return np.array(colorsys.hsv_to_rgb(hue, saturation * rng.random() ** 1.5, rng.uniform(0.15, 0.95)), np.float32)


def shades(rng: np.random.Generator, count: int, spread: float = 0.12) -> np.ndarray:
    """[count, 3] variations of one random color."""
    return np.clip(color(rng) + rng.normal(0, spread, (count, 1)) + rng.normal(0, spread / 4, (count, 3)), 0, 1)


def per_cell(rng: np.random.Generator, columns: Field, rows: Field, spread: float) -> Field:
    """One random number per integer cell, repeated over its pixels."""
    table = rng.normal(0, spread, 4096).astype(np.float32)
    return table[(columns.astype(np.int64) * 73 + rows.astype(np.int64) * 179) % 4096]


def blend(low: np.ndarray, high: np.ndarray, weight: Field) -> np.ndarray:
    return low + (high - low) * np.clip(weight, 0, 1)[..., None]


# ---------------------------------------------------------------------------------------------- surface patterns


def bricks(rng: np.random.Generator) -> Texture:
    width, height = rng.uniform(14, 40), rng.uniform(6, 16)
    gap, shift = rng.uniform(0.8, 2.5), rng.choice([0.5, 0.33, 0.0])
    body, mortar, spread = color(rng), color(rng, 0.2), rng.uniform(0.02, 0.12)
    grain, cells = noise_tile(rng, rng.uniform(0.5, 2)), np.random.default_rng(rng.integers(2**32))

    def texture(u: Field, v: Field) -> np.ndarray:
        row = np.floor(v / height)
        x = u / width + row * shift
        column = np.floor(x)
        edge = np.minimum(
            np.minimum(x - column, 1 - x + column) * width, np.minimum(v - row * height, (row + 1) * height - v)
        )
        tone = per_cell(cells, column, row, spread)[..., None] + 0.06 * sample(grain, u, v, 1.0)[..., None]
        return blend(mortar + 0.03 * sample(grain, v, u, 1.0)[..., None], body + tone, edge - gap / 2 + 0.5)

    return texture


def planks(rng: np.random.Generator) -> Texture:
    width, length = rng.uniform(7, 24), rng.uniform(60, 220)
    body, spread, contrast = color(rng), rng.uniform(0.02, 0.09), rng.uniform(0.04, 0.14)
    grain = noise_tile(rng, rng.uniform(0.6, 1.6), stretch=rng.uniform(6, 20))
    rings, cells = noise_tile(rng, 2.5, stretch=4.0), np.random.default_rng(rng.integers(2**32))
    seam = body * rng.uniform(0.2, 0.6)

    def texture(u: Field, v: Field) -> np.ndarray:
        row = np.floor(v / width)
        x = u / length + np.mod(row * 0.618, 1.0)
        column = np.floor(x)
        edge = np.minimum(
            np.minimum(v - row * width, (row + 1) * width - v), np.minimum(x - column, 1 - x + column) * length
        )
        lift = per_cell(cells, column, row, spread)
        offset = per_cell(cells, row, column, 80.0)
        fibre = sample(grain, u + offset, v + offset, 1.0) + 0.8 * np.sin(4 * sample(rings, u + offset, v, 0.5))
        return blend(seam, body + (lift + contrast * 0.5 * fibre)[..., None], edge + 0.3)

    return texture


def tiles(rng: np.random.Generator) -> Texture:
    side, gap = rng.uniform(8, 36), rng.uniform(0.6, 2.2)
    pair, grout = shades(rng, 2, rng.uniform(0.0, 0.25)), color(rng, 0.2)
    stone, cells = noise_tile(rng, rng.uniform(1, 2.5)), np.random.default_rng(rng.integers(2**32))
    spread, depth = rng.uniform(0, 0.06), rng.uniform(0.01, 0.08)

    def texture(u: Field, v: Field) -> np.ndarray:
        column, row = np.floor(u / side), np.floor(v / side)
        edge = np.minimum(
            np.minimum(u - column * side, (column + 1) * side - u), np.minimum(v - row * side, (row + 1) * side - v)
        )
        body = np.where(np.mod(column + row, 2)[..., None] > 0, pair[0], pair[1])
        tone = per_cell(cells, column, row, spread) + depth * sample(stone, u, v, 1.0)
        return blend(grout, body + tone[..., None], edge - gap / 2 + 0.5)

    return texture


def stripes(rng: np.random.Generator) -> Texture:
    period, duty, angle = rng.uniform(4, 30), rng.uniform(0.2, 0.8), rng.choice([0.0, np.pi / 2, rng.uniform(0, np.pi)])
    first, second, wobble = color(rng), color(rng), rng.choice([0.0, rng.uniform(0.5, 4)])
    bend, grain, soft = noise_tile(rng, 3), noise_tile(rng, 1), rng.uniform(0.5, 4)

    def texture(u: Field, v: Field) -> np.ndarray:
        x = u * np.cos(angle) + v * np.sin(angle) + wobble * sample(bend, u, v, 1.0)
        inside = (duty / 2 - np.abs(np.mod(x / period, 1) - 0.5)) * period / soft + 0.5
        return blend(first, second, inside) + 0.03 * sample(grain, u, v, 1.0)[..., None]

    return texture


def weave(rng: np.random.Generator) -> Texture:
    period, body = rng.uniform(3, 9), shades(rng, 2, 0.15)
    warp, cells = noise_tile(rng, 1.5), np.random.default_rng(rng.integers(2**32))

    def texture(u: Field, v: Field) -> np.ndarray:
        column, row = np.floor(u / period), np.floor(v / period)
        over = np.mod(column + row, 2) > 0
        across = np.where(over, u / period - column, v / period - row)
        light = np.sin(np.pi * across) * 0.25 + per_cell(cells, np.where(over, column, 0), np.where(over, 0, row), 0.05)
        return np.where(over[..., None], body[0], body[1]) - 0.15 + (light + 0.04 * sample(warp, u, v, 1.0))[..., None]

    return texture


def dots(rng: np.random.Generator) -> Texture:
    period, radius = rng.uniform(8, 28), rng.uniform(0.15, 0.42)
    ground, ink, grain = color(rng), color(rng, 0.9), noise_tile(rng, 1.5)
    squared = rng.random() < 0.4

    def texture(u: Field, v: Field) -> np.ndarray:
        row = np.floor(v / period)
        x, y = np.mod(u / period + 0.5 * np.mod(row, 2), 1) - 0.5, np.mod(v / period, 1) - 0.5
        distance = np.maximum(np.abs(x), np.abs(y)) if squared else np.hypot(x, y)
        return blend(ground, ink, (radius - distance) * period + 0.5) + 0.03 * sample(grain, u, v, 1.0)[..., None]

    return texture


def cloudy(rng: np.random.Generator) -> Texture:
    """Plaster, concrete, earth, marble, leaves: noise of a random slope through a random curve."""
    base, vein, fine = (
        noise_tile(rng, rng.uniform(0.8, 3.2)),
        noise_tile(rng, 2.6),
        noise_tile(rng, rng.uniform(0, 1.2)),
    )
    palette, style = shades(rng, 3, rng.uniform(0.05, 0.25)), rng.integers(3)
    frequency, rough, cut = rng.uniform(0.03, 0.2), rng.uniform(0.01, 0.08), rng.uniform(-0.8, 0.8)

    def texture(u: Field, v: Field) -> np.ndarray:
        field = sample(base, u, v, 1.0)
        if style == 0:
            weight = 0.5 + 0.35 * field
        elif style == 1:
            weight = 0.5 + 0.5 * np.sin(frequency * (u + 0.4 * v) + 3 * sample(vein, u, v, 1.0))
        else:
            weight = (field - cut) * 3 + 0.5
        body = blend(palette[0], palette[1], weight)
        return blend(body, palette[2], 0.3 * sample(vein, v, u, 1.0)) + rough * sample(fine, u, v, 1.0)[..., None]

    return texture


PATTERNS = {
    "brick": bricks,
    "planks": planks,
    "tiles": tiles,
    "stripes": stripes,
    "fabric": weave,
    "dots": dots,
    "plaster": cloudy,
}


def random_texture(rng: np.random.Generator) -> tuple[Texture, str]:
    """Return a pattern at a random turn and size, and its name."""
    name = str(rng.choice(list(PATTERNS), p=[0.16, 0.2, 0.14, 0.12, 0.08, 0.08, 0.22]))
    pattern = PATTERNS[name](rng)
    angle, scale = (
        (rng.normal(0, 0.05) if rng.random() < 0.6 else rng.uniform(0, np.pi)),
        np.exp(rng.uniform(-0.4, 0.6)),
    )
    shift = rng.uniform(0, 1000, 2)

    def texture(u: Field, v: Field) -> np.ndarray:
        c, s = np.cos(angle) / scale, np.sin(angle) / scale
        return pattern((u * c - v * s + shift[0]).astype(np.float32), (u * s + v * c + shift[1]).astype(np.float32))

    return texture, name
