"""Pictures inside a page, as data: small enough that a page with a hundred of them can be sent around."""

from __future__ import annotations

import base64
import io
from html import escape
from pathlib import Path

import numpy as np
from PIL import Image

from reffusion.io.images import resized

QUALITY = 70  # of WebP
BYTES_PER_PIXEL = 0.2  # bytes, about, that a photograph takes at that quality
COLOURS = 64  # of a chart


def photo_address(array: np.ndarray, longest: int) -> str:
    """A picture, uint8 [H, W, 3], as the address of an image with at most so many pixels a side."""
    factor = min(1.0, longest / max(array.shape[:2]))
    small = resized(array, (max(1, round(array.shape[1] * factor)), max(1, round(array.shape[0] * factor))))
    return _address(Image.fromarray(small), "webp", quality=QUALITY)


def chart_element(path: Path, alt: str) -> str:
    """A chart's PNG as an element; wide, so that it is scrolled on a phone and its words stay readable."""
    with Image.open(path) as drawn:
        few = drawn.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    source = _address(few, "png", optimize=True)
    return f'<div class="wide"><img class="chart" src="{source}" alt="{escape(alt)}"></div>'


def affordable_side(count: int, megabytes: float, least: int, most: int, aspect: float) -> int:
    """The longer side in px, between `least` and `most`, at which `count` pictures take about so many megabytes."""
    pixels = megabytes * 1e6 / max(count, 1) / BYTES_PER_PIXEL
    return round(min(most, max(least, (pixels * max(aspect, 1 / aspect)) ** 0.5)))


def picture_grid(cells: list[tuple[str, str]]) -> str:
    """Pictures side by side, as many as there is room for: (address, words below it)."""
    lines = [
        f'<figure><img src="{address}" alt="{escape(words)}"><figcaption>{escape(words)}</figcaption></figure>'
        for address, words in cells
    ]
    return '<div class="grid">' + "\n".join(lines) + "</div>"


def _address(image: Image.Image, kind: str, **options: int | bool) -> str:
    written = io.BytesIO()
    image.save(written, kind, **options)
    return f"data:image/{kind};base64,{base64.b64encode(written.getvalue()).decode()}"
