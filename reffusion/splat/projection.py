"""From Gaussians to footprints and colours, and back: everything that is done once per Gaussian.

Geometry is computed in float64: scales of any size stay finite and needles keep their gradients. What the pixels see is
rounded to float32. Derivation of the backward pass: docs/splatting.md.
"""

from __future__ import annotations

import math

import numpy as np

from reffusion.splat.compiled import kernel
from reffusion.splat.conventions import (
    JACOBIAN_MARGIN,
    LOW_PASS,
    MAX_PIXELS,
    MAX_VARIANCE,
    MIN_ALPHA,
    NEAR,
)
from reffusion.splat.vectors import prefetch, take_ticket
from reffusion.types import Camera

# Columns of a footprint: 2D mean; slant xy/yy; the whitening factors along x and y, scaled so that
# log2(alpha) = LEVEL - u^2 - v^2 with v = WHITEN_Y dy, u = WHITEN_X (dx - SLANT dy); camera z; colour.
MEAN_X, MEAN_Y, SLANT, WHITEN_X, WHITEN_Y, LEVEL, DEPTH, RED, GREEN, BLUE = range(10)
FOOTPRINT = 16  # columns, of which the last six are unused: one cache line each

# Columns of a gradient record: the sums over pixels of g = dLoss/d(ln alpha), and of g times u, v, uu, uv, vv;
# then the gradients of camera z, colour and features.
SUM_G, SUM_U, SUM_V, SUM_UU, SUM_UV, SUM_VV, GRAD_DEPTH, GRAD_RED, GRAD_GREEN, GRAD_BLUE, GRAD_FEATURES = range(11)

CHUNKS = 32  # pieces that the Gaussians are shared out in; fixed, so that nothing depends on the number of threads
AHEAD = 8  # steps between asking for a row of another order (`vectors.prefetch`) and using it

_LOG2_E = 1.4426950408889634
_HALF_LOG2_E = math.sqrt(0.5 * _LOG2_E)


def view_numbers(camera: Camera) -> np.ndarray:
    """[23] float64: rotation rows, translation, fx, fy, cx, cy, clamping range of x/z and y/z, size, unused."""
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
            *(camera.width, camera.height),
            0.0,
        ],
        np.float64,
    )


@kernel
def next_part(tickets, count):
    """Borders of the next of CHUNKS parts of range(count), or (-1, -1) when all are drawn."""
    ticket = take_ticket(tickets)
    if ticket >= CHUNKS:
        return -1, -1
    return ticket * count // CHUNKS, (ticket + 1) * count // CHUNKS


