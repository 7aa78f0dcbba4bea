"""View-dependent colour: spherical harmonics in the direction from the camera to the Gaussian, and their gradients."""

from __future__ import annotations

import math

import numpy as np

from reffusion.splat.compiled import kernel
from reffusion.splat.conventions import SH0, SH1, SH2, SH3
from reffusion.splat.projection import AHEAD, BLUE, FOOTPRINT, GRAD_BLUE, GRAD_GREEN, GRAD_RED, GREEN, RED, next_part
from reffusion.splat.vectors import fma, load, pack, prefetch, store, striped, thrice, total, triple_sums

_F = np.float32


@kernel
def _direction(mean, center):
    """Unit vector from the camera centre to a mean, and 1 / distance."""
    x = np.float64(mean[0]) - center[0]
    y = np.float64(mean[1]) - center[1]
    z = np.float64(mean[2]) - center[2]
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    return np.float32(x * inverse), np.float32(y * inverse), np.float32(z * inverse), np.float32(inverse)


@kernel
def _basis(degree, x, y, z):
    """The 16 spherical harmonics of 3DGS in a unit direction, as lanes; zero above `degree`."""
    b1 = b2 = b3 = b4 = b5 = b6 = b7 = b8 = b9 = b10 = b11 = b12 = b13 = b14 = b15 = _F(0)
    if degree >= 1:
        b1, b2, b3 = _F(-SH1) * y, _F(SH1) * z, _F(-SH1) * x
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        b4 = _F(SH2[0]) * x * y
        b5 = _F(SH2[1]) * y * z
        b6 = _F(SH2[2]) * (_F(2) * zz - xx - yy)
        b7 = _F(SH2[3]) * x * z
        b8 = _F(SH2[4]) * (xx - yy)
        if degree >= 3:
            b9 = _F(SH3[0]) * y * (_F(3) * xx - yy)
            b10 = _F(SH3[1]) * x * y * z
            b11 = _F(SH3[2]) * y * (_F(4) * zz - xx - yy)
            b12 = _F(SH3[3]) * z * (_F(2) * zz - _F(3) * xx - _F(3) * yy)
            b13 = _F(SH3[4]) * x * (_F(4) * zz - xx - yy)
            b14 = _F(SH3[5]) * z * (xx - yy)
            b15 = _F(SH3[6]) * x * (xx - _F(3) * yy)
    return pack((_F(SH0), b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14, b15))


@kernel
def _slope(degree, x, y, z, a):
    """Gradient of sum_k a_k Y_k(x, y, z) in x, y, z."""
    gx, gy, gz = -_F(SH1) * a[3], -_F(SH1) * a[1], _F(SH1) * a[2]
    if degree >= 2:
        b4, b5, b6, b7 = _F(SH2[0]) * a[4], _F(SH2[1]) * a[5], _F(2 * SH2[2]) * a[6], _F(SH2[3]) * a[7]
        b8 = _F(2 * SH2[4]) * a[8]
        gx += b4 * y + b7 * z + (b8 - b6) * x
        gy += b4 * x + b5 * z - (b8 + b6) * y
        gz += b5 * y + b7 * x + _F(2) * b6 * z
    if degree >= 3:
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        b9, b10, b11, b12 = _F(3 * SH3[0]) * a[9], _F(SH3[1]) * a[10], _F(SH3[2]) * a[11], _F(3 * SH3[3]) * a[12]
        b13, b14, b15 = _F(SH3[4]) * a[13], _F(SH3[5]) * a[14], _F(3 * SH3[6]) * a[15]
        gx += _F(2) * (b9 * xy - b11 * xy - b12 * xz + b14 * xz) + b10 * yz + b13 * (_F(4) * zz - _F(3) * xx - yy)
        gx += b15 * (xx - yy)
        gy += b9 * (xx - yy) + b10 * xz + b11 * (_F(4) * zz - xx - _F(3) * yy)
        gy -= _F(2) * (b12 * yz + b13 * xy + b14 * yz + b15 * xy)
        gz += b10 * xy + _F(8) * (b11 * yz + b13 * xz) + b12 * (_F(2) * zz - xx - yy) + b14 * (xx - yy)
    return gx, gy, gz


@kernel
def _coefficients(sh, flat, i, padded):
    """The 48 coefficients of a Gaussian in three vectors, zero for the degrees it lacks.

    Args:
        sh: [N, K, 3]; flat: the same memory as one row; padded: 48 floats of which the last 48 - 3 K are zero.
    """
    if sh.shape[1] == 16:
        return load(flat, i * 48), load(flat, i * 48 + 16), load(flat, i * 48 + 32)
    for k in range(sh.shape[1]):
        for c in range(3):
            padded[3 * k + c] = sh[i, k, c]
    return load(padded, 0), load(padded, 16), load(padded, 32)


