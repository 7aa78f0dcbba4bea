"""The detail that the views of a capture support: resolution of pictures, and degree of spherical harmonics.

Also samples pictures at the points that are visible in them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isqrt

import numpy as np

from reffusion import geometry
from reffusion.capture.normalized_frame import nearest_depths
from reffusion.types import Camera

CELLS = 40  # cells along a view's width; the nearest point of a cell hides the points behind it
NEARLY = 1.15  # ratio to the nearest depth in a cell up to which other points of the cell are visible too


def is_enlarged(images: Iterable[np.ndarray], detail: float) -> bool:
    """Return whether pictures show no more detail than pictures of half their size would.

    The test is the energy in the highest octave of spatial frequencies (above half of the highest frequency), divided
    by the energy in the octave below. The ratio is 0.25 to 0.8 in the sharp photographs that were tried, and 0.4 to 0.7
    in those of the demo. In pictures that were enlarged to twice their size by any filter, or are out of focus, it is
    0.01 to 0.08.

    Args:
        images: uint8 [H, W, 3] each, at the size at which they would be used; some of the views are enough.
        detail: threshold for the median ratio of the pictures; below it the result is True.
    """
    return float(np.median([_octave_ratio(image) for image in images])) < detail


def _octave_ratio(image: np.ndarray) -> float:
    """Return the energy in a picture's highest octave of frequencies over that in the octave below; inf if plain."""
    gray = image.mean(-1)
    height, width = gray.shape
    # without the window, the step from one border to the opposite border would count as detail
    windowed = (gray - gray.mean()) * np.outer(np.hanning(height), np.hanning(width))
    power = np.abs(np.fft.rfft2(windowed)) ** 2
    frequency = np.maximum(np.abs(np.fft.fftfreq(height))[:, None], np.fft.rfftfreq(width)[None])
    below = power[(frequency >= 0.125) & (frequency < 0.25)].sum()
    return float(power[frequency >= 0.25].sum() / below) if below > 0 else np.inf


def typical_view_count(points: np.ndarray, cameras: Sequence[Camera]) -> int:
    """Return the median over points [P, 3] of the number of views whose pictures contain the point, occluded or not.

    The median is rounded down. Without points, it is the number of cameras.
    """
    seen = np.zeros(len(points), int)
    for camera in cameras:
        uv, z = geometry.project(points, camera)
        with np.errstate(invalid="ignore"):
            framed = (uv >= 0).all(-1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
        seen += framed & (z > 0)
    return int(np.median(seen)) if len(points) else len(cameras)


def choose_sh_degree(points: np.ndarray, cameras: Sequence[Camera], most: int) -> tuple[int, int]:
    """Return the highest degree of spherical harmonics that the number of views supports, at most `most`.

    A degree has (degree + 1)^2 coefficients per color. The degree is supported if at least that many views contain a
    typical point (`typical_view_count`).

    Args:
        points: [P, 3] sparse points.
        most: largest degree that may be returned.

    Returns:
        The degree, and the `typical_view_count`.
    """
    views = typical_view_count(points, cameras)
    return min(most, max(isqrt(views) - 1, 0)), views


def sample_visible(camera: Camera, points: np.ndarray, picture: np.ndarray, cells: int = CELLS) -> np.ndarray:
    """Sample a view's picture at the projections of those points that are visible.

    The picture is divided into square cells. A point is visible if it projects into the picture, and its depth is below
    `NEARLY` times the smallest depth among the points in the same cell.

    Args:
        points: [P, 3].
        picture: [H, W, C], of the camera's size.
        cells: number of cells along the picture's width.

    Returns:
        [P, C] values of the nearest pixels; NaN for points that are not visible.
    """
    uv, depth = geometry.project(points, camera)
    values, inside = geometry.sample_nearest(picture, uv)
    cell = max(1.0, camera.width / cells)
    index = np.full(len(points), -1)  # one cell for all points outside the picture
    index[inside] = (uv[inside] // cell).astype(int) @ (10_000, 1)
    visible = inside & (depth < NEARLY * np.maximum(nearest_depths(index, depth), 0))
    return np.where(visible[:, None], values, np.nan)
