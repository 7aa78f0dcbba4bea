"""Resizes and undistorts the pictures and masks of a capture, for the stages `poses` and `raw_masks`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from reffusion.capture.layouts.capture import Capture
from reffusion.capture.lens import Lens, undistort_image, undistort_mask, undistortion_map
from reffusion.capture.roles import Roles
from reffusion.io.files import BadInput
from reffusion.io.given_masks import WHITE, MaskValues, load_given_mask, load_united_masks, mask_file_size
from reffusion.io.images import fitting_size, image_size, load_alpha, load_image, resize_image, save_image, save_mask
from reffusion.io.scene import IGNORED


def load_resized(path: Path, longest: int, upright: bool) -> np.ndarray:
    """Read a picture as uint8 [H, W, 3], reduced to its `fitting_size` by area averaging.

    Args:
        longest: largest length of the longer side in pixels.
        upright: True to obey the EXIF orientation tag.
    """
    image = load_image(path, upright)
    return resize_image(image, fitting_size(image.shape[1], image.shape[0], longest))


def resized_lens(name: str, capture: Capture, longest: int) -> tuple[Lens, Lens]:
    """Return the lens of a view's photograph and the pinhole of its undistorted picture, without writing the picture.

    Both are for the size that the picture has after reduction to `longest` (`fitting_size`). This is for camera-only
    views (views whose pixels are not used). Raises BadInput as `undistorted_pinhole` does.
    """
    width, height = image_size(capture.pictures[name], upright=capture.upright)
    lens = capture.poses.lenses[name].resized(*fitting_size(width, height, longest))
    return lens, undistortion_map(lens)[0]


def save_undistorted_view(out: Path, name: str, capture: Capture, longest: int) -> tuple[Lens, Lens]:
    """Write the undistorted picture of the view `name` to `out`/images/<view>.png.

    Args:
        longest: largest length of the picture's longer side in pixels; larger photographs are reduced first.

    Returns:
        The photograph's lens with distortion, resized to the written picture; and the pinhole of the written picture.

    Raises:
        BadInput: the photograph is unreadable, or its distortion cannot be removed; the message names the file.
    """
    image = load_resized(capture.pictures[name], longest, capture.upright)
    lens = capture.poses.lenses[name].resized(image.shape[1], image.shape[0])
    try:
        pinhole, where = undistortion_map(lens)
    except ValueError as error:
        raise BadInput(f"{capture.pose_source or capture.pictures[name]}: view '{name}': {error}") from error
    save_image(out / "images" / f"{name}.png", image if where is None else undistort_image(image, where))
    return lens, pinhole


def describe_transparency(names: Collection[str], capture: Capture) -> list[str]:
    """Return one warning that names the views with transparent pixels in their photographs, in a list, else [].

    Only photographs with an alpha channel are read.
    """
    found = [name for name in names if load_alpha(capture.pictures[name]) is not None]
    if not found:
        return []
    named = ", ".join(found[:4]) + (f" and {len(found) - 4} more" if len(found) > 4 else "")
    count = "1 photograph has" if len(found) == 1 else f"{len(found)} photographs have"
    return [f"{count} transparent pixels, which are trained on as black: {named}"]


def save_undistorted_masks(out: Path, name: str, roles: Roles, lens: Lens) -> None:
    """Write the undistorted masks of the view `name` below `out`, as far as the view has such masks.

    The files are masks/<view>.png (masks/<object>/<view>.png if masks distinguish between objects),
    test_masks/<view>.png and fill/<view>.png, all of the size of `lens`.

    Args:
        lens: lens of the view's photograph, with its distortion, at the size of the undistorted picture.

    Raises:
        BadInput: a mask is unreadable; the message names the file.
    """
    own = {path for files in roles.masks.values() for path in files.values()}
    for folder, files in roles.mask_files.items():
        if name in files:
            values = roles.values if files[name] in own else WHITE
            save_mask(out / folder / f"{name}.png", load_undistorted_mask(files[name], lens, values))


def load_undistorted_mask(path: Path, lens: Lens, values: MaskValues = WHITE) -> np.ndarray:
    """Read the mask file of a photograph and undistort it, bool [H, W], at the size of `lens`.

    Args:
        values: the pixel values that mark the object.

    Raises:
        BadInput: the file is unreadable; the message names it.
    """
    mask, where = load_given_mask(path, (lens.height, lens.width), values), undistortion_map(lens)[1]
    return mask if where is None else undistort_mask(mask, where)


def save_ignored_pixels(out: Path, name: str, roles: Roles, lens: Lens) -> None:
    """Write the union of a view's ignore masks, undistorted, to `out`/ignored/<view>.png; nothing without masks.

    Args:
        lens: lens of the view's photograph at the size of the undistorted picture.
    """
    if masks := [load_undistorted_mask(path, lens) for path in roles.ignore.get(name, ())]:
        save_mask(out / IGNORED / f"{name}.png", np.logical_or.reduce(masks))


def check_ignored(ignore: Mapping[str, Sequence[Path]]) -> None:
    """Raise BadInput if an ignore mask is unreadable, or a view's masks together cover it; `ignore`: view -> files."""
    for name, paths in ignore.items():
        if load_united_masks(paths, mask_file_size(paths[0])[::-1]).all():
            raise BadInput(
                f"{paths[-1]}: all of the view '{name}' is ignored; leave it out instead: `exclude: [{name}]`"
            )


def check_masks(masks: Mapping[str, Path], values: MaskValues = WHITE) -> None:
    """Check that masks are readable, and that not all of them are empty and not all of them are full.

    Args:
        masks: view name -> file.
        values: the pixel values that mark the object.

    Raises:
        BadInput: a mask is unreadable, or all are empty or full; the message names the file or the folder.
    """
    shares = [load_given_mask(path, values=values).mean() for path in masks.values()]
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
