"""The check of poses: photographs that contradict their poses are left out.

A warning names them, and the line of scene.yaml that would keep them.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scenes import capture as captures
from scenes.cameras import world_rays
from scipy.spatial.transform import Rotation

from reffusion.capture.checks.pose_check import check_poses
from reffusion.capture.views import load_placed_views
from reffusion.io.files import BadInput
from reffusion.io.images import load_image, save_image
from reffusion.io.scene import load_scene
from reffusion.params.poses import Params
from reffusion.params.reference import ReferenceSpec
from reffusion.references.files import load_reference_files
from reffusion.types import Camera
from report import check
from stages import poses

WALL, SQUARE, HALF = 0.6, -0.4, 0.5  # depths of a wall and of a square before the wall; half the square's side
BAD = "v04"


def smooth_textures() -> tuple[np.ndarray, np.ndarray]:
    """Return two images of smooth noise, float32 [256, 256, 3], with values around 128 on the scale 0 to 255."""
    noise = np.random.default_rng(5).uniform(0, 255, (2, 256, 256, 3)).astype(np.float32)
    blurred = (
        sum(weight * cv2.GaussianBlur(each, (0, 0), width) for width, weight in ((2, 4), (8, 12))) for each in noise
    )
    return tuple((each - each.mean()) * 1.5 + 128 for each in blurred)


def render_two_planes(camera: Camera, images: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Render the textured wall and square as the camera sees them, uint8 [H, W, 3]; `images` are the two textures."""
    rays = world_rays(camera)
    at = [camera.center + rays * ((depth - camera.center[2]) / rays[..., 2:]) for depth in (WALL, SQUARE)]
    pictures = [
        cv2.remap(
            image,
            *np.moveaxis(((places[..., :2] + 2) * 64).astype(np.float32), -1, 0),
            cv2.INTER_LINEAR,
            None,
            cv2.BORDER_REFLECT,
        )
        for image, places in zip(images, at, strict=True)
    ]
    on_square = (np.abs(at[1][..., :2]) < HALF).all(-1, keepdims=True)
    return np.where(on_square, pictures[1], pictures[0]).clip(0, 255).astype(np.uint8)


def sample_two_planes() -> np.ndarray:
    draws = np.random.default_rng(6)
    wall = np.c_[draws.uniform(-1.2, 1.2, (900, 2)), np.full(900, WALL)]
    square = np.c_[draws.uniform(-HALF, HALF, (300, 2)), np.full(300, SQUARE)]
    return np.concatenate([wall, square])


TRUTH = replace(captures.make_truth(views=10), points=sample_two_planes())
CAMERAS = {
    name: Camera(name, captures.WIDTH, captures.HEIGHT, 90.0, 90.0, 48.0, 36.0, pose)
    for name, pose in TRUTH.world_to_camera.items()
}
PICTURES = {name: render_two_planes(camera, smooth_textures()) for name, camera in CAMERAS.items()}


def write_two_planes(folder: Path, **pictures: np.ndarray) -> Path:
    """Write a COLMAP capture of the wall and the square to `folder`; return `folder`.

    Args:
        pictures: view name to image, uint8 [H, W, 3], in place of the right photograph.
    """
    for name, image in (PICTURES | pictures).items():
        save_image(folder / "images" / f"{name}.png", image)
    captures.write_masks(folder / "masks", TRUTH.world_to_camera)
    captures.write_model(folder / "sparse" / "0", TRUTH, ending=".png")
    return folder


def run_poses_with_warnings(folder: Path, **params) -> tuple[Path, list[str]]:
    """Run the stage `poses`; return its output folder and the warnings that it wrote."""
    out = folder.parent / "run" / "poses"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        poses.run(Params(**params), out, scene=folder)
    out.with_name("raw_masks").mkdir(exist_ok=True)
    path = out / "warnings.json"
    return out, json.loads(path.read_text()) if path.exists() else []


def contradicting_views(cameras=CAMERAS, **pictures: np.ndarray) -> tuple[str, ...]:
    return check_poses(list(cameras.values()), TRUTH.points, (PICTURES | pictures).__getitem__).contradicting


