"""Geometry of LANES Gaussians at a time: from parameters to footprints (2D Gaussians), and the backward pass.

All is computed in float64, so that scales of any size stay finite and needles keep their gradients. Results for pixels
are rounded to float32 by the callers. docs/method.md#splatting derives the backward pass.

With the Jacobian J of the projection, the camera's rotation W, and the Gaussian's rotation R and standard deviations s,
the *projector* is J W [2, 3], and the *root* is A = J W R diag(s) [2, 3], with rows a and b. The 2D covariance is
A A^T + low-pass. A tuple of three vectors stands for a row of such a matrix, for LANES Gaussians. `view` is from
`view_numbers`.
"""

from __future__ import annotations

import math

import numpy as np

from reffusion.kernels.compiled import inlined
from reffusion.kernels.memory import load, load_column
from reffusion.kernels.vectors import LANES, ceiling, exp2, log2, maximum, minimum, root, select, widen
from reffusion.splat.conventions import JACOBIAN_MARGIN, LOW_PASS, MAX_PIXELS, MAX_VARIANCE, MIN_ALPHA, NEAR
from reffusion.splat.layout import GRAD_DEPTH, SUM_G, SUM_U, SUM_UU, SUM_UV, SUM_V, SUM_VV
from reffusion.types import Camera

_LOG2_E = 1.4426950408889634
_HALF_LOG2_E = math.sqrt(0.5 * _LOG2_E)
_UNSCALE = 1.0 / _HALF_LOG2_E  # undoes the scale sqrt(log2(e) / 2) of a footprint's u and v
_LEAST_LEVEL = math.log2(MIN_ALPHA)


def view_numbers(camera: Camera, antialiased: bool) -> np.ndarray:
    """Return the numbers of a view that kernels need, as one array.

    Args:
        camera: the view.
        antialiased: True uses the 2D filter of Mip-Splatting.

    Returns:
        [24] float64: 0 to 8 the camera's rotation, row by row; 9 to 11 its translation; 12 to 15 fx, fy, cx, cy; 16 to
        19 the least and greatest x/z, then y/z, to which the Jacobian is clamped; 20, 21 width and height; 22
        antialiased, 0 or 1; 23 the low-pass in square pixels of this view.
    """
    half_x, half_y = camera.width / 2 / camera.fx, camera.height / 2 / camera.fy
    return np.array(
        [
            *camera.world_to_camera[:3, :3].ravel(),
            *camera.world_to_camera[:3, 3],
            *(camera.fx, camera.fy, camera.cx, camera.cy),
            -camera.cx / camera.fx - JACOBIAN_MARGIN * half_x,
            (camera.width - camera.cx) / camera.fx + JACOBIAN_MARGIN * half_x,
            -camera.cy / camera.fy - JACOBIAN_MARGIN * half_y,
            (camera.height - camera.cy) / camera.fy + JACOBIAN_MARGIN * half_y,
            *(camera.width, camera.height, antialiased, LOW_PASS),
        ],
        np.float64,
    )


@inlined
def three_columns(array, row, last):
    """Return the three columns of LANES rows, from `row` on, of an array [R, 3] (flat), as float64 vectors.

    `last` is the last row of the array; it also stands for all rows after it.
    """
    return (
        widen(load_column(array, 3, 0, row, last)),
        widen(load_column(array, 3, 1, row, last)),
        widen(load_column(array, 3, 2, row, last)),
    )


@inlined
def exponential(x):
    """Return e^x, with x limited so that the result is finite and not 0."""
    return exp2(maximum(minimum(x * _LOG2_E, 1020.0), -1020.0))


@inlined
def camera_point(view, mean):
    """Return the camera coordinates x, y and z of the means."""
    a, b, c = mean
    return (
        view[0] * a + view[1] * b + view[2] * c + view[9],
        view[3] * a + view[4] * b + view[5] * c + view[10],
        view[6] * a + view[7] * b + view[8] * c + view[11],
    )


