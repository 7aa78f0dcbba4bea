"""Imitation of structure from motion on the photographs: an arbitrary frame, and sparse points with errors."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lab.scenes import raycast
from lab.scenes.kinds import FULL, Kind, randomness
from lab.scenes.world import World


@dataclass(frozen=True)
class Frame:
    """Similarity transform from the room to the scene frame, the arbitrary frame of a structure-from-motion model.

    x_scene = scale * rotation @ x_room + offset.
    """

    scale: float
    rotation: np.ndarray
    offset: np.ndarray

    def points(self, points: np.ndarray) -> np.ndarray:
        """Transform room points [..., 3] to the scene frame."""
        return self.scale * points @ self.rotation.T + self.offset

    def world_to_camera(self, camera: np.ndarray) -> np.ndarray:
        """Return the world-to-camera pose [4, 4] in the scene frame of a camera row [16], see `raycast`."""
        turn = self.rotation @ camera[4:13].reshape(3, 3)
        result = np.eye(4)
        result[:3, :3] = turn.T
        result[:3, 3] = -turn.T @ self.points(camera[13:])
        return result


def scene_frame(seed: int) -> Frame:
    """Return the random scene frame of a scene."""
    draw = randomness(seed, "frame")
    rotation, _ = np.linalg.qr(draw.normal(size=(3, 3)))
    return Frame(draw.uniform(0.7, 3.0), rotation * np.sign(np.linalg.det(rotation)), draw.normal(0, 2, 3))


@dataclass(frozen=True)
class SparsePoints:
    """P sparse points with errors like those of structure from motion.

    Attributes:
        positions: [P, 3] in the room, metres.
        colors: [P, 3] uint8.
        tracks: [P, V, 2] image points in V training views, px of the full resolution; NaN where the point is not
            matched.
    """

    positions: np.ndarray
    colors: np.ndarray
    tracks: np.ndarray


def sparse_points(seed: int, kind: Kind, world: World, cameras: np.ndarray, photos: np.ndarray) -> SparsePoints:
    """Make at most `kind.points` sparse points on textured surfaces, each matched in at least 3 training views.

    Args:
        seed: seed of the scene.
        kind: kind of the scene.
        world: the room as photographed.
        cameras: [V, 16], training views.
        photos: uint8 [V, H, W, 3], training photographs.
    """
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
    # As in structure from motion, a point is matched in only some of the views that show it.
    tracks[draw.random(tracks.shape[:2]) > max(0.2, 4 / len(cameras))] = np.nan
    good = np.flatnonzero(np.isfinite(tracks[..., 0]).sum(1) >= 3)
    good = np.sort(draw.permutation(good)[: kind.points])
    tracks = tracks[good] + draw.normal(0, 0.4, (len(good), len(cameras), 2))
    return SparsePoints(positions[good] + draw.normal(0, 0.0015, (len(good), 3)), colors[good], tracks)


def _textured_pixels(photo: np.ndarray, count: int, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw `count` pixels, more often where the gradient of the gray levels is large; return (rows, columns)."""
    gray = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY).astype(np.float32)
    edges = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)).ravel() + 4
    return np.divmod(draw.choice(edges.size, count, replace=False, p=edges / edges.sum()), photo.shape[1])
