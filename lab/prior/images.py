"""Training images of the embedded prior: procedural surfaces, corners of rooms, photographs, made rooms; their masks.

Image number k of a seed is a pure function of (seed, k) and the photographs, so training resumes to the same pictures.
The patterns are made here. Photographs come with scikit-image, and from `photographs` (the model card lists them with
their licences); pictures of rooms come from `rooms`.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from functools import lru_cache
from typing import TypeAlias

import cv2
import numpy as np

from lab.prior.surfaces import Field, blend, noise_tile, random_texture
from reffusion.seeding import seed_for

SIZE = 128  # px, side of one training image; crops are taken from it
SUPERSAMPLE = 2
PHOTOS = ("astronaut", "chelsea", "coffee", "rocket", "brick", "grass", "gravel", "camera", "coins")
HELD_OUT_PHOTOS = ("chelsea", "gravel")
SUBJECTS = {  # of scikit-image's photographs, in the words of `build.WORDS`
    "astronaut": "a person",
    "brick": "brick",
    "camera": "a person",
    "chelsea": "things",
    "coffee": "things",
    "coins": "things",
    "grass": "grass",
    "gravel": "stone",
    "rocket": "sky",
}
# Of the masks, a quarter cover the whole picture, as in the training of SD's inpainting models: only then do all words
# of a caption matter. A third cover `LARGE_HOLE` of it.
FULL_SHARE, LARGE_SHARE, LARGE_HOLE = 1 / 4, 1 / 3, 0.7
DARK, BRIGHT, GRAY = 0.3, 0.6, 0.06  # limits of mean brightness, and of the mean color's largest minus smallest channel
HUES = ("red", "orange", "yellow", "green", "green", "blue", "blue", "blue", "purple", "purple", "red")

Photographs: TypeAlias = Sequence[tuple[str, np.ndarray]]  # subjects, and pictures uint8 [H, W, 3]


def caption(subject: str, cropped: bool, color: str = "") -> str:
    """Return the caption of a picture of a subject, shown as a whole or as a crop, with or without its color."""
    return f"A photo of {subject}{', ' if color else ''}{color}{', cropped' if cropped else ''}"


def name_color(colors: np.ndarray) -> str:
    """Name mean brightness (unless it is medium) and hue of colors [P, 3] from 0 to 255: "gray", "dark green"."""
    color = colors.mean(0) / 255
    hue, *_ = colorsys.rgb_to_hsv(*color)
    level = "dark " if color.mean() < DARK else "bright " if color.mean() > BRIGHT else ""
    return level + ("gray" if np.ptp(color) < GRAY else HUES[int(hue * (len(HUES) - 1) + 0.5)])


def image(
    seed: int, index: int, photographs: Photographs | None = None, held_out: bool = False, rooms: Photographs = ()
) -> tuple[np.ndarray, str]:
    """Make an image.

    Args:
        seed, index: seed and number of the image.
        photographs: the photographs to crop; None for those of scikit-image.
        held_out: make an image that training never sees. Fewer of these are photographs.
        rooms: pictures of made rooms. Two thirds of the images that would be corners show one of them.

    Returns:
        The image, uint8 [SIZE, SIZE, 3], and its subject: a material, several materials or a kind of place.
    """
    rng = np.random.default_rng(seed_for(seed, "held-out" if held_out else "train", index))
    shares = [0.35, 0.45, 0.2] if held_out else [0.2, 0.3, 0.5]
    kind = rng.choice(["surface", "corner", "photo"], p=shares)
    if kind == "photo":
        return photo_crop(rng, bundled_photographs(held_out) if photographs is None else photographs)
    if kind == "corner" and rooms and rng.random() < 2 / 3:
        return room_view(rng, rooms)
    picture, subject = surface(rng) if kind == "surface" else corner(rng)
    if rng.random() < 0.5:
        picture = with_props(rng, picture)
    picture = cv2.resize(picture, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    return np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8), subject


# ---------------------------------------------------------------------------------------------- procedural


def pixels() -> tuple[Field, Field]:
    """Centers of the supersampled pixels, in image units centerd at 0, about [-SIZE/2, SIZE/2]."""
    ticks = (np.arange(SIZE * SUPERSAMPLE, dtype=np.float32) + 0.5) / SUPERSAMPLE - SIZE / 2
    return np.meshgrid(ticks, ticks)


def surface(rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """One textured plane, frontal or slanted, under a shading gradient."""
    texture, name = random_texture(rng)
    x, y = pixels()
    tilt = rng.normal(0, 0.002, 2) if rng.random() < 0.7 else np.zeros(2)
    w = np.maximum(1 + tilt[0] * x + tilt[1] * y, 0.35)
    return shaded(rng, texture(x / w, y / w), x, y), name


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
        side *= 100  # no visible side wall
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
    return shaded(rng, picture * np.exp(-fade * t)[..., None], x, y), " and ".join(dict.fromkeys(names))


def with_props(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    """Up to three textured blobs or boxes in the foreground: edges that end, and shapes that occlude."""
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
def bundled_photographs(held_out: bool = False) -> Photographs:
    """Load the photographs of scikit-image that are on disk."""
    from pathlib import Path

    import skimage

    folder, found = Path(skimage.__file__).parent / "data", []
    for name in HELD_OUT_PHOTOS if held_out else [each for each in PHOTOS if each not in HELD_OUT_PHOTOS]:
        path = next((folder / f"{name}{end}" for end in (".png", ".jpg") if (folder / f"{name}{end}").exists()), None)
        if path is not None:
            found.append((SUBJECTS[name], cv2.imread(str(path), cv2.IMREAD_COLOR)[..., ::-1].copy()))
    return found


def photo_crop(rng: np.random.Generator, photographs: Photographs) -> tuple[np.ndarray, str]:
    """Return a crop of a photograph at a random scale, flipped, with its colors shifted."""
    subject, photo = photographs[rng.integers(len(photographs))]
    side = int(SIZE * np.exp(rng.uniform(0, np.log(max(min(photo.shape[:2]) / SIZE, 1.01)))))
    top, left = rng.integers(photo.shape[0] - side + 1), rng.integers(photo.shape[1] - side + 1)
    crop = cv2.resize(photo[top : top + side, left : left + side], (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    crop = crop[:, ::-1] if rng.random() < 0.5 else crop
    tint = rng.uniform(0.75, 1.2, 3) if rng.random() < 0.5 else rng.uniform(0.8, 1.2)
    return np.clip(np.round(crop * tint), 0, 255).astype(np.uint8), subject


def room_view(rng: np.random.Generator, rooms: Photographs) -> tuple[np.ndarray, str]:
    """Return a room, mirrored or not: all of the picture, squeezed to a square as whole views are, or a square part."""
    place, room = rooms[rng.integers(len(rooms))]
    if rng.random() < 0.5:
        side = int(rng.integers(SIZE, min(room.shape[:2]) + 1))
        top, left = (rng.integers(length - side + 1) for length in room.shape[:2])
        room = room[top : top + side, left : left + side]
    picture = cv2.resize(room, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(picture[:, ::-1] if rng.random() < 0.5 else picture), place


# ---------------------------------------------------------------------------------------------- masks


def mask(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw a mask, bool [size, size], as in the method (silhouette, half plane, rectangles), large, or all."""
    coverage = rng.random()
    if coverage < FULL_SHARE:
        return np.ones((size, size), bool)
    if coverage < FULL_SHARE + LARGE_SHARE:
        return large_hole(rng, size)
    kind = rng.choice(["silhouette", "halfplane", "rectangles"], p=[0.6, 0.22, 0.18])
    canvas = np.zeros((size, size), np.uint8)
    if kind == "rectangles":
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
        canvas = silhouettes(rng, size)
    return large_hole(rng, size) if canvas.all() else canvas.astype(bool)