@inlined
def _unit_quaternion(quaternions, row, last):
    """Load LANES quaternions, and return w, x, y and z of the unit quaternions, and 1 / length."""
    w = widen(load_column(quaternions, 4, 0, row, last))
    x = widen(load_column(quaternions, 4, 1, row, last))
    y = widen(load_column(quaternions, 4, 2, row, last))
    z = widen(load_column(quaternions, 4, 3, row, last))
    square = w * w + x * x + y * y + z * z
    # A zero quaternion becomes the identity, with 0 for 1 / length, so that its gradient is 0.
    is_nonzero = square > 0.0
    inverse = 1.0 / root(select(is_nonzero, square, 1.0))
    inverse = select(is_nonzero, inverse, select(square <= 0.0, 0.0, square))  # NaN stays NaN
    return select(is_nonzero, w * inverse, 1.0), x * inverse, y * inverse, z * inverse, inverse


@inlined
def _rotation(w, x, y, z):
    """Return the rotation matrices of unit quaternions, as three rows."""
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    wx, wy, wz = w * x, w * y, w * z
    return (
        (1.0 - 2.0 * (yy + zz), 2.0 * (xy - wz), 2.0 * (xz + wy)),
        (2.0 * (xy + wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - wx)),
        (2.0 * (xz - wy), 2.0 * (yz + wx), 1.0 - 2.0 * (xx + yy)),
    )


@inlined
def _projector(view, x, y, z_inverse):
    """Return the two rows of the projector, Jacobian x camera rotation, with x/z and y/z clamped."""
    slope_x = maximum(minimum(x * z_inverse, view[17]), view[16])
    slope_y = maximum(minimum(y * z_inverse, view[19]), view[18])
    fx, fy = view[12] * z_inverse, view[13] * z_inverse
    return (
        (fx * (view[0] - slope_x * view[6]), fx * (view[1] - slope_x * view[7]), fx * (view[2] - slope_x * view[8])),
        (fy * (view[3] - slope_y * view[6]), fy * (view[4] - slope_y * view[7]), fy * (view[5] - slope_y * view[8])),
    )


@inlined
def _times_rotation(p, r):
    """Return a row p of three numbers times the rotation matrix r."""
    return (
        p[0] * r[0][0] + p[1] * r[1][0] + p[2] * r[2][0],
        p[0] * r[0][1] + p[1] * r[1][1] + p[2] * r[2][1],
        p[0] * r[0][2] + p[1] * r[1][2] + p[2] * r[2][2],
    )


@inlined
def _times_scales(e, scales):
    """Return the product of a row and the diagonal matrix of `scales`."""
    return e[0] * scales[0], e[1] * scales[1], e[2] * scales[2]


@inlined
def _dot(a, b):
    """Return the dot product of two rows of three vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def _cross(a, b):
    """Return the cross product of two rows of three vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def _covariance(a, b, low):
    """Return xx, xy, yy and the determinant of A A^T, and the determinant of A A^T + low-pass; A has the rows a, b."""
    xx, xy, yy = _dot(a, a), _dot(a, b), _dot(b, b)
    # By Cauchy-Binet the determinant is the sum of the squared 2x2 minors of A, without the cancellation of
    # xx yy - xy^2.
    m0, m1, m2 = _cross(a, b)
    sharp = m0 * m0 + m1 * m1 + m2 * m2
    return xx, xy, yy, sharp, sharp + low * (xx + yy) + low * low


