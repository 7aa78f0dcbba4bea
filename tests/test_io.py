"""Round trips of every file format, and the files that are refused."""

from __future__ import annotations

import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
import torch
from PIL import Image, ImageOps
from plyfile import PlyData
from scenes.capture import load_test_masks
from scenes.random_scene import random_gaussians, random_rotation, random_scene

from reffusion.io import rotations
from reffusion.io.arrays import load_json, load_labels, save_json, save_labels
from reffusion.io.images import (
    image_size,
    load_alpha,
    load_exr,
    load_image,
    load_mask,
    load_thumbnail,
    orientation_matrix,
    save_exr,
    save_image,
    save_mask,
)
from reffusion.io.ply import load_ply, load_points, save_ply, save_points
from reffusion.io.scene import (
    load_mask_sets,
    load_raw_masks,
    load_references,
    load_scene,
    load_views,
    save_mask_sets,
    save_references,
    save_scene,
)
from reffusion.types import MaskSet, Reference, Similarity


def test_io_costs_no_torch():
    code = "import sys, reffusion.io; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_images_round_trip_and_floats_are_rounded(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (5, 9, 3)).astype(np.uint8)
    save_image(tmp_path / "deep" / "x.png", pixels)
    assert np.array_equal(load_image(tmp_path / "deep" / "x.png"), pixels)
    assert image_size(tmp_path / "deep" / "x.png") == (9, 5)
    save_image(tmp_path / "f.png", pixels / np.float32(255))
    assert np.array_equal(load_image(tmp_path / "f.png"), pixels)
    save_image(tmp_path / "clip.png", np.array([[[-1.0, 0.5, 2.0]]]))
    assert load_image(tmp_path / "clip.png").tolist() == [[[0, 128, 255]]]


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "LA"])
def test_images_of_every_kind_become_rgb(tmp_path, mode):
    Image.new("RGB", (4, 3), (102, 102, 102)).convert(mode).save(tmp_path / "x.png")
    assert np.array_equal(load_image(tmp_path / "x.png"), np.full((3, 4, 3), 102))


def test_orientation_is_obeyed_only_on_request(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (40, 20)).save(tmp_path / "x.jpg", exif=exif)
    assert load_image(tmp_path / "x.jpg").shape == (20, 40, 3) and image_size(tmp_path / "x.jpg") == (40, 20)
    assert load_image(tmp_path / "x.jpg", upright=True).shape == (40, 20, 3)
    assert image_size(tmp_path / "x.jpg", upright=True) == (20, 40)


def test_unreadable_pictures_are_named(tmp_path):
    (tmp_path / "text.png").write_text("no picture")
    pixels = np.random.default_rng(0).integers(0, 256, (50, 50, 3)).astype(np.uint8)
    save_image(tmp_path / "whole.png", pixels)
    (tmp_path / "cut.png").write_bytes((tmp_path / "whole.png").read_bytes()[:2000])
    Image.fromarray(np.zeros((4, 4), np.float32)).save(tmp_path / "deep.tiff")
    for name in ("text.png", "cut.png", "absent.png", "deep.tiff"):
        with pytest.raises(ValueError, match=name):
            load_image(tmp_path / name)
    with pytest.raises(ValueError, match="not finite"):
        save_image(tmp_path / "nan.png", np.full((2, 2, 3), np.nan))


def test_a_tiff_of_float_colors_is_named(tmp_path):
    cv2.imwrite(str(tmp_path / "x.tif"), np.zeros((4, 5, 3), np.float32))
    with pytest.raises(ValueError, match=r"x\.tif: float pixels; save it as a picture of 8 or 16 bits"):
        load_image(tmp_path / "x.tif")


