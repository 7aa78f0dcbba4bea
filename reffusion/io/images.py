"""Reading and writing of pictures, masks and EXR depth maps."""

from __future__ import annotations

import logging
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps, TiffImagePlugin

from reffusion.io.files import BadInput, check_pixels, reading, shorten

HEIC = (".heic", ".heif")  # endings of the pictures that phones write
# endings of pictures, in lower case
ENDINGS = (".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".tif", ".tiff", ".bmp", ".webp", ".avif", *HEIC)

DARK = 8  # grey level up to which an area of a mask counts as background
FLAT = 0.002  # share of a mask that a value must fill to count as an area, not as part of a soft edge
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "GIF", "PPM", "HEIF", "AVIF")
_SINCE = ("HEIF", "AVIF")  # formats that Pillow reads only with a plugin, or in newer versions
_FLOATS = 3  # value of TIFF's tag SampleFormat
_HEIC_BRANDS = tuple(
    b"ftyp" + brand for brand in (b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1", b"hevc", b"hevx")
)
logging.getLogger("PIL").addHandler(logging.NullHandler())  # errors here say the same in one line
Image.MAX_IMAGE_PIXELS = None  # `open_image` checks the size: Pillow would warn from half of its own limit on


@contextmanager
def open_image(path: Path, what: str = "a readable image") -> Iterator[Image.Image]:
    """Open a picture as a context; only its header is read at first.

    Args:
        what: what the file should be, for error messages.

    Raises:
        BadInput: the file is no readable picture, or has more than `MOST_PIXELS` pixels. Errors that are raised inside
            the context, e.g. while pixels are decoded, become BadInput too. The message names the file.
    """
    with reading(path, what):
        with open(path, "rb") as file:
            start = file.read(12)  # the ending of the file's name may be another one
        if start[4:12] in _HEIC_BRANDS:
            _register_heic(path)
        if start[4:12] in (b"ftypavif", b"ftypavis"):
            _register_avif(path)
        if start[:4] in (b"II*\0", b"MM\0*"):
            _refuse_float_colors(path)
        known = [each for each in _FORMATS if each not in _SINCE or each in Image.OPEN]
    with reading(path, what), Image.open(path, formats=known) as image:
        check_pixels(path, *image.size)
        yield image


def _register_heic(path: Path) -> None:
    """Enable Pillow to read HEIC pictures, always with their orientation applied.

    pi-heif is used, and not pillow-heif: pi-heif only decodes, and the wheels of pillow-heif contain an encoder under
    the GPL.

    Raises:
        BadInput: pi-heif is not installed.
    """
    try:
        import pi_heif
    except ImportError:
        raise BadInput(f"{path}: HEIC pictures need pi-heif: `pip install pi-heif`, or save them as JPEG") from None
    pi_heif.register_heif_opener()


def _register_avif(path: Path) -> None:
    """Enable Pillow to read AVIF pictures. Raises BadInput if the installed Pillow cannot."""
    try:
        from PIL.AvifImagePlugin import SUPPORTED
    except ImportError:
        SUPPORTED = False
    if not SUPPORTED:
        raise BadInput(f"{path}: AVIF pictures need Pillow 11.3: `pip install -U pillow`, or save them as JPEG")


def _refuse_float_colors(path: Path) -> None:
    """Raise BadInput if a TIFF picture has several channels of floats, which Pillow does not read."""
    with open(path, "rb") as file:
        tags = TiffImagePlugin.ImageFileDirectory_v2(file.read(8))
        file.seek(tags.next)
        tags.load(file)
    kinds = tags.get(TiffImagePlugin.SAMPLEFORMAT, ())
    if _FLOATS in kinds and len(kinds) > 1:
        raise BadInput(f"{path}: float pixels; save it as a picture of 8 or 16 bits")


def image_size(path: Path, upright: bool = False) -> tuple[int, int]:
    """Return the (width, height) of a picture in pixels; only the file's header is read.

    Args:
        upright: True applies the orientation tag, as in `load_image`.
    """
    with open_image(path) as image:
        width, height = image.size
        turned = upright and _orientation(image) in (5, 6, 7, 8)
        return (height, width) if turned else (width, height)


def orientation_matrix(path: Path) -> np.ndarray:
    """Return [2, 3], the affine map from places in a stored picture to those in the picture turned by its EXIF tag.

    Places are (x, y) as shares of the picture's width and height. Only the file's header is read.
    """
    with open_image(path) as image:
        return np.array(_TURNS[_orientation(image)], float)


# EXIF orientation tag -> rows (x by x, x by y, shift of x) and the same for y
_TURNS = {
    1: ((1, 0, 0), (0, 1, 0)),
    2: ((-1, 0, 1), (0, 1, 0)),
    3: ((-1, 0, 1), (0, -1, 1)),
    4: ((1, 0, 0), (0, -1, 1)),
    5: ((0, 1, 0), (1, 0, 0)),
    6: ((0, -1, 1), (1, 0, 0)),
    7: ((0, -1, 1), (-1, 0, 1)),
    8: ((0, 1, 0), (-1, 0, 1)),
}


def _orientation(image: Image.Image) -> int:
    """Return the EXIF orientation tag of a picture; 1, upright, where it has none or an undefined one."""
    tag = image.getexif().get(0x0112, 1)
    return tag if tag in _TURNS else 1


def load_image(path: Path, upright: bool = False) -> np.ndarray:
    """Read a picture as uint8 [H, W, 3], sRGB.

    Grey becomes RGB, 16-bit grey levels are divided by 257, and an alpha channel is dropped.

    Args:
        upright: True applies the EXIF orientation tag. False ignores the tag, because poses that come with photographs
            refer to the stored pixels.

    Raises:
        BadInput: the file is missing or truncated, or its pixels have more than 16 bits or are floats. The message
            names the file.
    """
    with open_image(path) as image:
        turned = ImageOps.exif_transpose(image) if upright else image
        if image.mode[0] not in "IF":
            return np.array(turned.convert("RGB"))
        levels = np.array(turned)
        if image.mode == "F" or levels.min() < 0 or levels.max() > 65535:
            raise BadInput(f"{path}: {image.mode} pixels; save it as a picture of 8 or 16 bits")
        return np.repeat(np.round(levels / 257).astype(np.uint8)[..., None], 3, axis=2)


def load_thumbnail(path: Path, side: int, upright: bool = False) -> np.ndarray:
    """Read a picture, reduced so that its longer side is at most `side` px, as uint8 [h, w, 3].

    OpenCV is not imported.

    Args:
        upright: True applies the orientation tag, as in `load_image`.
    """
    with open_image(path) as image:
        if image.mode[0] not in "IF":
            image.draft("RGB", (2 * side, 2 * side))  # JPEGs are decoded at a fraction of their size
            image = image.convert("RGB")
            image.thumbnail((side, side), Image.Resampling.BOX)
            return np.array(ImageOps.exif_transpose(image) if upright else image)
    whole = load_image(path, upright)
    step = max(1, -(-max(whole.shape[:2]) // side))
    return np.ascontiguousarray(whole[::step, ::step])


def save_image(path: Path, array: np.ndarray) -> None:
    """Write an array as an 8-bit picture, and create its folder.

    Args:
        path: the file; its ending determines the format.
        array: [H, W, 3] or [H, W], uint8 or floats. Floats are clipped to [0, 1], scaled by 255 and rounded.

    Raises:
        ValueError: a value is not finite, or the shape or type is another one.
    """
    array = np.asarray(array)
    if np.issubdtype(array.dtype, np.floating):
        if not np.isfinite(array).all():
            raise ValueError(f"{path}: the picture holds values that are not finite")
        array = to_uint8(array)
    if array.dtype != np.uint8 or not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)):
        raise ValueError(f"{path}: a picture is uint8 or float [H, W, 3], got {array.dtype} {list(array.shape)}")
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    # These are the fastest settings of the lossless coder: files are a third larger, and written five times faster.
    quick: dict[str, Any] = {"compress_level": 1, "compress_type": zlib.Z_RLE} if _is_png(path) else {}
    Image.fromarray(np.ascontiguousarray(array)).save(path, **quick)


def replace_image(path: Path, array: np.ndarray) -> None:
    """Write an array as an 8-bit picture (see `save_image`), atomically.

    If the process is killed, `path` holds either the complete new picture or its old content.
    """
    writing = Path(path).with_name(f".{Path(path).name}")
    save_image(writing, array)
    writing.replace(path)


def to_uint8(array: np.ndarray) -> np.ndarray:
    """Convert floats to uint8 of the same shape: clip to [0, 1], scale by 255 and round."""
    return np.round(np.clip(array, 0.0, 1.0) * 255.0).astype(np.uint8)


def to_gray(image: np.ndarray) -> np.ndarray:
    """Return the luma of an RGB picture, uint8 [H, W, 3], as float32 [H, W] in [0, 255]."""
    import cv2

    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)


