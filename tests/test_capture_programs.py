"""Cameras that other programs wrote are read with the right values; files that are not read are named."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scenes.capture import (
    HEIGHT,
    PINHOLE,
    RADIAL,
    WIDTH,
    Truth,
    make_truth,
    write_capture,
    write_masks,
    write_model,
    write_pictures,
    write_transforms,
)
from scenes.capture_checks import change_transforms

from reffusion.capture.layouts.capture import Capture
from reffusion.capture.load import detect_layout, load_capture
from reffusion.capture.roles import assign_roles
from reffusion.io.colmap import load_images
from reffusion.io.files import BadInput
from reffusion.io.images import image_size, load_image

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
POINTS = np.array([[0.0, 0.0, 0.0], [0.5, 0.1, -0.3], [-0.4, 0.3, 0.2]])


def write_polycam(folder: Path, truth: Truth, kind: str = "") -> None:
    lens = {"width": WIDTH, "height": HEIGHT, "fx": truth.lens.fx, "fy": truth.lens.fy, "cx": 48.0, "cy": 36.0}
    cameras = folder / f"keyframes/{kind}cameras"
    cameras.mkdir(parents=True)
    for name, pose in truth.world_to_camera.items():
        matrix = np.linalg.inv(pose) @ FLIP
        values = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
        (cameras / f"{name}.json").write_text(json.dumps({"blur_score": 50.0, **lens, **values}))
    write_pictures(folder / f"keyframes/{kind}images", truth.world_to_camera, ending=".jpg")


def write_corrected_polycam(folder: Path, truth: Truth) -> None:
    write_polycam(folder, truth, "corrected_")
    moved = {name: np.linalg.inv(FLIP) @ pose for name, pose in truth.world_to_camera.items()}
    write_polycam(folder, Truth(moved, truth.points, truth.model))


def write_realitycapture(folder: Path, truth: Truth) -> None:
    rows = ["#cameras 6", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for name, pose in truth.world_to_camera.items():
        x, y, alt = -pose[:3, :3].T @ pose[:3, 3]
        axes = pose[:3, :3].T @ FLIP[:3, :3]  # columns: the camera's right, up and backwards
        heading, pitch = np.arctan2(axes[0, 1], axes[1, 1]), np.arcsin(axes[2, 1])
        angles = np.degrees([heading, pitch, np.arctan2(-axes[2, 0], axes[2, 2])])
        focal, px = truth.lens.fx / WIDTH * 36, (truth.lens.cx - WIDTH / 2) / WIDTH * 36
        numbers = (x, y, alt, *angles, focal, px, 0.0, *truth.lens.radial, 0, 0, 0, 0, 0)
        rows.append(",".join([f"{name}.png", *(repr(float(n)) for n in numbers)]))
    (folder / "cameras.csv").write_text("\r\n".join(rows) + "\r\n")
    write_pictures(folder / "images", truth.world_to_camera)


def write_bundler(folder: Path, truth: Truth) -> None:
    rows = ["# Bundle file v0.3", f"{len(truth.world_to_camera) + 1} {len(POINTS)}", *["0 0 0"] * 5]
    for pose in truth.world_to_camera.values():
        flipped = FLIP @ pose
        numbers = [[truth.lens.fx, *truth.lens.radial, 0.0][:3], *flipped[:3, :3], flipped[:3, 3]]
        rows += [" ".join(repr(float(n)) for n in row) for row in numbers]
    for point in POINTS:
        rows += [" ".join(map(str, point)), "99 98 97", "1 0 5 1.0 2.0"]
    (folder / "bundle.out").write_text("\n".join(rows) + "\n")
    names = ["unplaced.png", *(f"{name}.png" for name in truth.world_to_camera)]
    (folder / "list.txt").write_text("".join(f".\\images\\{name} 0 532.1\n" for name in names))
    write_pictures(folder / "images", truth.world_to_camera)


def write_splat_cameras(folder: Path, truth: Truth) -> None:
    record = []
    for k, (name, pose) in enumerate(truth.world_to_camera.items()):
        matrix = np.linalg.inv(pose)
        pose_values = {"position": matrix[:3, 3].tolist(), "rotation": matrix[:3, :3].tolist()}
        size = {"width": 2 * WIDTH, "height": 2 * HEIGHT, "fx": 2 * truth.lens.fx, "fy": 2 * truth.lens.fy}
        record.append({"id": k, "img_name": name, **size, **pose_values})
    (folder / "cameras.json").write_text(json.dumps(record))
    write_pictures(folder / "images", truth.world_to_camera)


def write_opensfm(folder: Path, truth: Truth) -> None:
    lens = {"projection_type": "brown", "width": WIDTH, "height": HEIGHT, "k1": truth.lens.radial[0], "k2": 0.0}
    lens |= {"focal_x": truth.lens.fx / WIDTH, "focal_y": truth.lens.fy / WIDTH, "c_x": 0.0, "c_y": 0.0}
    shots = {
        f"{name}.png": {"rotation": cv2.Rodrigues(pose[:3, :3])[0][:, 0].tolist(), "translation": pose[:3, 3].tolist()}
        for name, pose in truth.world_to_camera.items()
    }
    points = {str(k): {"coordinates": list(point), "color": [99.0, 98.0, 97.0]} for k, point in enumerate(POINTS)}
    whole = {"cameras": {"c": lens}, "shots": {n: s | {"camera": "c"} for n, s in shots.items()}, "points": points}
    part = {"cameras": {"c": lens}, "shots": dict(list(whole["shots"].items())[:2])}
    (folder / "reconstruction.json").write_text(json.dumps([part, whole]))
    write_pictures(folder / "images", truth.world_to_camera)


def assert_cameras(capture: Capture, truth: Truth) -> None:
    """Assert that the capture has exactly the poses and lenses of `truth`."""
    assert capture.poses is not None and sorted(capture.pictures) == sorted(truth.world_to_camera)
    for name, pose in truth.world_to_camera.items():
        np.testing.assert_allclose(capture.poses.world_to_camera[name], pose, atol=1e-9)
        ours, true = capture.poses.lenses[name], truth.lens
        assert (ours.width, ours.height) == (WIDTH, HEIGHT)
        np.testing.assert_allclose((ours.fx, ours.fy, ours.cx, ours.cy), (true.fx, true.fy, true.cx, true.cy))
        assert [k for k in ours.radial if k] == list(true.radial) and ours.tangential == (0.0, 0.0)


@pytest.mark.parametrize(
    ("layout", "write", "model", "points"),
    [
        ("polycam", write_polycam, PINHOLE, 0),
        ("polycam", write_corrected_polycam, PINHOLE, 0),
        ("realitycapture", write_realitycapture, RADIAL, 0),
        ("bundler", write_bundler, RADIAL, 3),
        ("3dgs", write_splat_cameras, PINHOLE, 0),
        ("opensfm", write_opensfm, RADIAL, 3),
    ],
)
def test_cameras_of_other_programs(tmp_path, layout, write, model, points):
    truth = make_truth(model)
    write(tmp_path, truth)
    capture = load_capture(tmp_path)
    assert capture.layout == layout
    assert_cameras(capture, truth)
    assert len(capture.poses.points) == points
    if points:
        np.testing.assert_allclose(capture.poses.points, POINTS)
        assert capture.poses.colors.tolist() == [[99, 98, 97]] * 3
    assert capture.warnings == ()


@pytest.mark.parametrize(
    ("angles", "forward", "up"),
    [
        ("0,0,0", (0, 0, -1), (0, 1, 0)),  # looks down, the top of the picture is north
        ("90,0,0", (0, 0, -1), (1, 0, 0)),  # turned clockwise, as seen from above
        ("0,90,0", (0, 1, 0), (0, 0, 1)),  # looks north
        ("90,90,0", (1, 0, 0), (0, 0, 1)),  # looks east
        ("0,90,90", (-1, 0, 0), (0, 0, 1)),  # looks north, then turned about its upward axis
    ],
)
def test_heading_pitch_and_roll_of_realitycapture(tmp_path, angles, forward, up):
    rows = [f"v{k}.png,{k},2,3,{angles},36,3.6,-1.8" for k in range(3)]
    (tmp_path / "a.csv").write_text("\n".join(["#name,x,y,alt,heading,pitch,roll,f,px,py", *rows]))
    write_pictures(tmp_path / "images", ["v0", "v1", "v2"])
    poses = load_capture(tmp_path).poses
    right, down, ahead = poses.world_to_camera["v1"][:3, :3]
    np.testing.assert_allclose([ahead, -down, right], [forward, up, np.cross(forward, up)], atol=1e-12)
    lens = poses.lenses["v1"]
    np.testing.assert_allclose((lens.fx, lens.fy, lens.cx, lens.cy), (96, 96, 48 + 9.6, 36 - 4.8))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda f: (f / "b.csv").write_text((f / "cameras.csv").read_text()),
            "cameras.csv: cameras of RealityCapture, as in b.csv beside it",
        ),
        (
            lambda f: (f / "cameras.csv").write_text("#name,x,y,alt,heading,pitch,roll,f\nv00.png,1,2,3,a,5,6,7"),
            "line 2",
        ),
        (
            lambda f: (f / "cameras.csv").write_text("#name,x,y,alt,heading,pitch,roll,f\nv00.png,1,2,3,4,5,6,0"),
            "0 px;",
        ),
        (lambda f: [p.rename(p.with_stem(f"x{p.stem}")) for p in (f / "images").iterdir()], "none of its 6 pictures"),
    ],
)
def test_tables_of_realitycapture_that_are_refused(tmp_path, change, message):
    write_realitycapture(tmp_path, make_truth(RADIAL))
    change(tmp_path)
    with pytest.raises(BadInput, match=message):
        load_capture(tmp_path)


def test_bundler_without_its_list(tmp_path):
    write_bundler(tmp_path, make_truth(RADIAL))
    (tmp_path / "list.txt").write_text("one.png\n")
    with pytest.raises(BadInput, match=r"bundle.out: 7 cameras, and no list of 7 pictures beside it; add list.txt"):
        load_capture(tmp_path)


def test_spherical_cameras_of_opensfm(tmp_path):
    write_opensfm(tmp_path, make_truth(RADIAL))
    file = tmp_path / "reconstruction.json"
    file.write_text(file.read_text().replace('"brown"', '"spherical"'))
    with pytest.raises(BadInput, match="the camera 'c' is spherical, which is not understood; one of perspective, "):
        load_capture(tmp_path)


# ------------------------------------------------------------------------------------------------- transforms files


def change_matrices(folder: Path, change: Callable[[np.ndarray], np.ndarray], frames: slice = slice(None)) -> None:
    turn = lambda frame: frame.update(transform_matrix=change(np.array(frame["transform_matrix"])).tolist())
    change_transforms(folder, lambda record: [turn(frame) for frame in record["frames"][frames]])


@pytest.mark.parametrize(
    ("change", "transposed"),
    [
        (lambda matrix: matrix.ravel(), False),
        (lambda matrix: matrix.T.ravel(), True),
        (lambda matrix: matrix.T, True),
        (lambda matrix: matrix[:3], False),
    ],
)
def test_matrices_by_columns_or_in_a_row(tmp_path, change, transposed):
    truth = make_truth()
    write_capture(tmp_path, "transforms", truth)
    change_matrices(tmp_path, change)
    capture = load_capture(tmp_path)
    assert_cameras(capture, truth)
    said = "transforms.json: its matrices are transposed (their last column is 0 0 0 1) and are read as such"
    assert capture.warnings == ((said,) if transposed else ())


def test_some_matrices_by_columns(tmp_path):
    write_capture(tmp_path, "transforms", make_truth())
    change_matrices(tmp_path, np.transpose, slice(2))
    message = "the matrix of 'images/v05.png' is transposed, that of 'images/v03.png' is not; write all alike"
    with pytest.raises(BadInput, match=message):
        load_capture(tmp_path)


def test_a_frame_that_is_listed_again(tmp_path):
    truth = make_truth()
    write_capture(tmp_path, "transforms", truth)
    change_transforms(tmp_path, lambda record: record["frames"].append(dict(record["frames"][1], sharpness=3.0)))
    capture = load_capture(tmp_path)
    assert_cameras(capture, truth)
    assert capture.warnings == ("1 of the 7 frames in transforms.json are listed again with the same pose: v04.png",)
    change_transforms(tmp_path, lambda record: record["frames"][-1].update(fl_x=80.0))
    with pytest.raises(BadInput, match=r"transforms.json: 'v04.png' is listed twice, with another lens each time"):
        load_capture(tmp_path)
    change_transforms(
        tmp_path, lambda record: record["frames"][-1].update(record["frames"][2], file_path="images/v04.png")
    )
    with pytest.raises(BadInput, match=r"transforms.json: 'v04.png' is listed twice, with another pose each time"):
        load_capture(tmp_path)


SPLITS = {
    "train and test": ({"train": [0, 1, 2], "test": [4, 5]}, [0, 1, 2], [4, 5]),
    "val is not test": ({"train": [0, 1, 2], "test": [4], "val": [5]}, [0, 1, 2], [4]),
    "val counts as test": ({"train": [0, 1, 2], "val": [5]}, [0, 1, 2], [5]),
    "test only": ({"test": [5]}, [0, 1, 2, 3, 4], [5]),
    "train only": ({"train": [0, 1, 2], "test": []}, [0, 1, 2], []),
    "in both": ({"train": [0, 1, 2, 3, 4, 5], "test": [5]}, [0, 1, 2, 3, 4], [5]),
}


@pytest.mark.parametrize(("lists", "train", "test"), SPLITS.values(), ids=SPLITS.keys())
def test_lists_of_training_and_test_views(tmp_path, lists, train, test):
    write_capture(tmp_path, "transforms", make_truth())
    named = {f"{split}_filenames": [f"./images/v0{k}.png" for k in views] for split, views in lists.items()}
    change_transforms(tmp_path, lambda record: record.update(named))
    capture = load_capture(tmp_path)
    roles = assign_roles(tmp_path, capture)
    assert roles.train == tuple(f"v0{k}" for k in train) and roles.test == tuple(f"v0{k}" for k in test)
    unused = sorted({f"v0{k}" for k in range(6)} - {*roles.train, *roles.test}, reverse=True)
    assert sorted(capture.unused, reverse=True) == unused and len(capture.warnings) == bool(unused)


@pytest.mark.parametrize(
    ("place", "text"),
    [
        ("sparse/0/test.txt", "v01.png\r\nv04\n"),
        ("test.txt", "images/v01.png\nimages/v04.png\n"),
        ("test_list.txt", "v01\nv04"),
        ("train_test_lists.json", '{"train": ["v00.png"], "test": ["v01.png", "v04.png"], "has_masks": false}'),
    ],
)
def test_a_list_of_test_pictures_beside_a_model(tmp_path, place, text):
    write_capture(tmp_path, "colmap", make_truth())
    (tmp_path / place).write_text(text)
    assert load_capture(tmp_path).test == ("v01", "v04")


def test_scene_yaml_prevails_over_lists(tmp_path):
    write_capture(tmp_path, "transforms", make_truth())
    lists = {"train_filenames": ["images/v00.png", "images/v01.png"], "test_filenames": ["images/v05.png"]}
    change_transforms(tmp_path, lambda record: record.update(lists))
    capture = load_capture(tmp_path)
    roles = assign_roles(tmp_path, capture, test=["v02"], train=["v00", "v03", "v05"])
    assert (roles.train, roles.test) == (("v00", "v03", "v05"), ("v02",))


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["images/v05.png", "images/v77.png"], "test_filenames: 'images/v77.png' is no frame's file_path; correct it"),
        ("v05", "test_filenames = v05 is no list of names"),
        ([5], r"test_filenames = \[5\] is no list of names"),
    ],
)
def test_lists_that_are_refused(tmp_path, names, message):
    write_capture(tmp_path, "transforms", make_truth())
    change_transforms(tmp_path, lambda record: record.update(test_filenames=names))
    with pytest.raises(BadInput, match=message):
        load_capture(tmp_path)


def write_export(folder: Path, truth: Truth, split: str, views: list[str], **lens: float) -> None:
    """Write a list of poses as `ns-export cameras` does, with the keys `lens` in each frame."""
    pose = lambda view: (np.linalg.inv(truth.world_to_camera[view]) @ FLIP)[:3].tolist()
    frames = [{"file_path": f"images/{view}.png", "transform": pose(view), **lens} for view in views]
    (folder / f"transforms_{split}.json").write_text(json.dumps(frames))


def test_exported_lists_of_cameras(tmp_path):
    truth = make_truth()
    write_pictures(tmp_path / "images", truth.world_to_camera)
    views = list(truth.world_to_camera)
    for split, chosen in (("train", views[:4]), ("eval", views[4:])):
        write_export(tmp_path, truth, split, chosen, fl_x=90.0)
    capture = load_capture(tmp_path)
    assert_cameras(capture, truth)
    assert capture.test == ("v04", "v05")


def test_exported_lists_without_focal_lengths(tmp_path):
    truth = make_truth()
    write_pictures(tmp_path / "images", truth.world_to_camera)
    write_export(tmp_path, truth, "train", list(truth.world_to_camera))
    capture = load_capture(tmp_path)
    assert capture.layout == "photos" and capture.warnings == (
        "transforms_train.json (ns-export cameras, without focal lengths) is not read; add fl_x to its frames; without "
        "that, poses are solved anew, in another frame",
    )
    write_model(tmp_path / "sparse/0", truth)
    assert load_capture(tmp_path).layout == "colmap"


# ------------------------------------------------------------------------------------------------- COLMAP


IMAGES = [f"{k} 1 0 0 0 0.5 {k} 0 1 {name}" for k, name in enumerate(("a.png", "day 0/my photo 7.png", "c.png"), 1)]
POINT_LINE = "1.5 2.5 -1 20.0 3e1 7 1.5 2.5 -1 20.0 3e1 7"  # twelve numbers, as many as words in an image's line


@pytest.mark.parametrize(
    "lines",
    [
        "\n\n".join(IMAGES),
        "\n".join(IMAGES),
        "\n\n\n".join(IMAGES),
        "# comment\r\n\r\n" + f"\r\n{POINT_LINE}\r\n".join(IMAGES) + "\r\n\r\n\r\n",
        f"{IMAGES[0]}\n\n{IMAGES[1]}\n{POINT_LINE}\n\n{IMAGES[2]}\n",
    ],
)
def test_lines_of_points_may_be_missing(tmp_path, lines):
    (tmp_path / "images.txt").write_text(lines)
    found = load_images(tmp_path / "images.txt")
    assert {k: image.name for k, image in found.items()} == {1: "a.png", 2: "day 0/my photo 7.png", 3: "c.png"}
    assert [image.world_to_camera[1, 3] for image in found.values()] == [1, 2, 3]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("\n4 1 0 0 0 0 0 0 1", "line 6: cannot read the image '4 1 0 0 0 0 0 0 1' (10 fields are expected)"),
        (f"{POINT_LINE}\n{POINT_LINE}", "line 6: cannot read the image '1.5 2.5 -1 20.0 3e1 7 1.5"),
        ("4 one 0 0 0 0 0 0 1 d.png", "line 5: cannot read the image '4 one 0 0"),
    ],
)
def test_lines_that_are_no_images(tmp_path, line, message):
    (tmp_path / "images.txt").write_text("# comment\n" + "\n".join([*IMAGES, line]))
    with pytest.raises(BadInput) as error:
        load_images(tmp_path / "images.txt")
    assert message in str(error.value)


def test_a_workspace_of_automatic_reconstruction(tmp_path):
    truth = make_truth()
    write_pictures(tmp_path / "dense/0/images", truth.world_to_camera)
    write_model(tmp_path / "dense/0/sparse", truth)
    write_masks(tmp_path / "masks", truth.world_to_camera)
    assert_cameras(capture := load_capture(tmp_path), truth)
    assert len(assign_roles(tmp_path, capture).masks[""]) == 6
    distorted = make_truth(RADIAL)
    write_model(tmp_path / "sparse/0", distorted)
    assert_cameras(load_capture(tmp_path), truth)
    write_pictures(tmp_path / "images", truth.world_to_camera)
    assert_cameras(load_capture(tmp_path), distorted)


# ------------------------------------------------------------------------------------------------- not read

EXPORT = "export a COLMAP model or transforms.json from it"
UNREAD = {
    "images/v00.xmp": ("http://www.capturingreality.com/ns/xcr/1.1#", "RealityCapture", "export its Internal/External"),
    "images/v00.XMP": (
        'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"',
        "RealityCapture",
        "export its Internal/",
    ),
    "xmp/v00.xmp": (
        'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"',
        "RealityCapture",
        "export its Internal/",
    ),
    "odm_report/shots.geojson": ("{}", "OpenDroneMap", "copy the project's opensfm/reconstruction.json here"),
    "images/registration.csv": ("#name,x,y,alt,heading,pitch,roll", "RealityCapture", "export its Internal/External"),
    "cameras.xml": ('<?xml version="1.0"?><document version="2.0.0"><chunk label="1">', "Metashape", EXPORT),
    "blocks.xml": ('<?xml version="1.0"?><BlocksExchange version="2.1">', "ContextCapture", EXPORT),
    "metadata": ('{"w": 96, "K": [], "poses": []}', "Record3D", "convert it to transforms.json, or"),
    "metadata.json": ('{"w": 96, "K": [], "poses": []}', "Record3D", "convert it to transforms.json, or"),
    "sfm_data.json": ("{}", "OpenMVG", "convert it by openMVG_main_openMVG2Colmap"),
    "cameras.sfm": ("{}", "Meshroom", EXPORT),
    "cameras.json": ("[]", "not of 3D Gaussian Splatting", EXPORT),
    "sparse/0/images.bin": ("", "COLMAP, elsewhere or incomplete", "move the complete model to sparse/0"),
    "out/transforms.json": ("{}", "nerfstudio, in a sub-folder", "move it to the scene's folder"),
}


@pytest.mark.parametrize(("name", "row"), UNREAD.items(), ids=UNREAD.keys())
def test_poses_that_are_not_read_are_named(tmp_path, name, row):
    content, program, remedy = row
    truth = make_truth()
    write_pictures(tmp_path / "images", truth.world_to_camera)
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text(content)
    (said,) = load_capture(tmp_path).warnings
    assert said.startswith(f"{name} ({program}) is not read; {remedy}")
    assert said.endswith("; without that, poses are solved anew, in another frame")
    write_transforms(tmp_path, truth)
    assert load_capture(tmp_path).warnings == (), "other poses are there"


def test_other_tables_and_sidecars_are_not_poses(tmp_path):
    write_pictures(tmp_path / "images", ["a", "b", "c"])
    (tmp_path / "images/a.xmp").write_text('<x:xmpmeta xmlns:crs="http://ns.adobe.com/camera-raw-settings/1.0/">')
    (tmp_path / "prices.csv").write_text("name,x,y\n")
    (tmp_path / "metadata.json").write_text('{"author": "me"}')
    assert load_capture(tmp_path).warnings == ()


@pytest.mark.parametrize("word", ["_matte", "-segmentation", ".alpha", "_msk", ".png.mask"])
def test_masks_beside_photographs(tmp_path, word):
    write_pictures(tmp_path / "images", ["a", "b", "c"])
    write_masks(tmp_path / "images", [f"{name}{word}" for name in "abc"])
    capture = load_capture(tmp_path)
    assert [*capture.pictures] == ["a", "b", "c"] and [*assign_roles(tmp_path, capture).masks[""]] == ["a", "b", "c"]


def test_a_file_of_bundler_under_another_name_and_a_camera_of_polycam_without_a_size(tmp_path):
    truth = make_truth(RADIAL)
    (tmp_path / "a").mkdir()
    write_bundler(tmp_path / "a", truth)
    (tmp_path / "a/bundle.out").rename(tmp_path / "a/scan.out")
    (tmp_path / "a/other.out").write_text("training ended\n")
    assert load_capture(tmp_path / "a").pose_source == tmp_path / "a/scan.out"
    (tmp_path / "a/export").mkdir()
    for name in ("scan.out", "list.txt"):
        (tmp_path / "a" / name).rename(tmp_path / "a/export" / name)
    assert load_capture(tmp_path / "a").pose_source == tmp_path / "a/export/scan.out"
    write_polycam(tmp_path / "b", truth)
    for path in tmp_path.glob("b/keyframes/*cameras/*.json"):
        record = json.loads(path.read_text())
        path.write_text(json.dumps({key: value for key, value in record.items() if key not in ("width", "height")}))
    lenses = load_capture(tmp_path / "b").poses.lenses
    assert {(lens.width, lens.height) for lens in lenses.values()} == {(WIDTH, HEIGHT)}
    # Pictures of half the size: the middle of the lens says for which size it holds.
    write_pictures(tmp_path / "b/keyframes/images", truth.world_to_camera, (WIDTH // 2, HEIGHT // 2), ending=".jpg")
    for lens in load_capture(tmp_path / "b").poses.lenses.values():
        assert (lens.width, lens.fx) == (WIDTH // 2, pytest.approx(truth.lens.fx / 2))


def test_a_table_of_realitycapture_may_say_yaw(tmp_path):
    truth = make_truth(RADIAL)
    write_realitycapture(tmp_path, truth)
    table = tmp_path / "cameras.csv"
    table.write_text(table.read_text().replace("heading", "yaw"))
    assert_cameras(load_capture(tmp_path), truth)


@pytest.mark.parametrize("ending", [".jfif", ".jpe", ".avif"])
def test_endings_of_pictures(tmp_path, ending):
    truth, folder = make_truth(), tmp_path / "images"
    if ending == ".avif":
        avif = pytest.importorskip("PIL.AvifImagePlugin")
        if not avif.SUPPORTED:
            pytest.skip("this Pillow does not read AVIF")
    folder.mkdir()
    for name in truth.world_to_camera:
        kind = "AVIF" if ending == ".avif" else "JPEG"
        Image.new("RGB", (WIDTH, HEIGHT), (200, 100, 50)).save(folder / f"{name}{ending}", kind)
    write_model(tmp_path / "sparse/0", truth, ending=ending)
    write_masks(tmp_path / "masks", truth.world_to_camera)
    assert_cameras(capture := load_capture(tmp_path), truth)
    assert len(assign_roles(tmp_path, capture).masks[""]) == 6
    assert np.abs(load_image(folder / f"v00{ending}").astype(int) - (200, 100, 50)).max() <= 3


@pytest.mark.parametrize("channels", [3, 4])
def test_float_colors_are_refused(tmp_path, channels):
    file = tmp_path / "a.tif"
    cv2.imwrite(str(file), np.full((8, 9, channels), 0.5, np.float32))
    with pytest.raises(BadInput, match=r"a.tif: float pixels; save it as a picture of 8 or 16 bits"):
        image_size(file)


def test_camera_raw_among_photographs(tmp_path):
    truth = make_truth()
    write_capture(tmp_path, "colmap", truth)
    for name in ("v00.DNG", "w1.DNG", "w2.DNG"):  # v00.png lies beside the first
        (tmp_path / "images" / name).write_bytes(b"II*\0")
    write_masks(tmp_path / "masks", ["w1"])
    capture = load_capture(tmp_path)
    said = "images holds 2 .DNG pictures (camera raw), which are not read; develop them to JPEG"
    assert capture.warnings == (said,)
    assert len(assign_roles(tmp_path, capture).masks[""]) == 6


@pytest.mark.parametrize(
    ("files", "hint"),
    [
        (["images/a.DNG", "images/b.DNG"], r"images holds 2 .DNG pictures \(camera raw\), which are not read; develop"),
        (["images/a.jxl"], "images holds 1 .jxl pictures"),
        (["clip.MP4"], r"give the video itself: scene=.*clip.MP4"),
        (["IMG one/a.png", "IMG one/b.png"], "IMG one holds 2 pictures: name their folder as `images: IMG one` in"),
        (["one/rgb/a.png"], "one/rgb holds 1 picture: give the folder of the capture: scene=.*/one$"),
        (["DCIM/a.MP4"], "give the video itself: scene=.*/DCIM/a.MP4$"),
        (["capture.zip"], "unpack capture.zip"),
        ([], "name their folder as `images` in scene.yaml"),
    ],
)
def test_folders_without_pictures(tmp_path, files, hint):
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(BadInput, match=f"no pictures in images, photos, input, rgb, .; {hint}"):
        load_capture(tmp_path)


# ------------------------------------------------------------------------------------------------- panoramas


def panorama(turn: float, width: int = 256) -> np.ndarray:
    """Return a picture uint8 [width // 2, width, 3] of smooth waves that close around it."""
    around, down = np.meshgrid(np.arange(width) / width * 2 * np.pi + turn, np.linspace(0, np.pi, width // 2))
    waves = np.sin(around) * np.sin(3 * down) + np.cos(2 * around + down) + np.sin(5 * down)
    return np.repeat(np.round(128 + 40 * waves).astype(np.uint8)[..., None], 3, axis=2)


def test_panoramas_are_refused_by_their_borders(tmp_path):
    (tmp_path / "images").mkdir()
    for k in range(5):
        Image.fromarray(panorama(0.7 * k)).save(tmp_path / f"images/p{k}.png")
    message = (
        r"images: 5 of 5 pictures are 360-degree panoramas \(p0, p1, p2, ...\); cut them into perspective views: "
        r"`reffusion panoramas"
    )
    with pytest.raises(BadInput, match=message):
        load_capture(tmp_path)
    for k in range(5):
        Image.fromarray(panorama(0.7 * k)[64:128, :128]).save(tmp_path / f"images/p{k}.png")
    assert detect_layout(tmp_path) == "photos" and len(load_capture(tmp_path).pictures) == 5


@pytest.mark.parametrize("kind", ["equirectangular", "cylindrical", "none"])
def test_panoramas_are_refused_by_their_metadata(tmp_path, kind):
    xmp = f'<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" GPano:ProjectionType="{kind}"/>'
    data = b"http://ns.adobe.com/xap/1.0/\0" + xmp.encode()
    write_pictures(tmp_path / "images", ["a", "b", "c"], ending=".jpg")
    content = (tmp_path / "images/b.jpg").read_bytes()
    segment = b"\xff\xe1" + struct.pack(">H", len(data) + 2) + data
    (tmp_path / "images/b.jpg").write_bytes(content[:2] + segment + content[2:])
    if kind == "none":
        assert len(load_capture(tmp_path).pictures) == 3
        return
    with pytest.raises(BadInput, match=r"1 of 3 pictures are 360-degree panoramas \(b\); cut them"):
        load_capture(tmp_path)