def large_hole(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw a hole, bool [size, size]; it covers `LARGE_HOLE` of the picture, around a point or beyond a line, wavy."""
    ticks = (np.arange(size) + 0.5) / size
    (x, y), angle = rng.uniform(0.2, 0.8, 2), rng.uniform(0, 2 * np.pi)
    round_field = np.hypot(ticks[None] - x, ticks[:, None] - y)
    field = round_field if rng.random() < 0.6 else np.cos(angle) * ticks[None] + np.sin(angle) * ticks[:, None]
    field = field + rng.uniform(0, 0.15) * noise_tile(rng, 3.0, size=128)[:size, :size]
    return field < np.quantile(field, LARGE_HOLE)


def silhouettes(rng: np.random.Generator, size: int) -> np.ndarray:
    """One to three objects' outlines, as polygons; bool [size, size]."""
    canvas = np.zeros((size, size), np.uint8)
    for _ in range(rng.integers(1, 4)):
        center = rng.uniform(0.15, 0.85, 2) * size
        count = rng.integers(5, 11)
        radius = size * rng.uniform(0.12, 0.45) * rng.uniform(0.6, 1.2, count)
        turn = np.sort(rng.uniform(0, 2 * np.pi, count))
        outline = center + np.stack([np.cos(turn) * radius, np.sin(turn) * radius * rng.uniform(0.6, 1.6)], 1)
        cv2.fillPoly(canvas, [outline.astype(np.int32)], 1)
    return canvas.astype(bool)