@inlined
def _frame(view, x, y, z_inverse, quaternions, log_scales, row, last):
    """Return the unit quaternion with 1 / length, rotation R, projector, standard deviations, and rows of root A."""
    # The forward and the backward pass share these quantities.
    quaternion = _unit_quaternion(quaternions, row, last)
    rotation = _rotation(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
    projector = _projector(view, x, y, z_inverse)
    l0, l1, l2 = three_columns(log_scales, row, last)
    scales = exponential(l0), exponential(l1), exponential(l2)
    a = _times_scales(_times_rotation(projector[0], rotation), scales)
    b = _times_scales(_times_rotation(projector[1], rotation), scales)
    return quaternion, rotation, projector, scales, a, b


@inlined
def project(view, mean, quaternions, log_scales, opacity_logits, row, last):
    """Compute the footprints of LANES Gaussians.

    Args:
        view: see `view_numbers`.
        mean: the means of these Gaussians, three float64 vectors.
        quaternions, log_scales, opacity_logits: parameters of all Gaussians, flat.
        row: index of the first of these Gaussians.
        last: index of the last of all Gaussians.

    Returns:
        A mask of the Gaussians to keep: camera z is at least `NEAR`, the opacity at least 1/255, and the variances are
        below `MAX_VARIANCE`. Then float64 vectors: x and y of the 2D mean; slant, the two whitening factors and level
        of the footprint (see `layout`); camera z; half width and half height, in whole pixels, of the box around
        alpha >= 1/255.
    """
    x, y, z = camera_point(view, mean)
    z_inverse = 1.0 / z
    _, _, _, _, a, b = _frame(view, x, y, z_inverse, quaternions, log_scales, row, last)
    xx, xy, yy, sharp, determinant = _covariance(a, b, view[23])
    is_kept = (z >= NEAR) & (xx < MAX_VARIANCE) & (yy < MAX_VARIANCE)
    xx, yy = xx + view[23], yy + view[23]
    mean_x, mean_y = view[12] * x * z_inverse + view[14], view[13] * y * z_inverse + view[15]
    opacity = 1.0 / (1.0 + exponential(0.0 - widen(load_column(opacity_logits, 1, 0, row, last))))
    opacity = opacity * root(maximum(1.0 - view[22] * (1.0 - sharp / determinant), 0.0))
    is_kept = is_kept & (opacity >= MIN_ALPHA)
    level = log2(opacity)
    cut = root(maximum((level - _LEAST_LEVEL) * (2.0 / _LOG2_E), 0.0))
    whiten_x, whiten_y = _HALF_LOG2_E * root(yy / determinant), _HALF_LOG2_E / root(yy)
    reach_x, reach_y = ceiling(cut * root(xx)), ceiling(cut * root(yy))
    return is_kept, mean_x, mean_y, xy / yy, whiten_x, whiten_y, level, z, reach_x, reach_y


@inlined
def in_image(view, mean_x, mean_y, reach_x, reach_y):
    """Return a mask of the Gaussians whose box around alpha >= 1/255 touches the image.

    Boxes with a center beyond `MAX_PIXELS` are not in the mask.

    Args:
        mean_x, mean_y: centers of the boxes in pixels.
        reach_x, reach_y: half widths and half heights of the boxes in pixels.
    """
    near_enough = (mean_x > -MAX_PIXELS) & (mean_x < MAX_PIXELS) & (mean_y > -MAX_PIXELS) & (mean_y < MAX_PIXELS)
    inside_x = (mean_x + reach_x > 0.0) & (mean_x - reach_x < view[20])
    inside_y = (mean_y + reach_y > 0.0) & (mean_y - reach_y < view[21])
    return near_enough & inside_x & inside_y


@inlined
def anchor(view, mean_x, mean_y, slant, whiten_x, whiten_y):
    """Return x and y of the anchor, the point of the image nearest to the 2D mean, and its whitened u and v."""
    x, y = minimum(maximum(mean_x, 0.0), view[20]), minimum(maximum(mean_y, 0.0), view[21])
    dx, dy = x - mean_x, y - mean_y
    return x, y, whiten_x * (dx - slant * dy), whiten_y * dy


@inlined
def project_backward(view, mean, quaternions, log_scales, opacity_logits, row, last, moments):
    """Compute the gradients of the geometry of LANES Gaussians.

    Args:
        view, mean, quaternions, log_scales, opacity_logits, row, last: as for `project`.
        moments: the columns of the Gaussians' summed gradient records (`layout`), LANES values each.

    Returns:
        Gradients of the mean (3), quaternion (4), log-scales (3), opacity logit and 2D mean (2), as float64 vectors.
    """
    x, y, z = camera_point(view, mean)
    z_inverse = 1.0 / z
    quaternion, rotation, projector, scales, a, b = _frame(view, x, y, z_inverse, quaternions, log_scales, row, last)
    _, xy, yy, sharp, determinant = _covariance(a, b, view[23])
    yy = yy + view[23]
    slant, lx, ly = xy / yy, root(yy / determinant), 1.0 / root(yy)

    # 2D mean: u = lx (dx - slant dy), v = ly dy, ln alpha = ln opacity - (u^2 + v^2) / 2
    grad_mean_x = lx * (_UNSCALE * _column(moments, SUM_U))
    grad_mean_y = ly * (_UNSCALE * _column(moments, SUM_V)) - slant * grad_mean_x

    grad_a, grad_b = _root_backward(a, b, slant, lx, ly, moments)
    grad_a, grad_b = _compensation_backward(
        a, b, sharp, determinant, view[23], view[22] * _column(moments, SUM_G), grad_a, grad_b
    )
    grad_log_scales = (
        grad_a[0] * a[0] + grad_b[0] * b[0],
        grad_a[1] * a[1] + grad_b[1] * b[1],
        grad_a[2] * a[2] + grad_b[2] * b[2],
    )
    grad_a, grad_b = _times_scales(grad_a, scales), _times_scales(grad_b, scales)
    grad_quaternion = _quaternion_backward(quaternion, projector, grad_a, grad_b)
    grad_x, grad_y, grad_z = _projector_backward(view, x, y, z_inverse, rotation, projector, grad_a, grad_b)
    grad_x = grad_x + view[12] * z_inverse * grad_mean_x
    grad_y = grad_y + view[13] * z_inverse * grad_mean_y
    grad_z = grad_z + _column(moments, GRAD_DEPTH) - z_inverse * (x * grad_x + y * grad_y)
    grad_mean = (
        view[0] * grad_x + view[3] * grad_y + view[6] * grad_z,
        view[1] * grad_x + view[4] * grad_y + view[7] * grad_z,
        view[2] * grad_x + view[5] * grad_y + view[8] * grad_z,
    )
    opacity_logit = widen(load_column(opacity_logits, 1, 0, row, last))
    grad_logit = _column(moments, SUM_G) / (1.0 + exponential(opacity_logit))
    return grad_mean, grad_quaternion, grad_log_scales, grad_logit, (grad_mean_x, grad_mean_y)


@inlined
def _column(moments, column):
    """Return a column of the moments as a float64 vector."""
    return widen(load(moments, column * LANES))


@inlined
def _root_backward(a, b, slant, lx, ly, moments):
    """Return the gradient of the root A through the 2D covariance, as two rows: dLoss/dA = L M L^T A."""
    # L is the factor of the inverse 2D covariance L L^T. Its entries give u = lx (dx - slant dy) and v = ly dy, without
    # the scale of `layout`. M is the matrix of second moments of (u, v) in `moments`.
    uu = _UNSCALE * _UNSCALE * _column(moments, SUM_UU)
    uv = _UNSCALE * _UNSCALE * _column(moments, SUM_UV)
    vv = _UNSCALE * _UNSCALE * _column(moments, SUM_VV)
    w0, w1, w2 = lx * (a[0] - slant * b[0]), lx * (a[1] - slant * b[1]), lx * (a[2] - slant * b[2])
    h0, h1, h2 = ly * b[0], ly * b[1], ly * b[2]
    ga0, ga1, ga2 = lx * (uu * w0 + uv * h0), lx * (uu * w1 + uv * h1), lx * (uu * w2 + uv * h2)
    gb0 = ly * (uv * w0 + vv * h0) - slant * ga0
    gb1 = ly * (uv * w1 + vv * h1) - slant * ga1
    gb2 = ly * (uv * w2 + vv * h2) - slant * ga2
    return (ga0, ga1, ga2), (gb0, gb1, gb2)


@inlined
def _compensation_backward(a, b, sharp, determinant, low, grad, grad_a, grad_b):
    """Add the gradient of the root through the antialiased opacity, which contains sqrt(sharp / determinant)."""
    # The added gradient is `grad`, dLoss/d(ln opacity), times the gradient of ln sqrt(sharp / determinant), that is,
    # half the difference of the gradients of the two logarithms. The gradient of the minors is a cross product, again
    # without cancellation. If sharp is 0, nothing is rendered, and `grad` is 0. It is also 0 if the Gaussians are not
    # antialiased.
    m = _cross(a, b)
    sharpness = grad * (1.0 / maximum(sharp, 1e-300) - 1.0 / determinant)
    width = grad * (low / determinant)
    by_a, by_b = _cross(b, m), _cross(m, a)
    return (_moved_row(grad_a, by_a, sharpness, a, width), _moved_row(grad_b, by_b, sharpness, b, width))


@inlined
def _moved_row(grad, by, sharpness, row, width):
    """Return grad + sharpness * by - width * row, for rows of three numbers."""
    return (
        grad[0] + sharpness * by[0] - width * row[0],
        grad[1] + sharpness * by[1] - width * row[1],
        grad[2] + sharpness * by[2] - width * row[2],
    )


@inlined
def _quaternion_backward(quaternion, p, ga, gb):
    """Return the gradient of the quaternion (w, x, y, z) through the rotation matrix."""
    # `p` has the rows of the projector, and `ga` and `gb` are the rows of dLoss/d(root) diag(scales).
    w, x, y, z, inverse = quaternion
    p0, p1 = p
    g00, g01, g02 = p0[0] * ga[0] + p1[0] * gb[0], p0[0] * ga[1] + p1[0] * gb[1], p0[0] * ga[2] + p1[0] * gb[2]
    g10, g11, g12 = p0[1] * ga[0] + p1[1] * gb[0], p0[1] * ga[1] + p1[1] * gb[1], p0[1] * ga[2] + p1[1] * gb[2]
    g20, g21, g22 = p0[2] * ga[0] + p1[2] * gb[0], p0[2] * ga[1] + p1[2] * gb[1], p0[2] * ga[2] + p1[2] * gb[2]
    gw = 2.0 * (x * (g21 - g12) + y * (g02 - g20) + z * (g10 - g01))
    gx = 2.0 * (w * (g21 - g12) + y * (g01 + g10) + z * (g02 + g20)) - 4.0 * x * (g11 + g22)
    gy = 2.0 * (w * (g02 - g20) + x * (g01 + g10) + z * (g12 + g21)) - 4.0 * y * (g00 + g22)
    gz = 2.0 * (w * (g10 - g01) + x * (g02 + g20) + y * (g12 + g21)) - 4.0 * z * (g00 + g11)
    # Project the gradient of the unit quaternion to the tangent of the unit sphere, and divide it by the length of the
    # quaternion. A zero quaternion gets a zero gradient.
    radial = gw * w + gx * x + gy * y + gz * z
    return (
        (gw - radial * w) * inverse,
        (gx - radial * x) * inverse,
        (gy - radial * y) * inverse,
        (gz - radial * z) * inverse,
    )


@inlined
def _projector_backward(view, x, y, z_inverse, r, p, ga, gb):
    """Return the gradient of the camera coordinates x, y and z of the means through the projector."""
    # The projector has the rows fx/z (W0 - slope_x W2) and fy/z (W1 - slope_y W2), with the rows W0, W1 and W2 of the
    # camera's rotation and the slopes x/z and y/z. `ga` and `gb` are the rows of dLoss/d(root) diag(scales).
    gp0 = _dot(ga, r[0]), _dot(ga, r[1]), _dot(ga, r[2])
    gp1 = _dot(gb, r[0]), _dot(gb, r[1]), _dot(gb, r[2])
    slope_x, slope_y = x * z_inverse, y * z_inverse
    grad_slope_x = -view[12] * z_inverse * (gp0[0] * view[6] + gp0[1] * view[7] + gp0[2] * view[8])
    grad_slope_y = -view[13] * z_inverse * (gp1[0] * view[6] + gp1[1] * view[7] + gp1[2] * view[8])
    # A clamped slope has no gradient.
    free_x = (slope_x >= view[16]) & (slope_x <= view[17])
    free_y = (slope_y >= view[18]) & (slope_y <= view[19])
    grad_x = select(free_x, grad_slope_x * z_inverse, 0.0)
    grad_y = select(free_y, grad_slope_y * z_inverse, 0.0)
    # The gradient of z leaves out that the slopes depend on z; the caller adds this part, which has the same form for
    # the 2D mean.
    return grad_x, grad_y, 0.0 - z_inverse * (_dot(gp0, p[0]) + _dot(gp1, p[1]))
