"""Checks the clicks in scene.yaml, and maps points and masks between photographs and their undistorted pictures.

A click is a point in a photograph that the user marks as on the object (+) or not on the object (-).
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from reffusion.capture.layouts.capture import Capture
from reffusion.capture.lens import Lens, to_directions, to_pixels, undistortion_map
from reffusion.capture.lenses import load_lenses, load_photograph_sizes
from reffusion.capture.roles import Roles
from reffusion.capture.views import find_view, resolve_view
from reffusion.io.files import BadInput
from reffusion.io.images import image_size
from reffusion.params.clicks import Clicked


def check_clicks(clicks: Clicked, capture: Capture, roles: Roles) -> None:
    """Check that the clicks in scene.yaml can be used with the capture.

    Raises:
        BadInput: a view is unknown, named twice, not a training view, clean (without the object), or has a mask; a
            click lies outside its photograph; there are no masks and no click is on the object; or the masks
            distinguish between objects, which clicks cannot.
    """
    if set(roles.masks) - {""}:
        raise BadInput("scene.yaml: clicks: the masks tell objects apart, and clicks do not; leave one of them out")
    named = {resolve_view(name, capture.pictures, "clicks"): points for name, points in clicks.items()}
    if len(named) < len(clicks):
        raise BadInput("scene.yaml: clicks: a view is named twice, with its ending and without; keep one")
    for name, points in named.items():
        if name not in roles.train or name in roles.clean:
            raise BadInput(f"scene.yaml: clicks: '{name}' is no training view that shows the object; click on one")
        if name in roles.masks.get("", {}):
            raise BadInput(f"scene.yaml: clicks: '{name}' has a mask, {roles.masks[''][name]}; remove one of them")
        width, height = image_size(capture.pictures[name], upright=capture.upright)
        if outside := [(x, y) for x, y, _ in points if x > width or y > height]:
            x, y = outside[0]
            raise BadInput(
                f"scene.yaml: clicks: [{x:g}, {y:g}] lies outside of '{name}', which has {width}x{height} px; count "
                "from its upper left corner"
            )
    if not roles.masks.get("") and not any(sign == "+" for points in named.values() for _, _, sign in points):
        raise BadInput("scene.yaml: clicks: none is on the object; add one like [x, y, +]")


def undistort_clicks(poses: Path, clicks: Clicked) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Map clicks from photographs to undistorted pictures.

    Clicks outside the undistorted picture are left out, and so are views that the stage `poses` left out.

    Args:
        poses: the folder of the stage `poses`.
        clicks: view -> clicks, in pixels of its photograph.

    Returns:
        View -> points [K, 2], pixels of its undistorted picture; and bool [K], True if the click is on the object. K is
        0 for a view all of whose clicks are left out.
    """
    lenses, _ = load_lenses(poses)
    sizes, found = load_photograph_sizes(poses), {}
    for spelling, points in clicks.items():
        if name := find_view(spelling, lenses):
            at = undistort_points(np.array([point[:2] for point in points]).reshape(-1, 2), lenses[name], sizes[name])
            inside = ((at >= 0) & (at <= (lenses[name].width, lenses[name].height))).all(1)
            found[name] = at[inside], np.array([point[2] == "+" for point in points], bool)[inside]
    return found


def undistort_points(points: np.ndarray, lens: Lens, size: tuple[int, int]) -> np.ndarray:
    """Map pixels [K, 2] of a photograph to pixels [K, 2] of its undistorted picture.

    The results may lie outside the undistorted picture, and are NaN where the distortion cannot be inverted.

    Args:
        lens: lens of the photograph, at the size of the undistorted picture.
        size: (width, height) of the photograph.
    """
    pinhole, _ = _undistortion(lens)
    directions = to_directions(points * (lens.width / size[0], lens.height / size[1]), lens)
    return directions * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)


def distort_points(points: np.ndarray, lens: Lens, size: tuple[int, int]) -> np.ndarray:
    """Map pixels [K, 2] of an undistorted picture to pixels of its photograph: the inverse of `undistort_points`."""
    pinhole, _ = _undistortion(lens)
    directions = (points - (pinhole.cx, pinhole.cy)) / (pinhole.fx, pinhole.fy)
    return to_pixels(directions, lens) * (size[0] / lens.width, size[1] / lens.height)


def distort_mask(mask: np.ndarray, lens: Lens, size: tuple[int, int]) -> np.ndarray:
    """Resample a mask [H, W] of an undistorted picture to its photograph.

    The photograph shows more than the undistorted picture. Outside the undistorted picture, the mask's border pixels
    are repeated.

    Args:
        lens: lens of the photograph, at the size of the undistorted picture.
        size: (width, height) of the photograph.

    Returns:
        bool [height, width].
    """
    import cv2

    at = _undistortion(lens)[1]
    soft = mask.astype(np.float32)
    if at is not None:
        soft = cv2.remap(soft, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return cv2.resize(soft, size, interpolation=cv2.INTER_LINEAR) > 0.5


@lru_cache(maxsize=4)
def _undistortion(lens: Lens) -> tuple[Lens, np.ndarray | None]:
    """Return the pinhole that replaces a lens, and the `_distortion_map`, None if distortion is negligible."""
    # cached: most captures have a single lens, and inverting it takes most of the time
    pinhole, where = undistortion_map(lens)
    return pinhole, None if where is None else _distortion_map(lens, pinhole)


def _distortion_map(lens: Lens, pinhole: Lens) -> np.ndarray:
    """Return float32 [H, W, 2], where each pixel lies undistorted; (0, 0) is the center of the first pixel."""
    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    directions = to_directions(np.stack([columns, rows], -1), lens)
    return (directions * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy) - 0.5).astype(np.float32)
