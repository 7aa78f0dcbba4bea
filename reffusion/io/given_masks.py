"""Reading of masks that come with a scene: pictures of many kinds, cut-outs, arrays, and annotations of outlines.

The brightness of a pixel is its largest channel, scaled to [0, 255].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from reffusion.io.annotations import annotation_size, is_annotation, load_annotation
from reffusion.io.arrays import load_array
from reffusion.io.files import BadInput, as_bad_input, check_pixels
from reffusion.io.images import image_size, open_image, resize_nearest

DARK, LIGHT = 8, 200  # brightness up to which an area counts as background, and from which as a light gray
FLAT = 0.002  # share of a mask that a value must fill to count as an area, not as part of a soft edge
SAMPLES = 500_000  # number of pixels from which the levels of a mask are estimated
SLACK = 0.1  # of the difference of two levels: a pixel that is this close to a level has it
# A mask of two areas: least share of the pixels above the lower level that are even and have the upper one, and least
# share of all pixels that are even and have the lower one. Photographs cut out on black have up to 0.02 of the former.
EVEN_HIGH, EVEN_LOW = 0.1, 0.05
# A mask of thin white parts: least share of all pixels that have one of the levels (photographs have up to 0.5), and of
# the pixels above the lower level that have the upper one.
THIN, THIN_HIGH = 0.6, 0.2
SPECKS = 0.05  # of a cut-out's pixels: largest area of dots in it and around it; photographs of the night have more


@dataclass(frozen=True)
class MaskValues:
    """The pixel values of a mask file that mark the object.

    Attributes:
        ids: gray levels, entries of a palette, or categories of a COCO file that mark the object. If empty, white
            pixels mark it, as `load_given_mask` describes.
        inverted: True if the object is all other pixels instead.
    """

    ids: tuple[int, ...] = ()
    inverted: bool = False


WHITE = MaskValues()  # the object is white


def mask_file_size(path: Path) -> tuple[int, int]:
    """Return the (width, height) in px of any mask that `load_given_mask` reads; raises BadInput if unreadable."""
    if is_annotation(path):
        return annotation_size(path)
    if path.suffix.lower() == ".npy":
        height, width = _load_array(path).shape
        return width, height
    return image_size(path)


def load_given_mask(path: Path, size: tuple[int, int] | None = None, values: MaskValues = WHITE) -> np.ndarray:
    """Read a mask as bool [H, W], True = masked.

    A mask is one of these:

    - a picture with two levels: {0, 1}, {0, 255}, one bit per pixel, a palette or one color on black, of 8 or 16 bits
      or floats. The threshold lies between the two levels, so lossy compression and soft edges do not matter;
    - a photograph whose alpha varies: opaque pixels are the object. In other pictures transparent pixels are not;
    - a photograph cut out on black, if more than half of it is black: every pixel but black is the object;
    - labelme's outlines, or COCO's of one picture (`reffusion.io.annotations`);
    - an array, [H, W] or [1, H, W].

    Args:
        size: (height, width) to which the mask is resized by nearest neighbor; None keeps the file's size.
        values: which pixel values mark the object.

    Raises:
        BadInput: the file is unreadable, or has colors while `values` has `ids`. Without `ids`: the file is another
            photograph; its alpha varies and its colors do not, because tools disagree whether transparent or opaque
            pixels are the object; it has areas of several values or colors (such as numbers of objects); or its levels
            are too dark to tell. The message names the file.
    """
    if is_annotation(path):
        mask = load_annotation(path, values.ids)
    elif path.suffix.lower() == ".npy":
        array = _load_array(path)
        with as_bad_input(path, "a readable mask"):
            mask = np.isin(array, values.ids) if values.ids else _mark_by_colors(path, array[..., None], True)
    else:
        with open_image(path, "a readable mask") as image:
            mask = _numbered_pixels(path, image, values.ids) if values.ids else _mark_by_picture(path, image)
    mask = mask ^ values.inverted
    return mask if size is None else resize_nearest(mask, size)


def load_united_masks(paths: Sequence[Path], size: tuple[int, int]) -> np.ndarray:
    """Return the union, bool [H, W], of one or more masks (`load_given_mask`), resized to `size`, (height, width)."""
    return np.logical_or.reduce([load_given_mask(path, size) for path in paths])


def _load_array(path: Path) -> np.ndarray:
    """Read the array [H, W] or [1, H, W] in a .npy file, as [H, W]. Raises BadInput for any other array."""
    array = load_array(path, "a readable mask")
    single = array[0] if array.ndim == 3 and len(array) == 1 else array
    if single.ndim != 2 or single.dtype.kind not in "biuf" or not single.size:
        shape = " x ".join(map(str, array.shape))
        raise BadInput(f"{path}: an array of {shape} {array.dtype}; save one mask, as high and wide as its picture")
    check_pixels(path, *single.shape[::-1])
    return single


def _numbered_pixels(path: Path, image: Image.Image, ids: tuple[int, ...]) -> np.ndarray:
    """Return the pixels, bool [H, W], whose gray level or palette entry is one of `ids`; raises BadInput on colors."""
    array = np.array(image)
    opaque: np.ndarray | bool = True
    if image.mode in ("RGBA", "LA"):
        array, opaque = array[..., :-1], array[..., -1] > 0
    if array.ndim == 3 and (array[..., :1] == array).all():
        array = array[..., 0]
    if array.ndim != 2:
        raise BadInput(f"{path}: {image.mode} colors are no object numbers; save gray levels or a palette, or no `id`")
    return np.isin(array, ids) & opaque


def _mark_by_picture(path: Path, image: Image.Image) -> np.ndarray:
    """Return the pixels, bool [H, W], that a picture marks by alpha if that cuts out a photograph, else by colors."""
    lossless, palette = image.format != "JPEG", image.mode in ("P", "PA")
    if image.mode[0] in "IF" or not image.has_transparency_data:
        array = np.array(image if image.mode[0] in "IF1L" and image.mode != "LAB" else image.convert("RGB"))
        return _mark_by_colors(path, array.reshape(*array.shape[:2], -1), lossless, palette)
    array = np.array(image.convert("RGBA"))
    colors, opaque = array[..., :3], array[..., 3] >= 128
    if not np.ptp(array[..., 3]):
        return _mark_by_colors(path, colors, lossless, palette)
    if (colors == colors[0, 0]).all():
        raise BadInput(f"{path}: its alpha differs, its colors do not; write 255 where the object is, 0 elsewhere")
    if opaque.any() and not _is_drawing(colors[opaque], lossless):
        return opaque
    return _mark_by_colors(path, colors * opaque[..., None], lossless, palette)


def _is_drawing(colors: np.ndarray, lossless: bool) -> bool:
    """Return whether the opaque pixels of a picture, [N, 3], are of one color, or black and one color."""
    if np.ptp(colors, axis=0).max() <= 2 * DARK:
        return True
    some = colors[:: -(-len(colors) // SAMPLES)]
    levels = _find_levels(some, np.ones(len(some), bool), lossless)
    return levels.low <= 2 * DARK and levels.share >= 0.9 and levels.is_one_color


def _mark_by_colors(path: Path, colors: np.ndarray, lossless: bool, palette: bool = False) -> np.ndarray:
    """Return the pixels, bool [H, W], that colors mark; raises BadInput for several objects or a photograph."""
    # `colors` is [H, W, C] of any type, C = 1 or 3. The colors of a JPEG (not `lossless`) are not exact. The entries
    # of a palette may be named as `masks: {id: ...}`.
    colors = colors.astype(np.uint8) if colors.dtype == bool else colors
    is_gray = all((colors[..., :1] == colors[..., k : k + 1]).all() for k in range(1, colors.shape[2]))
    colors = colors[..., :1] if is_gray else colors
    some, even = _sample(colors)
    numbers = some[:, 0] if is_gray else some.astype(np.int32) @ (65536, 256, 1)
    scale = _scale_of(colors)
    brightness, some = _brightness(colors) * scale, some * scale
    low, high = float(np.nanmin(brightness)), float(np.nanmax(brightness))
    if low >= 255 - 2 * DARK or 0 <= low <= high <= (0 if lossless else 2 * DARK):  # a full or an empty mask
        return brightness > 128
    areas = [number for number in _flat_areas(numbers, even) if number > (DARK if is_gray else 0)] if lossless else []
    if is_map := bool(areas) and np.isin(numbers[some.max(1) > DARK], areas).mean() >= 0.5:
        low, high = 0.0, float(some[np.argmax(numbers == areas[0])].max())
    if len(areas) > 1 and is_map and not is_gray:
        numbered = ", or name the object's entries in scene.yaml: `masks: {id: ...}`" if palette else ""
        raise BadInput(
            f"{path}: {len(areas)} colors beside black; write white where the object is, black elsewhere{numbered}"
        )
    if is_gray and (low < 0 or high < 128 or (len(areas) > 1 and is_map)):
        found = ", ".join(f"{number:g}" for number in (areas or [numbers.max()])[:6])
        raise BadInput(
            f"{path}: its values ({found}) are neither 0/1 nor 0/255; write 255 where the object is, 0 elsewhere, or "
            "name the object's numbers in scene.yaml: `masks: {id: ...}`"
        )
    is_black = some.max(1) <= DARK
    if is_map and not is_gray and (~np.isin(numbers, areas) & ~is_black).sum() > is_black.sum():
        raise BadInput(f"{path}: a photograph cut out on one color; save white where the object is, black elsewhere")
    if is_map:
        return brightness > high / 2
    levels = _find_levels(some, even, lossless)
    if levels.has_two and levels.is_one_color:
        return brightness > (levels.low + levels.high) / 2
    if (cut_out := _cut_out(brightness > (DARK if lossless else 2 * DARK))) is not None:
        return cut_out
    raise BadInput(f"{path}: a photograph, not a mask; save white where the object is, black elsewhere")


def _brightness(colors: np.ndarray) -> np.ndarray:
    """Return the largest channel of colors [H, W, C], as [H, W]. `max` over a short last axis is ten times slower."""
    return (
        colors[..., 0]
        if colors.shape[2] == 1
        else np.maximum(np.maximum(*np.moveaxis(colors[..., :2], 2, 0)), colors[..., 2])
    )


def _scale_of(colors: np.ndarray) -> np.float32 | np.uint8:
    """Return the factor to [0, 255] of colors in [0, 1], [0, 255] or 16 bits, which their maximum tells."""
    top = np.nanmax(colors)
    if top <= 1:
        return np.float32(255) if colors.dtype.kind == "f" else np.uint8(255)
    return np.float32(1 / 257) if top > 255 else np.uint8(1)


def _sample(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return about `SAMPLES` pixels [N, C] of colors [H, W, C], evenly spaced, and which are even, bool [N]."""
    every = int(np.ceil((colors.shape[0] * colors.shape[1] / SAMPLES) ** 0.5))
    if every == 1:  # a small picture, of which borders count too
        colors = np.pad(colors, ((1, 0), (1, 0), (0, 0)), mode="edge")
    here, before = slice(1, None, every), slice(0, -1, every)
    some = colors[here, here]
    # An even pixel has the same color as its upper, left and upper left neighbors.
    even = np.all([(some == colors[r, c]).all(2) for r, c in ((before, here), (here, before), (before, before))], 0)
    return some.reshape(-1, colors.shape[2]), even.ravel()


