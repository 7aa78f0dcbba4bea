"""From the pictures of a capture to those of the `poses` folder: resized, and without the lens's distortion."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from reffusion.lens import Lens, sampling_map, undistort_image, undistort_mask, without_distortion

from .images import load_image, load_mask, save_image, save_mask
from .layouts import Capture
from .roles import Roles


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


def save_undistorted(out: Path, name: str, capture: Capture, roles: Roles, longest: int) -> Lens:
    """Write the view's image, mask, test mask and reference, all in the same pinhole, which is returned.

    Writes images/, masks/, test_masks/, references/<view>.png; the last three where the view has one.

    Raises:
        ValueError: naming the file, where one is unreadable, or its lens cannot be undone.
    """
    image = load_at(capture.pictures[name], longest, capture.upright)
    size = image.shape[1], image.shape[0]
    try:
        pinhole, where = _undoing(capture.poses.lenses[name].resized(*size))
    except ValueError as error:
        raise ValueError(f"{capture.brought_by or capture.pictures[name]}: view '{name}': {error}") from error
    straight = lambda picture: picture if where is None else undistort_image(picture, where)
    save_image(out / "images" / f"{name}.png", straight(image))
    for folder, files in (("masks", roles.masks), ("test_masks", roles.test_masks)):
        if name in files:
            mask = load_mask(files[name], (size[1], size[0]))
            save_mask(out / folder / f"{name}.png", mask if where is None else undistort_mask(mask, where))
    if name in roles.references:
        given = roles.references[name]
        reference = _resized(load_image(given.path, capture.upright), size)
        save_image(out / "references" / f"{name}.png", reference if given.undistorted else straight(reference))
    return pinhole


def check_masks(masks: Mapping[str, Path]) -> None:
    """ValueError where masks are given and not one of them holds a masked pixel, or one is unreadable."""
    found = [load_mask(path).any() for path in masks.values()]
    if found and not any(found):
        raise ValueError(
            f"{next(iter(masks.values())).parent}: all {len(found)} masks are empty; mark the object with 255 (or 1)"
        )