def _is_png(path: Path) -> bool:
    return Path(path).suffix.lower() == ".png"


@dataclass(frozen=True)
class MaskValues:
    """The pixel values of a mask file that mark the object.

    Attributes:
        ids: grey levels, or entries of a palette, that mark the object. If empty, white pixels mark it, as `load_mask`
            describes.
        inverted: True if the object is all other pixels instead.
    """

    ids: tuple[int, ...] = ()
    inverted: bool = False


WHITE = MaskValues()  # the object is white


def load_mask(path: Path, size: tuple[int, int] | None = None, values: MaskValues = WHITE) -> np.ndarray:
    """Read a mask file as bool [H, W], True = masked.

    The file may have values {0, 1} or {0, 255}, one bit per pixel, a palette, or colours on a black background. Values
    up to 255 are thresholded at 128, so that lossy compression and soft edges do not matter; 16-bit values at 32768. Of
    a colour, the brightest channel counts; in a palette of colours, every entry but black. An alpha channel is ignored.
    A file whose colours are constant while its alpha varies is refused, because tools disagree whether transparent or
    opaque pixels are the object.

    Args:
        size: (height, width) to which the mask is resized by nearest neighbour; None keeps the file's size.
        values: which pixel values mark the object.

    Raises:
        BadInput: the file is unreadable, or has colours while `values` has `ids`. Without `ids`: the file has its mask
            in the alpha channel, has areas of several values or colours (such as numbers of objects), or has values
            above 1 that all lie below the threshold. The message names the file.
    """
    with open_image(path, "a readable mask") as image:
        if values.ids:
            mask = np.isin(_object_numbers(path, image), values.ids)
        else:
            mask = _white_pixels(path, image)
    mask = mask ^ values.inverted
    return mask if size is None else resize_nearest(mask, size)


