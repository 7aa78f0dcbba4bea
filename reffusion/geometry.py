"""Pinhole geometry: pure functions on float64 arrays (camera conventions of types)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reffusion.types import Camera


class Degenerate(ValueError):
    """What is known does not determine the result.

    Attributes:
        reason: one or two words, to be counted where the loss of one view does no harm.
    """

    def __init__(self, reason: str, message: str):
        super().__init__(message)
        self.reason = reason


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


def reciprocal(values: np.ndarray) -> np.ndarray:
    """1 / values where they are positive, else 0: disparity of depth, and depth of disparity."""
    return np.divide(1.0, values, out=np.zeros_like(values), where=values > 0)


def sample_nearest(image: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pixels of `image` [H, W, ...] that contain uv [..., 2], and which uv lie inside the image (bool [...]).

    Outside, and for NaN, the value of pixel (0, 0) stands in: mask it with the second result.
    """
    height, width = image.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (uv[..., 0] >= 0) & (uv[..., 0] < width) & (uv[..., 1] >= 0) & (uv[..., 1] < height)
    column, row = (np.where(inside, uv[..., axis], 0.0).astype(np.int64) for axis in (0, 1))
    return image[row, column], inside


def angle_between_views(point: np.ndarray, camera: Camera, others: Sequence[Camera]) -> float:
    """Degrees in [0, 180] at `point` [3] between the direction to `camera` and that to the nearest of `others`.

    A camera at the point itself has no direction: 180.
    """
    towards = np.stack([view.center - point for view in (camera, *others)])
    lengths = np.linalg.norm(towards, axis=1)
    cosines = towards[1:] @ towards[0] / np.maximum(lengths[1:] * lengths[0], np.finfo(np.float64).tiny)
    known = (lengths[1:] > 0) & (lengths[0] > 0)
    return float(np.degrees(np.arccos(np.where(known, cosines, -1.0).clip(-1, 1))).min())


def cameras_extent(cameras: Sequence[Camera]) -> float:
    """3DGS's measure of a scene: 1.1 times the largest distance of a camera's centre from the mean of all."""
    centers = np.stack([camera.center for camera in cameras])
    return 1.1 * float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
