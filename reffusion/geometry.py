"""Pinhole geometry and the alignment of depth maps: pure functions on float64 arrays (camera conventions of types)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from reffusion.types import Camera

Space = Literal["depth", "disparity"]

LEAST_PIXELS = 4  # two unknowns, and as many pixels again to notice a misfit
REWEIGHTINGS = 30
LEAST_SPREAD = 1e-6  # relative; below it float32 input carries no slope


def to_camera(points: np.ndarray, camera: Camera) -> np.ndarray:
    """[..., 3] world points in the camera's axes (x right, y down, z forward), float64."""
    pose = camera.world_to_camera
    return np.asarray(points, np.float64) @ pose[:3, :3].T + pose[:3, 3]


def project(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """World points [..., 3] -> pixel coordinates uv [..., 2] and camera depth z [...], float64.

    The pixel in row j and column i has its centre at uv = (i + 0.5, j + 0.5). Points with z <= 0 are behind the
    camera: their uv is NaN, never a mirrored position.
    """
    x, y, z = np.moveaxis(to_camera(points, camera), -1, 0)
    ahead = np.where(z > 0, z, np.nan)
    uv = np.stack([camera.fx * x / ahead + camera.cx, camera.fy * y / ahead + camera.cy], -1)
    return uv, z


def pixel_rays(camera: Camera) -> np.ndarray:
    """[H, W, 3] camera-frame directions of the pixel centres, scaled to z = 1, float64."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], -1)


def unproject(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Depth [H, W] (camera z at pixel centres) -> world points [H, W, 3], float64. Inverse of `project`.

    Raises:
        ValueError: the depth map is not of the camera's size.
    """
    depth = np.asarray(depth, np.float64)
    if depth.shape != (camera.height, camera.width):
        raise ValueError(f"depth map is {depth.shape}, view {camera.name} is {(camera.height, camera.width)}")
    pose = camera.world_to_camera
    return (pixel_rays(camera) * depth[..., None] - pose[:3, 3]) @ pose[:3, :3]


def sample_nearest(image: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pixels of `image` [H, W, ...] that contain uv [..., 2], and which uv lie inside the image (bool [...]).

    Outside, and for NaN, the value of pixel (0, 0) stands in: mask it with the second result.
    """
    height, width = image.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (uv[..., 0] >= 0) & (uv[..., 0] < width) & (uv[..., 1] >= 0) & (uv[..., 1] < height)
    column, row = (np.where(inside, uv[..., axis], 0.0).astype(np.int64) for axis in (0, 1))
    return image[row, column], inside


@dataclass(frozen=True)
class Alignment:
    """target ~ scale * estimate + offset.

    Attributes:
        scale, offset: the fitted coefficients.
        residual: weighted root mean square of target - fit, in the target's unit.
    """

    scale: float
    offset: float
    residual: float

    def apply(self, estimate: np.ndarray) -> np.ndarray:
        return self.scale * np.asarray(estimate, np.float64) + self.offset


def align(
    estimate: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None, *, robust: bool = False
) -> Alignment:
    """Scale and offset by L2 on the pixels of positive weight (paper, depth supervision).

    The normal equations are solved about the weighted means and in units of the weighted spread, so that neither a
    large offset nor a large unit costs digits.

    Args:
        estimate, target: arrays of one shape, any unit.
        weights: same shape, >= 0 (bool for a choice of pixels); None: all ones.
        robust: iteratively reweighted least squares with Geman-McClure weights (their scale from the median absolute
            residual), which lets go of outliers up to about a third of the pixels.

    Raises:
        ValueError: fewer than 4 pixels of positive weight, an estimate whose spread there is under 1e-6 of its
            magnitude (a constant fixes no scale), shapes that differ, or values that are not finite.
    """
    estimate, target = np.asarray(estimate, np.float64), np.asarray(target, np.float64)
    weights = np.ones(estimate.shape) if weights is None else np.asarray(weights, np.float64)
    if not estimate.shape == target.shape == weights.shape:
        raise ValueError(f"alignment of arrays of different shapes: {estimate.shape}, {target.shape}, {weights.shape}")
    chosen = weights > 0
    x, y, w = estimate[chosen], target[chosen], weights[chosen]
    if x.size < LEAST_PIXELS:
        raise ValueError(f"alignment needs at least {LEAST_PIXELS} known pixels, got {x.size}")
    if not (np.isfinite(x).all() and np.isfinite(y).all() and np.isfinite(w).all()):
        raise ValueError("alignment got values that are not finite: leave those pixels out by weight 0")
    result = _weighted_line(x, y, w)
    for _ in range(REWEIGHTINGS if robust else 0):
        error = np.abs(y - result.apply(x))
        spread = 1.4826 * np.median(error)
        if spread <= 1e-12 * np.abs(y).max():
            break
        updated = _weighted_line(x, y, w / (1.0 + (error / (2.0 * spread)) ** 2) ** 2)
        moved = np.abs(updated.apply(x) - result.apply(x)).max()
        result = updated
        if moved < 1e-9 * np.abs(y).max():
            break
    return result


def _weighted_line(x: np.ndarray, y: np.ndarray, w: np.ndarray) -> Alignment:
    total = w.sum()
    x_mean, y_mean = (w @ x) / total, (w @ y) / total
    dx, dy = x - x_mean, y - y_mean
    spread = np.sqrt((w @ dx**2) / total)
    if spread <= LEAST_SPREAD * np.abs(x).max():
        raise ValueError(
            f"alignment is degenerate: the estimate is constant ({x_mean:.6g}) on its {x.size} known pixels, "
            "which fixes no scale"
        )
    scale = (w @ (dx / spread * dy)) / total / spread
    residual = np.sqrt((w @ (dy - scale * dx) ** 2) / total)
    return Alignment(float(scale), float(y_mean - scale * x_mean), float(residual))


def align_depth(
    estimate: np.ndarray, depth: np.ndarray, known: np.ndarray, *, space: Space = "disparity", robust: bool = False
) -> np.ndarray:
    """A monocular estimate brought to the scene's depth, [H, W] float64 camera z.

    PAPER leaves open: whether scale and offset act on depth or on its inverse. Both are here: it must be the space of
    the estimator's output (Depth Anything gives disparity), since an offset in one is no offset in the other.

    Args:
        estimate: [H, W], affine in the scene's depth or in its disparity, as `space` says.
        depth: [H, W] the scene's depth, read where `known`.
        known: bool or weights [H, W]; pixels of depth <= 0 do not count.
        space: what the estimate is affine in.
        robust: see `align`.

    Returns:
        depth; where the aligned disparity is not positive (beyond infinity), the largest depth among known pixels.

    Raises:
        ValueError: as `align`; or the fitted scale is not positive, i.e. the estimate is of the other space.
    """
    depth = np.asarray(depth, np.float64)
    weights = np.asarray(known, np.float64) * (depth > 0)
    target = depth if space == "depth" else np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    fitted = align(estimate, target, weights, robust=robust)
    if fitted.scale <= 0:
        other = "depth" if space == "disparity" else "disparity"
        raise ValueError(f"the estimate falls where the scene's {space} grows: is it {other}?")
    aligned, farthest = fitted.apply(estimate), depth[weights > 0].max()
    if space == "depth":
        nearest = depth[weights > 0].min()
        return np.where(aligned > 0, aligned, nearest)
    return np.divide(1.0, aligned, out=np.full(aligned.shape, farthest), where=aligned > 1.0 / (1e3 * farthest))
