"""Imitates structure from motion of the photographs: an arbitrary frame, and sparse points."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import raycast
from kinds import FULL, Kind, randomness
from world import World


@dataclass(frozen=True)
class Frame:
    """x_scene = scale * rotation @ x_room + offset: the arbitrary frame of an SfM model."""

    scale: float
    rotation: np.ndarray
    offset: np.ndarray

    def points(self, points: np.ndarray) -> np.ndarray:
        return self.scale * points @ self.rotation.T + self.offset

    def world_to_camera(self, camera: np.ndarray) -> np.ndarray:
        """[4, 4] of a camera row."""
        turn = self.rotation @ camera[4:13].reshape(3, 3)
        result = np.eye(4)
        result[:3, :3] = turn.T
        result[:3, 3] = -turn.T @ self.points(camera[13:])
        return result


def scene_frame(seed: int) -> Frame:
    draw = randomness(seed, "frame")
    rotation, _ = np.linalg.qr(draw.normal(size=(3, 3)))
    return Frame(draw.uniform(0.7, 3.0), rotation * np.sign(np.linalg.det(rotation)), draw.normal(0, 2, 3))


@dataclass(frozen=True)
class SparsePoints:
    """COLMAP's points: room positions [P, 3], colours [P, 3], image points [P, V, 2] at full resolution or NaN."""

    positions: np.ndarray
    colors: np.ndarray
    tracks: np.ndarray


def sparse_points(seed: int, kind: Kind, world: World, cameras: np.ndarray, photos: np.ndarray) -> SparsePoints:
    """Points on textured surfaces that at least 3 training views see, with errors like those of SfM."""
    draw = randomness(seed, "points")
    per_view = -(-kind.points * 3 // (2 * len(cameras)))
    positions, colors = [], []
    for camera, photo in zip(cameras, photos, strict=True):
        row, column = _textured_pixels(photo, per_view, draw)
        pixels = np.stack([column, row], 1) + 0.5
        positions.append(raycast.surface_points(world.solids, camera, pixels, True)[0])
        colors.append(photo[row, column])
    positions, colors = np.concatenate(positions), np.concatenate(colors)
    tracks = raycast.observations(world.solids, cameras, kind.width, kind.height, positions) * FULL
    # A feature is matched in only some of the views that show it.
    tracks[draw.random(tracks.shape[:2]) > max(0.2, 4 / len(cameras))] = np.nan
    good = np.flatnonzero(np.isfinite(tracks[..., 0]).sum(1) >= 3)
    good = np.sort(draw.permutation(good)[: kind.points])
    tracks = tracks[good] + draw.normal(0, 0.4, (len(good), len(cameras), 2))
    return SparsePoints(positions[good] + draw.normal(0, 0.0015, (len(good), 3)), colors[good], tracks)


def _textured_pixels(photo: np.ndarray, count: int, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(rows, columns) drawn with the gradient of the photograph's grey levels as probability."""
    grey = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY).astype(np.float32)
    edges = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)).ravel() + 4
    return np.divmod(draw.choice(edges.size, count, replace=False, p=edges / edges.sum()), photo.shape[1])
