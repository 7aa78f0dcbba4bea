"""Depth of a made scene without its object: `python data/depths.py --seed 0 --kind table --view in.npz --out z.npy`.

`benchmarks/studies/depth.py` runs it in a process of its own. `in.npz` holds a view of the scene frame:
`world_to_camera` [4, 4] and `rays` [H, W, 2], where its pixels lie at camera z = 1; `z.npy` is camera z [H, W] in the
unit of the scene frame. Lens, textures and light are ignored.
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
    """[16]: a camera of the ray caster, with focal length 1 and without distortion, at a pose of the scene frame."""
    turn = world_to_camera[:3, :3].T
    center = frame.rotation.T @ (-turn @ world_to_camera[:3, 3] - frame.offset) / frame.scale
    return np.array([1.0, 0.0, 0.0, 0.0, *(frame.rotation.T @ turn).ravel(), *center])


def background_depth(seed: int, kind: Kind, world_to_camera: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Camera z [...], in the scene frame's unit, of what the rays (x, y, 1) [..., 2] hit first without the object."""
    furniture, _ = furnish(seed, kind)
    solids, _ = furniture.arrays(defaultdict(int), kind.node)  # any textures: only shapes count
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
