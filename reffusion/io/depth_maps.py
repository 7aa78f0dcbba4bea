"""Reading of depth maps that other tools wrote: 16-bit or float pictures, .npy and .exr files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reffusion.io.arrays import load_array
from reffusion.io.files import BadInput
from reffusion.io.images import load_exr, open_image


def load_depth(path: Path) -> np.ndarray:
    """Read a map of depth or disparity as float32 [h, w], in the unit of the file, without any scaling.

    A pixel is unknown, and becomes NaN, if its value is not finite. A value of 0 means unknown too if the file holds
    integers.

    Raises:
        BadInput: the file is unreadable, has several channels or is a picture of 8 bits, or its known values are all
            equal or cover less than 1 % of the pixels. The message names the file.
    """
    path = Path(path)
    values = _values(path)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2 or not values.size or not np.issubdtype(values.dtype, np.number) or np.iscomplexobj(values):
        raise BadInput(f"{path}: {values.dtype} {list(values.shape)}; a depth map is one number for each pixel")
    empty = (values == 0) if np.issubdtype(values.dtype, np.integer) else np.zeros(values.shape, bool)
    with np.errstate(over="ignore"):
        values = values.astype(np.float32)
    values[empty | ~np.isfinite(values)] = np.nan
    if np.isnan(values).mean() > 0.99:
        raise BadInput(
            f"{path}: hardly a pixel is known (0 or not finite); depth is needed of what is drawn, and around"
        )
    if np.nanmin(values) == np.nanmax(values):
        raise BadInput(f"{path}: all its values are {np.nanmin(values):g}; that is no depth map")
    return values


def _values(path: Path) -> np.ndarray:
    """Read the array of a file in its own type; raises BadInput if it is unreadable or a picture of 8 bits."""
    if path.suffix.lower() == ".exr":
        return load_exr(path)
    if path.suffix.lower() == ".npy":
        return load_array(path, "a readable depth map")
    with open_image(path, "a readable depth map") as image:
        mode, values = image.mode, np.array(image)
    if mode[0] not in "IF":
        raise BadInput(f"{path}: {mode} pixels of 8 bits are too coarse for depth; write 16-bit gray, .npy or .exr")
    return values
