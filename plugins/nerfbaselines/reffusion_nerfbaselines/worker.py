"""What RefFusion does for nerfbaselines, in RefFusion's own environment: `python worker.py`, started by ask.py.

A message, each way: eight bytes with its length, little-endian, then a .npz of arrays; `ask` names the function, a
reply with `error` says in a line what is wrong.
"""

from __future__ import annotations

import importlib
import io
import shutil
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.command import root
from reffusion.io.arrays import load_json
from reffusion.io.images import load_mask, save_mask
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_raw_masks, load_scene
from reffusion.metrics import image_metrics, lpips
from reffusion.splat import rasterizer
from reffusion.types import Camera, Similarity


def dataset(path: np.ndarray, split: np.ndarray, cache: np.ndarray) -> dict[str, Any]:
    """Return the views of a split, undistorted as RefFusion undistorts them, with cameras in the scene's own frame.

    Masks are written to `cache`: those of test views mark the object, those of training views the pixels beside it.

    Args:
        path: a scene, or the folder that RefFusion's stage `poses` made of one.

    Raises:
        ValueError: the path is neither.
    """
    poses, part, out = Path(str(path)), str(split), Path(str(cache))
    if not (poses / "views.json").is_file():
        poses = _undistorted(poses, out / "poses")
    scene, raw_masks = load_scene(poses), poses.with_name("raw_masks")
    cameras = [scene.cameras[name] for name in (scene.train if part == "train" else scene.test)]
    raw = load_raw_masks(raw_masks, scene.train) if part == "train" else {}
    masks, to_world = [], []
    for camera in cameras:
        file = raw_masks / "test_masks" / f"{camera.name}.png"
        shown = raw.get(camera.name, np.zeros((camera.height, camera.width), bool))
        shown = load_mask(file) if part == "test" and file.is_file() else shown
        masks.append(out / part / f"{camera.name}.png")
        save_mask(masks[-1], ~shown if part == "train" else shown)
        pose = np.linalg.inv(camera.world_to_camera)[:3]
        pose[:, 3] = pose[:, 3] / scene.similarity.scale + scene.similarity.offset
        to_world.append(pose)
    return {
        "poses": np.stack(to_world),
        "intrinsics": np.array([[each.fx, each.fy, each.cx, each.cy] for each in cameras]),
        "sizes": np.array([[each.width, each.height] for each in cameras]),
        "pictures": np.array([str(poses / "images" / f"{each.name}.png") for each in cameras]),
        "masks": np.array([str(mask) for mask in masks]),
        "bounds": np.stack([_bounds(camera, scene.points) for camera in cameras]) / scene.similarity.scale,
        "points": scene.points / scene.similarity.scale + scene.similarity.offset,
        "colors": scene.point_colors,
    }


def _bounds(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Nearest and farthest depth of the points before the camera, and a tenth; 0.1 and 10 without any."""
    depths = points @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    depths = depths[depths > 0]
    return np.array([0.9 * depths.min(), 1.1 * depths.max()]) if len(depths) else np.array([0.1, 10.0])


def _undistorted(scene: Path, out: Path) -> Path:
    """Run `poses` (size and cameras as given) and `raw_masks`, in a folder beside, once for a scene; return `out`."""
    if not (out / "made").is_file():
        sys.path.insert(0, str(root()))
        raw_masks = out.with_name("raw_masks")
        for folder in (out, raw_masks):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        stage, params = (importlib.import_module(name) for name in ("stages.poses", "reffusion.params.poses"))
        stage.run(params.Params(min_detail=0, refine=False), out, scene=scene)
        stage, params = (importlib.import_module(name) for name in ("stages.raw_masks", "reffusion.params.raw_masks"))
        stage.run(params.Params(), raw_masks, scene=scene, poses=out)
        (out / "made").touch()
    return out


@cache
def _scene(folder: str) -> tuple[Any, Similarity]:
    record = load_json(Path(folder) / "transform.json")
    similarity = Similarity(record["scale"], np.array(record["offset"], np.float64))
    return load_ply(Path(folder) / "scene.ply", similarity), similarity


def render(folder: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray, size: np.ndarray) -> dict[str, np.ndarray]:
    """Render a view of a checkpoint: color as the 8-bit picture that RefFusion scores, depth in the scene's unit."""
    gaussians, similarity = _scene(str(folder))
    to_world = np.eye(4)
    to_world[:3] = pose
    to_world[:3, 3] = similarity.scale * (to_world[:3, 3] - similarity.offset)
    width, height = (int(side) for side in size)
    camera = Camera("view", width, height, *(float(value) for value in intrinsics), np.linalg.inv(to_world))
    rendering = rasterizer.render(gaussians, camera)
    depth, alpha = (part.numpy().reshape(height, width) for part in (rendering.depth, rendering.alpha))
    return {
        "color": np.rint(255 * rendering.color.clamp(0, 1).numpy()).astype(np.uint8),
        "depth": (depth / similarity.scale).astype(np.float32),
        "accumulation": alpha.astype(np.float32),
    }


@cache
def _models(folder: str) -> dict[str, Any]:
    models = {net: lpips.load(net, folder or None)[0] for net in ("vgg", "alex")}
    return {net: model for net, model in models.items() if model}


def score(image: np.ndarray, truth: np.ndarray, mask: np.ndarray, weights: np.ndarray) -> dict[str, Any]:
    """Return the metrics in the mask's box, enlarged by 10 %; empty if the mask is empty.

    LPIPS is among them if its weights are in the folder or on the machine.
    """
    box = image_metrics.mask_box(mask.astype(bool))
    targets = image_metrics.lpips_targets(box.crop(truth), _models(str(weights))) if box else {}
    values = image_metrics.score(box.crop(image), box.crop(truth), targets) if box else {}
    return {name: np.float64(value) for name, value in values.items() if value is not None}


def splats(folder: np.ndarray) -> dict[str, np.ndarray]:
    """Return a checkpoint's Gaussians in the scene's own frame: scales and opacities as they are, not as logarithms."""
    gaussians, similarity = _scene(str(folder))
    return {
        "means": gaussians.means.numpy() / similarity.scale + similarity.offset,
        "scales": gaussians.log_scales.exp().numpy() / similarity.scale,
        "opacities": gaussians.opacity_logits.sigmoid().numpy().reshape(-1, 1),
        "quaternions": gaussians.quaternions.numpy(),
        "spherical_harmonics": gaussians.sh.transpose(1, 2).numpy(),
    }


ASKED = {"dataset": dataset, "render": render, "score": score, "splats": splats}


def main() -> None:
    input_stream, output = sys.stdin.buffer, sys.stdout.buffer
    sys.stdout = sys.stderr  # whatever is printed must not mix with replies
    while len(length := input_stream.read(8)) == 8:
        with np.load(io.BytesIO(input_stream.read(int.from_bytes(length, "little")))) as file:
            request = dict(file)
        try:
            reply = ASKED[str(request.pop("ask"))](**request)
        except (ValueError, OSError) as error:
            reply = {"error": " ".join(str(error).split())}
        np.savez(buffer := io.BytesIO(), **reply)
        data = buffer.getvalue()
        output.write(len(data).to_bytes(8, "little") + data)
        output.flush()


if __name__ == "__main__":
    main()
