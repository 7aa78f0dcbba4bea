"""Warnings about unusual captures (inverted or inconsistent masks, exposure jumps), and none for good captures."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes import wall_scene
from scenes.cameras import make_scene
from scenes.capture import make_truth, write_capture
from scenes.wall_scene import front_camera

from reffusion import geometry
from reffusion.capture.checks import sanity
from reffusion.capture.checks.sanity import find_odd_masks, find_odd_photographs
from reffusion.capture.image_detail import sample_visible
from reffusion.capture.load import load_capture
from reffusion.geometry import pixel_rays
from reffusion.io.arrays import load_json, save_json
from reffusion.io.images import image_size, save_mask
from reffusion.io.scene import load_raw_masks, load_scene, load_views
from reffusion.types import Camera
from report import check


@pytest.fixture(scope="module")
def wall_capture(tmp_path_factory):
    """Scene, masks and pictures of a wall with a square before it; the wall's texture has enough detail to localize."""
    folder = tmp_path_factory.mktemp("odd")
    poses, _, _ = wall_scene.write_poses_and_fit(folder, 1.5)
    scene = load_scene(poses)
    return scene, load_raw_masks(folder / "raw_masks", scene.train), load_views(poses, scene.cameras)


def describe_oddities(scene, masks, pictures) -> str:
    return "; ".join([*find_odd_masks(scene, masks), *find_odd_photographs(scene, pictures.__getitem__)])


def test_a_good_capture_has_no_warning(wall_capture):
    scene, masks, pictures = wall_capture
    assert describe_oddities(scene, masks, pictures) == ""
    assert describe_oddities(replace(scene, points=scene.points[:3]), {}, pictures) == ""


def test_inverted_masks(wall_capture):
    scene, masks, pictures = wall_capture
    assert "the masks cover 9" in describe_oddities(scene, {name: ~mask for name, mask in masks.items()}, pictures)
    one = describe_oddities(scene, masks | {"a1": ~masks["a1"]}, pictures)
    assert "the mask of a1 covers more than 50%" in one and "inverted?" in one


def test_a_blurred_photograph_is_named(wall_capture):
    scene, masks, pictures = wall_capture
    draws = np.random.default_rng(0)
    grain = {
        name: (each * 0.2 + draws.integers(0, 150, each.shape)).astype(np.uint8) for name, each in pictures.items()
    }
    assert describe_oddities(scene, masks, grain) == ""
    blurred = grain | {"a2": cv2.GaussianBlur(grain["a2"], (0, 0), 3)}
    assert describe_oddities(scene, masks, blurred) == (
        "blurred photographs: a2; leave them out by `exclude: [a2]` in scene.yaml"
    )


def test_masks_that_disagree_in_3d(wall_capture):
    scene, masks, pictures = wall_capture
    elsewhere = np.roll(masks["a3"], 40, 0)
    assert describe_oddities(scene, masks | {"a3": elsewhere}, pictures) == (
        "the mask of a3 shows something else than those of the other views do"
    )
    empty = np.zeros_like(masks["a3"])
    assert describe_oddities(scene, masks | {"a3": empty}, pictures) == (
        "the mask of a3 is empty, though the object of the other masks lies in its view; is it hidden there?"
    )
    away = replace(scene.cameras["a3"], cx=1e4)
    elsewhere_scene = replace(scene, cameras=scene.cameras | {"a3": away})
    assert "is empty" not in describe_oddities(elsewhere_scene, masks | {"a3": empty}, pictures)
    far = {name: np.roll(mask, 17 * k, 0) for k, (name, mask) in enumerate(masks.items())}
    assert "masks do not agree in 3D" in describe_oddities(scene, far, pictures)
    assert describe_oddities(replace(scene, clean=frozenset({"a3"})), masks | {"a3": elsewhere}, pictures) == ""


