"""Writes the pictures and masks of a capture for the `poses` and `raw_masks` folders: resized and undistorted."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from reffusion.capture.layouts.capture import Capture
from reffusion.capture.lens import Lens, undistort_image, undistort_mask, undistortion_map
from reffusion.capture.roles import Roles
from reffusion.io.files import BadInput
from reffusion.io.images import (
    WHITE,
    MaskValues,
    image_size,
    load_image,
    load_mask,
    resize_image,
    save_image,
    save_mask,
)


def fitting_size(width: int, height: int, longest: int) -> tuple[int, int]:
    """(width, height) with the longer side at most `longest`; proportions stay, nothing is enlarged."""
    factor = min(1.0, longest / max(width, height))
    return max(1, round(width * factor)), max(1, round(height * factor))


def load_resized(path: Path, longest: int, upright: bool) -> np.ndarray:
    """The picture, uint8 [H, W, 3], at its `fitting_size`, downscaled by area averaging."""
    image = load_image(path, upright)
    return resize_image(image, fitting_size(image.shape[1], image.shape[0], longest))


def resized_lens(name: str, capture: Capture, longest: int) -> tuple[Lens, Lens]:
    """The lens of a view whose pixels are not used, and its pinhole, at the size its picture would have."""
    width, height = image_size(capture.pictures[name], upright=capture.upright)
    lens = capture.poses.lenses[name].resized(*fitting_size(width, height, longest))
    return lens, undistortion_map(lens)[0]


def save_undistorted_view(out: Path, name: str, capture: Capture, longest: int) -> tuple[Lens, Lens]:
    """Write the undistorted picture of a view, images/<view>.png.

    Returns:
        the photograph's lens at this size, and the pinhole.

    Raises:
        BadInput: naming the file, where it is unreadable, or its distortion cannot be removed.
    """
    image = load_resized(capture.pictures[name], longest, capture.upright)
    lens = capture.poses.lenses[name].resized(image.shape[1], image.shape[0])
    try:
        pinhole, where = undistortion_map(lens)
    except ValueError as error:
        raise BadInput(f"{capture.pose_source or capture.pictures[name]}: view '{name}': {error}") from error
    save_image(out / "images" / f"{name}.png", image if where is None else undistort_image(image, where))
    return lens, pinhole


def save_undistorted_masks(out: Path, name: str, roles: Roles, lens: Lens) -> None:
    """Write the undistorted masks of a view: masks/, test_masks/ and fill/<view>.png, those that the view has; with
    several objects masks/<object>/<view>.png.

    Args:
        lens: of the view's photograph, see `reffusion.capture.lenses`.

    Raises:
        BadInput: naming the file, where it is unreadable.
    """
    own = {path for files in roles.masks.values() for path in files.values()}
    for folder, files in roles.mask_files.items():
        if name in files:
            values = roles.values if files[name] in own else WHITE
            mask, where = load_mask(files[name], (lens.height, lens.width), values), undistortion_map(lens)[1]
            save_mask(out / folder / f"{name}.png", mask if where is None else undistort_mask(mask, where))


def check_masks(masks: Mapping[str, Path], values: MaskValues = WHITE) -> None:
    """Check that masks are readable, and not all empty or all full; BadInput naming the folder."""
    shares = [load_mask(path, values=values).mean() for path in masks.values()]
    if shares and (max(shares) == 0 or min(shares) == 1):
        state, folder = "empty" if max(shares) == 0 else "full", next(iter(masks.values())).parent
        if values.ids:
            numbers = ", ".join(map(str, values.ids))
            raise BadInput(
                f"{folder}: all {len(shares)} masks are {state} for the id {numbers}; correct `masks: {{id: ...}}`"
            )
        raise BadInput(
            f"{folder}: all {len(shares)} masks are {state}; mark the object, and nothing else, with 255 (or 1)"
        )
