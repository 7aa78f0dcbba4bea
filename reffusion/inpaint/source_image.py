"""A picture beside the surfaces that it shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Shown:
    """A picture and the surfaces that it shows.

    Attributes:
        image: [H, W, 3] uint8.
        masked: bool [H, W], pixels that must not be read.
        usable: bool [H, W], where a patch may have its middle.
        surface: int [H, W], the plane shown, 1, 2, ...; 0: none.
        to_plane: [H, W, 2, 2], change of the plane's coordinates with (x, y) in pixels; any regular matrix off planes.
        size: [H, W], the world's length of a pixel.
        place: [H, W, 2], where on its plane a pixel lies; anything off planes.
        layer: int [H, W], of things that stand before what is around them, 1, 2, ..., the one shown; 0: none.
        normal: [H, W, 3], how the surface shown lies in space, see `slopes`; zeros where nothing is known.
    """

    image: np.ndarray
    masked: np.ndarray
    usable: np.ndarray
    surface: np.ndarray
    to_plane: np.ndarray
    size: np.ndarray
    place: np.ndarray
    layer: np.ndarray
    normal: np.ndarray


def alone(image: np.ndarray, hole: np.ndarray) -> Shown:
    """A picture of which nothing else is known."""
    unit, none = np.broadcast_to(np.eye(2), (*hole.shape, 2, 2)), np.zeros(hole.shape, np.int64)
    place, normal = np.zeros((*hole.shape, 2)), np.zeros((*hole.shape, 3), np.float32)
    return Shown(image, hole, ~hole, none, unit, np.ones(hole.shape), place, none, normal)
