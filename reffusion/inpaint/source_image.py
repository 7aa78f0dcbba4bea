"""An image together with the geometry of the surfaces that it shows: the input of all exemplar-based methods."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SourceImage:
    """An image and the surfaces that it shows. It is the view whose hole is filled, or a source of texture.

    Attributes:
        image: [H, W, 3] uint8.
        masked: bool [H, W], True for pixels whose colors must not be used.
        usable: bool [H, W], True for pixels at which a patch may have its center.
        plane: int [H, W], index of the plane that the pixel shows, 1, 2, ...; 0 for none.
        to_plane: [H, W, 2, 2], derivative of the coordinates on the plane with respect to the pixel (x, y); any regular
            matrix for pixels on no plane.
        pixel_size: [H, W], length of a pixel on the surface, in world units.
        plane_xy: [H, W, 2], the pixel's coordinates on its plane; meaningless for pixels on no plane.
    """

    image: np.ndarray
    masked: np.ndarray
    usable: np.ndarray
    plane: np.ndarray
    to_plane: np.ndarray
    pixel_size: np.ndarray
    plane_xy: np.ndarray


def flat_source(image: np.ndarray, hole: np.ndarray) -> SourceImage:
    """Return an image whose surfaces are unknown: no planes, and pixels of one size.

    Args:
        image: uint8 [H, W, 3].
        hole: bool [H, W]; these pixels are masked, and all others usable.
    """
    identity, none = np.broadcast_to(np.eye(2), (*hole.shape, 2, 2)), np.zeros(hole.shape, np.int64)
    return SourceImage(image, hole, ~hole, none, identity, np.ones(hole.shape), np.zeros((*hole.shape, 2)))