def _object_numbers(path: Path, image: Image.Image) -> np.ndarray:
    """Return the object numbers [H, W] of a mask file: its grey levels, or the indices of its palette entries.

    Raises:
        BadInput: the pixels have colours.
    """
    array = np.array(image)
    if array.ndim == 3 and (array[..., :1] == array[..., : min(3, array.shape[2])]).all():
        array = array[..., 0]
    if array.ndim != 2:
        raise BadInput(f"{path}: {image.mode} colours are no object numbers; save grey levels or a palette, or no `id`")
    return array


def _white_pixels(path: Path, image: Image.Image) -> np.ndarray:
    mode = image.mode
    array = np.array(image.convert("RGB") if mode in ("P", "PA") else image)
    if array.ndim == 3:
        colors = array[..., : 3 if array.shape[2] >= 3 else 1]
        if mode in ("RGBA", "LA") and (colors == colors[0, 0]).all() and np.ptp(array[..., -1]):
            raise BadInput(f"{path}: its alpha differs, its colours do not; write 255 where the object is, 0 elsewhere")
        if image.format != "JPEG" and np.ptp(colors, axis=2).any():
            _check_colors(path, mode, colors)
            if mode in ("P", "PA"):
                return np.any(colors, axis=2)
        array = colors.max(axis=2)
    if array.dtype == np.bool_ or array.max() <= 1:
        return array > 0
    half = 32768 if array.max() > 255 else 128
    levels = _flat_levels(array) if image.format != "JPEG" else []
    inner = [level for level in levels if level > DARK]
    if array.max() < half or len(inner) > 1:
        found = ", ".join(str(level) for level in ([level for level in levels if level] or [array.max()])[:6])
        raise BadInput(
            f"{path}: its values ({found}) are neither 0/1 nor 0/255; write 255 where the object is, 0 elsewhere, or "
            "name the object's numbers in scene.yaml: `masks: {id: ...}`"
        )
    return array >= half


def _check_colors(path: Path, mode: str, colors: np.ndarray) -> None:
    """Raise BadInput if a mask file has areas of more than one colour besides black.

    Each of these colours could be the object.

    Args:
        path: the file, for the message.
        mode: Pillow's mode of the picture.
        colors: its pixels, [H, W, 3].
    """
    found = [color for color in _flat_levels(colors.astype(np.int32) @ (65536, 256, 1)) if color]
    if len(found) > 1:
        numbers = ", or name the object's entries in scene.yaml: `masks: {id: ...}`" if mode in ("P", "PA") else ""
        raise BadInput(
            f"{path}: {len(found)} colours beside black; write white where the object is, black elsewhere{numbers}"
        )


