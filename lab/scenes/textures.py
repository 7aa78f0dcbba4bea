"""Procedural textures: square, tileable (or fitted to one face), [N, N, 3] floats, sRGB from 0 to about 1.

Each function makes one kind of texture. Its arguments are a numpy random generator `rng` and N, called `size`, which is
a power of two. `mipmaps.build_mipmaps` clips values above 1. Arguments that are colors are in bytes. A texture *fitted
to its face* is stretched over one whole face instead of repeated.
"""

from __future__ import annotations

import cv2
import numpy as np

from lab.scenes.patterns import blend, cell, fbm, grid, noise, ramp, random_per_cell, rim, shift, srgb, step

WOODS = (
    ((96, 58, 32), (150, 98, 56), (196, 146, 94)),  # oak
    ((70, 42, 30), (112, 70, 48), (158, 108, 76)),  # walnut
    ((132, 108, 84), (176, 152, 122), (212, 192, 162)),  # limed
    ((110, 62, 38), (168, 96, 56), (206, 140, 88)),  # cherry
)


def wood_planks(rng, size, rows=24, pieces=3, palette=None):
    """Make floor boards along x, each with a tone, grain and rings of its own, and dark joints between them.

    Args:
        rows: number of rows of boards.
        pieces: number of boards per row.
        palette: colors from dark to light; None draws one of `WOODS`.
    """
    palette = WOODS[rng.integers(len(WOODS))] if palette is None else palette
    x, y = grid(size)
    row, across = cell(y * rows)
    piece, along = cell((x + rng.random(rows)[row]) % 1 * pieces)
    tone, dx, dy = random_per_cell(rng, rows, pieces, row, piece)
    warp = shift(noise(rng, size, 4, 4), x + dx, y + dy)
    grain = shift(fbm(rng, size, min(128, size // 4), 4, 4), x * 2 + dx, y + dy)
    fine = shift(fbm(rng, size, size // 4, 16, 2), x + dy, y + dx)
    rings = np.sin(6.28 * ((across - 0.5 + 0.5 * dx) * (2 + 3 * dy) + 1.1 * warp + 0.25 * grain))
    color = ramp(0.5 + 0.55 * (tone - 0.5) + 0.15 * grain + 0.09 * rings + 0.05 * fine, *palette)
    edge = np.minimum(rim(across), rim(along) * (rows / pieces))
    return color * (0.35 + 0.65 * step(0.008, 0.045, edge))[..., None]


def herringbone(rng, size, cells=32, long=4):
    """Make a herringbone floor: narrow blocks at right angles to each other, with the grain along each block.

    Args:
        cells: number of block widths along a side; the texture is tileable only for a multiple of 2 * `long`.
        long: length of a block over its width.
    """
    palette = WOODS[rng.integers(len(WOODS))]
    x, y = grid(size)
    a, b = x * cells, y * cells
    i, j = np.floor(a).astype(int), np.floor(b).astype(int)
    phase = (i - j) % (2 * long)  # position along a block that is parallel to x, then along one that is parallel to y
    flat = phase < long
    left = np.where(flat, i - phase, i)
    top = np.where(flat, j, j - (2 * long - 1 - phase))
    along, across = np.where(flat, a - left, b - top) / long, np.where(flat, b - top, a - left)
    tone, dx, dy = random_per_cell(rng, cells, cells, top % cells, left % cells)
    grain = shift(fbm(rng, size, min(128, size // 4), 8, 4), along * 0.25 + dx, across * 0.06 + dy)
    color = ramp(0.5 + 0.5 * (tone - 0.5) + 0.12 * (flat - 0.5) + 0.16 * grain, *palette)
    edge = np.minimum(rim(across), long * rim(along))
    return color * (0.35 + 0.65 * step(0.01, 0.07, edge))[..., None]


STONES = (
    ((150, 140, 126), (186, 176, 160), (214, 206, 192), (120, 112, 104)),
    ((128, 78, 58), (172, 108, 78), (198, 138, 104), (150, 140, 126)),
    ((92, 100, 108), (128, 138, 146), (166, 174, 180), (196, 192, 184)),
)


def stone_tiles(rng, size, cells=8):
    """Make cells x cells veined stone tiles with light grout."""
    *palette, grout = STONES[rng.integers(len(STONES))]
    x, y = grid(size)
    (i, fx), (j, fy) = cell(x * cells), cell(y * cells)
    tone, dx, dy = random_per_cell(rng, cells, cells, j, i)
    cloud = shift(fbm(rng, size, 8, 8, 6), x + dx, y + dy)
    vein = np.exp(-((shift(fbm(rng, size, 4, 4, 6), x + dy, y + dx) / 0.09) ** 2))
    color = ramp(0.5 + 0.5 * (tone - 0.5) + 0.17 * cloud - 0.3 * vein, *palette)
    edge = np.minimum(rim(fx), rim(fy))
    joint = srgb(grout) * (0.9 + 0.05 * fbm(rng, size, 64, 64, 3))[..., None]
    color *= (0.8 + 0.2 * step(0.02, 0.07, edge))[..., None]
    return blend(joint, color, step(0.014, 0.03, edge))


BRICKS = (
    ((112, 48, 36), (156, 76, 56), (188, 112, 84), (188, 178, 164)),
    ((196, 188, 176), (218, 210, 198), (236, 230, 220), (160, 152, 142)),
    ((92, 84, 80), (128, 116, 108), (160, 146, 134), (196, 190, 180)),
    ((150, 98, 62), (186, 132, 88), (212, 168, 122), (206, 196, 180)),
)


def bricks(rng, size, rows=24, columns=8):
    """Make a brick wall in running bond, with rounded edges lit from above left."""
    *palette, mortar = BRICKS[rng.integers(len(BRICKS))]
    x, y = grid(size)
    wobble = 0.012 * fbm(rng, size, 16, 16, 3)
    row, fy = cell(y * rows)
    column, fx = cell(x * columns + 0.5 * (row % 2))
    tone, dx, dy = random_per_cell(rng, rows, columns, row, column % columns)
    rough = shift(fbm(rng, size, 32, 32, 5), x + dx, y + dy)
    color = ramp(0.5 + 0.75 * (tone - 0.5) + 0.13 * rough + 0.06 * fbm(rng, size, 4, 4, 3), *palette)
    aspect = rows / columns
    edge = np.minimum(rim(fy), aspect * rim(fx)) + wobble
    body = step(0.07, 0.16, edge)
    height = body * (1 + 0.12 * rough)
    slope = np.roll(height, 2, 0) - np.roll(height, -2, 0) + 0.6 * (np.roll(height, 2, 1) - np.roll(height, -2, 1))
    joint = srgb(mortar) * (0.82 + 0.07 * fbm(rng, size, 128, 128, 2))[..., None]
    return blend(joint, color, body) * (1 - 0.22 * np.clip(slope, -1, 1))[..., None]


PAPERS = (
    ((38, 84, 92), (214, 196, 152), (70, 122, 126)),
    ((226, 214, 190), (150, 92, 72), (196, 170, 134)),
    ((52, 62, 98), (206, 186, 170), (90, 104, 146)),
    ((200, 208, 190), (84, 110, 86), (226, 222, 200)),
    ((150, 70, 66), (236, 212, 176), (178, 104, 92)),
)


def wallpaper(rng, size, repeats=4):
    """Make wallpaper: flowers in a half-drop repeat, each in a pointed frame with leaves, over fine stripes."""
    ground, figure, second = (srgb(c) for c in PAPERS[rng.integers(len(PAPERS))])
    x, y = grid(size)
    petals, turns = int(rng.integers(5, 8)), rng.random() * 6.28
    stripe = 0.5 + 0.5 * np.cos(6.2832 * x * repeats * 6)
    color = blend(np.broadcast_to(ground, (size, size, 3)), second, 0.25 * step(0.55, 0.8, stripe))
    u = x * repeats
    # The frames are two families of vertical waves, half a period apart, that touch each other.
    swing = 0.235 * np.cos(6.2832 * y * repeats)
    for sign in (-1, 1):
        off = np.abs((u + sign * swing + 0.25 * (1 + sign)) % 1 - 0.5)
        color = blend(color, second, step(0.022, 0.012, np.abs(off - 0.02)))
    for offset in (0.0, 0.5):
        a, b = (u + offset) % 1 - 0.5, (y * repeats + offset) % 1 - 0.5
        radius, angle = np.hypot(a, b), np.arctan2(b, a)
        for tilt in (0.6, np.pi - 0.6):
            p, q = a * np.cos(tilt) + b * np.sin(tilt), b * np.cos(tilt) - a * np.sin(tilt)
            leaf = np.abs(q) - 0.35 * (0.3 - np.abs(p)) * np.sqrt(np.abs(p) / 0.3)
            color = blend(color, second, step(0.006, -0.006, leaf) * step(0.0, 0.006, np.abs(q) + 0.004))
        flower = 0.16 + 0.045 * np.cos(petals * angle + turns)
        color = blend(color, figure, step(0.010, -0.010, radius - flower))
        color = blend(color, ground, step(0.008, -0.008, np.abs(radius - 0.075) - 0.007))
        color = blend(color, second, step(0.008, -0.008, radius - 0.045))
    paper = 1 + 0.035 * fbm(rng, size, 32, 32, 5) + 0.03 * fbm(rng, size, 4, 4, 3)
    return color * paper[..., None]


def plaster(rng, size, color=(214, 208, 198)):
    """Make painted plaster with cloudy variations, trowel marks and grain."""
    rough = 0.022 * fbm(rng, size, 4, 4, 4) + 0.02 * fbm(rng, size, 64, 16, 4) + 0.018 * fbm(rng, size, 128, 128, 2)
    return srgb(color) * (1 + rough)[..., None]


def rug(rng, size):
    """Make a woven carpet with a border and diamonds, fitted to its face."""
    hues = [srgb(c) for c in ((116, 34, 42), (28, 52, 84), (220, 196, 150), (194, 128, 60))]
    rng.shuffle(hues)
    x, y = grid(size)
    a, b = (x * 6) % 1 - 0.5, (y * 4) % 1 - 0.5
    diamond = np.abs(a) + np.abs(b)
    color = np.broadcast_to(hues[0], (size, size, 3)).copy()
    for level, hue in ((0.44, 1), (0.36, 2), (0.28, 0), (0.2, 3), (0.1, 1)):
        color = blend(color, hues[hue], step(0.01, -0.01, diamond - level))
    edge = np.minimum(rim(x) * 1.5, rim(y))
    zigzag = np.abs(((x + y * 0.667) * 24) % 1 - 0.5) * 2
    border = blend(np.broadcast_to(hues[1], color.shape), hues[2], step(0.45, 0.55, zigzag))
    color = blend(border, color, step(0.098, 0.102, edge))
    for level, hue in ((0.1, 3), (0.022, 0)):
        color = blend(color, hues[hue], step(0.012, 0.008, np.abs(edge - level)))
    weave = 1 + 0.08 * np.sin(x * 6.2832 * 96) * np.sin(y * 6.2832 * 64) + 0.05 * fbm(rng, size, 64, 64, 3)
    return color * weave[..., None]


def books(rng, size, thick=1.0):
    """Make a row of book spines, fitted to its face; `thick` is a factor on the width of the spines."""
    color = np.full((size, size, 3), 0.05, np.float32)
    x = 0
    while x < size:
        width = int(size * thick * rng.uniform(0.03, 0.075))
        top = int(size * rng.uniform(0.02, 0.28))
        hsv = (rng.normal(20, 45) + rng.choice((0, 0, 180))) % 360, rng.uniform(0.15, 0.6), rng.uniform(0.25, 0.8)
        hue = cv2.cvtColor(np.float32([[hsv]]), cv2.COLOR_HSV2RGB)[0, 0]
        end = min(x + width, size)
        shade = 0.45 + 0.55 * np.sin(np.linspace(0.25, 2.9, end - x))[:, None]
        color[top:, x:end] = hue * shade
        for band in rng.uniform(0.1, 0.9, rng.integers(2, 5)):
            row = int(top + band * (size - top))
            light = np.float32([0.86, 0.78, 0.55]) if hue.mean() < 0.55 else hue * 0.4
            color[row : row + max(size // 60, 2), x:end] = light * shade
        x = end + max(size // 200, 1)
    return np.clip(color * (1 + 0.06 * fbm(rng, size, 64, 64, 3))[..., None], 0, 1)


def picture(rng, size):
    """Make a framed landscape with sky, sun and ranges of hills, fitted to its face."""
    x, y = grid(size)
    hue = rng.uniform(0, 60)
    sky = ramp(y, (60 + hue, 110, 170), (236, 190 - hue, 140), (250, 220, 170))
    sun = np.hypot((x - rng.uniform(0.25, 0.75)), y - rng.uniform(0.25, 0.45))
    color = blend(sky, np.float32([1.0, 0.93, 0.75]), step(0.085, 0.075, sun))
    for k in range(5):
        ridge = 0.42 + 0.1 * k + (0.09 - 0.01 * k) * fbm(rng, size, 4, 4, 5)[size // 3][None, :]
        far = srgb((60 + hue - 12 * k, 112 - 14 * k, 120 - 20 * k))
        textured = far * (1 + 0.1 * fbm(rng, size, 32, 32, 4))[..., None]
        color = blend(color, textured, step(-0.004, 0.004, y - ridge))
    edge = np.minimum(rim(x), rim(y))
    color = blend(np.broadcast_to(np.float32([0.93, 0.91, 0.86]), color.shape), color, step(0.158, 0.162, edge))
    frame = np.float32([0.24, 0.15, 0.09]) * (1 + 0.2 * fbm(rng, size, 64, 8, 3))[..., None]
    frame = frame * (0.7 + 0.6 * np.sin(np.clip(edge / 0.06, 0, 1) * 3.14))[..., None]
    return blend(frame, color, step(0.058, 0.062, edge))


def leaves(rng, size):
    """Make overlapping leaves on a dark ground."""
    color = ramp(np.full((size, size), 0.05), (16, 34, 16), (90, 150, 60))
    for k in range(420):
        u, v, angle, length = rng.integers(size), rng.integers(size), rng.random() * 6.28, rng.uniform(0.05, 0.09)
        reach = np.arange(-int(length * size), int(length * size) + 1)
        rows, columns = np.ix_((v + reach) % size, (u + reach) % size)
        b, a = np.meshgrid(reach / size, reach / size, indexing="ij")
        p, q = a * np.cos(angle) + b * np.sin(angle), b * np.cos(angle) - a * np.sin(angle)
        inside = step(0.004, -0.004, np.abs(q) - 0.34 * length * (1 - (p / length) ** 2))
        rib = 1 - 0.35 * step(0.004, 0.0, np.abs(q))
        tone = (0.25 + 0.75 * k / 420) * (0.75 + 1.25 * q / length) * rib * rng.uniform(0.8, 1.15)
        leaf = np.multiply.outer(tone, np.array([70, 138, 52]) / 255)
        color[rows, columns] = blend(color[rows, columns], leaf, inside)
    return np.clip(color, 0, 1)


def wicker(rng, size, cells=16):
    """Make the weave of a basket, with cells x cells crossings."""
    x, y = grid(size)
    a, b = x * cells, y * cells
    over = (np.floor(a) + np.floor(b)) % 2 > 0
    fa, fb = a % 1 - 0.5, b % 1 - 0.5
    along, across = np.where(over, fa, fb), np.where(over, fb, fa)
    shade = np.sqrt(np.clip(1 - (across * 1.9) ** 2, 0.05, 1)) * np.cos(along * 2.4)
    straw = 0.5 + 0.3 * fbm(rng, size, 128, 128, 3) * 0.4
    return ramp(straw, (140, 96, 52), (196, 150, 92), (226, 190, 132)) * (0.3 + 0.7 * shade)[..., None]


def plain_paint_front(rng, size, color=(30, 120, 120)):
    """Make a cabinet's front, fitted to its face: two doors with sunk panels and brass knobs, a drawer above each."""
    x, y = grid(size)
    base = srgb(color) * (1 + 0.05 * fbm(rng, size, 16, 128, 4))[..., None]
    light = np.ones((size, size), np.float32)
    knob = np.zeros((size, size), np.float32)
    for x0, x1 in ((0.03, 0.49), (0.51, 0.97)):
        for y0, y1 in ((0.05, 0.27), (0.31, 0.94)):
            d = np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y))
            light *= 1 - 0.6 * step(0.008, 0.003, np.abs(d))  # the gap around the door
            sunk = step(0.0, 0.012, d - 0.055)
            light *= 1 - 0.12 * sunk
            rim = step(0.009, 0.0, np.abs(d - 0.06))
            upper = ((y - y0) < (y1 - y)) & (np.abs(y - y0 - 0.06) < 0.02)
            light *= 1 + rim * np.where(upper, -0.4, 0.22)
            cx, cy = ((x0 + x1) / 2, (y0 + y1) / 2) if y1 < 0.3 else ((0.45 if x0 < 0.3 else 0.55), 0.5)
            radius = np.hypot(x - cx, y - cy)
            light *= 1 - 0.35 * step(0.035, 0.0, np.hypot(x - cx, y - cy - 0.012))
            knob = np.maximum(knob, step(0.021, 0.017, radius))
    brass = ramp(np.clip(0.5 + 0.4 * fbm(rng, size, 8, 8, 2), 0, 1), (120, 84, 30), (226, 184, 92), (250, 230, 170))
    return blend(base * light[..., None], brass, knob)


def plain_paint(rng, size, color=(30, 120, 120)):
    """Make brushed paint of one color."""
    relief = 1 + 0.05 * fbm(rng, size, 16, 128, 4) + 0.03 * fbm(rng, size, 4, 4, 3)
    return srgb(color) * relief[..., None]


def ball(rng, size, first=(214, 66, 48), second=(240, 226, 196)):
    """Make a beach ball, fitted to a sphere: x is the longitude and y the latitude.

    Its wedges about a tilted axis alternate between the colors `first` and `second`; its caps are yellow.
    """
    x, y = grid(size)
    longitude, latitude = x * 6.2832, y * 3.1416
    p = np.stack([np.sin(latitude) * np.cos(longitude), np.cos(latitude), np.sin(latitude) * np.sin(longitude)], -1)
    axis = rng.normal(size=3) * (1, 0.6, 1)
    q, _ = np.linalg.qr(np.stack([axis, (0, 1, 0), (1, 0, 0.3)], 1))
    p = p @ q
    wedge = np.sin(4 * np.arctan2(p[..., 2], p[..., 1]))
    # Without the division by the radius, the soft edges between wedges would become narrower towards the poles.
    soft = 0.05 / np.maximum(np.hypot(p[..., 1], p[..., 2]), 0.1)
    one, two = (srgb(c) for c in (first, second))
    color = blend(np.broadcast_to(one, (size, size, 3)), two, step(-1, 1, wedge / soft))
    return blend(color, np.float32([0.95, 0.78, 0.25]), step(0.955, 0.965, np.abs(p[..., 0])))


def quilt(rng, size, first=(214, 66, 48), second=(240, 226, 196), cells=8):
    """Make a patchwork of triangles, stitched along the seams: cells x cells squares, each of two triangles.

    One triangle of a square has a shade of `first`, the other one a shade of `second`.
    """
    x, y = grid(size)
    (i, fx), (j, fy) = cell(x * cells), cell(y * cells)
    flip = rng.integers(0, 2, (cells, cells))[j, i] > 0
    upper = np.where(flip, fx > fy, fx + fy > 1)
    shade = rng.uniform(0.75, 1.1, (cells, cells, 2)).astype(np.float32)[j, i, upper.astype(int)]
    one, two = (srgb(c) for c in (first, second))
    color = np.where(upper[..., None], one, two) * shade[..., None]
    diagonal = np.abs(np.where(flip, fx - fy, fx + fy - 1))
    seam = np.minimum(np.minimum(rim(fx), rim(fy)), diagonal)
    puffed = 0.72 + 0.28 * step(0.0, 0.16, seam)
    return color * (puffed * (1 + 0.06 * fbm(rng, size, 128, 128, 3)))[..., None]


def glaze(rng, size, color=(40, 70, 130), bands=(236, 230, 214)):
    """Make glazed pottery with wavy rings of the color `bands`, fitted to its face."""
    x, y = grid(size)
    wash = srgb(color) * (1 + 0.1 * fbm(rng, size, 4, 4, 5))[..., None]
    ring = np.zeros_like(x)
    for center, width in zip(rng.uniform(0.12, 0.88, 4), rng.uniform(0.01, 0.045, 4), strict=True):
        wave = center + 0.015 * np.sin(x * 6.2832 * 9)
        ring = np.maximum(ring, step(width + 0.008, width, np.abs(y - wave)))
    return blend(wash, srgb(bands), ring)
