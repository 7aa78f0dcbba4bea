"""The arrays of the patch search, and the transform that relates a patch of a source image to the hole."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from reffusion.kernels.compiled import inlined

PATCH_RADIUS = 3  # px, so that a patch has 7 x 7 px
MAX_TURN = 0.15  # radians by which a patch may be turned in its plane
MIN_SCALE, MAX_SCALE = 0.8, 1.4  # bounds of the scale of a patch that does not follow a plane
SCALE_TOLERANCE = 0.1  # a scale that differs from 1 by less is taken as 1, because sampling between pixels blurs
MIN_AREA, MAX_AREA = 0.6, 3.0  # bounds of the source pixels per pixel of the hole, for a patch that follows a plane
MAX_STRETCH = 6.0  # bound of the squared Frobenius norm of the transform of such a patch
NO_MATCH = np.float32(1e29)  # misfit of a pixel that has no patch


class Sources(NamedTuple):
    """K images from which patches are taken, padded to one size.

    Attributes:
        values: [K, H, W, C] float32, colors in [0, 255], followed by the other features by which patches are compared.
        plane: [K, H, W] int32, index of the plane that a pixel shows, 1, 2, ...; 0 for none; -1 if no patch may have
            its center here.
        to_pixels: [K, H, W, 4] float32, derivative of the pixel (x, y) with respect to the coordinates on the plane, a
            2 x 2 matrix by rows.
        pixel_size: [K, H, W] float32, length of a pixel on the surface, in world units.
    """

    values: np.ndarray
    plane: np.ndarray
    to_pixels: np.ndarray
    pixel_size: np.ndarray


class Hole(NamedTuple):
    """The N pixels to be filled.

    Attributes:
        row, column: [N] int64, their positions.
        index: [H, W] int64, the index 0..N-1 of each pixel of the hole; -1 outside the hole.
        plane: [N] int32, index of the plane on which the pixel lies; 0 for none.
        along_plane: [N] bool, True if the pixel's patch may follow the perspective of this plane.
        to_plane: [N, 4] float32, derivative of the coordinates on the plane with respect to the pixel (x, y), a 2 x 2
            matrix by rows.
        pixel_size: [N] float32, length of the pixel on the surface, in world units.
    """

    row: np.ndarray
    column: np.ndarray
    index: np.ndarray
    plane: np.ndarray
    along_plane: np.ndarray
    to_plane: np.ndarray
    pixel_size: np.ndarray


class PyramidLevel(NamedTuple):
    """One level of the image pyramid.

    Attributes:
        hole: the pixels to be filled.
        sources: the images from which patches are taken.
        current: [H, W, C] float32, the features of the target, with the present content of the hole. Votes change it.
        weight: [H, W] float32, weight of each pixel of `current` in the comparison of patches.
    """

    hole: Hole
    sources: Sources
    current: np.ndarray
    weight: np.ndarray


class Matches(NamedTuple):
    """The match of each of the N pixels of the hole (nearest-neighbor field): the source patch that it takes.

    Attributes:
        source: [N] int32, index of the source image; -1 for no patch.
        row, column: [N] float32, center of the patch in the source image.
        angle: [N] float32, radians by which the patch is turned in its plane.
        along_plane: [N] bool, True if the patch follows the perspective of its plane.
        misfit: [N] float32, how badly the patch fits (`search.misfit`); `NO_MATCH` if the pixel has no patch, or one
            that it must not take.
    """

    source: np.ndarray
    row: np.ndarray
    column: np.ndarray
    angle: np.ndarray
    along_plane: np.ndarray
    misfit: np.ndarray


class Positions(NamedTuple):
    """The places at which a patch may have its center, as a list for random draws.

    Attributes:
        places: [M, 3] int32 (source, row, column): first all places, then again those on plane 1, on plane 2, ...
        starts: [S + 2] int64 for S planes. `starts[k]` is the first entry of plane k in `places`, and `starts[k + 1]`
            the end of its entries; k = 0 stands for all places.
    """

    places: np.ndarray
    starts: np.ndarray


@inlined
def patch_transform(hole, n, sources, along_plane, source, row, column, angle):
    """Compute the linear transform that takes steps (x, y) around a pixel of the hole to steps around a source pixel.

    For a patch that follows a plane, the transform contains the perspective of both images and a turn in the plane.
    For any other patch it is a scale, the ratio of the pixels' lengths on their surfaces, within bounds.

    Args:
        hole: `Hole`.
        n: index of the pixel of the hole.
        sources: `Sources`.
        along_plane: whether the patch follows the perspective of a plane.
        source, row, column: the source pixel.
        angle: radians by which the patch is turned in its plane.

    Returns:
        Whether the transform is within bounds, and its matrix [[xx, xy], [yx, yy]] as xx, xy, yx, yy.
    """
    if not along_plane:
        scale = hole.pixel_size[n] / sources.pixel_size[source, row, column]
        scale = min(max(scale, np.float32(MIN_SCALE)), np.float32(MAX_SCALE))
        if abs(scale - 1) < SCALE_TOLERANCE:
            scale = np.float32(1)
        return True, scale, np.float32(0), np.float32(0), scale
    cosine, sine = np.float32(math.cos(angle)), np.float32(math.sin(angle))
    b, f = hole.to_plane[n], sources.to_pixels[source, row, column]
    r0, r1 = cosine * b[0] - sine * b[2], cosine * b[1] - sine * b[3]
    r2, r3 = sine * b[0] + cosine * b[2], sine * b[1] + cosine * b[3]
    xx, xy = f[0] * r0 + f[1] * r2, f[0] * r1 + f[1] * r3
    yx, yy = f[2] * r0 + f[3] * r2, f[2] * r1 + f[3] * r3
    area = xx * yy - xy * yx
    bounded = MIN_AREA < area < MAX_AREA and xx * xx + xy * xy + yx * yx + yy * yy < MAX_STRETCH
    return bounded, xx, xy, yx, yy


@inlined
def match_transform(hole, n, sources, matches):
    """Return the transform of the patch that pixel n of the hole takes at present; see `patch_transform`."""
    row, column = math.floor(matches.row[n] + 0.5), math.floor(matches.column[n] + 0.5)
    return patch_transform(hole, n, sources, matches.along_plane[n], matches.source[n], row, column, matches.angle[n])
