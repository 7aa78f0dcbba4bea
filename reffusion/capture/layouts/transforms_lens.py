"""Reads lenses from the frames of transforms.json."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.capture.layouts.capture import resize_lens
from reffusion.capture.lens import Lens
from reffusion.io.files import BadInput, shorten
from reffusion.io.images import image_size

MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "OPENCV_FISHEYE",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
)


def load_frame_lens(values: dict[str, Any], picture: Path, source: Path) -> Lens:
    """Return a frame's lens, resized to the frame's picture file (see `frame_lens` and `resize_lens`).

    Raises:
        BadInput: the frame's keys are wrong; the picture's aspect ratio is another than that of the keys w and h; or w
            and h are missing, and the principal point is far from the picture's middle.
    """
    width, height = image_size(picture)
    lens = frame_lens(values, picture, source, (width, height))
    central = 0.25 < lens.cx / width < 0.75 and 0.25 < lens.cy / height < 0.75
    if not {"w", "h"} & values.keys() and not central and (lens.cx or lens.cy):  # zeros: see `check_intrinsics`
        raise BadInput(
            f"{source}: cx, cy = {lens.cx:g}, {lens.cy:g} for '{picture.name}' of {width}x{height} px: they are "
            "those of another size; add that size as w and h"
        )
    return resize_lens(lens, picture)


def frame_lens(values: dict[str, Any], picture: Path, source: Path, size: tuple[int, int]) -> Lens:
    """Return the lens that the keys of a frame describe (fl_x or camera_angle_x, cx, k1, camera_model ...).

    Args:
        values: the keys of the frame, together with the keys of the whole file that the frame does not have.
        picture, source: the frame's picture and the transforms file, for messages.
        size: (width, height) to use if the keys w and h are missing.

    Raises:
        BadInput: a value is no finite number, the focal length is missing, a size or focal length is not positive, or
            the camera model is not supported.
    """
    lens = _lens(values, picture, source, size)
    if min(lens.fx, lens.fy) <= 0:
        raise BadInput(f"{source}: the focal length (or angle) of '{picture.name}' is not positive")
    if lens.width < 1 or lens.height < 1:
        raise BadInput(f"{source}: w and h of '{picture.name}' are {lens.width}x{lens.height}; give its size in pixels")
    return lens


def read_number(values: dict[str, Any], key: str, default: float, picture: Path, source: Path) -> float:
    """Return the number under a key of a frame, or `default` if the key is missing.

    Args:
        values: the keys of the frame.
        picture, source: the frame's picture and the transforms file, for messages.

    Raises:
        BadInput: the value is no number, is NaN, or has an absolute value of 1e12 or more.
    """
    value = values.get(key, default)
    if isinstance(value, str):
        raise BadInput(
            f"{source}: {key} = \"{shorten(value)}\" of '{picture.name}' is text; write the number without quotes"
        )
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e12:
        raise BadInput(f"{source}: {key} = {shorten(value)} of '{picture.name}' is no finite number")
    return float(value)


def _lens(values: dict[str, Any], picture: Path, source: Path, size: tuple[int, int]) -> Lens:
    """Return `frame_lens`, before sizes and focal lengths are checked to be positive."""
    number = lambda key, default=0.0: read_number(values, key, default, picture, source)
    width, height = number("w", size[0]), number("h", size[1])
    model = _camera_model(values, source)
    fx = _focal_length(values, "x", width, number)
    if fx is None:
        raise BadInput(f"{source}: neither fl_x nor camera_angle_x for '{picture.name}'; add one of them to the file")
    fy = _focal_length(values, "y", height, number)
    fisheye = "FISHEYE" in model or bool(values.get("is_fisheye", False))
    k = [number(f"k{i}") for i in range(1, 7)]
    rational = model == "FULL_OPENCV"
    return Lens(
        round(width),
        round(height),
        fx,
        fx if fy is None else fy,
        number("cx", width / 2),
        number("cy", height / 2),
        radial=_strip_zeros(k[:3] if rational else k[:4]),
        denominator=_strip_zeros(k[3:]) if rational else (),
        tangential=(0.0, 0.0) if fisheye else (number("p1"), number("p2")),
        fisheye=fisheye,
        model=model,
    )


def _camera_model(values: dict[str, Any], source: Path) -> str:
    """Return the name of a frame's camera model, one of `MODELS`; raises BadInput for another."""
    model = values.get("camera_model", "OPENCV")
    model = model.upper() if isinstance(model, str) else shorten(model)
    if model == "EQUIRECTANGULAR":
        raise BadInput(
            f"{source}: camera_model {model} means 360-degree panoramas; cut them into perspective views: "
            f"`reffusion panoramas {source.parent}`"
        )
    if model not in MODELS:
        raise BadInput(f"{source}: camera_model {shorten(model)} is not understood; one of {', '.join(MODELS)}")
    return model


def _focal_length(values: dict[str, Any], axis: str, extent: float, number: Callable[..., float]) -> float | None:
    """Return the focal length in px from fl_<axis>, else camera_angle_<axis>; None without both, 0 for a bad angle."""
    if f"fl_{axis}" in values:
        return number(f"fl_{axis}")
    if f"camera_angle_{axis}" in values:
        angle = number(f"camera_angle_{axis}")
        return 0.5 * extent / float(np.tan(0.5 * angle)) if 0 < angle < np.pi else 0.0
    return None


def _strip_zeros(coefficients: list[float]) -> tuple[float, ...]:
    """Return the coefficients without trailing zeros."""
    while coefficients and coefficients[-1] == 0.0:
        coefficients = coefficients[:-1]
    return tuple(coefficients)
