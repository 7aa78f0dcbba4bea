"""Write small captures with known poses in each supported layout, and run `poses` and `raw_masks` on them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from reffusion.capture import lens
from reffusion.io import colmap
from reffusion.io.images import load_mask, save_image
from reffusion.io.scene import load_scene
from scenes.cameras import rotation_along
from stages import poses, raw_masks
from stages.plan import poses as poses_plan
from stages.plan import raw_masks as raw_masks_plan

WIDTH, HEIGHT = 96, 72
CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "data"
FISHEYE = ("OPENCV_FISHEYE", (60.0, 61.0, 48.5, 35.0, 0.02, -0.01, 0.002, 0.001))
OPENCV = ("OPENCV", (90.0, 91.0, 47.0, 36.5, 0.06, -0.08, -0.001, 0.002))
RADIAL = ("SIMPLE_RADIAL", (90.0, 48.0, 36.0, 0.05))
PINHOLE = ("SIMPLE_PINHOLE", (90.0, 48.0, 36.0))


@dataclass(frozen=True)
class Truth:
    """The true poses, points and lens of a capture, in the capture's own frame.

    Attributes:
        world_to_camera: view name -> [4, 4].
        points: [N, 3].
        model: name and parameters of the COLMAP camera model of all views.
    """

    world_to_camera: dict[str, np.ndarray]
    points: np.ndarray
    model: tuple[str, tuple[float, ...]]

    @property
    def lens(self) -> lens.Lens:
        return lens.from_colmap(self.model[0], WIDTH, HEIGHT, self.model[1])


def load_test_masks(folder: Path) -> dict[str, np.ndarray]:
    """Return test view name -> bool [H, W], True where the object would be visible if it were present."""
    return {path.stem: load_mask(path) for path in sorted((folder / "test_masks").glob("*.png"))}


def make_truth(model=PINHOLE, views=6, scale=1.0, offset=(0.0, 0.0, 0.0)) -> Truth:
    """Return cameras on an arc that look at a cloud of points around `offset` from a distance of 4 * scale."""
    generator, cameras, offset = np.random.default_rng(3), {}, np.array(offset)
    for k in range(views):
        angle = np.radians(-25 + 50 * k / (views - 1))
        center = 4 * np.array([np.sin(angle), 0.15 * generator.normal(), -np.cos(angle)])
        pose = np.eye(4)
        pose[:3, :3] = rotation_along(-center, (0.0, -1.0, -0.1 * generator.normal()))
        pose[:3, 3] = -pose[:3, :3] @ (scale * center + offset)
        cameras[f"v{k:02d}"] = pose
    return Truth(cameras, generator.uniform(-0.9, 0.9, (60, 3)) * scale + offset, model)


def write_pictures(folder: Path, names, size=(WIDTH, HEIGHT), ending=".png") -> None:
    for k, name in enumerate(names):
        save_image(folder / f"{name}{ending}", np.full((size[1], size[0], 3), 40 + k, np.uint8))


def write_masks(folder: Path, names, size=(WIDTH, HEIGHT), value=255) -> None:
    mask = np.zeros((size[1], size[0]), np.uint8)
    mask[size[1] // 4 : size[1] // 2, size[0] // 4 : size[0] // 2] = value
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.fromarray(mask).save(folder / f"{name}.png")


def write_model(folder: Path, truth: Truth, text=False, factor=1, ending=".jpg") -> None:
    """Write a COLMAP model whose image size is `factor` times that of the written pictures."""
    at = truth.lens.resized(WIDTH * factor, HEIGHT * factor)
    single = truth.model[0].startswith(("SIMPLE", "RADIAL"))
    head = (at.fx, at.cx, at.cy) if single else (at.fx, at.fy, at.cx, at.cy)
    params = (*head, *truth.model[1][len(head) :])
    cameras = {1: colmap.ModelCamera(truth.model[0], at.width, at.height, params)}
    images = {
        k: colmap.ModelImage(name + ending, 1, pose)
        for k, (name, pose) in enumerate(sorted(truth.world_to_camera.items(), reverse=True), start=7)
    }
    colors = np.full((len(truth.points), 3), 99, np.uint8)
    colmap.save_model(folder, cameras, images, truth.points, colors)
    if text:
        convert_to_text(folder)


def convert_to_text(folder: Path) -> None:
    """Replace the binary COLMAP model in a folder by the same model in text format."""
    import pycolmap

    pycolmap.Reconstruction(folder).write_text(folder)
    for path in folder.glob("*.bin"):
        path.unlink()


def write_transforms(folder: Path, truth: Truth, per_frame=False, **changes) -> None:
    at, flip = truth.lens, np.diag([1.0, -1.0, -1.0, 1.0])
    values = {"w": WIDTH, "h": HEIGHT, "fl_x": at.fx, "fl_y": at.fy, "cx": at.cx, "cy": at.cy}
    values |= {f"k{i}": k for i, k in enumerate(at.radial, start=1)} | dict(
        zip(("p1", "p2"), at.tangential, strict=True)
    )
    values["camera_model"] = truth.model[0]
    frames = [
        {"file_path": f"images/{name}.png", "transform_matrix": (np.linalg.inv(pose) @ flip).tolist()}
        for name, pose in sorted(truth.world_to_camera.items(), reverse=True)
    ]
    record = {"frames": [f | values for f in frames]} if per_frame else {**values, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(record | changes))


def write_poses_bounds(folder: Path, truth: Truth, factor=4) -> None:
    rows = []
    for pose in (truth.world_to_camera[name] for name in sorted(truth.world_to_camera)):
        right, down, forward = pose[:3, :3]
        size = np.array([HEIGHT * factor, WIDTH * factor, truth.lens.fx * factor])
        matrix = np.stack([down, right, -forward, -pose[:3, :3].T @ pose[:3, 3], size], axis=1)
        z = truth.points @ forward + pose[2, 3]
        rows.append([*matrix.ravel(), z.min(), z.max()])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def write_capture(folder: Path, layout: str, truth: Truth) -> Path:
    """Write pictures, masks and poses of a capture; return the folder.

    Args:
        layout: "llff", "llff+bin", "llff+txt", "colmap", "colmap txt", or a name that begins with "transforms" (with
            intrinsics for each frame if the name ends with "each"). Other names write pictures and masks only.
    """
    images = folder / ("images_4" if layout.startswith("llff") else "images")
    write_pictures(images, truth.world_to_camera)
    write_masks(images / "label" if layout.startswith("llff") else folder / "masks", truth.world_to_camera)
    if layout.startswith("llff"):
        write_poses_bounds(folder, truth)
    if layout in ("llff+bin", "llff+txt", "colmap", "colmap txt"):
        write_model(folder / "sparse" / "0", truth, layout.endswith("txt"), 4 if layout.startswith("llff") else 1)
    if layout.startswith("transforms"):
        write_transforms(folder, truth, layout.endswith("each"))
    return folder


def write_spin_nerf(folder: Path, test=2, full=True, mask_value=1, label_size=(WIDTH, HEIGHT + 3)) -> Truth:
    """Write 6 views in the layout of the SPIn-NeRF dataset, the first `test` of them as test views; return the truth.

    Args:
        full: whether the pictures in full resolution are written, too.
        mask_value: value of masked pixels in the masks of training views.
        label_size: width and height in px of the masks of test views.
    """
    truth = make_truth(RADIAL)
    names = sorted(truth.world_to_camera)
    write_pictures(folder / "images_4", names)
    if full:
        write_pictures(folder / "images", names, (4 * WIDTH, 4 * HEIGHT), ".jpg")
    write_masks(folder / "images_4" / "label", names[test:], value=mask_value)
    write_masks(folder / "images_4" / "test_label", [f"out_{k:05d}" for k in range(test)], label_size)
    write_poses_bounds(folder, truth)
    write_model(folder / "sparse" / "0", truth, factor=4)
    return truth


def run_stages(folder: Path, **params):
    """Run `poses` and `raw_masks` on a capture; return the scene, and the folder to which both stages write."""
    out = folder.parent / (folder.name + "_out")
    out.mkdir(exist_ok=True)
    run_stages_into(folder, out, **params)
    return load_scene(out), out


def run_stages_into(folder: Path, out: Path, **params) -> None:
    """Preview `raw_masks`, then run `poses` and `raw_masks`; both stages write to the folder `out`."""
    raw_masks_plan.preview(_mask_params(params), scene=folder)
    poses.run(poses.Params(**params), out, scene=folder)
    raw_masks.run(_mask_params(params), out, scene=folder, poses=out)


def preview_stages(folder: Path, **params) -> list[str]:
    """Return the messages with which `poses` and `raw_masks` announce their work before they run."""
    notes = poses_plan.preview(poses.Params(**params), folder)
    return notes + raw_masks_plan.preview(_mask_params(params), scene=folder)


def _mask_params(params: dict) -> raw_masks.Params:
    return raw_masks.Params(**{key: value for key, value in params.items() if key in raw_masks.Params.model_fields})


def reprojection_error(scene, truth: Truth) -> float:
    """Return the largest reprojection error of the true points over all views, in px of the distorted photograph.

    Each point is projected by the true camera, and by the scene's undistorted camera followed by the true distortion.
    """
    worst = 0.0
    for name, pose in truth.world_to_camera.items():
        at = truth.points @ pose[:3, :3].T + pose[:3, 3]
        pixels = lens.to_pixels(at[:, :2] / at[:, 2:], truth.lens)
        camera = scene.cameras[name]
        ours = scene.similarity.apply(truth.points) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        uv = (ours[:, :2] / ours[:, 2:] * (camera.fx, camera.fy)) + (camera.cx, camera.cy)
        back = (uv - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        worst = max(worst, float(np.abs(lens.to_pixels(back, truth.lens) - pixels).max()))
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    return worst


def write_four_photos(folder: Path) -> None:
    """Write a capture of four photographs of 32 x 24 px from a row of cameras, with masks and transforms.json."""
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    frames = []
    for k in range(4):
        pose = [[1, 0, 0, 0.1 * k], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/v{k}.png", "transform_matrix": pose})
        Image.new("RGB", (32, 24), (40 + k, 80, 120)).save(folder / "images" / f"v{k}.png")
        Image.new("L", (32, 24), 255).save(folder / "masks" / f"v{k}.png")
    lens = {"w": 32, "h": 24, "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 12.0}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))


def real_capture(name: str) -> Path:
    """Return the folder of a real capture; skip the test if the capture is not on this machine."""
    if not (CAPTURES / name).is_dir():
        pytest.skip(f"the capture {name} is not in ../shared/data")
    return CAPTURES / name
