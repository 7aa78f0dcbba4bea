"""Captures with uncommon COLMAP models, views in folders, and Blender's files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes.capture import (
    HEIGHT,
    WIDTH,
    Truth,
    make_truth,
    write_masks,
    write_model,
    write_pictures,
    write_transforms,
)
from scenes.capture_checks import (
    SHARE,
    assert_cameras,
    assert_masked_views,
    assert_message,
    convert_to_text,
    masked_share,
    rename_views,
    run_with_messages,
    select_views,
    write_mask,
    write_named_model,
)

from reffusion.capture.load import load_capture
from reffusion.io.scene import list_objects


def truth_in_other_frame(views: int) -> Truth:
    """Return the truth of `make_truth` in another world frame, as another run of COLMAP would give."""
    return make_truth(views=views, scale=2.5, offset=(7.0, -3.0, 11.0))


def write_transforms_with_paths(folder: Path, truth: Truth, paths: dict[str, str]) -> None:
    """Write transforms.json whose frames have the given paths; `paths`: view -> file_path."""
    write_transforms(folder, truth)
    record = json.loads((folder / "transforms.json").read_text())
    for frame in record["frames"]:
        frame["file_path"] = paths[Path(frame["file_path"]).stem]
    (folder / "transforms.json").write_text(json.dumps(record))


# ------------------------------------------------------------------------------------------------- several models


def test_largest_of_three_models_that_nerfstudio_left(tmp_path):
    folder, truth = tmp_path / "s", make_truth(views=8)
    write_pictures(folder / "images", truth.world_to_camera, ending=".jpg")
    write_masks(folder / "masks", truth.world_to_camera)
    write_model(folder / "colmap/sparse/0", select_views(truth_in_other_frame(8), 0, 4))
    write_model(folder / "colmap/sparse/1", select_views(truth, 1, 8), text=True)
    write_model(folder / "colmap/sparse/2", select_views(truth_in_other_frame(8), 5, 8))
    scene, _, sentences = run_with_messages(folder)
    assert scene.train == tuple(f"v{k:02d}" for k in range(1, 8))
    assert_cameras(scene, select_views(truth, 1, 8))
    assert_message(sentences, "sparse", "1", "0", "2")


def test_two_digit_model_beside_masks_of_images_4(tmp_path):
    folder, truth = tmp_path / "s", make_truth()
    write_pictures(folder / "images_4", truth.world_to_camera)
    write_masks(folder / "images_4/label", truth.world_to_camera)
    write_model(folder / "sparse/2", select_views(truth_in_other_frame(6), 2, 5), factor=4)
    write_model(folder / "sparse/10", truth, factor=4, ending=".JPG")
    (folder / "sparse/0").mkdir()
    (folder / "sparse/0/cameras.bin").write_bytes((folder / "sparse/10/cameras.bin").read_bytes())
    scene, _, sentences = run_with_messages(folder)
    assert len(scene.train) == 6
    assert_cameras(scene, truth)
    assert_message(sentences, "sparse", "10", "2")


# ------------------------------------------------------------------------------------------------- names and folders


def test_rig_of_two_cameras_two_folders_deep(tmp_path):
    folder, truth = tmp_path / "s", make_truth()
    paths = {v: f"rig1/{('left', 'right')[k % 2]}/{k // 2:03d}" for k, v in enumerate(sorted(truth.world_to_camera))}
    write_pictures(folder / "images", paths.values(), ending=".jpg")
    for path in paths.values():
        write_mask(folder / "masks" / f"{path}.png")
    write_named_model(folder / "sparse/0", truth, {v: f"{path}.jpg" for v, path in paths.items()}, text=True)
    chosen = {"test": ["rig1/right/002.jpg"], "cameras_only": ["rig1/left/001.jpg", "rig1-right-000"]}
    scene, out, _ = run_with_messages(folder, **chosen)
    assert scene.train == ("rig1-left-000", "rig1-left-002", "rig1-right-001")
    assert scene.test == ("rig1-right-002",) and scene.camera_only == ("rig1-left-001", "rig1-right-000")
    views = {v: path.replace("/", "-") for v, path in paths.items()}
    assert_cameras(scene, rename_views(truth, views))
    assert list_objects(out) == [] and masked_share(out, "rig1-left-002") == pytest.approx(SHARE, abs=1e-3)


def test_equal_names_in_transforms_json(tmp_path):
    folder, truth = tmp_path / "s", make_truth()
    paths = {v: f"cam_{'ab'[k % 2]}/frame_{k // 2:05d}" for k, v in enumerate(sorted(truth.world_to_camera))}
    write_pictures(folder / "images", paths.values())
    written = {v: f"./images/{path}" if "cam_a" in path else rf"images\{path}.png" for v, path in paths.items()}
    write_transforms_with_paths(folder, truth, {v: p.replace("cam_b/", "cam_b\\") for v, p in written.items()})
    scene, _, _ = run_with_messages(folder, masks="none", test=["cam_b/frame_00001.png"])
    views = {v: path.replace("/", "-") for v, path in paths.items()}
    assert scene.test == ("cam_b-frame_00001",) and len(scene.train) == 5
    assert_cameras(scene, rename_views(truth, views))


def test_absolute_windows_paths_and_other_case(tmp_path):
    folder, truth = tmp_path / "s", make_truth(views=7)
    stems = {v: f"img_{k:04d}" for k, v in enumerate(sorted(truth.world_to_camera))}
    names = {v: rf"D:\Scans\Garden 2\photos\{stem.upper()}.JPG" for v, stem in stems.items()}
    write_named_model(folder / "sparse/0", truth, names)
    del stems["v02"]  # one picture is missing, so order cannot pair pictures with poses
    write_pictures(folder / "images", stems.values())
    write_masks(folder / "masks", stems.values())
    scene, _, _ = run_with_messages(folder, test=["img_0003.png"])
    assert scene.test == ("img_0003",) and len(scene.train) == 5
    assert_cameras(scene, rename_views(truth, stems))


# ------------------------------------------------------------------------------------------------- masks in folders


def test_masks_by_colmaps_rule_for_equal_names(tmp_path):
    folder, truth = tmp_path / "s", make_truth()
    paths = {v: f"site/cam{k % 3}/A{k // 3}.jpg" for k, v in enumerate(sorted(truth.world_to_camera))}
    write_pictures(folder / "images", [path.removesuffix(".jpg") for path in paths.values()], ending=".jpg")
    for path in paths.values():
        write_mask(folder / "masks" / f"{path}.png")
    write_named_model(folder / "sparse/0", truth, paths)
    scene, out, _ = run_with_messages(folder)
    views = [path.removesuffix(".jpg").replace("/", "-") for path in paths.values()]
    assert list_objects(out) == [] and sorted(scene.train) == sorted(views)
    assert_masked_views(out, views)


def test_masks_of_one_day_only(tmp_path):
    folder, truth = tmp_path / "s", make_truth()
    days = {v: f"2024-05-0{1 + k // 3}/IMG_{k}" for k, v in enumerate(sorted(truth.world_to_camera))}
    write_pictures(folder / "images", days.values(), ending=".jpg")
    for path in list(days.values())[:3]:
        write_mask(folder / "segmentation" / f"{path}.png")
    write_transforms_with_paths(folder, truth, {v: f"images/{path}.jpg" for v, path in days.items()})
    scene, out, sentences = run_with_messages(folder, masks="segmentation")
    assert list_objects(out) == [] and len(scene.train) == 6
    assert_masked_views(out, ["IMG_0", "IMG_1", "IMG_2"])
    assert_message(sentences, "3", "no mask", "IMG_4")


def test_folders_of_objects_stay_objects(tmp_path):
    folder, truth = tmp_path / "s", make_truth()
    write_pictures(folder / "images", truth.world_to_camera, ending=".jpg")
    for thing in ("chair", "lamp"):
        write_masks(folder / "masks" / thing, truth.world_to_camera)
    write_model(folder / "sparse/0", truth)
    _, out, _ = run_with_messages(folder, remove=["lamp"])
    assert list_objects(out) == ["chair", "lamp"]


# ------------------------------------------------------------------------------------------------- Blender's files


def blender_frames(truth: Truth, paths: dict[str, str]) -> list[dict]:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    pose = lambda view: (np.linalg.inv(truth.world_to_camera[view]) @ flip).tolist()
    return [{"file_path": path, "rotation": 0.0125, "transform_matrix": pose(v)} for v, path in paths.items()]


def test_nerf_synthetic_with_three_splits_of_equal_names(tmp_path):
    folder, truth = tmp_path / "s", make_truth(views=8)
    counts, views = {"train": 4, "test": 2, "val": 2}, sorted(truth.world_to_camera)
    named, angle = {}, 2 * float(np.arctan(WIDTH / 2 / truth.lens.fx))
    for split, count in counts.items():
        paths = {views.pop(0): f"{split}/r_{k}" for k in range(count)}
        (folder / split).mkdir(parents=True)
        for path in paths.values():
            Image.new("RGBA", (WIDTH, HEIGHT), (90, 120, 60, 255)).save(folder / f"{path}.png")
        listed = blender_frames(truth, {v: f"./{path}" for v, path in paths.items()})
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": listed}))
        named |= {v: path.replace("/", "-") for v, path in paths.items() if split != "val"}
    assert load_capture(folder).layout == "transforms"
    scene, _, sentences = run_with_messages(folder, masks="none")
    assert scene.train == ("train-r_0", "train-r_1", "train-r_2", "train-r_3")
    assert scene.test == ("test-r_0", "test-r_1")
    assert_cameras(scene, rename_views(truth, named))
    assert_message(sentences, "val")


def test_addon_that_writes_validation_but_no_test(tmp_path):
    folder, truth = tmp_path / "s", make_truth(views=7)
    at, views = truth.lens, sorted(truth.world_to_camera)
    lens = {"fl_x": at.fx, "fl_y": at.fy, "cx": at.cx, "cy": at.cy, "w": WIDTH, "h": HEIGHT, "aabb_scale": 4}
    stems = {v: f"{k + 1:04d}" for k, v in enumerate(views)}
    for split, chosen in (("train", views[:5]), ("val", views[5:])):
        write_pictures(folder / split, [stems[v] for v in chosen])
        frames = blender_frames(truth, {v: f"{split}/{stems[v]}.png" for v in chosen})
        (folder / f"transforms_{split}.json").write_text(json.dumps(lens | {"k1": 0.0, "frames": frames}))
    write_masks(folder / "masks", [stems[v] for v in views[:5]])
    scene, out, _ = run_with_messages(folder)
    assert scene.train == ("0001", "0002", "0003", "0004", "0005") and scene.test == ("0006", "0007")
    assert_cameras(scene, rename_views(truth, stems))
    assert_masked_views(out, scene.train)


def test_training_file_alone_has_no_test_views(tmp_path):
    folder, truth = tmp_path / "s", make_truth()
    write_pictures(folder / "images", truth.world_to_camera)
    write_transforms(folder, truth, per_frame=True)
    (folder / "transforms.json").rename(folder / "transforms_train.json")
    write_model(folder / "sparse/0", truth_in_other_frame(6))
    convert_to_text(folder / "sparse/0")
    scene, _, _ = run_with_messages(folder, masks="none", layout="transforms")
    assert len(scene.train) == 6 and scene.test == ()
    assert_cameras(scene, truth)
