"""Splatting in plain torch: slow and simple, in any dtype, with gradients from autograd.

Every pixel evaluates every Gaussian. The fast implementations are tested against this one in float64.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from reffusion.splat.conventions import (
    JACOBIAN_MARGIN,
    LOW_PASS,
    MAX_ALPHA,
    MAX_PIXELS,
    MAX_VARIANCE,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    NEAR,
    SH0,
    SH1,
    SH2,
    SH3,
)
from reffusion.types import Camera, Gaussians, Rendering

_CHUNK = 2**22  # pairs of a pixel and a Gaussian that are in memory at once


class Projected(NamedTuple):
    """The 2D Gaussians (footprints) of the M Gaussians that reach the image, front to back.

    Attributes:
        order: [M] indices of the Gaussians.
        means: [M, 2] 2D means in pixels.
        covariances: [M, 3] xx, xy and yy of the 2D covariances in px^2, with low-pass.
        determinants: [M] determinants of these covariances in px^4.
        depths: [M] camera z.
        opacities: [M], compensated for the low-pass if the Gaussians are antialiased.
    """

    order: Tensor
    means: Tensor
    covariances: Tensor
    determinants: Tensor
    depths: Tensor
    opacities: Tensor


def render(
    gaussians: Gaussians, camera: Camera, features: Tensor | None, background: Tensor, degree: int, probe: Tensor | None
) -> Rendering:
    """Render Gaussians; see `reffusion.splat.rasterizer.render`, which checks the arguments."""
    projected, radii = project(gaussians, camera, probe)
    order = projected.order
    columns = [colors(gaussians, camera, degree)[order], projected.depths[:, None]]
    if features is not None:
        columns.append(features[order])
    blended, transmittance = [], []
    for pixels in _pixel_chunks(camera, projected):
        weights, behind = blending_weights(projected, pixels)
        blended.append(weights @ torch.cat(columns, 1))
        transmittance.append(behind)
    image = torch.cat(blended).reshape(camera.height, camera.width, -1)
    behind = torch.cat(transmittance).reshape(camera.height, camera.width)
    alpha = 1 - behind
    covered = alpha > 0
    return Rendering(
        color=image[..., :3] + behind[..., None] * background,
        depth=torch.where(covered, image[..., 3], 0) / torch.where(covered, alpha, 1),
        alpha=alpha,
        features=None if features is None else image[..., 4:],
        radii=radii,
    )


def accumulate(gaussians: Gaussians, camera: Camera, values: Tensor, count: bool) -> Tensor:
    """Sum pixel values by Gaussian; see `reffusion.splat.rasterizer.accumulate`, which checks the arguments."""
    projected, _ = project(gaussians, camera, None)
    gathered = values.new_zeros(len(projected.order), values.shape[-1])
    flat = values.reshape(camera.height * camera.width, -1)
    start = 0
    for pixels in _pixel_chunks(camera, projected):
        weights, _ = blending_weights(projected, pixels)
        if count:
            weights = (weights > 0).to(weights.dtype)
        gathered += weights.T @ flat[start : start + len(pixels)]
        start += len(pixels)
    result = values.new_zeros(len(gaussians), values.shape[-1])
    result[projected.order] = gathered
    return result


def project(gaussians: Gaussians, camera: Camera, probe: Tensor | None) -> tuple[Projected, Tensor]:
    """Project the Gaussians into the image (EWA splatting), and sort them by depth, equal depths by index.

    Args:
        probe: [N, 2] added to the 2D means, in pixels, or None.

    Returns:
        The footprints that reach the image; and [N] int32, the radii of all Gaussians in pixels, 0 for culled ones.
    """
    like = gaussians.means
    pose = torch.as_tensor(camera.world_to_camera, dtype=like.dtype, device=like.device)
    in_camera = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    with torch.no_grad():
        index = torch.nonzero(in_camera[:, 2] >= NEAR)[:, 0]
    x, y, z = in_camera[index].unbind(1)

    means = torch.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), 1)
    if probe is not None:
        means = means + probe[index]

    # Jacobian of the projection, with x/z and y/z clamped slightly outside the image.
    half_x, half_y = camera.width / 2 / camera.fx, camera.height / 2 / camera.fy
    right, left = (camera.width - camera.cx) / camera.fx, -camera.cx / camera.fx
    bottom, top = (camera.height - camera.cy) / camera.fy, -camera.cy / camera.fy
    slope_x = torch.clamp(x / z, left - JACOBIAN_MARGIN * half_x, right + JACOBIAN_MARGIN * half_x)
    slope_y = torch.clamp(y / z, top - JACOBIAN_MARGIN * half_y, bottom + JACOBIAN_MARGIN * half_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        (
            torch.stack((camera.fx / z, zero, -camera.fx * slope_x / z), 1),
            torch.stack((zero, camera.fy / z, -camera.fy * slope_y / z), 1),
        ),
        1,
    )
    axes = rotations(gaussians.quaternions[index]) * gaussians.log_scales[index].exp()[:, None, :]
    root = jacobian @ (pose[:3, :3] @ axes)  # [M, 2, 3]; the covariance is root rootᵀ + low-pass
    xx = root[:, 0].square().sum(1)
    xy = (root[:, 0] * root[:, 1]).sum(1)
    yy = root[:, 1].square().sum(1)
    # Cauchy-Binet: det(root rootᵀ) is the sum of the squared 2x2 minors, without the cancellation of xx·yy - xy².
    minors = torch.linalg.cross(root[:, 0], root[:, 1])
    sharp = minors.square().sum(1)
    low = LOW_PASS
    determinants = sharp + low * (xx + yy) + low**2
    covariances = torch.stack((xx + low, xy, yy + low), 1)
    opacities = torch.sigmoid(gaussians.opacity_logits[index])
    if gaussians.antialiased:
        opacities = opacities * torch.where(sharp > 0, sharp / determinants, 1).sqrt() * (sharp > 0)

    with torch.no_grad():
        cut = torch.sqrt(2 * torch.log(torch.clamp(opacities / MIN_ALPHA, min=1.0)))
        reach = torch.ceil(cut[:, None] * covariances[:, [0, 2]].sqrt())
        size = torch.tensor([camera.width, camera.height], dtype=like.dtype, device=like.device)
        near_enough = (means.abs() < MAX_PIXELS).all(1) & (xx < MAX_VARIANCE) & (yy < MAX_VARIANCE)
        visible = (opacities >= MIN_ALPHA) & near_enough
        visible &= ((means + reach > 0) & (means - reach < size)).all(1)
        radii = torch.zeros(len(gaussians), dtype=torch.int32, device=like.device)
        radii[index[visible]] = reach[visible].amax(1).clamp(1, 2**30).to(torch.int32)
        indices = torch.nonzero(visible)[:, 0]
        indices = indices[torch.sort(z[indices], stable=True).indices]
    columns = (index, means, covariances, determinants, z, opacities)
    return Projected(*(array[indices] for array in columns)), radii


def rotations(quaternions: Tensor) -> Tensor:
    """Return rotation matrices [M, 3, 3] for wxyz quaternions [M, 4] of any length; zero is the identity."""
    zero = (quaternions == 0).all(1, keepdim=True)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quaternions.dtype, device=quaternions.device)
    safe = torch.where(zero, identity, quaternions)
    w, x, y, z = (safe / safe.norm(dim=1, keepdim=True)).unbind(1)
    rows = (
        torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), 1),
        torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), 1),
        torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), 1),
    )
    return torch.stack(rows, 1)


def colors(gaussians: Gaussians, camera: Camera, degree: int) -> Tensor:
    """Return the colors [N, 3] of the Gaussians as the camera sees them: max(0, 0.5 + sum_k Y_k(direction) sh_k).

    Directions point from the camera to the Gaussians; `degree` is the degree of the spherical harmonics used.
    """
    center = torch.as_tensor(camera.center, dtype=gaussians.means.dtype, device=gaussians.means.device)
    weights = harmonics(gaussians.means - center, degree)
    return torch.clamp_min(0.5 + (weights[:, :, None] * gaussians.sh[:, : weights.shape[1]]).sum(1), 0)


def harmonics(directions: Tensor, degree: int) -> Tensor:
    """Return the spherical harmonics [..., (degree + 1)^2] of 3DGS in directions [..., 3] of any length."""
    x, y, z = (directions / directions.norm(dim=-1, keepdim=True).clamp_min(1e-30)).unbind(-1)
    basis = [torch.full_like(x, SH0)]
    if degree >= 1:
        basis += [-SH1 * y, SH1 * z, -SH1 * x]
    if degree >= 2:
        basis += [SH2[0] * x * y, SH2[1] * y * z, SH2[2] * (2 * z * z - x * x - y * y), SH2[3] * x * z]
        basis += [SH2[4] * (x * x - y * y)]
    if degree >= 3:
        basis += [SH3[0] * y * (3 * x * x - y * y), SH3[1] * x * y * z, SH3[2] * y * (4 * z * z - x * x - y * y)]
        basis += [SH3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y), SH3[4] * x * (4 * z * z - x * x - y * y)]
        basis += [SH3[5] * z * (x * x - y * y), SH3[6] * x * (x * x - 3 * y * y)]
    return torch.stack(basis, -1)


def blending_weights(projected: Projected, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the weights of front-to-back blending at P pixels.

    Args:
        projected: M Gaussians, front to back.
        pixels: [P, 2], centers of the pixels.

    Returns:
        The weights [P, M], alpha_k prod_{j<k} (1 - alpha_j), and the transmittance [P] behind all Gaussians.
    """
    dx, dy = (pixels[:, None, :] - projected.means).unbind(2)
    _, xy, yy = projected.covariances.unbind(1)
    # The quadratic form of the inverse covariance as a sum of squares: no cancellation for needles.
    along = dx - xy / yy * dy
    distance = dy.square() / yy + along.square() * (yy / projected.determinants)
    alpha = torch.clamp_max(projected.opacities * torch.exp(-0.5 * distance), MAX_ALPHA)
    alpha = torch.where(alpha < MIN_ALPHA, 0, alpha)
    with torch.no_grad():
        blended = torch.cumprod(1 - alpha, 1) >= MIN_TRANSMITTANCE
    alpha = torch.where(blended, alpha, 0)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat((dx.new_ones(len(dx), 1), after), 1)
    return alpha * before[:, :-1], before[:, -1]


def _pixel_chunks(camera: Camera, projected: Projected) -> tuple[Tensor, ...]:
    """Return the pixel centers of the image in row-major order, in chunks [P, 2] of at most `_CHUNK` / M pixels."""
    like = projected.means
    x = torch.arange(camera.width, dtype=like.dtype, device=like.device) + 0.5
    y = torch.arange(camera.height, dtype=like.dtype, device=like.device) + 0.5
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    centers = torch.stack((columns.reshape(-1), rows.reshape(-1)), 1)
    return torch.split(centers, max(1, _CHUNK // max(1, len(like))))
