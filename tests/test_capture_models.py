"""Captures with uncommon COLMAP models, views in folders, and Blender's files; wrong intrinsics and transforms.json."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes.capture import (
    HEIGHT,
    WIDTH,
    Truth,
    make_truth,
    write_capture,
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
    change_transforms,
    convert_to_text,
    masked_share,
    rename_views,
    run_with_messages,
    select_views,
    set_in_frames,
    write_mask,
    write_named_model,
)

from reffusion.capture.layouts import cameras
from reffusion.capture.load import load_capture
from reffusion.io.files import BadInput
from reffusion.io.scene import list_objects


def truth_in_other_frame(views: int) -> Truth:
    """Return the truth of `make_truth` in another world frame, as another run of COLMAP would give."""
    return make_truth(views=views, scale=2.5, offset=(7.0, -3.0, 11.0))


def write_transforms_with_paths(folder: Path, truth: Truth, paths: dict[str, str]) -> None:
    """Write transforms.json whose frames have the given paths; `paths`: view -> file_path."""
    write_transforms(folder, truth)
    set_in_frames(folder, "file_path", paths.get)


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
    assert_message(sentences, "sparse/1 is taken, which has most images (7)", "0", "2")


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


# ------------------------------------------------------------------------------------------------- Blender's files


def blender_frames(truth: Truth, paths: dict[str, str]) -> list[dict]:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    pose = lambda view: (np.linalg.inv(truth.world_to_camera[view]) @ flip).tolist()
    return [{"file_path": path, "rotation": 0.0125, "transform_matrix": pose(v)} for v, path in paths.items()]


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


# ------------------------------------------------------------------------------------------------- wrong intrinsics

IN_PIXELS = r"the focal length of 8 px means a field of view of {} degrees; is it in millimeters\? It must be in pixels"
AT = r"the principal point \(cx, cy = {}\) "
OTHER_SIZE = r"lies {} the picture of 96x72 px: are fl, cx and cy those of another size\? Give w and h of that size"
CORNER = "is in the picture's corner; give its middle in pixels, or leave cx and cy out"
INTRINSICS: dict[str, tuple[dict[str, object], str]] = {
    "millimeters": ({"fl_x": 8.0, "fl_y": 8.0}, IN_PIXELS.format(161)),
    "millimeters of a fisheye": ({"fl_x": 8.0, "fl_y": 8.0, "is_fisheye": True}, IN_PIXELS.format(688)),
    "of a picture 4 times as large": (
        {"cx": 192.0, "cy": 145.0},
        AT.format("192, 145") + OTHER_SIZE.format("outside of"),
    ),
    "of a picture twice as large": (
        {"cx": 95.0, "cy": 70.0},
        AT.format("95, 70") + OTHER_SIZE.format("in the corner of"),
    ),
    "cx alone": ({"cx": 150.0}, AT.format("150, [0-9]+") + OTHER_SIZE.format("outside of")),
    "zero": ({"cx": 0.0, "cy": 0}, AT.format("0, 0") + CORNER),
    "relative": ({"cx": 0.5, "cy": 0.5}, AT.format("0.5, 0.5") + CORNER),
}


@pytest.mark.parametrize(("changes", "message"), INTRINSICS.values(), ids=INTRINSICS.keys())
def test_intrinsics_that_no_camera_has(tmp_path, changes, message):
    folder = write_capture(tmp_path, "transforms", make_truth())
    change_transforms(folder, lambda record: record.update(changes))
    with pytest.raises(BadInput, match=rf"transforms\.json: view 'v0.': {message}"):
        load_capture(folder)
    with pytest.raises(BadInput, match=rf"transforms\.json: view 'v0.': {message}"):
        cameras.read(folder)


def test_zero_principal_point_without_a_size(tmp_path):
    folder = write_capture(tmp_path, "transforms", make_truth())
    change_transforms(folder, lambda record: [record.pop("w"), record.pop("h"), record.update(cx=0.0, cy=0.0)])
    with pytest.raises(BadInput, match=CORNER):
        load_capture(folder)


def test_intrinsics_of_a_colmap_model_that_no_camera_has(tmp_path):
    folder = write_capture(tmp_path, "colmap", make_truth(("PINHOLE", (90.0, 90.0, 192.0, 144.0))))
    with pytest.raises(BadInput, match=OTHER_SIZE.format("outside of")):
        load_capture(folder)


UNCOMMON: dict[str, list[dict[str, object]]] = {
    "140 degrees": [{"fl_x": 17.5, "fl_y": 17.5}],
    "fisheye of 200 degrees": [{"fl_x": 27.5, "fl_y": 27.5, "camera_model": "OPENCV_FISHEYE"}],
    "pictures reduced to a quarter": [{"w": 384, "h": 288, "cx": 192.0, "cy": 144.0, "fl_x": 360.0, "fl_y": 360.0}],
    "crop beside the middle": [{"cx": 110.0, "cy": 36.0}],
    "crops below the middle": [{"cx": 40.0 + 5 * k, "cy": -100.0} for k in range(6)],
    "four tiles of a picture": [{"cx": cx, "cy": cy} for cy in (72.0, 0.0) for cx in (96.0, 0.0)],
}


@pytest.mark.parametrize("changes", UNCOMMON.values(), ids=UNCOMMON.keys())
def test_uncommon_intrinsics_are_read(tmp_path, changes):
    folder = write_capture(tmp_path, "transforms", make_truth())
    change_transforms(
        folder, lambda record: [f.update(changes[k % len(changes)]) for k, f in enumerate(record["frames"])]
    )
    capture = load_capture(folder)
    assert len(capture.pictures) == 6 and not capture.warnings


# ----------------------------------------------------------------------------------------------- wrong transforms.json


WRONG: dict[str, tuple[Callable[[dict], object], str]] = {
    "text": (
        lambda record: record.update(fl_x="90.5"),
        "fl_x = \"90.5\" of 'v00.png' is text; write the number without quotes",
    ),
    "no frames": (lambda record: record.update(frames=[]), "its list `frames` is empty; export the poses again"),
    "panoramas": (
        lambda record: [record.update(camera_model="equirectangular"), record.pop("fl_x")],
        "camera_model EQUIRECTANGULAR means 360-degree panoramas; cut them into perspective views: `reffusion panorama",
    ),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG.keys())
def test_message_says_what_is_wrong_in_transforms_json(tmp_path, change, message):
    folder = write_capture(tmp_path, "transforms", make_truth())
    change_transforms(folder, change)
    with pytest.raises(BadInput, match=rf"transforms\.json: {re.escape(message)}"):
        load_capture(folder)


@pytest.mark.parametrize(
    ("old", "new", "line"), [("{", "// by hand\n{", 1), ("{", "{\n # lens\n", 2), ("],", "], /* all */", 1)]
)
def test_comments_in_transforms_json(tmp_path, old, new, line):
    file = write_capture(tmp_path, "transforms", make_truth()) / "transforms.json"
    file.write_text(file.read_text().replace(old, new, 1))
    message = rf"transforms\.json: not valid JSON: line {line} has a comment, which JSON does not allow; remove it"
    with pytest.raises(BadInput, match=message):
        load_capture(tmp_path)


def test_names_with_backslashes_from_an_archive(tmp_path):
    folder = write_capture(tmp_path, "transforms", make_truth())
    for path in sorted((folder / "images").iterdir()):
        path.rename(folder / rf"images\{path.name}")
    message = r"the folder holds files called `images\\v00.png`, as some unzip programs write archives made on Windows"
    with pytest.raises(BadInput, match=f"none of its 6 frames has a picture; {message}; unpack it again with another"):
        load_capture(folder)


def test_missing_depth_maps_are_named(tmp_path):
    folder = write_capture(tmp_path, "transforms", make_truth())
    name = lambda frame: frame.update(depth_file_path=frame["file_path"].replace("images", "depth"))
    change_transforms(folder, lambda record: [name(frame) for frame in record["frames"][:4]])
    message = "{} of 4 files of depth_file_path in transforms.json are missing (first: depth/v0{}.png)"
    assert load_capture(folder).warnings == (message.format(4, 2),)
    (folder / "depth").mkdir()
    depth = np.linspace(3000, 5000, WIDTH).astype(np.uint16)[None].repeat(HEIGHT, 0)
    Image.fromarray(depth).save(folder / "depth/v05.png")
    assert load_capture(folder).warnings[0] == message.format(3, 2)