def _flat_levels(array: np.ndarray) -> list[int]:
    """Return the values of an array [H, W] that fill areas, ascending.

    A pixel lies in an area if its upper, left and upper left neighbours have the same value. Values that only occur
    along soft edges are thereby left out. The areas of a value must cover more than the share `FLAT` of the pixels.
    """
    same = np.ones(array.shape, bool)
    same[1:] &= array[1:] == array[:-1]
    same[:, 1:] &= array[:, 1:] == array[:, :-1]
    same[1:, 1:] &= array[1:, 1:] == array[:-1, :-1]
    levels, counts = np.unique(array[same], return_counts=True)
    return [int(level) for level, count in zip(levels, counts, strict=True) if count > FLAT * array.size]


def resize_image(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize a picture, uint8 [h, w, 3] or [h, w], to `size`.

    The interpolation is area averaging if neither side grows, and bicubic else. A picture that has this size already is
    returned itself, not as a copy.

    Args:
        size: (width, height) in pixels.
    """
    import cv2

    if size == (image.shape[1], image.shape[0]):
        return image
    smaller = size[0] <= image.shape[1] and size[1] <= image.shape[0]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)


def resize_nearest(array: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize an array [H, W, ...] to [*size, ...] by nearest neighbour.

    Each new pixel takes the value of the old pixel that contains the new pixel's centre.

    Args:
        size: (height, width).
    """
    rows, columns = (
        np.minimum(((np.arange(new) + 0.5) * old / new).astype(int), old - 1)
        for new, old in zip(size, array.shape[:2], strict=True)
    )
    return array[rows[:, None], columns[None, :]]


def save_mask(path: Path, mask: np.ndarray) -> None:
    """Write a mask, bool [H, W], as a picture: 255 where it is True, else 0. Raises ValueError for any other array."""
    mask = np.asarray(mask)
    if mask.dtype != np.bool_ or mask.ndim != 2:
        raise ValueError(f"{path}: a mask is bool [H, W], got {mask.dtype} {list(mask.shape)}")
    save_image(path, mask.astype(np.uint8) * 255)


def save_exr(path: Path, depth: np.ndarray) -> None:
    """Write a depth map [H, W] (camera z) losslessly as float32 to the channel `Z` of an OpenEXR file.

    Raises:
        ValueError: the array is not two-dimensional, or the file cannot be written.
    """
    import OpenImageIO as oiio

    depth = np.ascontiguousarray(depth, np.float32)
    if depth.ndim != 2:
        raise ValueError(f"{path}: one channel [H, W] expected, got {list(depth.shape)}")
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    spec = oiio.ImageSpec(depth.shape[1], depth.shape[0], 1, oiio.FLOAT)
    spec.channelnames = ("Z",)
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "1970:01:01 00:00:00")  # the current time would make files of equal depths differ
    file = oiio.ImageOutput.create(str(path))
    if file is None or not file.open(str(path), spec) or not file.write_image(depth[..., None]) or not file.close():
        raise ValueError(f"{path}: cannot be written ({file.geterror() if file else oiio.geterror()})")


_EXR = b"\x76\x2f\x31\x01"


def load_exr(path: Path) -> np.ndarray:
    """Read the first channel of an OpenEXR file as float32 [H, W]. Raises BadInput if the file is unreadable."""
    import OpenImageIO as oiio

    with reading(path, "a readable EXR file"):
        with open(path, "rb") as start:
            if start.read(4) != _EXR:  # without this check the library tries other formats and prints their errors
                raise BadInput(f"{path}: not an EXR file; give it the ending of what it is")
        file = oiio.ImageInput.open(str(path))
        if file is None:
            raise BadInput(f"{path}: not a readable EXR file ({shorten(oiio.geterror(), 200)})")
        spec = file.spec()
        check_pixels(path, spec.width, spec.height * max(spec.depth, 1))
        pixels = file.read_image(0, 0, 0, 1, oiio.FLOAT)
        file.close()
        if pixels is None:
            raise BadInput(f"{path}: cut off ({shorten(file.geterror(), 200)})")
        return np.ascontiguousarray(pixels.reshape(pixels.shape[0], pixels.shape[1], -1)[..., 0])
