"""An image and the geometry of the surfaces that it shows: what every exemplar-based method works on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SourceImage:
    """An image and the surfaces that it shows.

    Attributes:
        image: [H, W, 3] uint8.
        masked: bool [H, W], pixels that must not be read.
        usable: bool [H, W], where a patch may have its middle.
        plane: int [H, W], index of the plane shown, 1, 2, ...; 0: none.
        to_plane: [H, W, 2, 2], derivative of the coordinates on the plane by the pixel (x, y); off planes any regular
            matrix.
        pixel_size: [H, W], length of a pixel on the surface, in the world's unit.
        plane_xy: [H, W, 2], coordinates on the pixel's plane; anything off planes.
        layer: int [H, W], index of the foreground layer shown, 1, 2, ..., a thing in front of all that it meets beside
            the hole; 0: none.
        normal: [H, W, 3], the surface's mean normal, see `normals.mean_normals`; zeros where nothing is known.
    """

    image: np.ndarray
    masked: np.ndarray
    usable: np.ndarray
    plane: np.ndarray
    to_plane: np.ndarray
    pixel_size: np.ndarray
    plane_xy: np.ndarray
    layer: np.ndarray
    normal: np.ndarray


def without_geometry(image: np.ndarray, hole: np.ndarray) -> SourceImage:
    """An image with a hole, bool [H, W], that is masked, and nothing known of its surfaces."""
    identity, none = np.broadcast_to(np.eye(2), (*hole.shape, 2, 2)), np.zeros(hole.shape, np.int64)
    plane_xy, normal = np.zeros((*hole.shape, 2)), np.zeros((*hole.shape, 3), np.float32)
    return SourceImage(image, hole, ~hole, none, identity, np.ones(hole.shape), plane_xy, none, normal)
