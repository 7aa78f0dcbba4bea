"""References that a scene brings, as the undistorted pictures of their views lie."""

from __future__ import annotations

import numpy as np

from reffusion.capture.lens import Lens, to_pixels, undistort_image, undoing
from reffusion.io.depth_maps import load_depth
from reffusion.io.files import BadInput
from reffusion.io.images import image_size, load_image, resize_nearest, resized
from reffusion.references.files import GivenReference

MUCH_LARGER = 1.5  # times the view: a picture is shrunk before it is read at moved places


def load_straight(
    given: GivenReference, lens: Lens, upright: bool, moved: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """A reference as its undistorted view lies: uint8 [H, W, 3], and bool [H, W]: pixels that the file has.

    Args:
        lens: of the view's photograph, see `reffusion.capture.lenses`.
        moved: [2, 3] affine map from the view's pixels to those that show the same in the result without it; the file
            is then read once, not twice. None: it lies as it should, and is treated as its photograph was.
    """
    image, size = load_image(given.path, upright), (lens.width, lens.height)
    pinhole, where = undoing(lens)
    if moved is None:
        image = resized(image, size)
        straight = image if where is None or given.undistorted else undistort_image(image, where)
        return straight, np.ones(straight.shape[:2], bool)
    if image.shape[1] > MUCH_LARGER * size[0]:
        image = resized(image, size)
    at = _places(image.shape, pinhole if given.undistorted else lens, pinhole, moved)
    inside = ((at >= 0) & (at <= (image.shape[1], image.shape[0]))).all(-1)
    return undistort_image(image, at), inside


def load_straight_depth(
    given: GivenReference, lens: Lens, upright: bool, moved: np.ndarray | None = None
) -> np.ndarray | None:
    """The reference's depth map as `load_straight` gives its picture, float32 [H, W] by the nearest pixel, NaN where it
    says nothing; None where it has none.

    Raises:
        BadInput: naming the file, where it is no depth map, or of other proportions than its picture.
    """
    if given.depth is None:
        return None
    depth, (of_width, of_height) = load_depth(given.depth), image_size(given.path, upright)
    height, width = depth.shape
    if abs(width * of_height - height * of_width) > 0.01 * width * of_height:
        raise BadInput(
            f"{given.depth}: {width}x{height} px, but {given.path.name} has {of_width}x{of_height}; "
            "make it over the whole picture, in its proportions"
        )
    pinhole, where = undoing(lens)
    if moved is None and (where is None or given.undistorted):
        return resize_nearest(depth, (lens.height, lens.width))
    at = _places(depth.shape, pinhole if given.undistorted else lens, pinhole, np.eye(2, 3) if moved is None else moved)
    column, row = (np.floor(at[..., k]).astype(int) for k in (0, 1))
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    return np.where(inside, depth[row.clip(0, height - 1), column.clip(0, width - 1)], np.float32(np.nan))


def _places(shape: tuple[int, ...], lens: Lens, pinhole: Lens, moved: np.ndarray) -> np.ndarray:
    """[H, W, 2]: for each pixel of the view, where to read in a file of this shape that was made over the lens."""
    columns, rows = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    at = np.stack([columns, rows], -1) @ moved[:, :2].T + moved[:, 2]
    directions = (at - (pinhole.cx, pinhole.cy)) / (pinhole.fx, pinhole.fy)
    return to_pixels(directions, lens) * (shape[1] / lens.width, shape[0] / lens.height)