# ----------------------------------------------------------------------------- which photographs contradict their poses


def test_right_photographs_are_never_named():
    draws = np.random.default_rng(0)
    assert contradicting_views() == ()
    bright = {n: (each * draws.uniform(0.6, 1.6)).clip(0, 255).astype(np.uint8) for n, each in PICTURES.items()}
    assert contradicting_views(**bright) == ()
    assert contradicting_views(**{n: cv2.GaussianBlur(each, (0, 0), 1) for n, each in PICTURES.items()}) == ()


def test_a_pattern_that_repeats_is_no_contradiction():
    rows, columns = np.mgrid[:256, :256] // 12
    tiles = np.repeat(((rows + columns) % 2 * 140 + 50)[..., None], 3, 2).astype(np.float32)
    tiled = {name: render_two_planes(camera, (tiles, tiles[::-1])) for name, camera in CAMERAS.items()}
    assert contradicting_views(**tiled) == ()
    assert contradicting_views(**tiled | {"v01": PICTURES["v01"]}) == ("v01",)


def test_photographs_that_show_something_else_are_named():
    swapped = {"v01": PICTURES["v06"], "v07": PICTURES["v00"]}
    assert contradicting_views(**swapped) == ("v01", "v07")
    assert contradicting_views(v03=PICTURES["v05"]) == ("v03",)
    assert contradicting_views(v03=np.ascontiguousarray(PICTURES["v03"][:, ::-1])) == ("v03",)
    assert contradicting_views(v03=np.ascontiguousarray(PICTURES["v03"][::-1, ::-1])) == ("v03",)


def test_a_pose_that_is_wrong_by_degrees_is_named():
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(np.radians([0.0, 4.0, 0.0])).as_matrix()
    turned = replace(CAMERAS["v05"], world_to_camera=turn @ CAMERAS["v05"].world_to_camera)
    assert contradicting_views(CAMERAS | {"v05": turned}) == ("v05",)


def test_plain_photographs_and_few_points_tell_nothing():
    plain = {name: np.full_like(each, 90) for name, each in PICTURES.items()}
    assert contradicting_views(**plain) == ()
    few = check_poses(list(CAMERAS.values()), TRUTH.points[:40], PICTURES.__getitem__)
    assert (few.judged, few.contradicting) == (0, ())


# ------------------------------------------------------------------------------- how the stage treats these photographs


def test_a_photograph_that_contradicts_its_pose_is_left_out(tmp_path):
    out, messages = run_poses_with_warnings(write_two_planes(tmp_path / "scene", **{BAD: PICTURES["v08"]}))
    scene = load_scene(out)
    assert scene.outliers == (BAD,) and BAD not in scene.cameras and len(scene.train) == 9
    assert json.loads((out / "views.json").read_text())["outliers"] == [BAD]
    assert messages == [
        "photographs that contradict their poses, or show something else than the others, are left out: v04; in "
        'scene.yaml, `exclude: ["v04"]` leaves them out for good, `keep: ["v04"]` uses them without this warning'
    ]
    _, lines = check.make(out.parent)
    assert lines == messages
    assert check.view_role(BAD, json.loads((out / "views.json").read_text())) == "left out"


def test_what_the_other_photographs_show_stays_as_it_was(tmp_path):
    whole, messages = run_poses_with_warnings(write_two_planes(tmp_path / "a" / "scene"))
    less, _ = run_poses_with_warnings(write_two_planes(tmp_path / "b" / "scene", **{BAD: PICTURES["v08"]}))
    assert messages == [] and "outliers" not in json.loads((whole / "views.json").read_text())
    for name, camera in load_scene(less).cameras.items():
        assert np.allclose(camera.world_to_camera, load_scene(whole).cameras[name].world_to_camera, atol=1e-12)


