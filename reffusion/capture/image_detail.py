"""How much detail the views of a capture support: resolution, degree of spherical harmonics; and sampling pictures at
visible points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isqrt

import numpy as np

from reffusion import geometry
from reffusion.capture.frame import nearest_depths
from reffusion.types import Camera

CELLS = 40  # cells along a view's width; the nearest point of each hides those behind it
NEARLY = 1.15  # relative depth, over the nearest point's, up to which a point is visible too


def is_enlarged(images: Iterable[np.ndarray], detail: float) -> bool:
    """Do the pictures show no more than pictures of half their size would?

    A picture that is sharp to the pixel has about as much energy between a half and the whole of its highest frequency
    as in the octave below (0.25 to 0.8 of it in photographs tried, 0.4 to 0.7 in the demo's). A picture enlarged twice,
    by whatever filter, or out of focus, has 0.01 to 0.08 of it.

    Args:
        images: uint8 [H, W, 3], as large as they would be used; some views are enough.
        detail: ratio of the energies of the two octaves, median over the pictures, below which the answer is yes.
    """
    return float(np.median([_octave_ratio(image) for image in images])) < detail


def _octave_ratio(image: np.ndarray) -> float:
    """Energy above half of the highest frequency, over that of the octave below; infinite for a plain picture."""
    gray = image.mean(-1)
    height, width = gray.shape
    # windowed, or the step from one border to the opposite one counts as detail
    windowed = (gray - gray.mean()) * np.outer(np.hanning(height), np.hanning(width))
    power = np.abs(np.fft.rfft2(windowed)) ** 2
    frequency = np.maximum(np.abs(np.fft.fftfreq(height))[:, None], np.fft.rfftfreq(width)[None])
    below = power[(frequency >= 0.125) & (frequency < 0.25)].sum()
    return float(power[frequency >= 0.25].sum() / below) if below > 0 else np.inf


def typical_view_count(points: np.ndarray, cameras: Sequence[Camera]) -> int:
    """Median over points [P, 3] of the number of views that contain them; the number of cameras where there are no
    points."""
    seen = np.zeros(len(points), int)
    for camera in cameras:
        uv, z = geometry.project(points, camera)
        with np.errstate(invalid="ignore"):
            framed = (uv >= 0).all(-1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
        seen += framed & (z > 0)
    return int(np.median(seen)) if len(points) else len(cameras)


def supported_sh_degree(points: np.ndarray, cameras: Sequence[Camera], most: int) -> tuple[int, int]:
    """The highest supported degree of spherical harmonics, at most `most`, and the `typical_view_count` behind it.

    A degree has (degree + 1)^2 coefficients; at least that many views must contain a typical point [P, 3], occluded or
    not.
    """
    views = typical_view_count(points, cameras)
    return min(most, max(isqrt(views) - 1, 0)), views


def sample_visible(camera: Camera, points: np.ndarray, picture: np.ndarray, cells: int = CELLS) -> np.ndarray:
    """[P, C] values of a view's picture [H, W, C] at the visible points among [P, 3]; NaN at the others.

    A point is hidden outside the picture, and behind the nearest point of its cell; there are `cells` along the width.
    """
    uv, depth = geometry.project(points, camera)
    values, inside = geometry.sample_nearest(picture, uv)
    cell = max(1.0, camera.width / cells)
    index = np.zeros(len(points), int)
    index[inside] = (uv[inside] // cell).astype(int) @ (10_000, 1)
    visible = inside & (depth < NEARLY * np.maximum(nearest_depths(index, depth), 0))
    return np.where(visible[:, None], values, np.nan)
