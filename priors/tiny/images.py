"""The images that train the embedded prior: procedural surfaces, corners of rooms and bundled photographs.

Image number k of a seed is a pure function of (seed, k), so training resumes to the same pictures without a
data set on disk. Nothing is downloaded: patterns are made here, photographs come with scikit-image (the model
card lists them with their licences).
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np

from reffusion.trace import seed_for

SIZE = 128  # px, side of one training image; crops are taken from it
SUPERSAMPLE = 2
PHOTOS = ("astronaut", "chelsea", "coffee", "rocket", "brick", "grass", "gravel", "camera", "coins")
HELD_OUT_PHOTOS = ("chelsea", "gravel")

Field = np.ndarray  # [H, W] float32
Texture = Callable[[Field, Field], np.ndarray]  # surface coordinates in texels -> [H, W, 3] in [0, 1]


def image(seed: int, index: int, held_out: bool = False) -> tuple[np.ndarray, str]:
    """Training image number `index`: ([SIZE, SIZE, 3] uint8, caption). `held_out`: never trained on."""
    rng = np.random.default_rng(seed_for(seed, "held-out" if held_out else "train", index))
    kind = rng.choice(["surface", "corner", "photo"], p=[0.35, 0.45, 0.2])
    if kind == "photo":
        return photo_crop(rng, held_out)
    picture, caption = surface(rng) if kind == "surface" else corner(rng)
    if rng.random() < 0.5:
        picture = with_props(rng, picture)
    picture = cv2.resize(picture, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    return np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8), caption


# ---------------------------------------------------------------------------------------------- noise and colour


def noise_tile(rng: np.random.Generator, slope: float, stretch: float = 1.0, size: int = 256) -> Field:
    """A periodic random field with power falling as frequency^-slope, deviation 1, longer along x by `stretch`."""
    fy, fx = np.meshgrid(np.fft.fftfreq(size) * size, np.fft.rfftfreq(size) * size, indexing="ij")
    frequency = np.sqrt((fx * stretch) ** 2 + fy**2)
    amplitude = np.where(frequency > 0, np.maximum(frequency, 1) ** (-slope / 2), 0)
    phase = np.exp(2j * np.pi * rng.random(frequency.shape))
    field = np.fft.irfft2(amplitude * phase * rng.rayleigh(1.0, frequency.shape), s=(size, size))
    return (field / field.std()).astype(np.float32)


def sample(tile: Field, u: Field, v: Field, scale: float) -> Field:
    """The periodic `tile` at surface coordinates (u, v), `scale` tile texels per surface texel."""
    n = tile.shape[0]
    x, y = np.mod(u * scale, n).astype(np.float32), np.mod(v * scale, n).astype(np.float32)
    return cv2.remap(tile, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def colour(rng: np.random.Generator, saturation: float = 0.6) -> np.ndarray:
    """One random colour [3], muted more often than vivid."""
    hue = rng.random() if rng.random() < 0.5 else rng.normal(0.08, 0.05) % 1
    return np.array(colorsys.hsv_to_rgb(hue, saturation * rng.random() ** 1.5, rng.uniform(0.15, 0.95)), np.float32)


def shades(rng: np.random.Generator, count: int, spread: float = 0.12) -> np.ndarray:
    """[count, 3] variations of one random colour."""
    return np.clip(colour(rng) + rng.normal(0, spread, (count, 1)) + rng.normal(0, spread / 4, (count, 3)), 0, 1)


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
    body, mortar, spread = colour(rng), colour(rng, 0.2), rng.uniform(0.02, 0.12)
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
    body, spread, contrast = colour(rng), rng.uniform(0.02, 0.09), rng.uniform(0.04, 0.14)
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
    pair, grout = shades(rng, 2, rng.uniform(0.0, 0.25)), colour(rng, 0.2)
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
    first, second, wobble = colour(rng), colour(rng), rng.choice([0.0, rng.uniform(0.5, 4)])
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
    ground, ink, grain = colour(rng), colour(rng, 0.9), noise_tile(rng, 1.5)
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
    """A pattern at a random turn and size, and its name."""
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


# ---------------------------------------------------------------------------------------------- pictures of them


def pixels() -> tuple[Field, Field]:
    """Centres of the supersampled pixels, in image units centred at 0, about [-SIZE/2, SIZE/2]."""
    ticks = (np.arange(SIZE * SUPERSAMPLE, dtype=np.float32) + 0.5) / SUPERSAMPLE - SIZE / 2
    return np.meshgrid(ticks, ticks)


def surface(rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """One textured plane seen from in front or aslant, under a shading gradient."""
    texture, name = random_texture(rng)
    x, y = pixels()
    tilt = rng.normal(0, 0.002, 2) if rng.random() < 0.7 else np.zeros(2)
    w = np.maximum(1 + tilt[0] * x + tilt[1] * y, 0.35)
    return shaded(rng, texture(x / w, y / w), x, y), f"A photo of {name}"


def shaded(rng: np.random.Generator, picture: np.ndarray, x: Field, y: Field) -> np.ndarray:
    slope = rng.normal(0, 0.0022, 2)
    return picture * np.clip(1 + slope[0] * x + slope[1] * y, 0.3, 1.6)[..., None]


def corner(rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """Floor and walls of a room by ray casting: one, two or three textured planes that meet in creases."""
    x, y = pixels()
    focal, pitch, yaw = SIZE * rng.uniform(0.8, 1.6), rng.uniform(-0.1, 0.7), rng.uniform(-0.8, 0.8)
    dx, dy, dz = x / focal, y / focal, np.ones_like(x)
    dy, dz = dy * np.cos(pitch) + dz * np.sin(pitch), dz * np.cos(pitch) - dy * np.sin(pitch)
    dx, dz = dx * np.cos(yaw) + dz * np.sin(yaw), dz * np.cos(yaw) - dx * np.sin(yaw)
    height, back, side = rng.uniform(0.7, 1.6), rng.uniform(1.2, 3.5), rng.choice([-1, 1]) * rng.uniform(0.8, 3)
    if rng.random() < 0.35:
        side *= 100  # no side wall in sight
    with np.errstate(divide="ignore"):
        reach = np.stack([height / dy, back / dz, side / dx])
    reach = np.where(reach > 1e-3, reach, np.inf)
    hit, t = reach.argmin(0), np.minimum(reach.min(0), 50).astype(np.float32)
    texel = SIZE * 0.8 / rng.uniform(1.0, 2.5)
    px, py, pz = dx * t * texel, dy * t * texel, dz * t * texel
    light = rng.uniform(0.65, 1.15, 3)
    picture, names = np.zeros((*x.shape, 3), np.float32), []
    for plane, (u, v) in enumerate([(px, pz), (px, py), (pz, py)]):
        inside = hit == plane
        if inside.any():
            texture, name = random_texture(rng)
            names.append(name)
            picture[inside] = (texture(u, v) * light[plane])[inside]
    fade = rng.uniform(0, 0.12)
    return shaded(rng, picture * np.exp(-fade * t)[..., None], x, y), f"A photo of {names[0]}"


def with_props(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    """Up to three textured blobs or boxes before the picture: edges that end and shapes that occlude."""
    x, y = pixels()
    for _ in range(rng.integers(1, 4)):
        texture, _ = random_texture(rng)
        cx, cy, a, b = *rng.uniform(-SIZE / 2, SIZE / 2, 2), *rng.uniform(6, 32, 2)
        u, v = x - cx, y - cy
        if rng.random() < 0.5:
            inside = (u / a) ** 2 + (v / b) ** 2
            light = np.sqrt(np.clip(1 - inside, 0, 1)) * 0.7 + 0.4
            weight = (1 - inside) * min(a, b) / 2
        else:
            light = np.where(u > a * rng.uniform(-0.5, 0.5), 0.7, 1.0)
            weight = np.minimum(a - np.abs(u), b - np.abs(v)) + 0.5
        picture = blend(picture, texture(u, v) * light[..., None], weight)
    return picture


# ---------------------------------------------------------------------------------------------- photographs


@lru_cache
def photographs(names: tuple[str, ...]) -> tuple[tuple[str, np.ndarray], ...]:
    """The named photographs of scikit-image that lie on disk, as [H, W, 3] uint8."""
    from pathlib import Path

    import skimage

    folder, found = Path(skimage.__file__).parent / "data", []
    for name in names:
        path = next((folder / f"{name}{end}" for end in (".png", ".jpg") if (folder / f"{name}{end}").exists()), None)
        if path is not None:
            found.append((name, cv2.imread(str(path), cv2.IMREAD_COLOR)[..., ::-1].copy()))
    return tuple(found)


def photo_crop(rng: np.random.Generator, held_out: bool) -> tuple[np.ndarray, str]:
    """A crop of a photograph at a random scale, flipped, with its colours shifted."""
    names = HELD_OUT_PHOTOS if held_out else tuple(n for n in PHOTOS if n not in HELD_OUT_PHOTOS)
    found = photographs(names)
    name, photo = found[rng.integers(len(found))]
    side = int(SIZE * np.exp(rng.uniform(0, np.log(max(min(photo.shape[:2]) / SIZE, 1.01)))))
    top, left = rng.integers(photo.shape[0] - side + 1), rng.integers(photo.shape[1] - side + 1)
    crop = cv2.resize(photo[top : top + side, left : left + side], (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    crop = crop[:, ::-1] if rng.random() < 0.5 else crop
    tint = rng.uniform(0.75, 1.2, 3) if rng.random() < 0.5 else rng.uniform(0.8, 1.2)
    return np.clip(np.round(crop * tint), 0, 255).astype(np.uint8), f"A photo of {name}"


# ---------------------------------------------------------------------------------------------- masks


def mask(rng: np.random.Generator, size: int) -> np.ndarray:
    """A mask like the job's, in a crop: a silhouette, a half plane, rectangles or everything; bool [size, size]."""
    kind = rng.choice(["silhouette", "halfplane", "rectangles", "all"], p=[0.55, 0.2, 0.17, 0.08])
    canvas = np.zeros((size, size), np.uint8)
    if kind == "all":
        canvas[:] = 1
    elif kind == "rectangles":
        for _ in range(rng.integers(1, 5)):
            w, h = (size * rng.uniform(0.1, 0.7, 2)).astype(int) + 1
            cx, cy = rng.integers(0, size, 2)
            canvas[max(cy - h // 2, 0) : cy + h // 2 + 1, max(cx - w // 2, 0) : cx + w // 2 + 1] = 1
    elif kind == "halfplane":
        angle, offset = rng.uniform(0, 2 * np.pi), rng.uniform(-0.35, 0.35) * size
        ticks = np.arange(size) - size / 2
        wave = noise_tile(rng, 3.0, size=64)[0]
        line = np.interp(np.arange(size), np.linspace(0, size, 64), wave) * size * rng.uniform(0, 0.08)
        canvas[(np.cos(angle) * ticks[None] + np.sin(angle) * ticks[:, None] + line[None]) > offset] = 1
    else:
        return silhouettes(rng, size)
    return canvas.astype(bool)


def silhouettes(rng: np.random.Generator, size: int) -> np.ndarray:
    """One to three objects' outlines, as polygons; bool [size, size]."""
    canvas = np.zeros((size, size), np.uint8)
    for _ in range(rng.integers(1, 4)):
        centre = rng.uniform(0.15, 0.85, 2) * size
        count = rng.integers(5, 11)
        radius = size * rng.uniform(0.12, 0.45) * rng.uniform(0.6, 1.2, count)
        turn = np.sort(rng.uniform(0, 2 * np.pi, count))
        outline = centre + np.stack([np.cos(turn) * radius, np.sin(turn) * radius * rng.uniform(0.6, 1.6)], 1)
        cv2.fillPoly(canvas, [outline.astype(np.int32)], 1)
    return canvas.astype(bool)
