"""Refuses 360-degree panoramas, which no lens of this project describes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from reffusion.io.files import BadInput
from reffusion.io.images import load_thumbnail, open_image

PROJECTION = re.compile(rb"GPano:ProjectionType\W+(equirectangular|cylindrical)")  # in the XMP data of a picture
LOOKED_AT = 8  # largest number of pictures whose borders are compared
IMAGE_FOLDERS = ("images", "photos", "input", "rgb", ".")  # usual folders of pictures without poses
SIDE = 512  # px, width of the reduced pictures
# The left and the right border of a panorama are neighbors. They may differ by this many times the difference of other
# neighboring columns.
ALIKE = 2.0
LEAST_CONTRAST = 6.0  # levels of 255: standard deviation along the borders, below which they are not compared


def refuse_panoramas(scene: Path, pictures: Mapping[str, Path]) -> None:
    """Raise BadInput if pictures are panoramas, by their metadata (GPano) or by what they show.

    Without metadata, pictures are panoramas if they are exactly twice as wide as high and in most of them the left and
    the right border show the same.

    Args:
        scene: the scene's folder, for the message.
        pictures: view name -> picture file.
    """
    heads = {name: _read_head(path) for name, path in pictures.items()}
    found = [name for name, (declared, _) in heads.items() if declared]
    if not found:
        wide = [name for name, (_, is_wide) in heads.items() if is_wide]
        some = wide[:: -(-len(wide) // LOOKED_AT)] if 2 * len(wide) > len(pictures) else []
        found = wide if 2 * sum(_is_closed(pictures[name]) for name in some) > len(some) else []
    if found:
        raise BadInput(
            f"{next(iter(pictures.values())).parent}: {len(found)} of {len(pictures)} pictures are 360-degree "
            f"panoramas ({', '.join(found[:3])}{', ...' if len(found) > 3 else ''}); cut them into perspective views: "
            f"`reffusion panoramas {scene}`"
        )


def _read_head(path: Path) -> tuple[bool, bool]:
    """Return whether the metadata of a picture call it a panorama, and whether it is twice as wide as high."""
    with open_image(path) as image:
        xmp = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
        declared = PROJECTION.search(xmp if isinstance(xmp, bytes) else xmp.encode())
        return declared is not None, image.width == 2 * image.height


def _is_closed(path: Path) -> bool:
    """Return whether the left and right border of a picture show the same, and are not plain."""
    pixels = load_thumbnail(path, SIDE).astype(np.float32)
    left, right = pixels[:, 0], pixels[:, -1]
    inside = np.abs(np.diff(pixels, axis=1)).mean(axis=(0, 2))
    alike = float(np.abs(left - right).mean()) <= ALIKE * float(np.median(inside))
    return alike and min(float(left.std()), float(right.std())) > LEAST_CONTRAST
