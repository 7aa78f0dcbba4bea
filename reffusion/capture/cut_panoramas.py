"""Cuts equirectangular panoramas into perspective views, which structure from motion places as rigs.

The views of a panorama share its center, and their rotations to each other are known. A *direction* is a view's
heading and elevation in degrees; heading 0 is the middle of the panorama, and turns to the right; elevation is upwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from reffusion import trace
from reffusion.capture import sfm
from reffusion.geometry import pixel_rays
from reffusion.io.files import BadInput
from reffusion.io.images import load_image, resize_image, save_image
from reffusion.types import Camera

# Eight views of 90 degrees: neighbors share half of their field of view, so that each thing is in two of them.
DIRECTIONS = tuple((heading, 0.0) for heading in range(0, 360, 45))
FIELD = 90.0  # degrees, of view in width and in height
LARGEST = 1600  # px, larger side of the views, as of the pictures in the paper


def perspective_camera(direction: tuple[float, float], size: int, name: str = "") -> Camera:
    """Return the square camera of `size` px at the origin that looks in a direction, in degrees; (0, 0) is along z."""
    heading, elevation = np.radians(direction)
    turn, tilt = np.eye(4), np.eye(4)
    turn[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(heading), -np.sin(heading), np.sin(heading), np.cos(heading)
    tilt[[1, 1, 2, 2], [1, 2, 1, 2]] = np.cos(elevation), np.sin(elevation), -np.sin(elevation), np.cos(elevation)
    focal = size / 2 / np.tan(np.radians(FIELD) / 2)
    return Camera(name, size, size, focal, focal, size / 2, size / 2, tilt @ turn)


def view_size(panorama_width: int) -> int:
    """Return the side in px of the views of a panorama: as detailed in the middle as the panorama, up to `LARGEST`."""
    focal = panorama_width / (2 * np.pi)
    return min(LARGEST, round(2 * focal * np.tan(np.radians(FIELD) / 2)))


def cut_view(panorama: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the view of a camera at the center of a panorama, uint8 [size, size, 3].

    Args:
        panorama: uint8 [H, 2 H, 3], equirectangular, the horizon in the middle.
        camera: see `perspective_camera`; only its rotation counts.
    """
    # A panorama that is more detailed than the view is reduced first.
    width = round(2 * np.pi * camera.fx)
    source = resize_image(panorama, (width, width // 2)) if width < panorama.shape[1] else panorama
    height, width = source.shape[:2]
    x, y, z = np.moveaxis(pixel_rays(camera) @ camera.world_to_camera[:3, :3], -1, 0)
    u = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * width - 0.5
    v = (np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * height - 0.5
    # The left and the right border are neighbors; above the first and below the last row is that row.
    wide = np.concatenate([source[:, -2:], source, source[:, :2]], axis=1)
    maps = (u + 2).astype(np.float32), v.astype(np.float32)
    return cv2.remap(wide, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def check_empty(out: Path) -> None:
    """Raise BadInput if a folder holds anything; it may be missing."""
    if out.exists() and any(out.iterdir()):
        raise BadInput(f"{out}: not empty; name another folder (--out)")


def cut_panoramas(panoramas: Mapping[str, Path], out: Path) -> str:
    """Cut panoramas into views, images/<heading>/<name>.png in `out`, and place the views: sparse/0, a COLMAP model.

    The first panorama sets the size of all views (`view_size`).

    Args:
        panoramas: name -> file.
        out: the folder to write, which `load_capture` reads; it may exist if it is empty.

    Returns:
        A sentence about what was written.

    Raises:
        BadInput: a picture is not twice as wide as high; `out` is not empty; or fewer than 3 panoramas can be placed.
    """
    check_empty(out)
    cameras: dict[str, Camera] = {}
    names, files = list(panoramas), list(panoramas.values())
    for k in trace.progress(len(names), "panoramas"):
        picture = load_image(files[k])
        height, width = picture.shape[:2]
        if width != 2 * height:
            raise BadInput(f"{files[k]}: {width}x{height} px; an equirectangular panorama is twice as wide as high")
        if not cameras:
            cameras = {_folder(each): perspective_camera(each, view_size(width), _folder(each)) for each in DIRECTIONS}
        for folder, camera in cameras.items():
            save_image(out / "images" / folder / f"{names[k]}.png", cut_view(picture, camera))
    placed = sfm.reconstruct_rigs(out / "images", list(cameras.values()), out / "sparse" / "0", out / "sfm")
    lost = f"; {len(names) - placed} could not be placed" if placed < len(names) else ""
    return f"{out}: {placed * len(cameras)} views of {placed} panoramas, placed{lost}; go on with scene={out}"


def _folder(direction: Sequence[float]) -> str:
    """Return the name of a direction's folder: its heading in three digits, such as "045"."""
    return f"{round(direction[0]):03d}"
