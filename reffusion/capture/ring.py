"""Cameras around a hole, for a scene that brings Gaussians and neither photographs nor cameras."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from reffusion.capture.layouts.capture import NO_POINTS, Poses
from reffusion.capture.lens import Lens
from reffusion.io.files import BadInput

ANGLE = np.radians(60)  # of view, across
ASPECT = 4 / 3
AROUND, ELEVATIONS = 16, np.radians([15, 35, 60])  # places on a ring, and the rings above the surface it stands on
DISTANCES = (5.0, 3.5, 2.5)  # of the hole's radius, the first from which it is in sight
BESIDE = 500  # splats next to the hole that tell which way is up
RAYS, STEPS = 64, 24  # by which it is found whether something stands before the hole
FREE = 0.7  # of these rays that must pass
LEAST = 3  # views


def cameras_around(means: np.ndarray, sizes: np.ndarray, opaque: np.ndarray, deleted: np.ndarray, width: int) -> Poses:
    """Views of the hole from all sides from which what stays does not hide it, above the surface that it stands on.

    Args:
        means: [N, 3], the whole scene's, in its own frame; sizes: [N], of each its largest standard deviation.
        opaque: bool [N]; deleted: bool [N], the hole.
        width: of the views, in pixels.

    Raises:
        BadInput: it is in sight from fewer than three places.
    """
    hole, stays = means[deleted], means[opaque & ~deleted]
    if len(stays) < BESIDE:
        raise BadInput(f"scene.yaml: cleaned: {len(stays)} opaque splats are left: too few to say where cameras can be")
    center = np.median(hole, 0)
    radius = float(np.percentile(np.linalg.norm(hole - center, axis=1), 95))
    near = cKDTree(stays), sizes[opaque & ~deleted]
    up = _up(hole, stays, center)
    aim = hole[:: max(1, len(hole) // RAYS)][:RAYS]
    found = {}
    for elevation in ELEVATIONS:
        for azimuth in np.arange(AROUND) * 2 * np.pi / AROUND:
            away = _direction(up, azimuth, elevation)
            places = (center + each * radius * away for each in DISTANCES)
            place = next((place for place in places if _free(place, aim, near, radius) >= FREE), None)
            if place is not None:
                found[f"ring_{len(found):02d}"] = _looking(place, center, up)
    if len(found) < LEAST:
        raise BadInput(
            "scene.yaml: cleaned: the hole is in sight from too few places around it; bring cameras, as "
            "transforms.json or a COLMAP model"
        )
    height, focal = round(width / ASPECT), width / 2 / np.tan(ANGLE / 2)
    lens = Lens(width, height, focal, focal, width / 2, height / 2)
    return Poses(dict.fromkeys(found, lens), found, *NO_POINTS, {})


def _up(hole: np.ndarray, stays: np.ndarray, center: np.ndarray) -> np.ndarray:
    """[3], the normal of what stays next to the hole, to the side on which the hole is."""
    beside = stays[np.argsort(cKDTree(hole).query(stays)[0])[:BESIDE]]
    middle = np.median(beside, 0)
    normal = np.linalg.svd(beside - middle, full_matrices=False)[2][2]
    return normal if normal @ (center - middle) >= 0 else -normal


def _direction(up: np.ndarray, azimuth: float, elevation: float) -> np.ndarray:
    along = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    along /= np.linalg.norm(along)
    level = np.cos(azimuth) * along + np.sin(azimuth) * np.cross(up, along)
    return np.cos(elevation) * level + np.sin(elevation) * up


def _free(place: np.ndarray, aim: np.ndarray, near: tuple[cKDTree, np.ndarray], radius: float) -> float:
    """Of the rays from a place to the hole's splats `aim` [P, 3], those that meet nothing before the hole."""
    tree, sizes = near
    ways = aim - place
    lengths = np.linalg.norm(ways, axis=1)
    ends = np.clip(1 - radius / lengths, 0, 1)  # what is that near to them is the ground they stand on
    points = place + ways[:, None] * (ends[:, None] * np.linspace(0, 1, STEPS))[..., None]
    distances, nearest = tree.query(points)
    return float((distances > sizes[nearest]).all(1).mean())


def _looking(place: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """[4, 4] world to camera."""
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ place
    return pose
