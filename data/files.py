"""The files of a scene: COLMAP's model, LLFF's poses, pictures, and the cameras of the truth."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
from kinds import FULL, Kind
from reconstruction import Frame, SparsePoints


def write_model(folder: Path, kind: Kind, names: list[str], cameras: np.ndarray, frame: Frame, points: SparsePoints):
    """COLMAP's cameras.bin, images.bin, points3D.bin. Training views come last and alone have image points."""
    folder.mkdir(parents=True, exist_ok=True)
    first = len(names) - points.tracks.shape[1]
    seen = [np.flatnonzero(np.isfinite(points.tracks[:, v, 0])) for v in range(points.tracks.shape[1])]
    (folder / "cameras.bin").write_bytes(_camera_record(kind, cameras[0]))
    with open(folder / "images.bin", "wb") as file:
        file.write(struct.pack("<Q", len(names)))
        for k, name in enumerate(names):
            pose = frame.world_to_camera(cameras[k])
            file.write(struct.pack("<i7di", k + 1, *quaternion(pose[:3, :3]), *pose[:3, 3], 1))
            file.write(name.encode() + b".jpg\0")
            ids = seen[k - first] if k >= first else []
            file.write(struct.pack("<Q", len(ids)))
            for p in ids:
                file.write(struct.pack("<ddq", *points.tracks[p, k - first], p + 1))
    order = [{p: n for n, p in enumerate(ids)} for ids in seen]
    positions = frame.points(points.positions)
    with open(folder / "points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", len(positions)))
        for p, (position, color) in enumerate(zip(positions, points.colors, strict=True)):
            views = np.flatnonzero(np.isfinite(points.tracks[p, :, 0]))
            file.write(struct.pack("<Q3d3BdQ", p + 1, *position, *color, 0.5, len(views)))
            for v in views:
                file.write(struct.pack("<ii", first + v + 1, order[v][p]))


def _camera_record(kind: Kind, camera: np.ndarray) -> bytes:
    """One camera, model 2: SIMPLE_RADIAL, of the full resolution."""
    f, cx, cy = FULL * camera[:3]
    return struct.pack("<QiiQQ4d", 1, 1, 2, FULL * kind.width, FULL * kind.height, f, cx, cy, camera[3])


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """wxyz of a rotation matrix, w >= 0: the eigenvector of Bar-Itzhack's symmetric matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    _, vectors = np.linalg.eigh(np.array([
        [a - e - i, d + b, g + c, h - f],
        [d + b, e - a - i, h + f, c - g],
        [g + c, h + f, i - a - e, d - b],
        [h - f, c - g, d - b, a + e + i],
    ]))  # fmt: skip
    x, y, z, w = vectors[:, -1]
    return np.array([w, x, y, z]) * (1 if w >= 0 else -1)


def write_poses_bounds(path: Path, kind: Kind, cameras: np.ndarray, frame: Frame, points: SparsePoints) -> None:
    """LLFF's [V, 17]: columns down, right, backwards, centre, (height, width, focal) row by row; near and far."""
    rows = []
    positions = frame.points(points.positions)
    for camera in cameras:
        pose = frame.world_to_camera(camera)
        right, down, forward = pose[:3, :3]
        center = -pose[:3, :3].T @ pose[:3, 3]
        intrinsics = FULL * np.array([kind.height, kind.width, camera[0]])
        depth = positions @ forward + pose[2, 3]
        bounds = np.percentile(depth[depth > 0], (0.1, 99.9))
        rows.append([*np.stack([down, right, -forward, center, intrinsics], 1).ravel(), *bounds])
    np.save(path, np.array(rows))


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image, [cv2.IMWRITE_PNG_COMPRESSION, 4])


def write_truth_cameras(path: Path, kind: Kind, names: list[str], cameras: np.ndarray, frame: Frame) -> None:
    """SIMPLE_RADIAL intrinsics at the size of the written images and each view's pose in the scene frame."""
    f, cx, cy, k1 = cameras[0, :4].tolist()
    views = {name: frame.world_to_camera(c).tolist() for name, c in zip(names, cameras, strict=True)}
    record = {"width": kind.width, "height": kind.height, "f": f, "cx": cx, "cy": cy, "k1": k1}
    record["world_to_camera"] = views
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=1))
