"""Captures with mislabelled files, uncommon lenses, masks and depth maps in transforms.json, and 16-bit photographs."""

from __future__ import annotations

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
    write_masks,
    write_pictures,
    write_transforms,
)
from scenes.capture_checks import (
    OBJECT,
    SHARE,
    assert_cameras,
    assert_masked_views,
    assert_message,
    change_transforms,
    refusal_message,
    run_with_messages,
    set_in_frames,
    write_mask,
)

from reffusion.capture import video_frames
from reffusion.io.files import BadInput
from reffusion.io.scene import load_views

# ----------------------------------------------------------------------- files whose content is not what the name says


@pytest.mark.parametrize("brand", [b"mif1", b"heix"])
def test_phone_picture_called_jpg_without_its_reader(tmp_path, monkeypatch, brand):
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    folder = tmp_path / "s"
    write_pictures(folder / "images", [f"IMG_{k}" for k in range(5)], ending=".jpg")
    write_masks(folder / "masks", [f"IMG_{k}" for k in range(5)])
    box = struct.pack(">I4s4sI4s4s", 24, b"ftyp", brand, 0, b"mif1", b"heic")
    (folder / "images/IMG_3.jpg").write_bytes(box + bytes(400))
    assert_message([refusal_message(folder)], "IMG_3.jpg", "pi-heif")


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


def write_inverse_masks(folder: Path, where: str) -> Truth:
    """Write a capture with nerfstudio's masks in the folder `where`: mask_path names them, and 0 marks the object."""
    truth = make_truth()
    write_pictures(folder / "images", truth.world_to_camera)
    for view in truth.world_to_camera:
        write_mask(folder / where / f"{view}.png", ~OBJECT)
    write_transforms(folder, truth)
    set_in_frames(folder, "mask_path", lambda view: f"./{where}/{view}.png")
    return truth


def test_masks_of_the_scene_win(tmp_path):
    truth = write_inverse_masks(tmp_path / "s", "dynamic_masks")
    for view in truth.world_to_camera:
        write_mask(tmp_path / "s/mask" / f"{view}.png", np.roll(OBJECT[:, : WIDTH // 2], 3, 0).repeat(2, 1))
    _, out, _ = run_with_messages(tmp_path / "s")
    assert_masked_views(out, truth.world_to_camera, 2 * SHARE)


def test_mask_of_half_of_the_frames(tmp_path):
    folder, truth = tmp_path / "s", make_truth(views=8)
    write_pictures(folder / "images", truth.world_to_camera)
    write_transforms(folder, truth)
    for view in ("v00", "v01", "v02", "v03"):
        write_mask(folder / "moving" / f"{view}_ignore.png", ~OBJECT)
    named = lambda frame: frame.update(mask_path=f"moving\\{Path(frame['file_path']).stem}_ignore.png")
    change_transforms(folder, lambda record: [named(f) for f in record["frames"] if Path(f["file_path"]).stem < "v04"])
    scene, out, _ = run_with_messages(folder)
    assert len(scene.train) == 8
    assert_masked_views(out, ["v00", "v01", "v02", "v03"])


# ------------------------------------------------------------------------------------------------- 16 bits of gray


@pytest.mark.parametrize(
    ("ending", "order", "low", "high"),
    [
        (".tif", "<u2", 0, 4095),
        (".tiff", ">u2", 300, 64_000),
        (".png", "<u2", 7_000, 21_000),
        (".png", "<u2", 0, 65_535),
    ],
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
    set_in_frames(folder, "file_path", lambda view: f"images/{view}{ending}")
    scene, out, _ = run_with_messages(folder)
    assert_cameras(scene, truth)
    for picture in load_views(out, scene.train).values():
        assert picture.shape == (HEIGHT, WIDTH, 3) and np.ptp(picture, axis=-1).max() == 0
        means = picture[..., 0].reshape(HEIGHT, 8, 12).mean((0, 2))
        assert high < 65_535 or np.array_equal(picture[..., 1], np.round(ramp.astype(order) / 257))
        assert (np.diff(means) > 0 if high > 5000 else np.diff(means) >= 0).all() and means[-1] > means[0] + 10