@kernel
def paint(tickets, footprints, ranks, means, sh, degree, center, painted):
    """Copy footprints to their place in depth order, with their colours.

    Args:
        footprints: [N, FOOTPRINT], from `project`.
        ranks: [N] int32, row in `painted` or -1.
        painted: [M, FOOTPRINT] float32, written.
    """
    padded = np.zeros(48, np.float32)
    red_lanes, green_lanes, blue_lanes = striped(1.0, 0.0, 0.0), striped(0.0, 1.0, 0.0), striped(0.0, 0.0, 1.0)
    flat, flat_painted, flat_sh = footprints.reshape(-1), painted.reshape(-1), sh.reshape(-1)
    while True:
        begin, end = next_part(tickets, means.shape[0])
        if begin < 0:
            return
        for i in range(begin, end):
            prefetch(flat_painted, ranks[min(i + AHEAD, end - 1)] * FOOTPRINT)
            if ranks[i] < 0:
                continue
            x, y, z, _ = _direction(means[i], center)
            basis = _basis(degree, x, y, z)
            c0, c1, c2 = _coefficients(sh, flat_sh, i, padded)
            y0, y1, y2 = thrice(basis)
            s0, s1, s2 = y0 * c0, y1 * c1, y2 * c2
            red = fma(s2, red_lanes[2], fma(s1, red_lanes[1], s0 * red_lanes[0]))
            green = fma(s2, green_lanes[2], fma(s1, green_lanes[1], s0 * green_lanes[0]))
            blue = fma(s2, blue_lanes[2], fma(s1, blue_lanes[1], s0 * blue_lanes[0]))
            store(flat_painted, ranks[i] * FOOTPRINT, load(flat, i * FOOTPRINT))
            target = painted[ranks[i]]
            target[RED] = max(_F(0.5) + total(red), _F(0.0))
            target[GREEN] = max(_F(0.5) + total(green), _F(0.0))
            target[BLUE] = max(_F(0.5) + total(blue), _F(0.0))


@kernel
def paint_backward(tickets, sums, ranks, footprints, means, sh, degree, center, grad_means, grad_sh):
    """Gradients of the coefficients (zeros, written); through the viewing direction, added to `grad_means`.

    Args:
        sums: [M, columns] as in `projection`; footprints: [M, FOOTPRINT]: a colour at 0 is clamped, without gradient.
    """
    padded, padded_grad, along = np.zeros(48, np.float32), np.zeros(48, np.float32), np.zeros(16, np.float32)
    width = 3 * sh.shape[1]
    flat_sh, flat_grad = sh.reshape(-1), grad_sh.reshape(-1)
    flat_sums, flat_footprints = sums.reshape(-1), footprints.reshape(-1)
    while True:
        begin, end = next_part(tickets, means.shape[0])
        if begin < 0:
            return
        for i in range(begin, end):
            soon, rank = ranks[min(i + AHEAD, end - 1)], ranks[i]
            prefetch(flat_sums, soon * sums.shape[1])
            prefetch(flat_footprints, soon * FOOTPRINT)
            if rank < 0:
                continue
            red = sums[rank, GRAD_RED] if footprints[rank, RED] > 0 else _F(0.0)
            green = sums[rank, GRAD_GREEN] if footprints[rank, GREEN] > 0 else _F(0.0)
            blue = sums[rank, GRAD_BLUE] if footprints[rank, BLUE] > 0 else _F(0.0)
            x, y, z, inverse = _direction(means[i], center)
            basis = _basis(degree, x, y, z)
            c0, c1, c2 = _coefficients(sh, flat_sh, i, padded)
            g0, g1, g2 = striped(red, green, blue)
            y0, y1, y2 = thrice(basis)
            if sh.shape[1] == 16:
                store(flat_grad, i * 48, y0 * g0)
                store(flat_grad, i * 48 + 16, y1 * g1)
                store(flat_grad, i * 48 + 32, y2 * g2)
            else:
                store(padded_grad, 0, y0 * g0)
                store(padded_grad, 16, y1 * g1)
                store(padded_grad, 32, y2 * g2)
                flat_grad[i * width : (i + 1) * width] = padded_grad[:width]
            if degree > 0:
                store(along, 0, triple_sums(g0 * c0, g1 * c1, g2 * c2))
                gx, gy, gz = _slope(degree, x, y, z, along)
                radial = gx * x + gy * y + gz * z
                grad_means[i, 0] += (gx - radial * x) * inverse
                grad_means[i, 1] += (gy - radial * y) * inverse
                grad_means[i, 2] += (gz - radial * z) * inverse
