"""What RefFusion does for nerfbaselines, in RefFusion's own environment: `python worker.py`, started by ask.py.

A message, each way: eight bytes with its length, little-endian, then a .npz of arrays; `ask` names the function, a
reply with `error` says in a line what is wrong.
"""

from __future__ import annotations

import io
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.capture.load import load_capture
from reffusion.capture.roles import load_roles
from reffusion.io.arrays import load_json
from reffusion.io.images import image_size, load_mask, save_mask
from reffusion.io.ply import load_ply
from reffusion.score import lpips, metrics
from reffusion.splat import rasterizer
from reffusion.types import Camera, Similarity

FISHEYE = 4  # coefficients of OpenCV's fisheye; its perspective model has k1, k2, p1, p2, k3 ... k6


def dataset(path: np.ndarray, split: np.ndarray, cache: np.ndarray) -> dict[str, Any]:
    """The views of a split: pictures as they are, cameras with their distortion, and masks, written to `cache`: of a
    test view where the object is, of a training view where it is not. ValueError where the folder is no such scene."""
    scene, part = Path(str(path)), str(split)
    capture = load_capture(scene, "llff")
    roles = load_roles(scene, capture)
    if capture.poses is None:
        raise ValueError(f"{scene}: no poses")
    names = list(roles.train if part == "train" else roles.test)
    lenses = [capture.poses.lenses[name].resized(*image_size(capture.pictures[name])) for name in names]
    masks = []
    for name, lens in zip(names, lenses, strict=True):
        files = [roles.test_masks[name]] if name in roles.test_masks else []
        if part == "train":
            files = [views[name] for views in roles.masks.values() if name in views]
        shown = np.zeros((lens.height, lens.width), bool)
        for file in files:
            shown |= load_mask(file, (lens.width, lens.height))
        masks.append(Path(str(cache)) / f"{name}.png")
        save_mask(masks[-1], ~shown if part == "train" else shown)
    poses = np.stack([np.linalg.inv(capture.poses.world_to_camera[name])[:3] for name in names])
    return {
        "poses": poses,
        "intrinsics": np.array([[lens.fx, lens.fy, lens.cx, lens.cy] for lens in lenses]),
        "sizes": np.array([[lens.width, lens.height] for lens in lenses]),
        "models": np.array([_model(lens) for lens in lenses]),
        "distortion": np.stack([_distortion(lens) for lens in lenses]),
        "pictures": np.array([str(capture.pictures[name]) for name in names]),
        "masks": np.array([str(mask) for mask in masks]),
        "bounds": np.array([capture.poses.bounds.get(name, (np.nan, np.nan)) for name in names]),
        "points": capture.poses.points,
        "colors": capture.poses.colors,
    }


def _model(lens: Any) -> str:
    if lens.fisheye:
        return "opencv_fisheye"
    return "opencv" if any(lens.radial) or any(lens.tangential) else "pinhole"


def _distortion(lens: Any) -> np.ndarray:
    """[8], in OpenCV's order."""
    found, radial = np.zeros(8), [*lens.radial, 0.0, 0.0, 0.0, 0.0]
    if any(lens.denominator) or any(radial[FISHEYE:]):
        raise ValueError(f"{lens.model}: nerfbaselines has no lens with so many terms")
    if lens.fisheye:
        found[:FISHEYE] = radial[:FISHEYE]
    else:
        found[:2], found[2:4], found[4] = radial[:2], lens.tangential, radial[2]
    return found


@cache
def _scene(folder: str) -> tuple[Any, Similarity]:
    said = load_json(Path(folder) / "transform.json")
    similarity = Similarity(said["scale"], np.array(said["offset"], np.float64))
    return load_ply(Path(folder) / "scene.ply", similarity), similarity


def render(folder: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray, size: np.ndarray) -> dict[str, np.ndarray]:
    """A view of a checkpoint: colour as the 8-bit picture that RefFusion scores, depth in the scene's own unit."""
    gaussians, similarity = _scene(str(folder))
    to_world = np.eye(4)
    to_world[:3] = pose
    to_world[:3, 3] = similarity.scale * (to_world[:3, 3] - similarity.offset)
    width, height = (int(side) for side in size)
    camera = Camera("view", width, height, *(float(value) for value in intrinsics), np.linalg.inv(to_world))
    drawn = rasterizer.render(gaussians, camera)
    depth, alpha = (part.numpy().reshape(height, width) for part in (drawn.depth, drawn.alpha))
    return {
        "color": np.rint(255 * drawn.color.clamp(0, 1).numpy()).astype(np.uint8),
        "depth": (depth / similarity.scale).astype(np.float32),
        "accumulation": alpha.astype(np.float32),
    }


@cache
def _models(folder: str) -> dict[str, Any]:
    found = {net: lpips.load(net, folder or None)[0] for net in ("vgg", "alex")}
    return {net: model for net, model in found.items() if model}


def score(image: np.ndarray, truth: np.ndarray, mask: np.ndarray, weights: np.ndarray) -> dict[str, Any]:
    """Metrics in the mask's box and 10 %; empty where the mask is. LPIPS where its weights are in the folder, or on the
    machine."""
    box = metrics.mask_box(mask.astype(bool))
    values = metrics.score(box.crop(image), box.crop(truth), _models(str(weights))) if box else {}
    return {name: np.float64(value) for name, value in values.items() if value is not None}


def splats(folder: np.ndarray) -> dict[str, np.ndarray]:
    """A checkpoint's Gaussians in the scene's own frame: scales and opacities as they are, not as logarithms."""
    gaussians, similarity = _scene(str(folder))
    return {
        "means": gaussians.means.numpy() / similarity.scale + similarity.offset,
        "scales": gaussians.scales.exp().numpy() / similarity.scale,
        "opacities": gaussians.opacities.sigmoid().numpy().reshape(-1, 1),
        "quaternions": gaussians.quats.numpy(),
        "spherical_harmonics": gaussians.sh.transpose(1, 2).numpy(),
    }


ASKED = {"dataset": dataset, "render": render, "score": score, "splats": splats}


def main() -> None:
    heard, said = sys.stdin.buffer, sys.stdout.buffer
    sys.stdout = sys.stderr  # whatever is printed must not mix with replies
    while len(length := heard.read(8)) == 8:
        with np.load(io.BytesIO(heard.read(int.from_bytes(length, "little")))) as file:
            asked = dict(file)
        try:
            reply = ASKED[str(asked.pop("ask"))](**asked)
        except (ValueError, OSError) as error:
            reply = {"error": " ".join(str(error).split())}
        np.savez(buffer := io.BytesIO(), **reply)
        data = buffer.getvalue()
        said.write(len(data).to_bytes(8, "little") + data)
        said.flush()


if __name__ == "__main__":
    main()
