"""Export of cameras for other tools, in the scene's own frame: a COLMAP model and nerfstudio's transforms.json."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reffusion.io.arrays import save_json
from reffusion.io.colmap import ModelCamera, ModelImage, save_model
from reffusion.io.ply import save_points

if TYPE_CHECKING:
    from reffusion.types import Camera, Scene, Similarity

POINTS = "sparse_pc.ply"
GL = np.diag([1.0, -1.0, -1.0, 1.0])  # to nerfstudio's camera axes: it looks along -z, and y points up


def save_cameras(folder: Path, scene: Scene, images: str) -> None:
    """Write the undistorted pinhole cameras and the sparse points of a scene, in the scene's own frame.

    The files are sparse/0/*.bin (COLMAP), transforms.json and sparse_pc.ply (nerfstudio). No picture is written.

    Args:
        folder: where the files are written.
        images: folder of the undistorted pictures <view>.png, relative to `folder`; transforms.json refers to them.
    """
    folder = Path(folder)
    points = scene.similarity.invert(scene.points)
    cameras, registered, frames = {}, {}, []
    for identity, camera in enumerate(scene.cameras.values(), start=1):
        pose = scene_frame_pose(camera, scene.similarity)
        lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        cameras[identity] = ModelCamera("PINHOLE", camera.width, camera.height, lens)
        registered[identity] = ModelImage(f"{camera.name}.png", identity, pose)
        frames.append(
            dict(zip(("fl_x", "fl_y", "cx", "cy"), map(float, lens), strict=True))
            | {"w": camera.width, "h": camera.height, "file_path": f"{images}/{camera.name}.png"}
            | {"transform_matrix": (np.linalg.inv(pose) @ GL).tolist()}
        )
    save_model(folder / "sparse" / "0", cameras, registered, points, scene.point_colors)
    save_points(folder / POINTS, points, scene.point_colors)
    save_json(folder / "transforms.json", {"camera_model": "PINHOLE", "ply_file_path": POINTS, "frames": frames})


def scene_frame_pose(camera: Camera, similarity: Similarity) -> np.ndarray:
    """Convert a camera's pose from the normalized frame to the scene's own frame and unit.

    Args:
        similarity: from the scene's own frame to the normalized frame.

    Returns:
        The world-to-camera transform, [4, 4] float64.
    """
    pose = camera.world_to_camera.copy()
    pose[:3, 3] = pose[:3, 3] / similarity.scale - pose[:3, :3] @ similarity.offset
    return pose
