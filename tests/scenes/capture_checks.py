"""Run `poses` and `raw_masks`, check their messages, refusals and results, and write captures with given names."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from reffusion.capture.normalized_frame import camera_centers
from reffusion.io import colmap
from reffusion.io.files import BadInput
from reffusion.types import Scene
from scenes.capture import (
    HEIGHT,
    WIDTH,
    Truth,
    convert_to_text,
    preview_stages,
    reprojection_error,
    run_stages,
    run_stages_into,
)

SHARE = 1 / 16  # share of a view's pixels that `scenes.capture.write_masks` masks
EXACT = 0.01  # px, largest allowed difference from the true cameras
OBJECT = np.zeros((HEIGHT, WIDTH), bool)
OBJECT[HEIGHT // 4 : HEIGHT // 2, WIDTH // 4 : WIDTH // 2] = True


def run_with_messages(folder: Path, **params) -> tuple[Scene, Path, list[str]]:
    """Preview and run the stages; return the scene, the output folder, and all messages and warnings.

    The path of `folder` is removed from the messages.
    """
    sentences = preview_stages(folder, **params)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene, out = run_stages(folder, **params)
    sentences += [str(each.message) for each in caught]
    return scene, out, [each.replace(str(folder), "") for each in sentences]  # the path may hold any word or number


def pose_errors(estimate: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Compare poses after the similarity transform of the estimate that aligns the camera centers best (least squares).

    Args:
        estimate: view -> world-to-camera pose [4, 4].
        truth: view -> world-to-camera pose [4, 4].

    Returns:
        For the V views that both have, sorted by name: distances of centers [V] in % of the extent of the true centers
        (the largest distance between two of these), and rotation errors [V] in degrees.
    """
    names = sorted(set(estimate) & set(truth))
    poses_a, poses_b = (np.stack([poses[name] for name in names]) for poses in (estimate, truth))
    a, b = camera_centers(poses_a), camera_centers(poses_b)
    a, b = a - a.mean(0), b - b.mean(0)
    u, stretch, v = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    turn = u @ np.diag(sign) @ v
    aligned = (stretch * sign).sum() / (a**2).sum() * a @ turn.T
    extent = np.linalg.norm(b[:, None] - b, axis=-1).max()
    rotations = Rotation.from_matrix(poses_b[:, :3, :3] @ turn @ poses_a[:, :3, :3].transpose(0, 2, 1))
    return 100 * np.linalg.norm(aligned - b, axis=1) / extent, np.degrees(rotations.magnitude())


def assert_message(sentences: Iterable[str], *words: str) -> None:
    """Assert that one of the messages contains all words. A number must not be part of a longer number."""
    sentences = list(sentences)
    patterns = [rf"(?<![\d.]){word}(?![\d])" if word.isdigit() else re.escape(word) for word in words]
    found = any(all(re.search(p, each, re.IGNORECASE) for p in patterns) for each in sentences)
    assert found, f"no sentence with {words} among {sentences}"


def refusal_message(folder: Path, **params) -> str:
    """Return the message of one line with which the preview refuses a capture."""
    with pytest.raises(BadInput) as caught:
        preview_stages(folder, **params)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def refusal_before_writing(folder: Path, **params) -> str:
    """Return the message of one line with which the preview or the stages refuse a capture.

    Asserts that the stages wrote nothing before.
    """
    out = folder.parent / f"{folder.name}_refused"
    out.mkdir()
    with pytest.raises(BadInput) as caught, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        preview_stages(folder, **params)
        run_stages_into(folder, out, **params)
    written = sorted(path.name for path in out.iterdir())
    assert "\n" not in str(caught.value) and not written, (str(caught.value), written)
    return str(caught.value)


def assert_cameras(scene: Scene, truth: Truth) -> None:
    """Assert the true poses and, for pinhole cameras, the true intrinsics."""
    assert reprojection_error(scene, truth) < EXACT
    at = truth.lens
    for name in truth.world_to_camera:
        camera = scene.cameras[name]
        found = (camera.fx, camera.fy, camera.cx, camera.cy)
        assert found == pytest.approx((at.fx, at.fy, at.cx, at.cy), abs=EXACT), name


def rename_views(truth: Truth, names: Mapping[str, str]) -> Truth:
    """Return the truth of the views in `names` (new name -> old name) under their new names."""
    return replace(truth, world_to_camera={new: truth.world_to_camera[old] for old, new in names.items()})


def select_views(truth: Truth, first: int, last: int) -> Truth:
    """Return the truth of the views whose index in alphabetical order is at least `first` and below `last`."""
    return replace(truth, world_to_camera=dict(sorted(truth.world_to_camera.items())[first:last]))


def write_named_model(folder: Path, truth: Truth, names: Mapping[str, str], text: bool = False) -> None:
    """Write a COLMAP model with given image names: `names` maps each view of the truth to the name of its image."""
    at = truth.lens
    cameras = {1: colmap.ModelCamera("PINHOLE", WIDTH, HEIGHT, (at.fx, at.fy, at.cx, at.cy))}
    listed = enumerate(sorted(names.items(), reverse=True), start=3)
    images = {k: colmap.ModelImage(name, 1, truth.world_to_camera[view]) for k, (view, name) in listed}
    colmap.save_model(folder, cameras, images, truth.points, np.full((len(truth.points), 3), 99, np.uint8))
    if text:
        convert_to_text(folder)


def write_mask(path: Path, mask: np.ndarray = OBJECT) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(255 * mask.astype(np.uint8)).save(path)


def masked_share(out: Path, view: str) -> float:
    """Return the share in [0, 1] of the view's pixels that its mask covers."""
    return float((np.array(Image.open(out / "masks" / f"{view}.png")) > 0).mean())


def masked_views(out: Path) -> list[str]:
    return sorted(path.stem for path in (out / "masks").glob("*.png"))


def assert_masked_views(out: Path, views: Iterable[str], share: float = SHARE) -> None:
    """Assert that exactly these views have a mask, and that each mask covers this share of the pixels."""
    views = sorted(views)
    assert masked_views(out) == views, masked_views(out)
    shares = [masked_share(out, view) for view in views]
    assert shares == pytest.approx([share] * len(views), abs=1e-3), shares


def change_transforms(folder: Path, change: Callable[[dict], object]) -> None:
    """Change transforms.json; `change` gets its content and changes it in place."""
    record = json.loads((folder / "transforms.json").read_text())
    change(record)
    (folder / "transforms.json").write_text(json.dumps(record))


def set_in_frames(folder: Path, key: str, value_of: Callable[[str], object]) -> None:
    """Set `key` in each frame of transforms.json to `value_of` of its view's name."""
    set_one = lambda frame: frame.update({key: value_of(Path(frame["file_path"]).stem)})
    change_transforms(folder, lambda record: [set_one(frame) for frame in record["frames"]])
