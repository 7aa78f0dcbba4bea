"""From the pictures of a capture to those of the `poses` folder: resized, and without the lens's distortion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path

import numpy as np

from reffusion.capture.given import GivenReference, load_depth
from reffusion.capture.layouts.capture import Capture
from reffusion.capture.lens import Lens, sampling_map, to_pixels, undistort_image, undistort_mask, without_distortion
from reffusion.capture.roles import Roles
from reffusion.io.arrays import load_json, save_json
from reffusion.io.images import image_size, load_image, load_mask, resize_nearest, save_image, save_mask

LENSES = "lenses.json"
MUCH_LARGER = 1.5  # times the view: a picture is shrunk before it is read at moved places


def fitting_size(width: int, height: int, longest: int) -> tuple[int, int]:
    """(width, height) with the longer side at most `longest`, proportions kept, never enlarged."""
    factor = min(1.0, longest / max(width, height))
    return max(1, round(width * factor)), max(1, round(height * factor))


def load_at(path: Path, longest: int, upright: bool) -> np.ndarray:
    """The picture, uint8 [H, W, 3], at its `fitting_size`; downscaled by area averaging."""
    image = load_image(path, upright)
    return _resized(image, fitting_size(image.shape[1], image.shape[0], longest))


def _resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    import cv2

    if size == (image.shape[1], image.shape[0]):
        return image
    smaller = size[0] <= image.shape[1] and size[1] <= image.shape[0]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)


@lru_cache(maxsize=4)
def _undoing(lens: Lens) -> tuple[Lens, np.ndarray | None]:
    """The pinhole that replaces the lens, and where to read; no map where nothing moves."""
    pinhole = without_distortion(lens)
    return pinhole, None if pinhole == lens.pinhole else sampling_map(lens, pinhole)


def save_undistorted(out: Path, name: str, capture: Capture, roles: Roles, longest: int) -> tuple[Lens, Lens]:
    """Write the view's image, mask and test mask, all in the same pinhole.

    Writes images/, masks/, test_masks/<view>.png; the last two where the view has one.

    Returns:
        the photograph's lens at this size, and the pinhole.

    Raises:
        ValueError: naming the file, where one is unreadable, or its lens cannot be undone.
    """
    image = load_at(capture.pictures[name], longest, capture.upright)
    size = image.shape[1], image.shape[0]
    lens = capture.poses.lenses[name].resized(*size)
    try:
        pinhole, where = _undoing(lens)
    except ValueError as error:
        raise ValueError(f"{capture.brought_by or capture.pictures[name]}: view '{name}': {error}") from error
    save_image(out / "images" / f"{name}.png", image if where is None else undistort_image(image, where))
    for folder, files in (("masks", roles.masks), ("test_masks", roles.test_masks)):
        if name in files:
            mask = load_mask(files[name], (size[1], size[0]))
            save_mask(out / folder / f"{name}.png", mask if where is None else undistort_mask(mask, where))
    return lens, pinhole


def save_lenses(poses_dir: Path, lenses: Mapping[str, Lens], upright: bool) -> None:
    """Write lenses.json: what undistorting a picture of these views takes, at the size of the undistorted ones."""
    views = {name: asdict(lens) for name, lens in lenses.items()}
    save_json(Path(poses_dir) / LENSES, {"upright": upright, "views": views})


def load_lenses(poses_dir: Path) -> tuple[dict[str, Lens], bool]:
    """View name -> its photograph's lens, at the size of the undistorted picture; is the orientation tag obeyed?"""
    path = Path(poses_dir) / LENSES
    if not path.is_file():
        raise ValueError(f"{path}: missing; {poses_dir} is no finished `poses` folder")
    read = load_json(path)
    tuples = ("radial", "denominator", "tangential")
    views = {
        name: Lens(**{key: tuple(value) if key in tuples else value for key, value in fields.items()})
        for name, fields in read["views"].items()
    }
    return views, read["upright"]


def load_straight(
    given: GivenReference, lens: Lens, upright: bool, moved: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """A reference as its undistorted view lies: uint8 [H, W, 3], and bool [H, W]: pixels that the file has.

    Args:
        lens: of the view's photograph, see `load_lenses`.
        moved: [2, 3] affine map from the view's pixels to those that show the same in the result without it; the file
            is then read once, not twice. None: it lies as it should, and is treated as its photograph was.
    """
    image, size = load_image(given.path, upright), (lens.width, lens.height)
    pinhole, where = _undoing(lens)
    if moved is None:
        image = _resized(image, size)
        straight = image if where is None or given.undistorted else undistort_image(image, where)
        return straight, np.ones(straight.shape[:2], bool)
    if image.shape[1] > MUCH_LARGER * size[0]:
        image = _resized(image, size)
    at = _places(image.shape, pinhole if given.undistorted else lens, pinhole, moved)
    inside = ((at >= 0) & (at <= (image.shape[1], image.shape[0]))).all(-1)
    return undistort_image(image, at), inside


def load_straight_depth(
    given: GivenReference, lens: Lens, upright: bool, moved: np.ndarray | None = None
) -> np.ndarray | None:
    """The reference's depth map as `load_straight` gives its picture, float32 [H, W] by the nearest pixel, NaN where it
    says nothing; None where it has none.

    Raises:
        ValueError: naming the file, where it is no depth map, or of other proportions than its picture.
    """
    if given.depth is None:
        return None
    depth, (of_width, of_height) = load_depth(given.depth), image_size(given.path, upright)
    height, width = depth.shape
    if abs(width * of_height - height * of_width) > 0.01 * width * of_height:
        raise ValueError(
            f"{given.depth}: {width}x{height} px, but {given.path.name} has {of_width}x{of_height}; "
            "make it over the whole picture, in its proportions"
        )
    pinhole, where = _undoing(lens)
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


def check_masks(masks: Mapping[str, Path]) -> None:
    """ValueError where masks are given and not one of them holds a masked pixel, or one is unreadable."""
    found = [load_mask(path).any() for path in masks.values()]
    if found and not any(found):
        raise ValueError(
            f"{next(iter(masks.values())).parent}: all {len(found)} masks are empty; mark the object with 255 (or 1)"
        )
