"""Closed camera paths through a capture, along which a scene is rendered from new positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reffusion.types import Camera

# Points count as around the focus point within this share of the usual distance of cameras, if there are so many.
AROUND, MIN_AROUND = 0.35, 10
POINT_WEIGHT = 1e-2  # weight of the points' median in the focus point; the optical axis of a camera has weight 1


def ellipse_path(cameras: Sequence[Camera], points: np.ndarray, frames: int) -> list[Camera]:
    """Return cameras on an ellipse that fits the positions of a capture's cameras, all looking at the same point.

    The center of the ellipse is the mean camera position. Its axes are the first two principal axes of the positions,
    and each semi-axis is sqrt(2) times the standard deviation along the axis. So cameras on a circle give this circle,
    and cameras side by side give a flat loop in front of the scene. The point looked at is `focus_point`.

    Args:
        cameras: cameras of the capture, at least one; the middle one of the sequence provides image size and focal
            lengths. The principal point of the returned cameras is the image center.
        points: [P, 3] sparse points of the scene. Their median determines the distance of the focus point if the
            optical axes are parallel. May be empty.
        frames: number of cameras to return; the path is closed, and the last camera is one step before the first.

    Raises:
        ValueError: there is no camera, or frames < 1.
    """
    if not cameras or frames < 1:
        raise ValueError(f"a camera path needs a camera and a frame, not {len(cameras)} and {frames}")
    centers = np.stack([camera.center for camera in cameras])
    middle, target = centers.mean(0), focus_point(cameras, points)
    _, sizes, axes = np.linalg.svd(centers - middle, full_matrices=False)
    radii = np.sqrt(2 / len(centers)) * sizes  # a circle has root mean square radius / sqrt 2 along each axis
    down = np.mean([camera.world_to_camera[1, :3] for camera in cameras], 0)
    lens, path = cameras[len(cameras) // 2], []
    for k in range(frames):
        turn = 2 * np.pi * k / frames
        offset = sum(f(turn) * radius * axis for f, radius, axis in zip((np.cos, np.sin), radii, axes, strict=False))
        pose = look_at(middle + offset, target, down)
        path.append(
            Camera(f"flight{k:04d}", lens.width, lens.height, lens.fx, lens.fy, lens.width / 2, lens.height / 2, pose)
        )
    return path


def focus_point(cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
    """Return the point [3] nearest to all optical axes in the least-squares sense, drawn slightly to the sparse points.

    The optical axes count as infinite lines. The attracting point is the coordinate-wise median of `points` [P, 3]. If
    `points` is empty, it is the mean of the points at distance 1 in front of the cameras.
    """
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    anchor = np.median(points, 0) if len(points) else np.mean([c.center + c.world_to_camera[2, :3] for c in cameras], 0)
    for camera in cameras:
        axis = camera.world_to_camera[2, :3]
        across = np.eye(3) - np.outer(axis, axis)
        matrix += across + POINT_WEIGHT * np.eye(3)
        right += across @ camera.center + POINT_WEIGHT * anchor
    return np.linalg.solve(matrix, right)


def find_central_view(cameras: Sequence[Camera], points: np.ndarray) -> Camera:
    """Return the camera that shows best what the photographs were taken for: probably whole, and from its broad side.

    The focus point is near the optical axis and at a usual distance, and the sparse points around it spread widely. A
    deviation of 20 degrees counts as much as a distance that is e times the median, or as a spread that is e^-.5 times.

    Args:
        cameras: cameras of the capture, at least one.
        points: [P, 3] sparse points of the scene, see `focus_point`.
    """
    target = focus_point(cameras, points)
    toward = target - np.stack([camera.center for camera in cameras])
    distance = np.maximum(np.linalg.norm(toward, axis=1), 1e-12)
    cosine = np.sum(toward * np.stack([camera.world_to_camera[2, :3] for camera in cameras]), 1) / distance
    usual = float(np.median(distance))
    cost = np.degrees(np.arccos(np.clip(cosine, -1, 1))) / 20 + np.abs(np.log(distance / usual))
    around = points[np.linalg.norm(points - target, axis=1) < AROUND * usual] if len(points) else points
    if len(around) >= MIN_AROUND:
        cost -= 2 * np.log(np.maximum([_spread(camera, around) for camera in cameras], 1e-12))
    return cameras[int(np.argmin(cost))]


def _spread(camera: Camera, points: np.ndarray) -> float:
    """Return the area over which points [P, 3] spread across a camera's view: in world units, but for a factor."""
    across = (points - points.mean(0)) @ camera.world_to_camera[:2, :3].T
    return float(np.sqrt(np.linalg.det(np.cov(across.T))))


def look_at(center: np.ndarray, target: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Return the world-to-camera pose [4, 4] of a camera at `center` [3] that looks at `target` [3].

    Args:
        down: [3], the direction in the world that points down in the image, as far as the viewing direction allows. The
            roll is arbitrary if `down` is parallel to the viewing direction.
    """
    forward = target - center
    length = np.linalg.norm(forward)
    forward = forward / length if length > 0 else np.array([0.0, 0.0, 1.0])
    right = np.cross(down, forward)
    if np.linalg.norm(right) < 1e-6 * max(
        np.linalg.norm(down), 1e-300
    ):  # looking straight down or up: any row direction works
        right = np.cross(np.eye(3)[np.argmin(np.abs(forward))], forward)
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ center
    return pose