def test_masks_of_a_small_object_in_a_deep_scene_agree():
    """A ball of radius 0.03 at distance 1 from ten cameras, in a scene whose points reach to a distance of 40."""
    draws, cameras, masks = np.random.default_rng(0), {}, {}
    for k in range(10):
        turn, pose = np.radians(9 * k), np.eye(4)
        pose[:3, :3] = [[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]]
        pose[2, 3] = 1.0
        camera = Camera(f"v{k}", 64, 64, 250.0, 250.0, 32.0, 32.0, pose)
        rays = pixel_rays(camera)
        apart = np.linalg.norm(rays - [0, 0, 1] * rays[..., 2:], axis=-1)
        cameras[camera.name], masks[camera.name] = camera, apart < 0.03
    directions = draws.standard_normal((40_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = directions * np.geomspace(0.5, 40, 40_000)[:, None]
    colors = np.zeros((40_000, 3), np.uint8)
    scene = make_scene(cameras, points=points, colors=colors)
    assert sanity._warn_inconsistent(scene, masks) == []
    moved = masks | {"v4": np.roll(masks["v4"], 20, 0)}
    assert sanity._warn_inconsistent(scene, moved) == [
        "the mask of v4 shows something else than those of the other views do"
    ]


def test_exposure_that_jumps(wall_capture):
    scene, masks, pictures = wall_capture
    dark = (pictures["a2"] * 0.4).astype(np.uint8)
    assert "exposed otherwise than the rest (a2; a2 is 0.4" in describe_oddities(scene, masks, pictures | {"a2": dark})


def test_a_black_photograph_is_to_be_left_out(wall_capture):
    scene, masks, pictures = wall_capture
    warned = describe_oddities(scene, masks, pictures | {"a2": np.zeros_like(pictures["a2"])})
    assert "black photographs: a2; leave them out by `exclude: [a2]`" in warned and "exposed otherwise" not in warned


def test_the_sheet_shows_every_mask_over_its_photograph(tmp_path, wall_capture):
    _, masks, _ = wall_capture
    poses, _, _ = wall_scene.write_poses_and_fit(tmp_path / "wall", 1.5)
    save_json(tmp_path / "wall/raw_masks/warnings.json", ["the mask of a3 is odd"])
    path, lines = check.make(tmp_path / "wall")
    assert lines == ["the mask of a3 is odd"] and image_size(path)[0] > 3 * check.WIDTH
    overlay = check.overlay_masks(poses, tmp_path / "wall/raw_masks", "a3")
    assert overlay.shape[:2] == (180, 240)
    assert (np.abs(overlay.astype(int) - check.TINT).sum(-1) < 300).mean() > 0.5 * masks["a3"].mean()


def test_the_sheet_shows_the_masks_of_several_objects(tmp_path, wall_capture):
    _, masks, _ = wall_capture
    poses, _, _ = wall_scene.write_poses_and_fit(tmp_path, 1.5, masks={})
    halves = {"left": masks["a3"].copy(), "right": masks["a3"].copy()}
    halves["left"][:, 48:], halves["right"][:, :48] = False, False
    plain = check.overlay_masks(poses, tmp_path / "raw_masks", "a3")
    for name, mask in halves.items():
        save_mask(tmp_path / f"raw_masks/masks/{name}/a3.png", mask)
    tinted = (check.overlay_masks(poses, tmp_path / "raw_masks", "a3") != plain).any(-1)
    assert tinted.mean() == pytest.approx(masks["a3"].mean(), rel=0.1)


def test_check_says_how_structure_from_motion_went(tmp_path, monkeypatch, capsys):
    poses, _, _ = wall_scene.write_poses_and_fit(tmp_path / "wall", 1.5)
    save_json(poses / "sfm.json", {"summary": "structure from motion: 3 of 4 photographs"})
    monkeypatch.setattr("sys.argv", ["check", "--scene", "wall", "--runs", str(tmp_path)])
    check.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "structure from motion: 3 of 4 photographs"
    assert lines[1].startswith("no warnings; masks drawn over the photographs: ")


def test_the_sheet_needs_the_stage_raw_masks(tmp_path):
    with pytest.raises(ValueError, match=r"run `make scene=x raw_masks` first"):
        check.make(tmp_path / "x")


def test_points_outside_a_picture_hide_nothing():
    camera, picture = front_camera("v", 0.0), np.zeros((72, 96, 1))
    corner = geometry.unproject(np.full((72, 96), 2.0), camera)[0, 0]
    near_but_outside = corner * 0.5 - [1.0, 0.0, 0.0]
    values = sample_visible(camera, np.stack([corner, near_but_outside]), picture)[:, 0]
    assert values[0] == 0 and np.isnan(values[1])


def test_cameras_with_positions_in_another_unit_are_named(tmp_path):
    write_capture(tmp_path, "transforms", make_truth())
    assert not load_capture(tmp_path).warnings
    cameras = load_json(tmp_path / "transforms.json")
    for row in cameras["frames"][0]["transform_matrix"][:3]:
        row[3] *= 1000
    save_json(tmp_path / "transforms.json", cameras)
    (warning,) = load_capture(tmp_path).warnings
    assert warning.startswith("1 of ") and "times as far away as usual" in warning