def test_own_masks_come_back_as_they_were(tmp_path):
    truth = np.random.default_rng(0).random((6, 8)) < 0.5
    save_mask(tmp_path / "x.png", truth)
    assert np.array_equal(load_mask(tmp_path / "x.png"), truth)
    assert np.array_equal(load_mask(tmp_path / "x.png", (3, 4)), truth[1::2, 1::2])
    Image.fromarray(truth.astype(np.uint8)).save(tmp_path / "ones.png")
    with pytest.raises(ValueError, match=r"ones\.png.*0 and 255"):
        load_mask(tmp_path / "ones.png")


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P"])
def test_transparent_pixels_are_shown_over_black(tmp_path, mode):
    """Alpha is straight. The palette has one transparent entry, as in a GIF or an 8-bit PNG."""
    color = np.array([[[200, 200, 200], [200, 200, 200], [90, 90, 90]]], np.uint8)
    alpha = np.array([[255, 0 if mode == "P" else 51, 255]], np.uint8)
    options = {"transparency": 1} if mode == "P" else {}
    if mode == "P":
        picture = Image.fromarray(np.array([[0, 1, 2]], np.uint8), "P")
        picture.putpalette([200, 200, 200, 200, 200, 200, 90, 90, 90])
    else:
        picture = Image.fromarray(np.dstack([color, alpha])).convert(mode)
    picture.save(tmp_path / "x.png", **options)
    assert load_image(tmp_path / "x.png")[0, :, 0].tolist() == [200, 0 if mode == "P" else 40, 90]
    assert load_thumbnail(tmp_path / "x.png", 3)[0, :, 1].tolist() == [200, 0 if mode == "P" else 40, 90]
    assert load_alpha(tmp_path / "x.png").tolist() == alpha.tolist()
    picture.convert("RGB").convert("RGBA").save(tmp_path / "opaque.png")
    assert load_alpha(tmp_path / "opaque.png") is None


def test_exr_keeps_every_bit(tmp_path):
    depth = np.random.default_rng(0).normal(size=(7, 11)).astype(np.float32) * 1e6
    depth[0, 0] = 0.0
    save_exr(tmp_path / "sub" / "depth.exr", depth)
    assert np.array_equal(load_exr(tmp_path / "sub" / "depth.exr"), depth)
    time.sleep(1.1)  # the format has a date in seconds, which must not change the bytes
    save_exr(tmp_path / "again.exr", depth)
    assert (tmp_path / "again.exr").read_bytes() == (tmp_path / "sub" / "depth.exr").read_bytes()


def test_json_and_labels(tmp_path):
    value = {"a": 0.1 + 0.2, "b": [1, None, "ü"]}
    save_json(tmp_path / "x.json", value)
    assert load_json(tmp_path / "x.json") == value
    with pytest.raises(ValueError):
        save_json(tmp_path / "y.json", {"a": float("nan")})
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(ValueError, match=r"bad\.json"):
        load_json(tmp_path / "bad.json")
    labels = torch.rand(10) < 0.5
    save_labels(tmp_path / "labels.npy", labels)
    assert torch.equal(load_labels(tmp_path / "labels.npy"), labels)
    with pytest.raises(ValueError, match="bool"):
        save_labels(tmp_path / "labels.npy", torch.zeros(3))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_ply_round_trip_is_exact(tmp_path, degree):
    gaussians = random_gaussians(5, degree)
    save_ply(tmp_path / "g.ply", gaussians)
    again = load_ply(tmp_path / "g.ply")
    again.zip_map(gaussians, lambda a, b: torch.testing.assert_close(a, b, rtol=0, atol=0))


