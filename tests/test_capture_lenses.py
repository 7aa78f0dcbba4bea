"""Captures with mislabelled files, uncommon lenses, masks and depth maps in transforms.json, and 16-bit photographs."""

from __future__ import annotations

import json
import re
import struct
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scenes.capture import (
    HEIGHT,
    WIDTH,
    Truth,
    make_truth,
    reprojection_error,
    write_capture,
    write_masks,
    write_pictures,
    write_transforms,
)
from scenes.capture_checks import (
    EXACT,
    OBJECT,
    SHARE,
    assert_cameras,
    assert_masked_views,
    assert_message,
    masked_share,
    refusal_message,
    run_with_messages,
    write_mask,
)

from reffusion.capture import video_frames
from reffusion.io.files import BadInput
from reffusion.io.images import save_image
from reffusion.io.ply import save_points
from reffusion.io.scene import load_views

# ----------------------------------------------------------------------- files whose content is not what the name says

POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:" + 64 * "4" + "\nsize 4096\n"
CONSENT_PAGE = b"\xef\xbb\xbf\r\n<!DOCTYPE html><html><title>Google Drive - Virus scan warning</title></html>"


@pytest.mark.parametrize(
    ("layout", "name", "content"),
    [
        ("photos", "images/v03.png", POINTER.encode()),
        ("transforms", "masks/v02.png", POINTER.encode()),
        ("llff", "images_4/v04.png", CONSENT_PAGE),
        ("colmap", "images/v05.png", b""),
    ],
)
def test_pointers_and_pages_instead_of_pictures(tmp_path, layout, name, content):
    folder = write_capture(tmp_path / "s", layout, make_truth())
    (folder / name).write_bytes(content)
    assert Path(name).name in refusal_message(folder)


@pytest.mark.parametrize("brand", [b"mif1", b"heix"])
def test_phone_picture_called_jpg_without_its_reader(tmp_path, monkeypatch, brand):
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    folder = tmp_path / "s"
    write_pictures(folder / "images", [f"IMG_{k}" for k in range(5)], ending=".jpg")
    write_masks(folder / "masks", [f"IMG_{k}" for k in range(5)])
    box = struct.pack(">I4s4sI4s4s", 24, b"ftyp", brand, 0, b"mif1", b"heic")
    (folder / "images/IMG_3.jpg").write_bytes(box + bytes(400))
    assert_message([refusal_message(folder)], "IMG_3.jpg", "pi-heif")


