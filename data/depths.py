"""True depth of a made scene without its object.

python data/depths.py --seed 0 --kind table --view in.npz --out z.npy

`benchmarks/studies/depth.py` runs this script in a process of its own. The input in.npz describes a view: its pose
`world_to_camera` [4, 4] in the scene frame (the frame of the written poses), and `rays` [H, W, 2], the points (x, y)
of its pixels on the plane at camera z = 1. The output z.npy is camera z [H, W] in the unit of the scene frame. Lens,
textures and light are ignored.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
import raycast
from kinds import KINDS, Kind
from reconstruction import Frame, scene_frame
from room import furnish


def camera_row(world_to_camera: np.ndarray, frame: Frame) -> np.ndarray:
    """Return a camera of the ray caster, [16], of a given pose, with focal length 1 and without distortion.

    So its image points are the points (x, y) on the plane at camera z = 1.

    Args:
        world_to_camera: pose [4, 4] in the scene frame.
        frame: transform from the room to the scene frame.
    """
    turn = world_to_camera[:3, :3].T
    center = frame.rotation.T @ (-turn @ world_to_camera[:3, 3] - frame.offset) / frame.scale
    return np.array([1.0, 0.0, 0.0, 0.0, *(frame.rotation.T @ turn).ravel(), *center])


def background_depth(seed: int, kind: Kind, world_to_camera: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return camera z [...], in the scene frame's unit, of the first surface on each ray, without the object.

    Args:
        seed: seed of the scene.
        kind: kind of the scene.
        world_to_camera: pose [4, 4] in the scene frame.
        rays: [..., 2], the (x, y) of ray directions (x, y, 1) in the camera's frame.
    """
    furniture, _ = furnish(seed, kind)
    solids, _ = furniture.arrays(defaultdict(int), kind.node)  # texture 0 for all faces, as only shapes matter here
    frame = scene_frame(seed)
    camera = camera_row(world_to_camera, frame)
    points, _ = raycast.surface_points(solids, camera, np.ascontiguousarray(rays.reshape(-1, 2), float), False)
    return frame.scale * ((points - camera[13:]) @ camera[4:13].reshape(3, 3)[:, 2]).reshape(rays.shape[:-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--kind", choices=KINDS, required=True)
    parser.add_argument("--view", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    view = np.load(arguments.view)
    np.save(
        arguments.out, background_depth(arguments.seed, KINDS[arguments.kind], view["world_to_camera"], view["rays"])
    )


if __name__ == "__main__":
    main()
