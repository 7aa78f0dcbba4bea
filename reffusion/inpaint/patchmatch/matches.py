"""The arrays that the patch search works on, and the transform of a patch from a source image to the hole."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from reffusion.kernels.compiled import inlined

PATCH_RADIUS = 3  # px from a patch's middle to its border
MAX_TURN = 0.15  # radians by which a patch may be turned in its plane
MIN_SCALE, MAX_SCALE = 0.8, 1.4  # bounds of the scale between two patches off planes
SCALE_TOLERANCE = 0.1  # a scale so near to 1 is taken as 1: sampling between pixels would only blur
MIN_AREA, MAX_AREA = 0.6, 3.0  # source pixels for one pixel of the hole, bounds along a plane
MAX_STRETCH = 6.0  # bound of the transform's squared Frobenius norm, along a plane
NO_MATCH = np.float32(1e29)  # misfit where there is no patch


class Sources(NamedTuple):
    """K images that patches are taken from, padded to one size.

    Attributes:
        values: [K, H, W, C] float32, colours in [0, 255] and the other features compared.
        plane: [K, H, W] int32, index of the plane shown, 1, 2, ...; 0: none; -1: no patch may have its middle here.
        to_pixels: [K, H, W, 4] float32, derivative of pixels (x, y) by the coordinates on the plane, 2 x 2 by rows.
        pixel_size: [K, H, W] float32, length of a pixel on the surface, in the world's unit.
    """

    values: np.ndarray
    plane: np.ndarray
    to_pixels: np.ndarray
    pixel_size: np.ndarray


class Hole(NamedTuple):
    """The N pixels to be filled.

    Attributes:
        row, column: [N] int64.
        index: [H, W] int64, a pixel's index, or -1 outside.
        plane: [N] int32 as in `Sources`.
        along_plane: [N] bool, whether patches may follow the plane's perspective.
        to_plane: [N, 4] float32, derivative of the coordinates on the plane by pixels (x, y), 2 x 2 by rows.
        pixel_size: [N] float32 as in `Sources`.
    """

    row: np.ndarray
    column: np.ndarray
    index: np.ndarray
    plane: np.ndarray
    along_plane: np.ndarray
    to_plane: np.ndarray
    pixel_size: np.ndarray


class Level(NamedTuple):
    """One level of the image pyramid.

    Attributes:
        hole: the pixels to be filled.
        sources: the images that patches are taken from.
        current: [H, W, C] float32, the target's features as they are now, with the hole filled.
        weight: [H, W] float32, of each of its pixels in the comparison.
    """

    hole: Hole
    sources: Sources
    current: np.ndarray
    weight: np.ndarray


class Matches(NamedTuple):
    """The patch that each pixel of the hole takes (nearest-neighbour field); all [N].

    Attributes:
        source: int32, index of the image, -1 for none.
        row, column: float32, the patch's middle.
        angle: float32, radians by which it is turned in its plane.
        along_plane: bool, whether it follows the plane's perspective.
        misfit: float32, see `search.misfit`; `NO_MATCH` for none.
    """

    source: np.ndarray
    row: np.ndarray
    column: np.ndarray
    angle: np.ndarray
    along_plane: np.ndarray
    misfit: np.ndarray


class Positions(NamedTuple):
    """Where a patch may have its middle: places, [M, 3] int32 (source, row, column), sorted by plane; and [S + 2]
    int64, where those of each plane start. Those of plane 0 are all places."""

    places: np.ndarray
    starts: np.ndarray


@inlined
def patch_transform(hole, n, sources, along_plane, source, row, column, angle):
    """Whether the transform is within bounds, and its matrix xx, xy, yx, yy, from steps (x, y) around pixel n to steps
    around a pixel of a source."""
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
    """The transform of the patch that pixel n takes; see `patch_transform`."""
    row, column = math.floor(matches.row[n] + 0.5), math.floor(matches.column[n] + 0.5)
    return patch_transform(hole, n, sources, matches.along_plane[n], matches.source[n], row, column, matches.angle[n])
