"""Pinhole geometry: pure functions on NumPy arrays, with coordinates in float64.

`types.Camera` defines the conventions of cameras and pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reffusion.types import Camera

# Relative differences of depth by which two surfaces are compared. Between the first two, neither holds.
SAME_SURFACE = 0.02  # up to this difference, two renderings show the same surface, or a rendering shows a plane
OTHER_SURFACE = 0.03  # from this difference on, one surface lies in front of the other
SAME_IF_MEASURED = 0.01  # as SAME_SURFACE, for depth from plane sweep stereo, which is more exact than rendered depth
SAME_IF_COARSE = 0.1  # as SAME_SURFACE, for pictures of a few hundred pixels and for single points


class Degenerate(ValueError):
    """Error: the data do not determine the result, e.g. because too few pixels have a known depth.

    Attributes:
        reason: the cause in one or two words, e.g. "few pixels". A caller that can do without one view skips the view
            and counts the skipped views by this reason.
    """

    def __init__(self, reason: str, message: str):
        super().__init__(message)
        self.reason = reason


def to_camera(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Transform world points [..., 3] into the camera's axes (x right, y down, z forward), float64 [..., 3]."""
    pose = camera.world_to_camera
    return np.asarray(points, np.float64) @ pose[:3, :3].T + pose[:3, 3]


def project(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Project world points [..., 3] to pixel coordinates uv [..., 2] and camera depth z [...], both float64.

    The pixel in row j and column i has its center at uv = (i + 0.5, j + 0.5). Points with z <= 0 are not in front of
    the camera. Their uv is NaN, not a mirrored position.
    """
    x, y, z = np.moveaxis(to_camera(points, camera), -1, 0)
    ahead = np.where(z > 0, z, np.nan)
    uv = np.stack([camera.fx * x / ahead + camera.cx, camera.fy * y / ahead + camera.cy], -1)
    return uv, z


def is_in_frame(uv: np.ndarray, z: np.ndarray, camera: Camera, margin: float = 0.0) -> np.ndarray:
    """Return bool [...], which points of `project` lie in the camera's image.

    Args:
        uv: [..., 2], pixel coordinates.
        z: [...], camera depth.
        margin: width of a margin around the image that counts as image, as a fraction of the image's width and height.
    """
    size = np.array([camera.width, camera.height])
    return (z > 0) & (uv >= -margin * size).all(-1) & (uv < (1 + margin) * size).all(-1)


def pixel_rays(camera: Camera) -> np.ndarray:
    """Return the ray directions through the pixel centers in the camera's axes, scaled to z = 1: float64 [H, W, 3]."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], -1)


def unproject(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the world points, float64 [H, W, 3], that a depth map describes; the inverse of `project`.

    Args:
        depth: [H, W], camera z at the pixel centers.

    Raises:
        ValueError: the size of the depth map is not the size of the camera's image.
    """
    depth = np.asarray(depth, np.float64)
    if depth.shape != (camera.height, camera.width):
        raise ValueError(f"depth map is {depth.shape}, view {camera.name} is {(camera.height, camera.width)}")
    pose = camera.world_to_camera
    return (pixel_rays(camera) * depth[..., None] - pose[:3, 3]) @ pose[:3, :3]


def reciprocal(values: np.ndarray) -> np.ndarray:
    """Return a new array with 1 / values where the values are positive, else 0.

    This converts depth to disparity, and disparity to depth.

    Args:
        values: float array of any shape.
    """
    return np.divide(1.0, values, out=np.zeros_like(values), where=values > 0)


def sample_nearest(image: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the values of the pixels that contain the given positions, without interpolation.

    Args:
        image: [H, W, ...], values of any type.
        uv: [..., 2], positions (column, row) in pixel coordinates; NaN is allowed.

    Returns:
        The values, with the shape of the positions followed by that of a pixel, and bool [...], True where a position
        lies inside the image. For a position outside the image, or NaN, the first result holds the value of pixel
        (0, 0), so callers must mask the first result with the second.
    """
    height, width = image.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (uv[..., 0] >= 0) & (uv[..., 0] < width) & (uv[..., 1] >= 0) & (uv[..., 1] < height)
    column, row = (np.where(inside, uv[..., axis], 0.0).astype(np.int64) for axis in (0, 1))
    return image[row, column], inside


def shows_points(depth: np.ndarray, uv: np.ndarray, z: np.ndarray, tolerance: float) -> np.ndarray:
    """Return bool [...], at which of the points of `project` a depth map shows a surface.

    Args:
        depth: [H, W], camera z, 0 where unknown.
        uv: [..., 2], pixel coordinates.
        z: [...], camera depth.
        tolerance: relative difference of depth below which the surface is at the point.
    """
    shown, inside = sample_nearest(depth, uv)
    return inside & (shown > 0) & (np.abs(z - shown) < tolerance * shown)


def angle_between_views(point: np.ndarray, camera: Camera, others: Sequence[Camera]) -> float:
    """Return the smallest of the angles at a point between the direction to `camera` and those to the other cameras.

    Args:
        point: [3], world coordinates of the vertex of the angle.
        others: at least one camera.

    Returns:
        Degrees in [0, 180]. An angle counts as 180 if the center of one of its two cameras is the point, because this
        camera has no direction.
    """
    towards = np.stack([view.center - point for view in (camera, *others)])
    lengths = np.linalg.norm(towards, axis=1)
    cosines = towards[1:] @ towards[0] / np.maximum(lengths[1:] * lengths[0], np.finfo(np.float64).tiny)
    known = (lengths[1:] > 0) & (lengths[0] > 0)
    return float(np.degrees(np.arccos(np.where(known, cosines, -1.0).clip(-1, 1))).min())


def cameras_extent(cameras: Sequence[Camera]) -> float:
    """Return the extent of a scene as 3DGS defines it.

    This is 1.1 times the largest distance of a camera's center from the mean of all camera centers, in world units.
    There must be at least one camera.
    """
    centers = np.stack([camera.center for camera in cameras])
    return 1.1 * float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
