"""Pictures embedded in a page as data URLs, reduced so that a page with a hundred pictures is small enough to send."""

from __future__ import annotations

import base64
import io
from html import escape
from pathlib import Path

import numpy as np
from PIL import Image

from reffusion.io.images import fitting_size, resize_image

QUALITY = 70  # WebP quality
BYTES_PER_PIXEL = 0.2  # approximate size of a photograph at that quality
COLORS = 64  # palette size of a chart


def photo_address(array: np.ndarray, longest: int) -> str:
    """Return the data URL of a picture, uint8 [H, W, 3], as WebP.

    A picture whose longer side exceeds `longest` px is reduced to this size; no picture is enlarged.
    """
    small = resize_image(array, fitting_size(array.shape[1], array.shape[0], longest))
    return _address(Image.fromarray(small), "webp", quality=QUALITY)


def chart_element(path: Path, alt: str) -> str:
    """Return the HTML element of a chart, with the PNG at `path` embedded.

    The chart scrolls sideways on a narrow screen instead of shrinking, so that its text stays readable.
    """
    with Image.open(path) as image:
        reduced = image.convert("RGB").quantize(COLORS, dither=Image.Dither.NONE)
    source = _address(reduced, "png", optimize=True)
    return f'<div class="wide"><img class="chart" src="{source}" alt="{escape(alt)}"></div>'


def affordable_side(count: int, megabytes: float, least: int, most: int, aspect: float) -> int:
    """Return the longer side in px at which `count` pictures together take about `megabytes`.

    Args:
        least: smallest result, px.
        most: largest result, px.
        aspect: width over height of the pictures, or height over width.
    """
    pixels = megabytes * 1e6 / max(count, 1) / BYTES_PER_PIXEL
    return round(min(most, max(least, (pixels * max(aspect, 1 / aspect)) ** 0.5)))


def picture_grid(cells: list[tuple[str, str]]) -> str:
    """Return an HTML grid of pictures that adapts to the width of the screen.

    Args:
        cells: (address of the picture, e.g. a data URL; caption in plain text).
    """
    lines = [
        f'<figure><img src="{address}" alt="{escape(words)}"><figcaption>{escape(words)}</figcaption></figure>'
        for address, words in cells
    ]
    return '<div class="grid">' + "\n".join(lines) + "</div>"


def _address(image: Image.Image, kind: str, **options: int | bool) -> str:
    """Return the data URL of an image in a format of Pillow, such as "webp"."""
    written = io.BytesIO()
    image.save(written, kind, **options)
    return f"data:image/{kind};base64,{base64.b64encode(written.getvalue()).decode()}"
