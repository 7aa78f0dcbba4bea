"""Normals of a depth map, and Gaussians that render its surface. Depth maps are float64 arrays of camera z."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from reffusion.geometry import pixel_rays, unproject
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians

THICKNESS = 0.1  # standard deviation along the normal, divided by the smaller of the two within the surface
GRAZING = 0.15  # cosine of the angle between normal and viewing direction below which disks are not stretched further
STEP = 0.02  # change of the disparity's slope per pixel, relative to the disparity, above which a pixel lies at a step


def surface_gaussians(
    image: np.ndarray,
    depth: np.ndarray,
    pixels: np.ndarray,
    camera: Camera,
    *,
    sh_count: int,
    spread: float = 0.5,
    opacity: float = 0.95,
    offset_px: float = 0.0,
) -> Gaussians:
    """Return one Gaussian for each chosen pixel: a disk on the surface that the depth map describes.

    In `camera` each disk appears round, with a standard deviation of `spread` pixels, because it is stretched along the
    slope of a slanted surface; along the normal it is thin. So the surface stays closed in nearer views and from the
    side.

    PAPER leaves open: scale and opacity of the initial Gaussians. The defaults reproduce the reference's picture.

    Args:
        image: [H, W, 3], the colors, uint8 or floating point in [0, 1].
        depth: [H, W] camera z, positive on the chosen pixels.
        pixels: bool [H, W], True for the chosen pixels.
        camera: the view.
        sh_count: number of spherical harmonics per Gaussian; all but the constant one are 0.
        spread: standard deviation of a disk in pixels of the view.
        opacity: opacity of each disk, in (0, 1).
        offset_px: distance of the disks behind the surface, along its normal, in pixels.

    Returns:
        The Gaussians in row-major order of the pixels, float32 on the CPU.

    Raises:
        ValueError: the depth of a chosen pixel is not positive and finite, or the depth map has not the view's size.
    """
    if not (np.isfinite(depth[pixels]).all() and (depth[pixels] > 0).all()):
        raise ValueError(f"view {camera.name}: the depth of a pixel to be filled is not positive and finite")
    points, normals = unproject(depth, camera), surface_normals(depth, camera)
    points, normals = points[pixels], normals[pixels]
    rays = points - camera.center
    view_directions = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    cosine = np.clip(-(view_directions * normals).sum(-1), GRAZING, 1.0)
    axes = _axes(normals, view_directions, camera)
    tangent_scale = spread * depth[pixels] / np.sqrt(camera.fx * camera.fy)
    scales = np.stack([tangent_scale, tangent_scale / cosine, THICKNESS * tangent_scale], -1)
    points = points - offset_px / spread * tangent_scale[:, None] * normals
    colors = (image[pixels] / 255.0 if image.dtype == np.uint8 else image[pixels]).astype(np.float64)
    sh = np.zeros((len(points), sh_count, 3))
    sh[:, 0] = (colors - 0.5) / SH0
    quaternions = Rotation.from_matrix(axes).as_quat(scalar_first=True) if len(points) else np.zeros((0, 4))
    logits = np.full(len(points), np.log(opacity / (1.0 - opacity)))
    arrays = (points, quaternions, np.log(scales), logits, sh)
    return Gaussians(*(torch.from_numpy(array).float() for array in arrays))


def _axes(normals: np.ndarray, view_directions: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the axes of N disks as the columns of rotation matrices [N, 3, 3] in world coordinates."""
    # The first axis lies within the surface and across the slope, where the disk has its smaller standard deviation.
    # The second lies within the surface and along the slope, where the disk is stretched. The third is the normal.
    # `view_directions` are unit vectors from the camera to the disks.
    first_axis = np.cross(normals, view_directions)
    length = np.linalg.norm(first_axis, axis=-1, keepdims=True)
    # A disk that faces the camera has no slope, so any axis within the surface serves.
    fallback = np.cross(normals, camera.world_to_camera[1, :3])
    first_axis = np.where(length > 1e-4, first_axis, fallback)
    first_axis /= np.linalg.norm(first_axis, axis=-1, keepdims=True)
    return np.stack([first_axis, np.cross(normals, first_axis), normals], -1)


def surface_normals(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the unit normals [H, W, 3] of a depth map, in world coordinates and towards the camera.

    Slopes are computed in disparity, where they are exact for planes. They are forward or backward differences,
    whichever belongs to the side where the slope changes less. So pixels beside a crease or a step get the normal of
    their own surface. The slope is 0 along an axis if the pixel lies between two steps.

    Args:
        depth: [H, W] camera z; 0 where unknown. The normals of unknown pixels have no meaning.
        camera: the view.
    """
    disparity = np.divide(1.0, depth, out=np.zeros(depth.shape), where=np.asarray(depth) > 0)
    along_x, along_y = one_sided_slope(disparity.T).T, one_sided_slope(disparity)
    # disparity = a x + b y + c over normalized image points is the plane with normal (a, b, c) in camera axes.
    rays = pixel_rays(camera)
    a, b = along_x * camera.fx, along_y * camera.fy
    normal = np.stack([a, b, disparity - a * rays[..., 0] - b * rays[..., 1]], -1)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(length > 0, -normal / np.where(length > 0, length, 1.0), (0.0, 0.0, -1.0))
    return normal @ camera.world_to_camera[:3, :3]


def is_beside_nearer(depth: np.ndarray, ratio: float) -> np.ndarray:
    """Return bool [H, W], the pixels of a depth map that lie next to a nearer surface.

    The color of the nearer surface bleeds into these pixels. Their depth exceeds `ratio` times the smallest depth among
    the 3 x 3 pixels around them.
    """
    return depth > ratio * cv2.erode(depth, np.ones((3, 3)))


def one_sided_slope(values: np.ndarray) -> np.ndarray:
    """Return the derivative of values [H, W] down the rows, per row, [H, W].

    At each element it is the forward or the backward difference, whichever has the smaller second difference next to
    it. It is 0 where both second differences exceed `STEP` times the absolute value.
    """
    if len(values) < 3:
        return np.gradient(values, axis=0) if len(values) > 1 else np.zeros_like(values)
    step = np.diff(values, axis=0)  # step[i] = v[i+1] - v[i]
    bend = np.abs(np.diff(step, axis=0))  # bend[i]: between step[i] and step[i+1]
    unknown = np.full((1, values.shape[1]), np.inf)
    # At i, forward compares step[i] with step[i+1], and backward compares step[i-1] with step[i-2].
    forward = np.concatenate([step, step[-1:]])
    backward = np.concatenate([step[:1], step])
    forward_bend = np.concatenate([bend, unknown, unknown])
    backward_bend = np.concatenate([unknown, unknown, bend])
    slope = np.where(forward_bend <= backward_bend, forward, backward)
    return np.where(np.minimum(forward_bend, backward_bend) <= STEP * np.abs(values), slope, 0.0)
