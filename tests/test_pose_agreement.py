"""Poses that do not belong to their photographs: the mistake is found by the pictures alone, undone and named.

The scene is a textured wall with a textured square before it, seen by cameras along an irregular path. There are no
sparse points and no masks.
"""

from __future__ import annotations

import itertools
import json
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scenes.cameras import rotation_along, world_rays
from scenes.capture import CAPTURES

from reffusion.capture.checks.agreement import judge_poses
from reffusion.capture.layouts.capture import invert_pose
from reffusion.capture.load import load_capture
from reffusion.io.files import BadInput
from reffusion.io.ply import save_points
from reffusion.io.scene import load_scene
from reffusion.params.poses import Params
from reffusion.types import Camera
from stages import poses

WIDTH, HEIGHT, FOCAL, VIEWS = 240, 180, 220.0, 16
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
ROLL = np.diag([-1.0, -1.0, 1.0, 1.0])
NAMES = [f"frame_{k}" for k in range(1, VIEWS + 1)]  # as text, frame_10 stands before frame_2


@cache
def true_poses() -> dict[str, np.ndarray]:
    """Return view name -> world-to-camera pose [4, 4], along a path that is no circle, in the order of `NAMES`."""
    draws, found = np.random.default_rng(4), {}
    for k, name in enumerate(NAMES):
        center = np.array([-1.6 + 0.21 * k, 0.5 * np.sin(0.9 * k) + 0.1 * draws.normal(), -4.2 + 0.4 * np.cos(1.7 * k)])
        pose = np.eye(4)
        pose[:3, :3] = rotation_along(-center + draws.normal(size=3) * 0.2, (0.15 * draws.normal(), -1.0, 0.0))
        pose[:3, 3] = -pose[:3, :3] @ center
        found[name] = pose
    return found


@cache
def photographs() -> dict[str, np.ndarray]:
    """Return view name -> picture, uint8 [H, W, 3]."""
    noise = np.random.default_rng(5).uniform(0, 255, (2, 512, 512, 3)).astype(np.float32)
    textures = [sum(w * cv2.GaussianBlur(each, (0, 0), w) for w in (2, 5)) for each in noise]
    textures = [(each - each.mean()) * 2.0 + 128 for each in textures]
    return {
        name: _render(Camera(name, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose), textures)
        for name, pose in true_poses().items()
    }


def _render(camera: Camera, textures) -> np.ndarray:
    rays = world_rays(camera)
    layers = []
    for depth, texture in zip((1.0, -1.0), textures, strict=True):
        at = camera.center + rays * ((depth - camera.center[2]) / rays[..., 2:])
        columns, rows = np.moveaxis(((at[..., :2] + 4) * 64).astype(np.float32), -1, 0)
        layers.append((at, cv2.remap(texture, columns, rows, cv2.INTER_LINEAR, None, cv2.BORDER_REFLECT)))
    near = (np.abs(layers[1][0][..., :2]) < 0.6).all(-1, keepdims=True)
    return np.where(near, layers[1][1], layers[0][1]).clip(0, 255).astype(np.uint8)


def write(folder: Path, stored_poses: dict[str, np.ndarray], orientation: int = 1, ending: str = "png") -> Path:
    """Write a capture with transforms.json that holds world-to-camera poses as OpenGL's camera-to-world matrices.

    Args:
        orientation: EXIF tag; the pictures are stored so that a program that obeys it shows them upright.
    """
    (folder / "images").mkdir(parents=True)
    for name, picture in photographs().items():
        turn, exif = {1: 0, 3: 2, 6: 1, 8: 3}[orientation], Image.Exif()
        exif[0x0112] = orientation
        Image.fromarray(np.rot90(picture, turn)).save(folder / "images" / f"{name}.{ending}", exif=exif)
    frames = [
        {"file_path": f"images/{name}.{ending}", "transform_matrix": (invert_pose(pose) @ FLIP).tolist()}
        for name, pose in stored_poses.items()
    ]
    values = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    (folder / "transforms.json").write_text(json.dumps({**values, "frames": frames}))
    return folder


