"""Cameras of small scenes, their rays and depth views, and scenes made of these cameras."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import cv2
import numpy as np

from reffusion import geometry
from reffusion.background.visibility import DepthView
from reffusion.types import Camera, Scene, Similarity

Vector = Sequence[float] | np.ndarray


def make_camera(
    name: str, size: tuple[int, int], focal: float, center: Vector = (0.0, 0.0, 0.0), rotation: np.ndarray | None = None
) -> Camera:
    """Return a pinhole camera at `center` [3] whose principal point is the middle of the picture.

    Args:
        size: width and height in px.
        focal: focal length in px.
        rotation: [3, 3], from world to camera; None for the identity, which looks along the world's z axis.
    """
    pose = np.eye(4)
    if rotation is not None:
        pose[:3, :3] = rotation
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(center, float)
    return Camera(name, *size, focal, focal, size[0] / 2, size[1] / 2, pose)


def yaw(angle: float) -> np.ndarray:
    """Return the rotation [3, 3] from world to camera of a camera turned right about y by an angle in radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def rotation_along(forward: np.ndarray, up: Vector = (0.0, 0.0, 1.0)) -> np.ndarray:
    """Return the rotation [3, 3] from world to camera of a camera that looks along `forward` [3].

    The direction `up` [3] points upwards in the picture.
    """
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def look_at_camera(
    name: str,
    center: Vector,
    target: Vector,
    size: tuple[int, int],
    focal: float,
    up: Vector = (0.0, 0.0, 1.0),
) -> Camera:
    """Return the camera at `center` [3] that shows `target` [3] in the middle of its picture."""
    return make_camera(name, size, focal, center, rotation_along(np.subtract(target, center), up))


def orbit_camera(
    name: str, azimuth_deg: float, height: float, radius: float, target: Vector, size: int, focal: float
) -> Camera:
    """Return a camera with a square picture on a circle about the z axis (up) that looks at `target` [3].

    Args:
        azimuth_deg: angle of the camera's position on the circle, in degrees from the x axis.
        height: z of the camera.
        radius: radius of the circle.
        size: width and height of the picture in px.
        focal: focal length in px.
    """
    angle = np.radians(azimuth_deg)
    center = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
    return look_at_camera(name, center, target, (size, size), focal)


def world_rays(view: Camera) -> np.ndarray:
    """Return the rays [H, W, 3] of the pixels in world axes; the component of each along the camera's z axis is 1."""
    return geometry.pixel_rays(view) @ view.world_to_camera[:3, :3]


def project_points(points: np.ndarray, view: Camera) -> np.ndarray:
    """Return the image points [..., 2] in px of the world points [..., 3]."""
    local = points @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    return local[..., :2] / local[..., 2:] * (view.fx, view.fy) + (view.cx, view.cy)


def meet_box(view: Camera, low: Vector, high: Vector) -> tuple[np.ndarray, np.ndarray]:
    """Intersect each pixel's ray with the axis-aligned box between the corners `low` and `high` [3].

    Returns:
        The depth [H, W] (camera z) at which each ray enters the box, and bool [H, W], True where the ray meets the box.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = np.stack([(np.asarray(corner) - view.center) / world_rays(view) for corner in (low, high)])
    enter, leave = bounds.min(0).max(-1), bounds.max(0).min(-1)
    return enter, (enter < leave) & (leave > 0)


def uneven_depth_view(view: Camera, depth: np.ndarray, hidden: np.ndarray, tolerance: float = 0.0) -> DepthView:
    """Return a DepthView whose depth range at each pixel holds the depths of all neighboring pixels.

    Args:
        depth: [H, W], camera z.
        hidden: bool [H, W], pixels of the object; the view's mask is this region dilated by 2 px.
        tolerance: share by which the depth range is widened on both sides.
    """
    kernel = np.ones((3, 3))
    mask = cv2.dilate(hidden.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    near, far = (1 - tolerance) * cv2.erode(depth, kernel), (1 + tolerance) * cv2.dilate(depth, kernel)
    return DepthView.from_range(view, depth, (near, far), mask)


def make_scene(
    cameras: Mapping[str, Camera],
    test: Sequence[str] = (),
    clean: Collection[str] = (),
    points: np.ndarray | None = None,
    colors: np.ndarray | None = None,
    similarity: Similarity | None = None,
) -> Scene:
    """Return a scene of these cameras. All views that `test` does not name are training views.

    Args:
        cameras: view name -> camera.
        test: names of the test views.
        clean: names of the clean views (views without the object).
        points: [N, 3]; None for one point at the origin.
        colors: uint8 [N, 3]; None for black.
        similarity: the map from the capture's frame to the scene's frame; None for the identity.
    """
    train = tuple(name for name in cameras if name not in test)
    points = np.zeros((1, 3)) if points is None else points
    colors = np.zeros((len(points), 3), np.uint8) if colors is None else colors
    similarity = similarity or Similarity(1.0, np.zeros(3))
    return Scene(dict(cameras), train, tuple(test), frozenset(clean), points, colors, similarity)
