"""What the patch search works on, and how a patch is carried from a photograph to the hole."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from reffusion.kernels.compiled import inlined

PATCH = 3  # pixels from a patch's middle to its border
TURN = 0.15  # radians by which a patch may be turned in its plane
NEAREST, FARTHEST = 1.4, 0.8  # bounds of the scale between two patches off planes
SAME_SCALE = 0.1  # within it of 1 they are not scaled: nothing is lost by sampling between pixels
SHRINK, GROW = 0.6, 3.0  # bounds of the source's area for one pixel of the hole, along a plane
STRETCH = 6.0  # bound of the squared Frobenius norm there
NONE = np.float32(1e29)  # misfit where there is no patch


class Pictures(NamedTuple):
    """What patches are taken from, of K pictures padded to one size.

    Attributes:
        values: [K, H, W, C] float32, colours in [0, 255] and what else is compared.
        surface: [K, H, W] int32, the plane shown, 1, 2, ...; 0: none; -1: no patch may have its middle here.
        to_pixels: [K, H, W, 4] float32, rows of the matrix from the plane's coordinates to pixels.
        size: [K, H, W] float32, the world's length of a pixel.
    """

    values: np.ndarray
    surface: np.ndarray
    to_pixels: np.ndarray
    size: np.ndarray


class Hole(NamedTuple):
    """The N pixels to be filled.

    Attributes:
        row, column: [N] int64. index: [H, W] int64, a pixel's number, or -1.
        surface: [N] int32 as in `Pictures`. planar: [N] bool, whether patches may be carried along the plane.
        to_plane: [N, 4] float32, rows of the matrix from pixels to the plane's coordinates. size: [N] float32.
    """

    row: np.ndarray
    column: np.ndarray
    index: np.ndarray
    surface: np.ndarray
    planar: np.ndarray
    to_plane: np.ndarray
    size: np.ndarray


class Compared(NamedTuple):
    """What patches are compared in.

    Attributes:
        hole: its pixels. pictures: the sources.
        now: [H, W, C] float32, the picture as it is now.
        weight: [H, W] float32, how much each of its pixels counts.
    """

    hole: Hole
    pictures: Pictures
    now: np.ndarray
    weight: np.ndarray


class Match(NamedTuple):
    """The patch that each pixel of the hole takes; all [N].

    Attributes:
        picture: int32, -1 for none. row, column: float32, its middle. angle: float32, radians.
        planar: bool, carried along the plane. misfit: float32, mean squared difference, `NONE` for none.
    """

    picture: np.ndarray
    row: np.ndarray
    column: np.ndarray
    angle: np.ndarray
    planar: np.ndarray
    misfit: np.ndarray


class Choice(NamedTuple):
    """Where a patch may have its middle: [M, 3] int32 of (picture, row, column), and [S + 2] int64 where those of each
    surface begin; those of surface 0 are all."""

    places: np.ndarray
    starts: np.ndarray


@inlined
def carried(hole, n, pictures, planar, picture, row, column, angle):
    """Whether the scale is within bounds, and by rows the matrix from steps around pixel n to steps in the picture."""
    if not planar:
        scale = hole.size[n] / pictures.size[picture, row, column]
        scale = min(max(scale, np.float32(FARTHEST)), np.float32(NEAREST))
        if abs(scale - 1) < SAME_SCALE:
            scale = np.float32(1)
        return True, scale, np.float32(0), np.float32(0), scale
    cosine, sine = np.float32(math.cos(angle)), np.float32(math.sin(angle))
    b, f = hole.to_plane[n], pictures.to_pixels[picture, row, column]
    r0, r1 = cosine * b[0] - sine * b[2], cosine * b[1] - sine * b[3]
    r2, r3 = sine * b[0] + cosine * b[2], sine * b[1] + cosine * b[3]
    xx, xy = f[0] * r0 + f[1] * r2, f[0] * r1 + f[1] * r3
    yx, yy = f[2] * r0 + f[3] * r2, f[2] * r1 + f[3] * r3
    area = xx * yy - xy * yx
    return SHRINK < area < GROW and xx * xx + xy * xy + yx * yx + yy * yy < STRETCH, xx, xy, yx, yy


@inlined
def carried_match(hole, n, pictures, match):
    row, column = math.floor(match.row[n] + 0.5), math.floor(match.column[n] + 0.5)
    return carried(hole, n, pictures, match.planar[n], match.picture[n], row, column, match.angle[n])
