"""What a capture's views support: no finer pictures, no more spherical harmonics than they can tell apart; and what
they show at its points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isqrt

import numpy as np

from reffusion import geometry
from reffusion.capture.frame import nearest_depths
from reffusion.types import Camera

CELLS = 40  # along a view's width, in each of which the nearest points hide those behind them
NEARLY = 1.15  # times as far as these: what is shown too


def enlarged(images: Iterable[np.ndarray], detail: float) -> bool:
    """Whether the pictures show no more than pictures of half their size would.

    A picture sharp to the pixel has about as much energy between a half and the whole of its highest frequency as in
    the octave below (0.25 to 0.8 of it in photographs tried, 0.4 to 0.7 in the demo's); enlarged twice, by whatever
    filter, or out of focus, it has 0.01 to 0.08 of it.

    Args:
        images: uint8 [H, W, 3], as large as they would be used; some views are enough.
        detail: ratio of the two octaves' energies, median over the pictures, under which it is so.
    """
    return float(np.median([_octaves(image) for image in images])) < detail


def _octaves(image: np.ndarray) -> float:
    """Energy at over a half of the highest frequency, over that of the octave below; infinite for a plain picture."""
    gray = image.mean(-1)
    height, width = gray.shape
    # windowed, or the step from one border to the opposite one counts as detail
    windowed = (gray - gray.mean()) * np.outer(np.hanning(height), np.hanning(width))
    power = np.abs(np.fft.rfft2(windowed)) ** 2
    frequency = np.maximum(np.abs(np.fft.fftfreq(height))[:, None], np.fft.rfftfreq(width)[None])
    below = power[(frequency >= 0.125) & (frequency < 0.25)].sum()
    return float(power[frequency >= 0.25].sum() / below) if below > 0 else np.inf


def views_of(points: np.ndarray, cameras: Sequence[Camera]) -> int:
    """In how many views a typical point is: the median over points [P, 3]; all where there are none."""
    seen = np.zeros(len(points), int)
    for camera in cameras:
        uv, z = geometry.project(points, camera)
        with np.errstate(invalid="ignore"):
            framed = (uv >= 0).all(-1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
        seen += framed & (z > 0)
    return int(np.median(seen)) if len(points) else len(cameras)


def harmonics(points: np.ndarray, cameras: Sequence[Camera], most: int) -> tuple[int, int]:
    """The highest degree of spherical harmonics, at most `most`, whose (degree + 1)^2 coefficients a typical point's
    views determine; and in how many views that point is (the median over points [P, 3])."""
    views = views_of(points, cameras)
    return min(most, max(isqrt(views) - 1, 0)), views


def sample_visible(camera: Camera, points: np.ndarray, picture: np.ndarray, cells: int = CELLS) -> np.ndarray:
    """[P, C] what a view's picture [H, W, C] shows at the points [P, 3]; NaN outside it, and behind nearer points:
    the nearest of each cell, of which there are `cells` along the picture's width, hide those behind them."""
    uv, depth = geometry.project(points, camera)
    values, inside = geometry.sample_nearest(picture, uv)
    cell = max(1.0, camera.width / cells)
    index = np.zeros(len(points), int)
    index[inside] = (uv[inside] // cell).astype(int) @ (10_000, 1)
    shown = inside & (depth < NEARLY * np.maximum(nearest_depths(index, depth), 0))
    return np.where(shown[:, None], values, np.nan)
