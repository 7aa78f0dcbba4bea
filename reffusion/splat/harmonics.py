"""View-dependent colors of LANES Gaussians at a time by spherical harmonics, and their gradients.

Directions point from the camera to the Gaussian. Arrays of harmonics, coefficients and their gradients are flat float32
arrays with LANES values (one per Gaussian) for each number.
"""

from __future__ import annotations

from reffusion.kernels.compiled import inlined
from reffusion.kernels.memory import load, store
from reffusion.kernels.vectors import LANES, fma, maximum, narrow, root, splat
from reffusion.splat.conventions import SH0, SH1, SH2, SH3


@inlined
def direction(mean, center):
    """Return the unit vectors from the camera center to the means, and 1 / distance.

    Args:
        mean: x, y and z of the means, three float64 vectors.
        center: [3], the camera center.

    Returns:
        x, y and z of the unit vectors, and 1 / distance, as float32 vectors.
    """
    x, y, z = mean[0] - center[0], mean[1] - center[1], mean[2] - center[2]
    inverse = 1.0 / root(x * x + y * y + z * z)
    return narrow(x * inverse), narrow(y * inverse), narrow(z * inverse), narrow(inverse)


@inlined
def fill_basis(degree, x, y, z, basis):
    """Write the (degree + 1)^2 spherical harmonics Y_k of 3DGS in the unit directions (x, y, z) into `basis`."""
    store(basis, 0, splat(SH0))
    if degree >= 1:
        store(basis, LANES, -SH1 * y)
        store(basis, 2 * LANES, SH1 * z)
        store(basis, 3 * LANES, -SH1 * x)
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        store(basis, 4 * LANES, SH2[0] * x * y)
        store(basis, 5 * LANES, SH2[1] * y * z)
        store(basis, 6 * LANES, SH2[2] * (2.0 * zz - xx - yy))
        store(basis, 7 * LANES, SH2[3] * x * z)
        store(basis, 8 * LANES, SH2[4] * (xx - yy))
        if degree >= 3:
            store(basis, 9 * LANES, SH3[0] * y * (3.0 * xx - yy))
            store(basis, 10 * LANES, SH3[1] * x * y * z)
            store(basis, 11 * LANES, SH3[2] * y * (4.0 * zz - xx - yy))
            store(basis, 12 * LANES, SH3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy))
            store(basis, 13 * LANES, SH3[4] * x * (4.0 * zz - xx - yy))
            store(basis, 14 * LANES, SH3[5] * z * (xx - yy))
            store(basis, 15 * LANES, SH3[6] * x * (xx - 3.0 * yy))


@inlined
def colors(degree, basis, coefficients):
    """Return red, green and blue, as three vectors: max(0, 0.5 + sum_k Y_k sh_k).

    Args:
        basis: Y_k, from `fill_basis`.
        coefficients: sh_k of red, green and blue, then those of the next k.
    """
    red = green = blue = splat(0.5)
    for k in range((degree + 1) * (degree + 1)):
        y, place = load(basis, k * LANES), 3 * k * LANES
        red = fma(y, load(coefficients, place), red)
        green = fma(y, load(coefficients, place + LANES), green)
        blue = fma(y, load(coefficients, place + 2 * LANES), blue)
    return maximum(red, 0.0), maximum(green, 0.0), maximum(blue, 0.0)


@inlined
def colors_backward(degree, basis, coefficients, red, green, blue, basis_gradient):
    """Write the gradients of the coefficients over the coefficients, and those of the harmonics to `basis_gradient`.

    Args:
        basis: Y_k, from `fill_basis`.
        coefficients: sh_k as for `colors`; output, dLoss/dsh_k.
        red, green, blue: dLoss/dcolor; the caller sets them to 0 where the color is clamped.
        basis_gradient: output, dLoss/dY_k.
    """
    for k in range((degree + 1) * (degree + 1)):
        y, place = load(basis, k * LANES), 3 * k * LANES
        slope = red * load(coefficients, place)
        slope = fma(green, load(coefficients, place + LANES), slope)
        slope = fma(blue, load(coefficients, place + 2 * LANES), slope)
        store(basis_gradient, k * LANES, slope)
        store(coefficients, place, y * red)
        store(coefficients, place + LANES, y * green)
        store(coefficients, place + 2 * LANES, y * blue)


@inlined
def direction_backward(degree, x, y, z, inverse, along):
    """Return the gradient of the means through the viewing directions, as three vectors.

    Args:
        x, y, z, inverse: from `direction`.
        along: dLoss/dY_k, from `colors_backward`.
    """
    gx = gy = gz = splat(0.0)
    if degree >= 1:
        gx, gy, gz = -SH1 * _at(along, 3), -SH1 * _at(along, 1), SH1 * _at(along, 2)
    if degree >= 2:
        b4, b5, b6 = SH2[0] * _at(along, 4), SH2[1] * _at(along, 5), 2.0 * SH2[2] * _at(along, 6)
        b7, b8 = SH2[3] * _at(along, 7), 2.0 * SH2[4] * _at(along, 8)
        gx = gx + b4 * y + b7 * z + (b8 - b6) * x
        gy = gy + b4 * x + b5 * z - (b8 + b6) * y
        gz = gz + b5 * y + b7 * x + 2.0 * b6 * z
    if degree >= 3:
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        b9, b10, b11 = 3.0 * SH3[0] * _at(along, 9), SH3[1] * _at(along, 10), SH3[2] * _at(along, 11)
        b12, b13 = 3.0 * SH3[3] * _at(along, 12), SH3[4] * _at(along, 13)
        b14, b15 = SH3[5] * _at(along, 14), 3.0 * SH3[6] * _at(along, 15)
        gx = gx + 2.0 * (b9 * xy - b11 * xy - b12 * xz + b14 * xz) + b10 * yz + b13 * (4.0 * zz - 3.0 * xx - yy)
        gx = gx + b15 * (xx - yy)
        gy = gy + b9 * (xx - yy) + b10 * xz + b11 * (4.0 * zz - xx - 3.0 * yy)
        gy = gy - 2.0 * (b12 * yz + b13 * xy + b14 * yz + b15 * xy)
        gz = gz + b10 * xy + 8.0 * (b11 * yz + b13 * xz) + b12 * (2.0 * zz - xx - yy) + b14 * (xx - yy)
    radial = gx * x + gy * y + gz * z
    return (gx - radial * x) * inverse, (gy - radial * y) * inverse, (gz - radial * z) * inverse


@inlined
def _at(along, k):
    """Return dLoss/dY_k as a vector."""
    return load(along, k * LANES)
