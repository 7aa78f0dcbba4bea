"""Clicks that a scene brings, checked against its photographs, and where undistorted views show what they are on."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from reffusion.capture.layouts.capture import Capture
from reffusion.capture.lens import Lens, to_directions, to_pixels, undoing
from reffusion.capture.lenses import load_lenses, photograph_sizes
from reffusion.capture.roles import Roles
from reffusion.capture.views import find_view, known
from reffusion.io.files import BadInput
from reffusion.io.images import image_size
from reffusion.params.clicks import Clicked


def check_clicks(clicks: Clicked, capture: Capture, roles: Roles) -> None:
    """BadInput for a view that is unknown or not trained on, a click beside its photograph, no click on the object, or
    masks that tell objects apart, which clicks do not."""
    if set(roles.masks) - {""}:
        raise BadInput("scene.yaml: clicks: the masks tell objects apart, and clicks do not; leave one of them out")
    named = {known(name, capture.pictures, "clicks"): points for name, points in clicks.items()}
    if len(named) < len(clicks):
        raise BadInput("scene.yaml: clicks: a view is named twice, with its ending and without; keep one")
    for name, points in named.items():
        if name not in roles.train or name in roles.clean:
            raise BadInput(f"scene.yaml: clicks: '{name}' is no training view that shows the object; click on one")
        if name in roles.masks.get("", {}):
            raise BadInput(f"scene.yaml: clicks: '{name}' has a mask, {roles.masks[''][name]}; remove one of them")
        width, height = image_size(capture.pictures[name], upright=capture.upright)
        if beside := [(x, y) for x, y, _ in points if x > width or y > height]:
            x, y = beside[0]
            raise BadInput(
                f"scene.yaml: clicks: [{x:g}, {y:g}] lies outside of '{name}', which has {width}x{height} px; count "
                "from its upper left corner"
            )
    if not roles.masks.get("") and not any(sign == "+" for points in named.values() for _, _, sign in points):
        raise BadInput("scene.yaml: clicks: none is on the object; add one like [x, y, +]")


def to_views(poses: Path, clicks: Clicked) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """View -> points [K, 2] in its undistorted picture, and bool [K], on the object; those that it does not show are
    left out, and views that could not be placed."""
    lenses, _ = load_lenses(poses)
    sizes, found = photograph_sizes(poses), {}
    for said, points in clicks.items():
        if name := find_view(said, lenses):
            at = straightened(np.array([point[:2] for point in points]).reshape(-1, 2), lenses[name], sizes[name])
            inside = ((at >= 0) & (at <= (lenses[name].width, lenses[name].height))).all(1)
            found[name] = at[inside], np.array([point[2] == "+" for point in points], bool)[inside]
    return found


def straightened(points: np.ndarray, lens: Lens, size: tuple[int, int]) -> np.ndarray:
    """Pixels [K, 2] of the photograph of `size` (width, height) -> pixels of its undistorted picture."""
    pinhole, _ = _straight(lens)
    directions = to_directions(points * (lens.width / size[0], lens.height / size[1]), lens)
    return directions * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)


def photographed(points: np.ndarray, lens: Lens, size: tuple[int, int]) -> np.ndarray:
    """Inverse of `straightened`."""
    pinhole, _ = _straight(lens)
    directions = (points - (pinhole.cx, pinhole.cy)) / (pinhole.fx, pinhole.fy)
    return to_pixels(directions, lens) * (size[0] / lens.width, size[1] / lens.height)


def as_photographed(mask: np.ndarray, lens: Lens, size: tuple[int, int]) -> np.ndarray:
    """A mask [H, W] of the undistorted picture as its photograph lies, of `size` (width, height); where the undistorted
    picture shows nothing of it, its rim goes on."""
    import cv2

    at = _straight(lens)[1]
    soft = mask.astype(np.float32)
    if at is not None:
        soft = cv2.remap(soft, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return cv2.resize(soft, size, interpolation=cv2.INTER_LINEAR) > 0.5


@lru_cache(maxsize=4)
def _straight(lens: Lens) -> tuple[Lens, np.ndarray | None]:
    """The pinhole that replaces a lens, and `_back`, None where nothing moves. One lens took most captures, and
    inverting it takes longer than all else here."""
    pinhole, where = undoing(lens)
    return pinhole, None if where is None else _back(lens, pinhole)


def _back(lens: Lens, pinhole: Lens) -> np.ndarray:
    """float32 [H, W, 2]: for each pixel of the photograph, where to read in the undistorted picture, counted from the
    centre of the first pixel."""
    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    directions = to_directions(np.stack([columns, rows], -1), lens)
    return (directions * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy) - 0.5).astype(np.float32)