@kernel
def _rotation(q):
    """Rotation matrix of a quaternion wxyz of any length (zero: identity), row by row, and 1 / length."""
    w, x, y, z = np.float64(q[0]), np.float64(q[1]), np.float64(q[2]), np.float64(q[3])
    square = w * w + x * x + y * y + z * z
    zero = square == 0.0
    inverse = 0.0 if zero else 1.0 / math.sqrt(square)
    w = 1.0 if zero else w * inverse
    x *= inverse
    y *= inverse
    z *= inverse
    return (
        (w, x, y, z, inverse),
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@kernel
def _to_camera(view, mean):
    """Camera coordinates of a mean."""
    a, b, c = np.float64(mean[0]), np.float64(mean[1]), np.float64(mean[2])
    return (
        view[0] * a + view[1] * b + view[2] * c + view[9],
        view[3] * a + view[4] * b + view[5] * c + view[10],
        view[6] * a + view[7] * b + view[8] * c + view[11],
    )


@kernel
def _projector(view, x, y, z):
    """The two rows of Jacobian x rotation [2, 3], and the clamped slopes x/z and y/z."""
    inverse = 1.0 / z
    slope_x = min(max(x * inverse, view[16]), view[17])
    slope_y = min(max(y * inverse, view[18]), view[19])
    fx, fy = view[12] * inverse, view[13] * inverse
    return (
        (fx * (view[0] - slope_x * view[6]), fx * (view[1] - slope_x * view[7]), fx * (view[2] - slope_x * view[8])),
        (fy * (view[3] - slope_y * view[6]), fy * (view[4] - slope_y * view[7]), fy * (view[5] - slope_y * view[8])),
        slope_x,
        slope_y,
    )


@kernel
def project(tickets, means, quaternions, log_scales, opacity_logits, probe, view, footprints, radii):
    """Footprints of all Gaussians.

    Args:
        probe: [N, 2] added to the 2D means, or [0, 2].
        view: see `view_numbers`.
        footprints: [N, FOOTPRINT] float32, written up to the depth for Gaussians that reach the image.
        radii: [N] int32 zeros, written for the same Gaussians.
    """
    while True:
        begin, end = next_part(tickets, means.shape[0])
        if begin < 0:
            return
        for i in range(begin, end):
            x, y, z = _to_camera(view, means[i])
            if not z >= NEAR:
                continue
            _, r0, r1, r2 = _rotation(quaternions[i])
            p0, p1, _, _ = _projector(view, x, y, z)
            s0 = math.exp(np.float64(log_scales[i, 0]))
            s1 = math.exp(np.float64(log_scales[i, 1]))
            s2 = math.exp(np.float64(log_scales[i, 2]))
            # root [2, 3]: the covariance is root rootᵀ + low-pass
            a0 = (p0[0] * r0[0] + p0[1] * r1[0] + p0[2] * r2[0]) * s0
            a1 = (p0[0] * r0[1] + p0[1] * r1[1] + p0[2] * r2[1]) * s1
            a2 = (p0[0] * r0[2] + p0[1] * r1[2] + p0[2] * r2[2]) * s2
            b0 = (p1[0] * r0[0] + p1[1] * r1[0] + p1[2] * r2[0]) * s0
            b1 = (p1[0] * r0[1] + p1[1] * r1[1] + p1[2] * r2[1]) * s1
            b2 = (p1[0] * r0[2] + p1[1] * r1[2] + p1[2] * r2[2]) * s2
            xx = a0 * a0 + a1 * a1 + a2 * a2
            xy = a0 * b0 + a1 * b1 + a2 * b2
            yy = b0 * b0 + b1 * b1 + b2 * b2
            # Cauchy-Binet: the sum of the squared 2x2 minors has no cancellation where xx yy - xy^2 loses everything
            m0, m1, m2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
            determinant = m0 * m0 + m1 * m1 + m2 * m2 + LOW_PASS * (xx + yy) + LOW_PASS * LOW_PASS
            xx += LOW_PASS
            yy += LOW_PASS
            mean_x = view[12] * x / z + view[14]
            mean_y = view[13] * y / z + view[15]
            if probe.shape[0] > 0:
                mean_x += probe[i, 0]
                mean_y += probe[i, 1]
            opacity = 1.0 / (1.0 + math.exp(-np.float64(opacity_logits[i])))
            near_enough = abs(mean_x) < MAX_PIXELS and abs(mean_y) < MAX_PIXELS
            if not (opacity >= MIN_ALPHA and near_enough and xx < MAX_VARIANCE and yy < MAX_VARIANCE):
                continue
            cut = math.sqrt(2.0 * math.log(opacity / MIN_ALPHA))
            reach_x, reach_y = math.ceil(cut * math.sqrt(xx)), math.ceil(cut * math.sqrt(yy))
            inside_x = mean_x + reach_x > 0 and mean_x - reach_x < view[20]
            inside_y = mean_y + reach_y > 0 and mean_y - reach_y < view[21]
            if not (inside_x and inside_y):
                continue
            radii[i] = np.int32(min(max(reach_x, reach_y, 1.0), 1073741824.0))
            footprints[i, MEAN_X] = mean_x
            footprints[i, MEAN_Y] = mean_y
            footprints[i, SLANT] = xy / yy
            footprints[i, WHITEN_X] = _HALF_LOG2_E * math.sqrt(yy / determinant)
            footprints[i, WHITEN_Y] = _HALF_LOG2_E / math.sqrt(yy)
            footprints[i, LEVEL] = math.log(opacity) * _LOG2_E
            footprints[i, DEPTH] = z


@kernel
def project_backward(
    tickets,
    sums,
    ranks,
    means,
    quaternions,
    log_scales,
    opacity_logits,
    view,
    grad_means,
    grad_quaternions,
    grad_scales,
    grad_opacities,
    grad_probe,
):
    """From the sums of each footprint to the gradients of means, quaternions, log-scales, opacity logits and probe.

    Args:
        sums: [M, >= GRAD_FEATURES] per footprint, columns as above.
        ranks: [N] int32, each Gaussian's row in `sums`, or -1.
        grad_means, grad_quaternions, grad_scales, grad_opacities, grad_probe: float32 zeros, written for the Gaussians
            with a rank; grad_probe may be [0, 2].
    """
    unscale = math.sqrt(2.0 / _LOG2_E)  # the record's u and v are scaled by sqrt(log2(e) / 2)
    want_probe, flat_sums = grad_probe.shape[0] > 0, sums.reshape(-1)
    while True:
        begin, end = next_part(tickets, means.shape[0])
        if begin < 0:
            return
        for i in range(begin, end):
            prefetch(flat_sums, ranks[min(i + AHEAD, end - 1)] * sums.shape[1])
            if ranks[i] < 0:
                continue
            record = sums[ranks[i]]
            x, y, z = _to_camera(view, means[i])
            (qw, qx, qy, qz, q_inverse), r0, r1, r2 = _rotation(quaternions[i])
            p0, p1, _, _ = _projector(view, x, y, z)
            s0 = math.exp(np.float64(log_scales[i, 0]))
            s1 = math.exp(np.float64(log_scales[i, 1]))
            s2 = math.exp(np.float64(log_scales[i, 2]))
            e00 = p0[0] * r0[0] + p0[1] * r1[0] + p0[2] * r2[0]
            e01 = p0[0] * r0[1] + p0[1] * r1[1] + p0[2] * r2[1]
            e02 = p0[0] * r0[2] + p0[1] * r1[2] + p0[2] * r2[2]
            e10 = p1[0] * r0[0] + p1[1] * r1[0] + p1[2] * r2[0]
            e11 = p1[0] * r0[1] + p1[1] * r1[1] + p1[2] * r2[1]
            e12 = p1[0] * r0[2] + p1[1] * r1[2] + p1[2] * r2[2]
            a0, a1, a2 = e00 * s0, e01 * s1, e02 * s2
            b0, b1, b2 = e10 * s0, e11 * s1, e12 * s2
            xx = a0 * a0 + a1 * a1 + a2 * a2
            xy = a0 * b0 + a1 * b1 + a2 * b2
            yy = b0 * b0 + b1 * b1 + b2 * b2
            m0, m1, m2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
            determinant = m0 * m0 + m1 * m1 + m2 * m2 + LOW_PASS * (xx + yy) + LOW_PASS * LOW_PASS
            yy += LOW_PASS
            slant = xy / yy
            lx, ly = math.sqrt(yy / determinant), 1.0 / math.sqrt(yy)

            # 2D mean: u = lx (dx - slant dy), v = ly dy, ln alpha = ln opacity - (u^2 + v^2) / 2
            sum_u, sum_v = unscale * record[SUM_U], unscale * record[SUM_V]
            g_mean_x = lx * sum_u
            g_mean_y = ly * sum_v - slant * g_mean_x
            if want_probe:
                grad_probe[i, 0] = g_mean_x
                grad_probe[i, 1] = g_mean_y

            # root: dLoss/d(root) = L M Lᵀ root, with L the whitening factor and M the second moments of (u, v)
            uu = unscale * unscale * record[SUM_UU]
            uv = unscale * unscale * record[SUM_UV]
            vv = unscale * unscale * record[SUM_VV]
            w0, w1, w2 = lx * (a0 - slant * b0), lx * (a1 - slant * b1), lx * (a2 - slant * b2)
            h0, h1, h2 = ly * b0, ly * b1, ly * b2
            ga0, ga1, ga2 = lx * (uu * w0 + uv * h0), lx * (uu * w1 + uv * h1), lx * (uu * w2 + uv * h2)
            gb0 = ly * (uv * w0 + vv * h0) - slant * ga0
            gb1 = ly * (uv * w1 + vv * h1) - slant * ga1
            gb2 = ly * (uv * w2 + vv * h2) - slant * ga2
            grad_scales[i, 0] = ga0 * a0 + gb0 * b0
            grad_scales[i, 1] = ga1 * a1 + gb1 * b1
            grad_scales[i, 2] = ga2 * a2 + gb2 * b2
            ga0, ga1, ga2, gb0, gb1, gb2 = ga0 * s0, ga1 * s1, ga2 * s2, gb0 * s0, gb1 * s1, gb2 * s2

            # rotation, then quaternion (tangential to the unit sphere, divided by the length; zero stays zero)
            g00, g01, g02 = p0[0] * ga0 + p1[0] * gb0, p0[0] * ga1 + p1[0] * gb1, p0[0] * ga2 + p1[0] * gb2
            g10, g11, g12 = p0[1] * ga0 + p1[1] * gb0, p0[1] * ga1 + p1[1] * gb1, p0[1] * ga2 + p1[1] * gb2
            g20, g21, g22 = p0[2] * ga0 + p1[2] * gb0, p0[2] * ga1 + p1[2] * gb1, p0[2] * ga2 + p1[2] * gb2
            gw = 2.0 * (qx * (g21 - g12) + qy * (g02 - g20) + qz * (g10 - g01))
            gx = 2.0 * (qw * (g21 - g12) + qy * (g01 + g10) + qz * (g02 + g20)) - 4.0 * qx * (g11 + g22)
            gy = 2.0 * (qw * (g02 - g20) + qx * (g01 + g10) + qz * (g12 + g21)) - 4.0 * qy * (g00 + g22)
            gz = 2.0 * (qw * (g10 - g01) + qx * (g02 + g20) + qy * (g12 + g21)) - 4.0 * qz * (g00 + g11)
            radial = gw * qw + gx * qx + gy * qy + gz * qz
            grad_quaternions[i, 0] = (gw - radial * qw) * q_inverse
            grad_quaternions[i, 1] = (gx - radial * qx) * q_inverse
            grad_quaternions[i, 2] = (gy - radial * qy) * q_inverse
            grad_quaternions[i, 3] = (gz - radial * qz) * q_inverse

            # projector rows fx/z (R0 - slope_x R2) and fy/z (R1 - slope_y R2), then camera coordinates
            gp00 = ga0 * r0[0] + ga1 * r0[1] + ga2 * r0[2]
            gp01 = ga0 * r1[0] + ga1 * r1[1] + ga2 * r1[2]
            gp02 = ga0 * r2[0] + ga1 * r2[1] + ga2 * r2[2]
            gp10 = gb0 * r0[0] + gb1 * r0[1] + gb2 * r0[2]
            gp11 = gb0 * r1[0] + gb1 * r1[1] + gb2 * r1[2]
            gp12 = gb0 * r2[0] + gb1 * r2[1] + gb2 * r2[2]
            z_inverse = 1.0 / z
            fx, fy = view[12] * z_inverse, view[13] * z_inverse
            g_slope_x = -fx * (gp00 * view[6] + gp01 * view[7] + gp02 * view[8])
            g_slope_y = -fy * (gp10 * view[6] + gp11 * view[7] + gp12 * view[8])
            free_x = view[16] <= x * z_inverse <= view[17]
            free_y = view[18] <= y * z_inverse <= view[19]
            g_x = fx * g_mean_x + (g_slope_x * z_inverse if free_x else 0.0)
            g_y = fy * g_mean_y + (g_slope_y * z_inverse if free_y else 0.0)
            g_z = -z_inverse * (x * g_x + y * g_y) + record[GRAD_DEPTH]
            g_z -= z_inverse * (gp00 * p0[0] + gp01 * p0[1] + gp02 * p0[2] + gp10 * p1[0] + gp11 * p1[1] + gp12 * p1[2])
            grad_means[i, 0] = view[0] * g_x + view[3] * g_y + view[6] * g_z
            grad_means[i, 1] = view[1] * g_x + view[4] * g_y + view[7] * g_z
            grad_means[i, 2] = view[2] * g_x + view[5] * g_y + view[8] * g_z

            grad_opacities[i] = record[SUM_G] / (1.0 + math.exp(np.float64(opacity_logits[i])))