def write_fisheye_capture(folder: Path, params: tuple[float, ...]) -> Truth:
    """Write a COLMAP capture with speckled photographs of a fisheye lens without distortion coefficients.

    Its camera model is OPENCV_FISHEYE with four zero coefficients, which COLMAP had before the models FISHEYE and
    SIMPLE_FISHEYE; `params` are (fx, fy, cx, cy) in px.
    """
    truth = make_truth(("OPENCV_FISHEYE", (*params, 0.0, 0.0, 0.0, 0.0)))
    write_capture(folder, "colmap", truth)
    for k, view in enumerate(truth.world_to_camera):
        speckle = np.random.default_rng(k).integers(0, 256, (HEIGHT // 6, WIDTH // 6, 3), np.uint8)
        save_image(folder / "images" / f"{view}.png", cv2.resize(speckle, (WIDTH, HEIGHT)))
    return truth


def assert_same_undistortion(folder: Path, truth: Truth, earlier: dict[str, np.ndarray]) -> None:
    """Assert the true cameras, and the undistorted pictures `earlier` (view -> picture) of the OPENCV_FISHEYE model."""
    scene, out, sentences = run_with_messages(folder)
    assert reprojection_error(scene, truth) < EXACT
    assert_message(sentences, "undistortion", "moves the border")
    for view, picture in load_views(out, scene.train).items():
        assert np.abs(picture.astype(int) - earlier[view]).max() <= 1, view


def write_camera(folder: Path, number: int, params: tuple[float, ...]) -> None:
    """Write cameras.bin with one camera; `number` is COLMAP's number of the camera model, `params` its parameters."""
    head = struct.pack("<QIiQQ", 1, 1, number, WIDTH, HEIGHT)
    (folder / "sparse/0/cameras.bin").write_bytes(head + struct.pack(f"<{len(params)}d", *params))


def load_undistorted(folder: Path) -> dict[str, np.ndarray]:
    scene, out, _ = run_with_messages(folder)
    return load_views(out, scene.train)


def test_fisheye_of_two_focal_lengths_in_text(tmp_path):
    params = (58.0, 61.0, 47.0, 36.5)
    truth = write_fisheye_capture(tmp_path / "s", params)
    earlier, model = load_undistorted(tmp_path / "s"), tmp_path / "s/sparse/0"
    (model / "cameras.bin").unlink()
    (model / "cameras.txt").write_text(f"# Camera list\n1 FISHEYE {WIDTH} {HEIGHT} {' '.join(map(str, params))}\n")
    assert_same_undistortion(tmp_path / "s", truth, earlier)


@pytest.mark.parametrize(("number", "params"), [(14, (60.0, 48.5, 35.0)), (15, (60.0, 57.0, 48.5, 35.0))])
def test_fisheyes_in_binary(tmp_path, number, params):
    truth = write_fisheye_capture(tmp_path / "s", params if number == 15 else (60.0, *params))
    earlier = load_undistorted(tmp_path / "s")
    write_camera(tmp_path / "s", number, params)
    assert_same_undistortion(tmp_path / "s", truth, earlier)


def assert_names_model(message: str, file: str, model: str) -> None:
    """Assert that the message names the file, the camera model and a remedy."""
    assert file in message and re.search(rf"\b{model}\b", message), message
    assert any(word in message.lower() for word in ("convert", "undistort")), message


@pytest.mark.parametrize(
    ("number", "name", "params"),
    [(17, "EQUIRECTANGULAR", (96.0, 72.0)), (12, "SIMPLE_DIVISION", (90.0, 48.0, 36.0, -0.1))],
)
def test_other_new_models_in_binary_are_named(tmp_path, number, name, params):
    folder = write_capture(tmp_path / "s", "colmap", make_truth())
    write_camera(folder, number, params)
    assert_names_model(refusal_message(folder), "cameras.bin", name)


@pytest.mark.parametrize("line", ["EUCM 96 72 60 60 48 36 0.5 1.1", "DIVISION 96 72 90 90 48 36 -0.1"])
def test_other_new_models_in_text_are_named(tmp_path, line):
    folder = write_capture(tmp_path / "s", "colmap txt", make_truth())
    (folder / "sparse/0/cameras.txt").write_text(f"1 {line}\n")
    assert_names_model(refusal_message(folder), "cameras.txt", line.split()[0])


def test_points_in_a_folder_by_a_windows_path(tmp_path):
    truth = make_truth()
    folder = write_capture(tmp_path / "s", "transforms", truth)
    points = np.repeat(truth.points, 3, 0)
    save_points(folder / "colmap/sparse/points.ply", points, np.full((180, 3), 7, np.uint8))
    write_transforms(folder, truth, ply_file_path="colmap\\sparse\\points.ply")
    scene, _, _ = run_with_messages(folder)
    assert scene.points.shape == (180, 3)
    np.testing.assert_allclose(scene.similarity.invert(scene.points), points, atol=1e-6)


@pytest.mark.parametrize("coded", [True, False])
def test_video_without_frames(tmp_path, coded):
    """Refuse an MP4 file with AV1 frames that cannot be decoded here (`coded`), or with a sound track only."""
    path = tmp_path / "walk.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30, (64, 48))
    for k in range(40):
        writer.write(np.random.default_rng(k).integers(0, 256, (48, 64, 3)).astype(np.uint8))
    writer.release()
    data = path.read_bytes()
    assert data.count(b"mp4v") == data.count(b"esds") == 1 and b"vide" in data
    other = data.replace(b"mp4v", b"av01").replace(b"esds", b"free")
    path.write_bytes(other if coded else data.replace(b"vide", b"soun"))
    with pytest.raises(BadInput) as caught:
        video_frames.extract_frames(path, tmp_path / "s", "0")
    message = str(caught.value)
    assert "\n" not in message and "walk.mp4" in message and not (tmp_path / "s").exists()
    way_out = ("codec", "decode", "H.264", "h264", "ffmpeg", "convert") if coded else ("video",)
    assert any(word in message for word in way_out), message


# ------------------------------------------------------------------------------ masks and depth of transforms.json


def add_to_frames(folder: Path, key: str, path_of) -> None:
    """Set `key` in every frame of transforms.json; `path_of` maps a view's name to the value."""
    record = json.loads((folder / "transforms.json").read_text())
    for frame in record["frames"]:
        frame[key] = path_of(Path(frame["file_path"]).stem)
    (folder / "transforms.json").write_text(json.dumps(record))


def write_inverse_masks(folder: Path, where: str) -> Truth:
    """Write a capture with nerfstudio's masks in the folder `where`: mask_path names them, and 0 marks the object."""
    truth = make_truth()
    write_pictures(folder / "images", truth.world_to_camera)
    for view in truth.world_to_camera:
        write_mask(folder / where / f"{view}.png", ~OBJECT)
    write_transforms(folder, truth)
    add_to_frames(folder, "mask_path", lambda view: f"./{where}/{view}.png")
    return truth


def test_masks_of_dynamic_objects(tmp_path):
    truth = write_inverse_masks(tmp_path / "s", "dynamic_masks/cam0")
    _, out, sentences = run_with_messages(tmp_path / "s")
    assert_masked_views(out, truth.world_to_camera)
    assert_message(sentences, "mask_path")


def test_masks_of_the_scene_win(tmp_path):
    truth = write_inverse_masks(tmp_path / "s", "dynamic_masks")
    for view in truth.world_to_camera:
        write_mask(tmp_path / "s/mask" / f"{view}.png", np.roll(OBJECT[:, : WIDTH // 2], 3, 0).repeat(2, 1))
    _, out, _ = run_with_messages(tmp_path / "s")
    assert_masked_views(out, truth.world_to_camera, 2 * SHARE)


def test_masks_that_lie_where_ours_are_looked_for(tmp_path):
    """nerfstudio's folder of masks is called `masks`, like ours, but its masks have the opposite sign.

    Either mask_path is followed, and the object is masked, or a message names mask_path.
    """
    write_inverse_masks(tmp_path / "s", "masks")
    try:
        _, out, sentences = run_with_messages(tmp_path / "s")
    except BadInput as error:
        assert_message([str(error)], "mask_path")
        return
    shares = [masked_share(out, f"v0{k}") for k in range(6)]
    if shares != pytest.approx(6 * [SHARE], abs=1e-3):
        assert_message(sentences, "mask_path")


def test_mask_of_half_of_the_frames(tmp_path):
    folder, truth = tmp_path / "s", make_truth(views=8)
    write_pictures(folder / "images", truth.world_to_camera)
    write_transforms(folder, truth)
    record = json.loads((folder / "transforms.json").read_text())
    for frame in record["frames"]:
        view = Path(frame["file_path"]).stem
        if int(view[1:]) < 4:
            write_mask(folder / "moving" / f"{view}_ignore.png", ~OBJECT)
            frame["mask_path"] = f"moving\\{view}_ignore.png"
    (folder / "transforms.json").write_text(json.dumps(record))
    scene, out, _ = run_with_messages(folder)
    assert len(scene.train) == 8
    assert_masked_views(out, ["v00", "v01", "v02", "v03"])


@pytest.mark.parametrize("unit", [None, 0.0005])
def test_depth_of_a_phone_makes_points(tmp_path, unit):
    """Depth maps become points on the plane z = 0, which the photographs show, or a message names depth_file_path.

    The maps have 16 bits and half the photographs' size. Their unit is a millimetre unless transforms.json gives
    another `unit` in metres; 0 means unknown.
    """
    truth = make_truth()
    folder = write_capture(tmp_path / "s", "transforms", truth)
    at = truth.lens.resized(WIDTH // 2, HEIGHT // 2)
    columns, rows = np.meshgrid(np.arange(at.width) + 0.5, np.arange(at.height) + 0.5)
    rays = np.stack([(columns - at.cx) / at.fx, (rows - at.cy) / at.fy, np.ones_like(rows)], -1)
    (folder / "depth").mkdir()
    for view, pose in truth.world_to_camera.items():
        center, directions = -pose[:3, :3].T @ pose[:3, 3], rays @ pose[:3, :3]
        depth = -center[2] / directions[..., 2]
        assert (depth > 0).all()
        values = np.round(depth / (unit or 0.001)).astype(np.uint16)
        values[:6] = 0
        Image.fromarray(values).save(folder / "depth" / f"{view}.png")
    changes = {} if unit is None else {"depth_unit_scale_factor": unit}
    write_transforms(folder, truth, **changes)
    add_to_frames(folder, "depth_file_path", lambda view: f"depth/{view}.png")
    scene, _, sentences = run_with_messages(folder)
    height = np.abs(scene.similarity.invert(scene.points)[:, 2])
    if len(height) < 100 or np.median(height) > 0.02:
        assert_message(sentences, "depth_file_path")


# ------------------------------------------------------------------------------------------------- 16 bits of gray


@pytest.mark.parametrize(
    ("ending", "order", "low", "high"),
    [(".tif", "<u2", 0, 4095), (".tiff", ">u2", 300, 64_000), (".png", "<u2", 7_000, 21_000)],
)
def test_gray_photographs_of_16_bits(tmp_path, ending, order, low, high):
    """A ramp of gray stays a ramp, from a 12-bit camera, a big-endian scan, and a thermal camera."""
    folder, truth = tmp_path / "s", make_truth()
    write_masks(folder / "masks", truth.world_to_camera)
    (folder / "images").mkdir()
    ramp = np.linspace(low, high, WIDTH)[None].repeat(HEIGHT, 0)
    for view in truth.world_to_camera:
        Image.fromarray(ramp.astype(order)).save(folder / "images" / f"{view}{ending}")
    write_transforms(folder, truth)
    add_to_frames(folder, "file_path", lambda view: f"images/{view}{ending}")
    scene, out, _ = run_with_messages(folder)
    assert_cameras(scene, truth)
    for picture in load_views(out, scene.train).values():
        assert picture.shape == (HEIGHT, WIDTH, 3) and np.ptp(picture, axis=-1).max() == 0
        means = picture[..., 0].reshape(HEIGHT, 8, 12).mean((0, 2))
        assert (np.diff(means) > 0 if high > 5000 else np.diff(means) >= 0).all() and means[-1] > means[0] + 10
