"""Reading and writing of pictures, masks and EXR depth maps."""

from __future__ import annotations

import logging
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, TiffImagePlugin

from reffusion.io.files import BadInput, check_pixels, reading, shorten

HEIC = (".heic", ".heif")  # endings of the pictures that phones write
# endings of pictures, in lower case
ENDINGS = (".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".tif", ".tiff", ".bmp", ".webp", ".avif", *HEIC)

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "GIF", "PPM", "HEIF", "AVIF")
_SINCE = ("HEIF", "AVIF")  # formats that Pillow reads only with a plugin, or in newer versions
_FLOATS = 3  # value of TIFF's tag SampleFormat
_HEIC_BRANDS = tuple(
    b"ftyp" + brand for brand in (b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1", b"hevc", b"hevx")
)
logging.getLogger("PIL").addHandler(logging.NullHandler())  # errors here say the same in one line
Image.MAX_IMAGE_PIXELS = None  # `open_image` checks the size: Pillow would warn from half of its own limit on


@contextmanager
def open_image(path: Path, what: str = "a readable image; save it anew as JPEG or PNG") -> Iterator[Image.Image]:
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
    """Enable Pillow to read HEIC pictures, with their orientation applied; raises BadInput without pi-heif."""
    # pi-heif is used, and not pillow-heif: pi-heif only decodes, and the wheels of pillow-heif contain an encoder under
    # the GPL.
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
    """Return the (width, height) of a picture in pixels; only the file's header is read. Raises as `open_image`.

    Args:
        upright: True applies the orientation tag, as in `load_image`.
    """
    with open_image(path) as image:
        width, height = image.size
        turned = _orientation(image) in (5, 6, 7, 8) and upright != _is_turned(image)
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


def _is_turned(image: Image.Image) -> bool:
    """Return whether Pillow itself turns a picture by its orientation tag while it decodes the pixels."""
    return image.format == "TIFF"


def _turn(pixels: Image.Image, tag: int, is_turned: bool, upright: bool) -> Image.Image:
    """Return pixels as the orientation `tag` shows them if `upright`, else as they are stored."""
    # `is_turned` says whether the pixels already are as the tag shows them.
    if upright == is_turned or tag == 1:
        return pixels
    turn, back = _TRANSPOSES[tag]
    return pixels.transpose(turn if upright else back)


# EXIF orientation tag -> the operation that shows the stored pixels upright, and its inverse
_TRANSPOSES = {
    2: (Image.Transpose.FLIP_LEFT_RIGHT,) * 2,
    3: (Image.Transpose.ROTATE_180,) * 2,
    4: (Image.Transpose.FLIP_TOP_BOTTOM,) * 2,
    5: (Image.Transpose.TRANSPOSE,) * 2,
    6: (Image.Transpose.ROTATE_270, Image.Transpose.ROTATE_90),
    7: (Image.Transpose.TRANSVERSE,) * 2,
    8: (Image.Transpose.ROTATE_90, Image.Transpose.ROTATE_270),
}


def _orientation(image: Image.Image) -> int:
    """Return the EXIF orientation tag of a picture; 1, upright, where it has none or an undefined one."""
    tag = image.getexif().get(0x0112, 1)
    return tag if tag in _TURNS else 1


def load_image(path: Path, upright: bool = False) -> np.ndarray:
    """Read a picture as uint8 [H, W, 3], sRGB.

    Gray becomes RGB, and 16-bit gray levels are divided by 257. A picture with transparent pixels is shown over black:
    its colors are multiplied by alpha, so that colors which nobody sees have no effect. Black is what Gaussians are
    rendered over, as in 3DGS; pixels without supervision would need a mask in every stage that compares pictures.

    Args:
        upright: True applies the EXIF orientation tag. False ignores the tag, because poses that come with photographs
            refer to the stored pixels.

    Raises:
        BadInput: the file is missing or truncated, or its pixels have more than 16 bits or are floats. The message
            names the file.
    """
    with open_image(path) as image:
        tag, is_turned = _orientation(image), _is_turned(image)
        image.load()  # before the size is used, which changes where Pillow turns the pixels
        turned = _turn(image, tag, is_turned, upright)
        if image.mode[0] not in "IF":
            return np.array(_to_rgb(turned))
        levels = np.array(turned)
        if image.mode == "F" or levels.min() < 0 or levels.max() > 65535:
            raise BadInput(f"{path}: {image.mode} pixels; save it as a picture of 8 or 16 bits")
        return np.repeat(np.round(levels / 257).astype(np.uint8)[..., None], 3, axis=2)


def _to_rgb(image: Image.Image) -> Image.Image:
    """Return a picture of 8 bits as RGB, shown over black where it is transparent."""
    if not image.has_transparency_data:
        return image.convert("RGB")
    return Image.alpha_composite(Image.new("RGBA", image.size, "black"), image.convert("RGBA")).convert("RGB")


def load_alpha(path: Path, upright: bool = False) -> np.ndarray | None:
    """Read the alpha channel of a picture as uint8 [H, W]; None without one, or if every pixel is opaque.

    Args:
        upright: True applies the orientation tag, as in `load_image`.
    """
    with open_image(path) as image:
        if image.mode[0] in "IF" or not image.has_transparency_data:
            return None
        tag, is_turned = _orientation(image), _is_turned(image)
        image.load()
        turned = _turn(image, tag, is_turned, upright)
        alpha = np.array(turned.convert("RGBA").getchannel("A"))
        return None if alpha.min() == 255 else alpha


def load_thumbnail(path: Path, side: int, upright: bool = False) -> np.ndarray:
    """Read a picture, reduced so that its longer side is at most `side` px, as uint8 [h, w, 3] over black.

    A picture is never enlarged. OpenCV is not imported.

    Args:
        upright: True applies the orientation tag, as in `load_image`.
    """
    with open_image(path) as image:
        if image.mode[0] not in "IF":
            tag, is_turned = _orientation(image), _is_turned(image)
            image.draft("RGB", (2 * side, 2 * side))  # JPEGs are decoded at a fraction of their size
            image = _to_rgb(image)
            image.thumbnail((side, side), Image.Resampling.BOX)
            return np.array(_turn(image, tag, is_turned, upright))
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


def load_mask(path: Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """Read a mask that `save_mask` wrote, as bool [H, W], True = masked.

    Masks that a user made are read by `reffusion.io.given_masks`.

    Args:
        size: (height, width) to which the mask is resized by nearest neighbor; None keeps the file's size.

    Raises:
        BadInput: the file is unreadable, or has other values than 0 and 255; the message names it.
    """
    with open_image(path, "a readable mask") as image:
        levels = np.array(image.convert("L"))
    mask = levels == 255
    if not (mask | (levels == 0)).all():
        raise BadInput(f"{path}: its values are not only 0 and 255; it is no mask that a stage wrote")
    return mask if size is None else resize_nearest(mask, size)


def fitting_size(width: int, height: int, longest: int) -> tuple[int, int]:
    """Return the (width, height) of a picture reduced so that its longer side is at most `longest`; never enlarged."""
    factor = min(1.0, longest / max(width, height))
    return max(1, round(width * factor)), max(1, round(height * factor))


def resize_image(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize a picture, uint8 [h, w, 3] or [h, w], to `size`.

    The interpolation is area averaging if neither side grows, else bicubic. A picture that has this size already is
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
    """Return an array [H, W, ...] resized to [*size, ...] by nearest neighbor, as a copy.

    Each new pixel takes the value of the old pixel that contains the new pixel's center.

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