def _flat_areas(numbers: np.ndarray, even: np.ndarray) -> list:
    """Return, ascending, the values of an array [N] whose even pixels are more than the share `FLAT` of all pixels."""
    # Values that only occur along soft edges are thereby left out.
    levels, counts = np.unique(numbers[even], return_counts=True)
    return levels[counts > FLAT * numbers.size].tolist()


@dataclass(frozen=True)
class _Levels:
    """How much a picture looks like a mask of two levels of brightness.

    Attributes:
        low, high: the two levels.
        has_two: True if there are two even areas of these levels, or thin white parts on the lower level.
        share: share of all pixels that have one of the levels.
        is_one_color: True if nearly all of the pixels above the lower level have the same hue.
    """

    low: float
    high: float
    has_two: bool
    share: float
    is_one_color: bool


def _find_levels(colors: np.ndarray, even: np.ndarray, lossless: bool) -> _Levels:
    """Return the two levels of pixels [N, C]: the medians of those darker and lighter than the middle of the range."""
    colors = colors.astype(np.float32)
    brightness = colors.max(1)
    bottom, top = float(brightness.min()), float(brightness.max())
    light = brightness >= (bottom + top) / 2
    low, high = float(np.median(brightness[brightness <= (bottom + top) / 2])), float(np.median(brightness[light]))
    slack = SLACK * (high - low)
    above, has_low = brightness > low + slack, np.abs(brightness - low) <= slack
    if not above.any():
        return _Levels(low, high, False, 1.0, True)
    has_high = np.abs(brightness - high) <= slack
    color = np.median(colors[has_high], axis=0)
    is_gray = np.ptp(color) <= 4
    # JPEG keeps gray exactly, but halves the resolution of hues.
    tolerance = 4 if lossless or is_gray else 40
    other_hue = np.abs(colors[above] - brightness[above, None] * (color / color.max())).max(1) > tolerance
    share = float((has_low | has_high).mean())
    is_thin = is_gray and high >= LIGHT and share >= THIN and has_high[above].mean() >= THIN_HIGH
    # The upper level of a gray picture that reaches a light gray is its maximum instead, because soft edges may be
    # wider than what they surround.
    if is_gray and top >= LIGHT:
        high, has_high = top, top - brightness <= slack
    areas = (has_high & even)[above].mean() >= EVEN_HIGH and (has_low & even).mean() >= EVEN_LOW
    return _Levels(low, high, bool(is_thin or areas), share, bool(other_hue.mean() <= 0.1))


def _cut_out(drawn: np.ndarray) -> np.ndarray | None:
    """Return the object, bool [H, W], in a photograph that was cut out on black; None if that is ambiguous."""
    from reffusion.morphology import remove_small_parts  # imports scipy, which `plan` should not wait for

    count = int(drawn.sum())
    if not 0 < count <= drawn.size / 2:
        return None
    # Remove dots of at most 1 % of the drawn pixels outside the object and fill them inside. In a photograph of the
    # night, as opposed to a cut-out, such dots are many.
    diameter = (0.01 * count * 4 / np.pi) ** 0.5
    mask = remove_small_parts(drawn, diameter, diameter)
    return mask if (mask ^ drawn).sum() <= SPECKS * count else None