def run(folder: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Run the stage; return view name -> world-to-camera pose in the scene's own frame, and the warnings."""
    out = folder.parent / "poses"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        poses.run(Params(longest=WIDTH, masks="none"), out, scene=folder)
    scene, found = load_scene(out), {}
    for name, camera in scene.cameras.items():
        pose = camera.world_to_camera.copy()
        center = camera.center / scene.similarity.scale + scene.similarity.offset
        pose[:3, 3] = -pose[:3, :3] @ center
        found[name] = pose
    path = out / "warnings.json"
    return found, json.loads(path.read_text()) if path.exists() else []


def relative_errors(found: dict[str, np.ndarray]) -> tuple[float, float]:
    """Return the largest errors between neighbors: of rotations in degrees, and of ratios of distances."""
    names = [name for name in NAMES if name in found]
    truth = true_poses()
    angles, steps = [], []
    for one, other in itertools.pairwise(names):
        turns = [each[other][:3, :3] @ each[one][:3, :3].T for each in (found, truth)]
        angles.append(np.degrees(np.arccos(np.clip((np.trace(turns[0] @ turns[1].T) - 1) / 2, -1, 1))))
        centers = [[invert_pose(each[name])[:3, 3] for name in (one, other)] for each in (found, truth)]
        steps.append(np.linalg.norm(centers[0][1] - centers[0][0]) / np.linalg.norm(centers[1][1] - centers[1][0]))
    return max(angles), float(np.max(steps) / np.median(steps) - 1)


def assert_right(found: dict[str, np.ndarray]) -> None:
    angle, ratio = relative_errors(found)
    assert angle < 0.1 and ratio < 1e-3


def transposed(pose: np.ndarray) -> np.ndarray:
    """Return the pose that a reader gets of a camera-to-world matrix whose rotation alone was transposed."""
    stored = invert_pose(pose) @ FLIP
    stored[:3, :3] = stored[:3, :3].T
    return invert_pose(stored @ FLIP)


CHANGES = {
    "OpenCV's axes": (lambda p: FLIP @ p, "OpenCV's in place of OpenGL's"),
    "cameras upside down": (lambda p: ROLL @ p, "rolled by 180 degrees"),
    "world-to-camera matrices": (lambda p: invert_pose(FLIP @ p) , "its matrices are inverted"),
    "world-to-camera matrices of OpenCV": (lambda p: invert_pose(p @ FLIP), "its matrices are inverted"),
    "transposed rotations": (transposed, "its rotations are transposed"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", CHANGES)
def test_wrong_axes_and_matrices_are_undone(tmp_path, mistake):
    change, words = CHANGES[mistake]
    capture = load_capture(write(tmp_path / "s", {name: change(pose) for name, pose in true_poses().items()}))
    verdict = judge_poses(capture)
    assert words in verdict.describe(capture.pose_source)
    assert_right(verdict.correction.apply(capture.poses).world_to_camera)


def test_right_poses_stay(tmp_path):
    verdict = judge_poses(load_capture(write(tmp_path / "s", true_poses())))
    assert verdict.correction is None and verdict.given == verdict.pairs >= 12


@pytest.mark.parametrize("shift", [6, -2])
def test_photographs_that_are_shifted_against_their_poses(tmp_path, shift):
    text = sorted(NAMES)
    given = {name: true_poses()[text[(k + shift) % VIEWS]] for k, name in enumerate(text)}
    folder = write(tmp_path / "s", given)
    random = np.random.default_rng(0)  # points of the far wall, with wrong colors: they are compared
    points = np.concatenate([random.uniform(-0.5, 0.5, (500, 2)), np.ones((500, 1))], 1)
    save_points(folder / "sparse_pc.ply", points, random.integers(0, 256, (500, 3)).astype(np.uint8))
    verdict = judge_poses(load_capture(folder))
    assert f"its poses are shifted against the photographs by {abs(shift)}" in verdict.describe(folder)
    capture = load_capture(folder, correction=verdict.correction)
    assert len(capture.pictures) == len(capture.poses.lenses) == VIEWS - abs(shift)
    assert_right(capture.poses.world_to_camera)


def test_poses_in_numerical_order_of_the_names(tmp_path):
    given = dict(zip(sorted(NAMES), true_poses().values(), strict=True))
    found, (message, *rest) = run(write(tmp_path / "s", given))
    assert "its poses are in numerical order of the names, such as 2 before 10. Corrected" in message and not rest
    assert len(found) == VIEWS
    assert_right(found)


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_poses_of_photographs_that_a_program_turned_upright(tmp_path, orientation):
    folder = write(tmp_path / "s", true_poses(), orientation, "jpg")
    if orientation == 3:  # only the pictures tell
        found, (message,) = run(folder)
        assert "its poses are those of the photographs turned by their EXIF orientation" in message
        assert_right(found)
        shown = np.array(Image.open(tmp_path / "poses/images/frame_3.png"))
        assert np.abs(shown.astype(float) - photographs()["frame_3"]).mean() < 20  # JPEG; 60 upside down
    else:  # the stored pictures have other proportions than the cameras
        capture = load_capture(folder)
        assert capture.upright and judge_poses(capture).correction is None


def test_poses_of_other_photographs_are_refused_before_any_work(tmp_path):
    order = np.random.default_rng(1).permutation(NAMES)
    folder = write(tmp_path / "s", {n: true_poses()[o] for n, o in zip(NAMES, order, strict=True)})
    with pytest.raises(BadInput) as refused:
        run(folder)
    message = str(refused.value)
    assert message.startswith(f"{folder / 'transforms.json'}: its poses are not those of the photographs: of ")
    assert "Solve the poses again, or remove the file to have them estimated; poses.trust=true uses them" in message
    assert not (tmp_path / "poses/images").exists()


def test_photographs_without_matches_decide_nothing(tmp_path):
    capture = load_capture(write(tmp_path / "s", true_poses()))
    for path in capture.pictures.values():
        Image.new("RGB", (WIDTH, HEIGHT), (90, 90, 90)).save(path)
    assert judge_poses(capture).pairs == 0


@pytest.mark.integration
@pytest.mark.parametrize("name", ["statue", "bear", "fox", "garden", "dinosaur", "church", "fountain", "orbit"])
def test_right_poses_of_captures_raise_no_alarm(name):
    if not (CAPTURES / name).is_dir():
        pytest.skip(f"needs the capture {name}")
    capture = load_capture(CAPTURES / name)
    verdict = judge_poses(capture)
    assert verdict.correction is None and verdict.pairs >= 10, verdict
    # half of the views: other pairs
    names = list(capture.pictures)[1::2]
    half = replace(capture, pictures={each: capture.pictures[each] for each in names})
    assert judge_poses(half).correction is None
