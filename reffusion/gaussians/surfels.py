"""Normals of a depth map, and Gaussians that render its surface. Inputs are float64 arrays."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from reffusion.geometry import pixel_rays, unproject
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians


def surface_gaussians(
    image: np.ndarray,
    depth: np.ndarray,
    pixels: np.ndarray,
    camera: Camera,
    *,
    sh_count: int,
    spread: float = 0.5,
    thickness: float = 0.1,
    grazing: float = 0.15,
    opacity: float = 0.95,
    offset_px: float = 0.0,
) -> Gaussians:
    """One Gaussian for each chosen pixel: a disk on the surface that the depth map describes.

    In `camera` each disk is round with a standard deviation of `spread` pixels, whatever the slant of the surface;
    along the normal it is thin. So the surface stays closed in nearer views and from the side.

    PAPER leaves open: scale and opacity of the initial Gaussians. These values reproduce the reference.

    Args:
        image: [H, W, 3] uint8 or [0, 1], the colours.
        depth: [H, W] camera z, positive on the chosen pixels.
        pixels: bool [H, W].
        camera: the view.
        sh_count: number K of spherical harmonics; all but the constant one are 0.
        spread: standard deviation in pixels.
        thickness: standard deviation along the normal, relative to the smaller one within the surface.
        grazing: cosine between normal and view below which disks are not stretched further.
        opacity: in (0, 1).
        offset_px: distance behind the surface, along its normal, in pixels.

    Returns:
        Gaussians, one for each chosen pixel in row-major order, float32 on the CPU.

    Raises:
        ValueError: depth not positive and finite on a chosen pixel, or not of the view's size.
    """
    if not (np.isfinite(depth[pixels]).all() and (depth[pixels] > 0).all()):
        raise ValueError(f"view {camera.name}: the depth of a pixel to be filled is not positive and finite")
    points, normals = unproject(depth, camera), surface_normals(depth, camera)
    points, normals = points[pixels], normals[pixels]
    rays = points - camera.center
    view_directions = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    cosine = np.clip(-(view_directions * normals).sum(-1), grazing, 1.0)
    axes = _axes(normals, view_directions, camera)
    tangent_scale = spread * depth[pixels] / np.sqrt(camera.fx * camera.fy)
    scales = np.stack([tangent_scale, tangent_scale / cosine, thickness * tangent_scale], -1)
    points = points - offset_px / spread * tangent_scale[:, None] * normals
    colors = (image[pixels] / 255.0 if image.dtype == np.uint8 else image[pixels]).astype(np.float64)
    sh = np.zeros((len(points), sh_count, 3))
    sh[:, 0] = (colors - 0.5) / SH0
    quaternions = Rotation.from_matrix(axes).as_quat(scalar_first=True) if len(points) else np.zeros((0, 4))
    logits = np.full(len(points), np.log(opacity / (1.0 - opacity)))
    arrays = (points, quaternions, np.log(scales), logits, sh)
    return Gaussians(*(torch.from_numpy(array).float() for array in arrays))


def _axes(normals: np.ndarray, view_directions: np.ndarray, camera: Camera) -> np.ndarray:
    """[N, 3, 3]: axes in columns: across the slope (scale w), up the slope (w / cosine), along the normal."""
    first_axis = np.cross(normals, view_directions)
    length = np.linalg.norm(first_axis, axis=-1, keepdims=True)
    fallback = np.cross(normals, camera.world_to_camera[1, :3])  # facing the camera, any direction will do
    first_axis = np.where(length > 1e-4, first_axis, fallback)
    first_axis /= np.linalg.norm(first_axis, axis=-1, keepdims=True)
    return np.stack([first_axis, np.cross(normals, first_axis), normals], -1)


def surface_normals(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """[H, W, 3]: unit normals of a depth map, towards the camera.

    Slopes are computed in disparity, where they are exact for planes, by forward or backward differences: the side
    whose slope changes less, so that pixels beside a crease or a step take the normal of their own surface.
    """
    disparity = np.divide(1.0, depth, out=np.zeros(depth.shape), where=np.asarray(depth) > 0)
    along_x, along_y = _one_sided_slope(disparity.T).T, _one_sided_slope(disparity)
    # disparity = a x + b y + c over normalised image points is the plane with normal (a, b, c) in camera axes.
    rays = pixel_rays(camera)
    a, b = along_x * camera.fx, along_y * camera.fy
    normal = np.stack([a, b, disparity - a * rays[..., 0] - b * rays[..., 1]], -1)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(length > 0, -normal / np.where(length > 0, length, 1.0), (0.0, 0.0, -1.0))
    return normal @ camera.world_to_camera[:3, :3]


def _one_sided_slope(values: np.ndarray) -> np.ndarray:
    """d/drow of [H, W]: the forward or backward difference, whichever has the smaller second difference."""
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
    return np.where(forward_bend <= backward_bend, forward, backward)