def test_keep_uses_a_view_and_exclude_drops_it_silently(tmp_path):
    folder = write_two_planes(tmp_path / "scene", **{BAD: PICTURES["v08"]})
    out, messages = run_poses_with_warnings(folder, keep=[f"{BAD}.png"])
    assert messages == [] and BAD in load_scene(out).train and load_scene(out).suspects == ()
    out, messages = run_poses_with_warnings(folder.parent / "scene", exclude=[BAD])
    assert messages == [] and BAD not in load_scene(out).cameras and load_scene(out).outliers == ()
    save_image(folder / "images" / "v07.png", PICTURES["v01"])
    out, (line,) = run_poses_with_warnings(folder, exclude=[BAD])
    assert 'are left out: v07; in scene.yaml, `exclude: ["v04", "v07"]`' in line


def test_test_and_clean_views_stay_and_are_named(tmp_path):
    folder = write_two_planes(tmp_path / "scene", v02=PICTURES["v07"], v06=PICTURES["v01"])
    out, (test, clean) = run_poses_with_warnings(folder, test=["v02"], clean=["v06"])
    scene = load_scene(out)
    assert scene.suspects == ("v02", "v06") and scene.outliers == ()
    assert "v02" in scene.test and "v06" in scene.clean
    assert "test photographs that contradict their poses" in test and "are scored all the same: v02;" in test
    assert (
        "clean photographs that contradict" in clean
        and 'used all the same: v06; in scene.yaml, `exclude: ["v06"]`' in clean
    )


def test_where_most_contradict_nothing_is_left_out(tmp_path):
    noise = np.random.default_rng(1).integers(0, 256, (10, 9, 12, 3)).astype(np.uint8)
    blocks = {n: np.kron(each, np.ones((8, 8, 1), np.uint8)) for n, each in zip(PICTURES, noise, strict=True)}
    out, messages = run_poses_with_warnings(write_two_planes(tmp_path / "scene", **blocks))
    assert messages == ["at least 5 of 10 photographs contradict their poses; do poses and pictures belong together?"]
    assert len(load_scene(out).train) == 10


def test_no_fewer_than_three_training_views_are_left(tmp_path):
    folder = write_two_planes(tmp_path / "scene", v05=PICTURES["v09"])
    out, (line,) = run_poses_with_warnings(folder, train=["v04", "v05", "v06"])
    assert "are used all the same, for fewer than 3 would be left: v05;" in line
    assert load_scene(out).train == ("v04", "v05", "v06")


def test_what_scene_yaml_brings_for_such_a_view_is_refused(tmp_path):
    folder = write_two_planes(tmp_path / "scene", **{BAD: PICTURES["v08"]})
    refusal = (
        "it is for the view 'v04', which is left out: its photograph contradicts its pose; choose another view, or add "
        '`keep: ["v04"]` to scene.yaml'
    )
    save_image(folder / "reference.png", PICTURES[BAD])
    reference = {"view": "v04.png", "image": "reference.png"}
    with pytest.raises(BadInput) as refused:
        run_poses_with_warnings(folder, reference=reference)
    assert str(refused.value) == f"scene.yaml: reference: {refusal}"
    out, _ = run_poses_with_warnings(folder)
    with pytest.raises(BadInput) as refused:  # the reader of references names the view too, after `poses` is done
        load_reference_files(folder, load_placed_views(out), ReferenceSpec(**reference))
    assert str(refused.value) == f"{folder / 'reference.png'}: {refusal}"
    out, _ = run_poses_with_warnings(folder, reference=reference, keep=[BAD])
    assert [each.view for each in load_reference_files(folder, load_placed_views(out), ReferenceSpec(**reference))] == [
        BAD
    ]


def test_a_view_is_excluded_or_kept(tmp_path):
    folder = write_two_planes(tmp_path / "scene")
    with pytest.raises(BadInput, match=r"scene.yaml: v01 in both exclude and keep; name a view in one of them"):
        run_poses_with_warnings(folder, exclude=["v01"], keep=["v01.png"])
    with pytest.raises(BadInput, match=r"scene.yaml: exclude: there is no view 'v77'"):
        run_poses_with_warnings(folder, exclude=["v77"])
    assert np.array_equal(load_image(folder / "images" / "v01.png"), PICTURES["v01"])
