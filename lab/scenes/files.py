"""Writers of a scene's files: COLMAP's model, LLFF's poses, pictures, and the true cameras.

A camera is a row [16] of the ray caster, see `raycast`. The *scene frame* is the arbitrary frame of the written poses.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np

from lab.scenes.kinds import FULL, Kind
from lab.scenes.reconstruction import Frame, SparsePoints


def write_model(folder: Path, kind: Kind, names: list[str], cameras: np.ndarray, frame: Frame, points: SparsePoints):
    """Write COLMAP's cameras.bin, images.bin and points3D.bin at full resolution.

    Args:
        folder: folder to write to.
        kind: kind of the scene.
        names: names of the views, to which ".jpg" is appended in the file; training views come last.
        cameras: [V, 16], one row per view.
        frame: transform from the room to the scene frame.
        points: sparse points with their image points in the training views; test views get no image points.
    """
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
    """Return the content of cameras.bin: one camera of full resolution, of COLMAP's model 2, SIMPLE_RADIAL."""
    f, cx, cy = FULL * camera[:3]
    return struct.pack("<QiiQQ4d", 1, 1, 2, FULL * kind.width, FULL * kind.height, f, cx, cy, camera[3])


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the quaternion wxyz of a rotation matrix, with w >= 0, as an eigenvector of Bar-Itzhack's matrix."""
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
    """Write LLFF's poses_bounds.npy, [V, 17], at full resolution.

    Each row has a 3 x 5 matrix, row by row, and the near and far depth. The columns of the matrix are the directions
    down, right and backwards, the camera center, and (height, width, focal length). Near and far are the 0.1 and 99.9
    percentiles of the depths of all sparse points in front of the camera, also of those that the camera does not show.
    Centers and depths are in the scene frame.
    """
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
    """Write an image, uint8 [H, W] or RGB [H, W, 3]; missing folders are created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image, [cv2.IMWRITE_PNG_COMPRESSION, 4])


def write_truth_cameras(path: Path, kind: Kind, names: list[str], cameras: np.ndarray, frame: Frame) -> None:
    """Write a JSON file with the true cameras.

    It has the SIMPLE_RADIAL intrinsics at the size of the written images, which all views share, and each view's
    world-to-camera pose in the scene frame.
    """
    f, cx, cy, k1 = cameras[0, :4].tolist()
    views = {name: frame.world_to_camera(c).tolist() for name, c in zip(names, cameras, strict=True)}
    record = {"width": kind.width, "height": kind.height, "f": f, "cx": cx, "cy": cy, "k1": k1}
    record["world_to_camera"] = views
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=1))
