"""Undistortion of references and their depth maps, by the lens of their views' photographs."""

from __future__ import annotations

import numpy as np

from reffusion.capture.lens import Lens, to_pixels, undistort_image, undistortion_map
from reffusion.io.depth_maps import load_depth
from reffusion.io.files import BadInput
from reffusion.io.images import image_size, load_alpha, load_image, resize_image, resize_nearest
from reffusion.references.files import ReferenceFile, obeys_orientation

DOWNSCALE_ABOVE = 1.5  # pictures wider than this many times their view are reduced before they are resampled


def undistort_reference(
    given: ReferenceFile, lens: Lens, photo: np.ndarray, affine: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Load the picture of a reference, and undistort it as the photograph of its view was undistorted.

    Where the picture is transparent, the photograph shows.

    Args:
        given: the files of the reference.
        lens: the lens of the picture, at the size of the undistorted photograph: that of the view's photograph
            (`reffusion.capture.lenses`), or the pinhole of the undistorted one. A picture of the latter is only
            resized and aligned.
        photo: uint8 [H, W, 3], the undistorted photograph.
        affine: [2, 3], an affine map that aligns the picture in addition. It leads from pixels of the view to pixels of
            the picture that this function returns for None. Both steps take a single resampling of the file. None if
            the picture needs no alignment.

    Returns:
        The picture, uint8 [H, W, 3] of the size of `lens`, and bool [H, W], the pixels that the file covers: where it
        is rather opaque and, with `affine`, not beyond its border.

    Raises:
        BadInput: the file is missing or truncated, or is no picture.
    """
    upright = obeys_orientation(given.path, (lens.width, lens.height))
    image, inside = _resample(load_image(given.path, upright), lens, affine)
    alpha = load_alpha(given.path, upright)
    if alpha is None:
        return image, inside
    share = _resample(alpha, lens, affine)[0] / 255.0
    blended = image + (1 - share[..., None]) * photo  # `load_image` multiplied the colors by alpha
    return np.round(blended).clip(0, 255).astype(np.uint8), inside & (share >= 0.5)


def _resample(image: np.ndarray, lens: Lens, affine: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return a picture or its alpha, uint8, undistorted and aligned, and bool [H, W], where it has pixels."""
    # The arguments are those of `undistort_reference`.
    size = lens.width, lens.height
    pinhole, where = undistortion_map(lens)
    if affine is None:
        image = resize_image(image, size)
        straight = image if where is None else undistort_image(image, where)
        return straight, np.ones(straight.shape[:2], bool)
    if image.shape[1] > DOWNSCALE_ABOVE * size[0]:
        image = resize_image(image, size)
    points = _sampling_points(image.shape, lens, pinhole, affine)
    inside = np.all((points >= 0) & (points <= (image.shape[1], image.shape[0])), -1)
    return undistort_image(image, points), inside


def undistort_reference_depth(given: ReferenceFile, lens: Lens, affine: np.ndarray | None = None) -> np.ndarray | None:
    """Load the depth map of a reference, and undistort it as `undistort_reference` does, but by the nearest pixel.

    Args:
        given, lens, affine: as of `undistort_reference`.

    Returns:
        float32 [H, W] in the unit of the file, NaN where unknown and outside the file; None if the reference has no
        depth map.

    Raises:
        BadInput: the file is no depth map, or has other proportions than the picture. The message names the file.
    """
    if given.depth is None:
        return None
    upright = obeys_orientation(given.path, (lens.width, lens.height))
    depth, (of_width, of_height) = load_depth(given.depth), image_size(given.path, upright)
    height, width = depth.shape
    if abs(width * of_height - height * of_width) > 0.01 * width * of_height:
        raise BadInput(
            f"{given.depth}: {width}x{height} px, but {given.path.name} has {of_width}x{of_height}; "
            "make it over the whole picture, in its proportions"
        )
    pinhole, where = undistortion_map(lens)
    if affine is None and where is None:
        return resize_nearest(depth, (lens.height, lens.width))
    points = _sampling_points(depth.shape, lens, pinhole, np.eye(2, 3) if affine is None else affine)
    column, row = (np.floor(points[..., k]).astype(int) for k in (0, 1))
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    return np.where(inside, depth[row.clip(0, height - 1), column.clip(0, width - 1)], np.float32(np.nan))


def _sampling_points(shape: tuple[int, ...], lens: Lens, pinhole: Lens, affine: np.ndarray) -> np.ndarray:
    """Return [H, W, 2], for each pixel of the view the position (x, y) in the file that shows the same point."""
    columns, rows = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    # `affine` is applied to the view's pixels first. `lens` is that of the file's picture, and `pinhole` that of the
    # view without distortion.
    points = np.stack([columns, rows], -1) @ affine[:, :2].T + affine[:, 2]
    directions = (points - (pinhole.cx, pinhole.cy)) / (pinhole.fx, pinhole.fy)
    return to_pixels(directions, lens) * (shape[1] / lens.width, shape[0] / lens.height)