def test_ply_is_the_layout_that_viewers_expect(tmp_path):
    gaussians = random_gaussians(4, 3)
    save_ply(tmp_path / "g.ply", gaussians)
    vertex = PlyData.read(str(tmp_path / "g.ply"))["vertex"]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(45)] + ["opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert [p.name for p in vertex.properties] == names and all(p.val_dtype == "f4" for p in vertex.properties)
    # The file lists the 15 coefficients of red first, then those of green, then those of blue.
    assert np.array_equal(vertex["f_rest_0"], gaussians.sh[:, 1, 0])
    assert np.array_equal(vertex["f_rest_14"], gaussians.sh[:, 15, 0])
    assert np.array_equal(vertex["f_rest_15"], gaussians.sh[:, 1, 1])
    assert np.array_equal(vertex["f_rest_44"], gaussians.sh[:, 15, 2])


def test_ply_goes_back_to_the_scenes_frame(tmp_path):
    gaussians, near = random_gaussians(50, 1), Similarity(0.25, np.array([1.0, -2.0, 3.0]))
    save_ply(tmp_path / "g.ply", gaussians, near)
    vertex = PlyData.read(str(tmp_path / "g.ply"))["vertex"]
    assert vertex["x"].dtype == np.float32
    np.testing.assert_allclose(vertex["y"], gaussians.means[:, 1].numpy() * 4 - 2, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(vertex["scale_0"], gaussians.log_scales[:, 0].numpy() + np.log(4), rtol=1e-6)
    again = load_ply(tmp_path / "g.ply", near)
    torch.testing.assert_close(again.means, gaussians.means, rtol=0, atol=1e-6)
    torch.testing.assert_close(again.log_scales, gaussians.log_scales, rtol=1e-6, atol=1e-6)
    assert torch.equal(again.sh, gaussians.sh)


def test_ply_of_a_geo_referenced_scene_loses_nothing(tmp_path):
    gaussians, far = random_gaussians(50, 0), Similarity(1.0, np.array([4e6, 5e6, 300.0]))
    save_ply(tmp_path / "g.ply", gaussians, far)
    torch.testing.assert_close(load_ply(tmp_path / "g.ply", far).means, gaussians.means, rtol=0, atol=1e-6)


def test_wrong_ply_files_are_named(tmp_path):
    save_points(tmp_path / "points.ply", np.zeros((3, 3)), np.zeros((3, 3), np.uint8))
    (tmp_path / "text.ply").write_text("hello")
    nan = random_gaussians(3, 0)
    nan.means[1:] = float("nan")
    save_ply(tmp_path / "nan.ply", nan)
    for name, why in (
        ("points.ply", "f_dc_0"),
        ("text.ply", "PLY"),
        ("nan.ply", "2 of 3 splats hold NaN or infinite values"),
        ("no.ply", "no such file"),
    ):
        with pytest.raises(ValueError, match=rf"{name}.*{why}"):
            load_ply(tmp_path / name)


def test_points_round_trip(tmp_path):
    points = np.random.default_rng(0).normal(size=(6, 3)) * 1e6
    colors = np.arange(18, dtype=np.uint8).reshape(6, 3)
    save_points(tmp_path / "p.ply", points, colors)
    again = load_points(tmp_path / "p.ply")
    assert np.array_equal(again[0], points) and np.array_equal(again[1], colors)


def test_scene_round_trip_in_full_precision(tmp_path):
    scene = random_scene()
    save_scene(tmp_path, scene)
    again = load_scene(tmp_path)
    assert list(again.cameras) == ["a", "b", "c"] and (again.train, again.test) == (scene.train, scene.test)
    assert again.clean == scene.clean and again.similarity.scale == scene.similarity.scale
    assert np.array_equal(again.similarity.offset, scene.similarity.offset)
    assert np.array_equal(again.points, scene.points) and np.array_equal(again.point_colors, scene.point_colors)
    for name, camera in scene.cameras.items():
        np.testing.assert_allclose(again.cameras[name].world_to_camera, camera.world_to_camera, atol=4e-16)
        assert np.array_equal(again.cameras[name].intrinsics, camera.intrinsics)
    (tmp_path / "sparse" / "0" / "images.bin").unlink()
    with pytest.raises(ValueError, match=r"images\.bin"):
        load_scene(tmp_path)


def test_quaternions_survive_half_turns():
    for axis in np.eye(3):
        half_turn = 2 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(
            rotations.quaternion_to_pose(rotations.rotation_to_quaternion(half_turn), axis)[:3, :3], half_turn
        )
    generator = np.random.default_rng(1)
    for _ in range(50):
        rotation = random_rotation(generator)
        again = rotations.quaternion_to_pose(rotations.rotation_to_quaternion(rotation), np.zeros(3))[:3, :3]
        np.testing.assert_allclose(again, rotation, atol=1e-15)


def test_our_model_is_read_by_colmap(tmp_path):
    import pycolmap

    scene = random_scene()
    save_scene(tmp_path, scene)
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    assert {i.name for i in model.images.values()} == {"a.png", "b.png", "c.png"}
    for image in model.images.values():
        expected = scene.cameras[image.name[0]]
        np.testing.assert_allclose(image.cam_from_world().matrix(), expected.world_to_camera[:3], atol=1e-12)
        assert list(model.cameras[image.camera_id].params) == [expected.fx, expected.fy, expected.cx, expected.cy]
    np.testing.assert_allclose([p.xyz for _, p in sorted(model.points3D.items())], scene.points)


def test_mask_sets_and_references(tmp_path):
    generator, scene = np.random.default_rng(0), random_scene()
    draw = lambda: generator.random((8, 12)) < 0.5
    sets = {name: MaskSet(draw(), draw(), draw(), draw()) for name in scene.cameras}
    save_mask_sets(tmp_path, sets)
    again = load_mask_sets(tmp_path, scene.cameras)
    for name, mask_set in sets.items():
        for kind in ("raw", "consistent", "unobserved", "invent"):
            assert np.array_equal(getattr(again[name], kind), getattr(mask_set, kind))
    image = generator.integers(0, 256, (8, 12, 3)).astype(np.uint8)
    save_references(tmp_path / "reference", [Reference(scene.cameras["b"], image, draw())])
    (reference,) = load_references(tmp_path / "reference", scene)
    assert reference.camera is scene.cameras["b"] and np.array_equal(reference.image, image) and reference.depth is None
    depth = np.where(draw(), np.nan, generator.random((8, 12))).astype(np.float32)
    save_references(tmp_path / "deep", [Reference(scene.cameras["b"], image, draw(), depth)])
    (deep,) = load_references(tmp_path / "deep", scene)
    assert np.array_equal(deep.depth, depth, equal_nan=True)
    save_exr(tmp_path / "deep" / "depth" / "b.exr", depth[:4])
    with pytest.raises(ValueError, match=r"b\.png.*its depth must have their view's size"):
        load_references(tmp_path / "deep", scene)
    save_image(tmp_path / "reference" / "references" / "z.png", image)
    with pytest.raises(ValueError, match=r"z\.png.*no view"):
        load_references(tmp_path / "reference", scene)


def test_views_and_masks_of_a_poses_folder(tmp_path):
    image, mask = np.full((4, 6, 3), 7, np.uint8), np.eye(4, 6, dtype=bool)
    save_image(tmp_path / "images" / "a.png", image)
    save_mask(tmp_path / "masks" / "a.png", mask)
    save_mask(tmp_path / "test_masks" / "t.png", mask)
    assert np.array_equal(load_views(tmp_path, ["a"])["a"], image)
    assert list(load_raw_masks(tmp_path, ["a", "b"])) == ["a"] and list(load_test_masks(tmp_path)) == ["t"]


@pytest.mark.parametrize("ending", ["jpg", "png", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_tags_of_every_format(tmp_path, ending, orientation):
    """The stored pixels are those of the file, and the upright ones those that a viewer shows."""
    stored = np.kron(np.random.default_rng(0).integers(0, 256, (3, 5, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    path, exif = tmp_path / f"x.{ending}", Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(stored).save(path, exif=exif, **({"quality": 100, "subsampling": 0} if ending == "jpg" else {}))
    reference = Image.fromarray(stored)
    reference.getexif()[0x0112] = orientation
    shown = np.array(ImageOps.exif_transpose(reference))
    for upright, right in ((False, stored), (True, shown)):
        assert image_size(path, upright) == right.shape[1::-1]
        assert np.abs(load_image(path, upright).astype(int) - right).max() <= 4
        assert np.abs(load_thumbnail(path, 40, upright).astype(int) - right).max() <= 4
    matrix = orientation_matrix(path)
    rows, columns = np.mgrid[: stored.shape[0], : stored.shape[1]]
    places = np.stack([(columns + 0.5) / stored.shape[1], (rows + 0.5) / stored.shape[0], np.ones(rows.shape)], -1)
    at = (places @ matrix.T * shown.shape[1::-1]).astype(int)
    assert np.array_equal(shown[at[..., 1], at[..., 0]], stored)
