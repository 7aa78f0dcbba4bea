"""`patch` for scenes that were moved, turned, scaled, cropped, filtered, merged or quantized in the editor."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes.cameras import make_camera
from scenes.edited_capture import remove_pictures, write_edited_capture
from scenes.random_scene import random_gaussians
from scipy.spatial.transform import Rotation

from reffusion.gaussians.movement import Movement, fit_movement
from reffusion.io.arrays import load_json, load_labels
from reffusion.io.ply import load_ply, save_ply, save_splats
from reffusion.io.scene import load_scene
from reffusion.splat import rasterizer
from reffusion.splat.rotation import rotate_gaussians
from reffusion.types import Gaussians, Similarity
from report import patch
from stages import poses
from stages.plan import poses as planned

pytestmark = [pytest.mark.integration, pytest.mark.filterwarnings("ignore:no photographs")]

HERE = Similarity(1.0, np.zeros(3))
TURN = Rotation.from_euler("xyz", (20, -70, 130), degrees=True).as_matrix()
LOOK_DOWN = np.array([np.eye(4)] * 3)
LOOK_DOWN[:, :3, 3] = (0.1, 0, 5), (0.9, 0, 5), (0.5, 0.6, 5)
MOVES = {
    "shifted": Movement(1.0, np.eye(3), np.array([3.0, -1.0, 0.5])),
    "scaled": Movement(7.3, np.eye(3), np.zeros(3)),
    "turned": Movement(1.0, TURN, np.zeros(3)),
    "all": Movement(0.04, TURN, np.array([-2.0, 9.0, 0.1])),
}


def room(count: int = 6000, degree: int = 3) -> tuple[Gaussians, np.ndarray]:
    """Return Gaussians of a floor, walls and haze around a ball, and bool [N], True for the ball."""
    draws = np.random.default_rng(5)
    made = random_gaussians(count, degree)
    means = draws.uniform((-2, -2, 0), (2, 2, 2), (count, 3))
    means[: count // 2, 2] *= 0.02
    means[count // 2 : 3 * count // 4, 1] = 2 + 0.02 * means[count // 2 : 3 * count // 4, 1]
    ball = np.arange(count) < count // 10
    means[ball] = (0.3, 0.2, 0.4) + 0.12 * draws.normal(size=(int(ball.sum()), 3))
    made = replace(made, sh=(0.3 * made.sh).clamp(-1, 1), means=torch.from_numpy(means).float())
    return replace(made, log_scales=0.3 * made.log_scales - 3.5), ball


def move(made: Gaussians, movement: Movement) -> Gaussians:
    turned = rotate_gaussians(made, movement.rotation)
    means = torch.from_numpy(movement.apply(made.means.double().numpy())).float()
    return replace(turned, means=means, log_scales=made.log_scales + float(np.log(movement.scale)))


def take(made: Gaussians, kept: np.ndarray) -> Gaussians:
    return made.map(lambda values: values[torch.from_numpy(kept)])


def run_poses(folder, before: Gaussians, after: Gaussians, name: str = "after.ply"):
    """Write a folder with the two scenes, run `poses`, and return its results."""
    save_ply(folder / "before.ply", before)
    frames = [{"file_path": f"{k}.png", "transform_matrix": LOOK_DOWN[k].tolist()} for k in range(3)]
    lens = {"w": 64, "h": 48, "fl_x": 50, "fl_y": 50, "cx": 32, "cy": 24, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(lens))
    save_splats(folder / name, after, HERE)
    params = poses.Params(gaussians="before.ply", cleaned=name, masks="none", longest=64)
    planned.preview(params, folder)
    (out := folder / "runs" / "s" / "poses").mkdir(parents=True)
    poses.run(params, out, scene=folder)
    return out


def finish(out, removed: np.ndarray):
    """Write what the later stages would: the scene without the removed Gaussians; return the patched scene."""
    home, kept = out.parent, torch.from_numpy(~removed)
    result = load_ply(out / "gaussians.ply").map(lambda values: values[kept])
    (home / "initialize").mkdir()
    np.save(home / "initialize" / "labels.npy", np.arange(len(result)) < 7)
    save_ply(home / "evaluate" / "scene.ply", result, load_scene(out).similarity)
    (home / "evaluate" / "receipt.json").write_text('{"needs": {"initialize": "x", "distill": null}}')
    said = patch.make(home)
    return load_ply(home / "patch" / patch.WHOLE), said


# ---------------------------------------------------------------------------------------------- rotation


def test_rotated_gaussians_look_the_same_from_a_rotated_camera():
    made = random_gaussians(300, 3)
    view = make_camera("v", (48, 36), 40.0, (0.0, 0.0, -6.0))
    pose = np.eye(4)
    pose[:3, :3] = TURN.T
    turned = rotate_gaussians(made, TURN)
    render = lambda gaussians, camera: rasterizer.render(gaussians, camera, impl="torch").color.numpy()
    beside = replace(view, world_to_camera=view.world_to_camera @ pose)
    np.testing.assert_allclose(render(turned, beside), render(made, view), atol=2e-4)
    assert np.abs(render(replace(turned, sh=made.sh), beside) - render(made, view)).max() > 0.05


@pytest.mark.parametrize("mirrors", [False, True])
def test_a_movement_is_fitted(mirrors):
    points = np.random.default_rng(0).normal(size=(20, 3))
    rotation = TURN @ np.diag([-1.0, 1, 1]) if mirrors else TURN
    true = Movement(0.7, rotation, np.array([1.0, 2, 3]))
    found = fit_movement(points, true.apply(points), mirrors)
    np.testing.assert_allclose(found.apply(points), true.apply(points), atol=1e-12)
    assert found.mirrors == mirrors
    np.testing.assert_allclose(found.invert(true.apply(points)), points, atol=1e-12)


# ---------------------------------------------------------------------------------------------- edits


@pytest.mark.parametrize(("name", "ending"), [
    ("shifted", ".ply"), ("scaled", ".splat"), ("turned", ".glb"), ("all", ".spz"), ("all", ".compressed.ply"),
])  # fmt: skip
def test_a_moved_scene_is_recognized_and_the_result_is_where_the_user_left_it(tmp_path, name, ending):
    if ending in (".spz", ".compressed.ply"):
        pytest.importorskip("gsply")
    before, ball = room()
    after = move(take(before, ~ball), MOVES[name])
    order = torch.randperm(len(after), generator=torch.Generator().manual_seed(0))
    out = run_poses(tmp_path, before, after.map(lambda values: values[order]), f"after{ending}")
    assert np.count_nonzero(load_labels(out / "deleted.npy").numpy() != ball) <= 0.002 * len(ball)
    facts = load_json(out / "movement.json")
    found = Movement(facts["scale"], np.array(facts["rotation"]), np.array(facts["shift"]))
    corners, extent = before.means.double().numpy(), 4 * MOVES[name].scale
    error = np.abs(found.apply(corners) - MOVES[name].apply(corners)).max()
    assert error < (1e-5 if ending in (".ply", ".glb", ".splat") else 1e-3) * extent
    patched, _ = finish(out, load_labels(out / "deleted.npy").numpy())
    true = move(take(before, ~load_labels(out / "deleted.npy").numpy()), MOVES[name])
    added = len(patched) - len(true)
    assert 0 <= added <= 0.002 * len(ball)
    np.testing.assert_allclose(patched.means[: len(true)], true.means, atol=2 * error + 1e-6 * extent)
    np.testing.assert_allclose(patched.log_scales[: len(true)], true.log_scales, atol=2e-3)
    np.testing.assert_allclose(patched.sh[: len(true)], true.sh, atol=5e-3)


def test_rows_at_their_places_are_not_rounded(tmp_path):
    before, ball = room(2000, 1)
    out = run_poses(tmp_path, before, take(before, ~ball))
    assert not (out / "movement.json").exists() and not (out / "added.ply").exists()


def test_harmonics_that_the_editor_removed_come_back(tmp_path):
    before, ball = room()
    after = move(take(before, ~ball), MOVES["all"])
    out = run_poses(tmp_path, before, replace(after, sh=after.sh[:, :4]))
    np.testing.assert_array_equal(load_labels(out / "deleted.npy"), ball)
    patched, _ = finish(out, ball)
    np.testing.assert_allclose(patched.sh, after.sh, atol=1e-4)


@pytest.mark.parametrize("name", ["as it was", "all"])
@pytest.mark.parametrize("sphere", [False, True])
def test_what_was_cropped_is_not_filled_and_not_given_back(tmp_path, name, sphere, capsys):
    before, ball = room(12000)
    means = before.means.numpy()
    inside = np.linalg.norm(means - (0.3, 0.2, 0.4), axis=1) < 1.3 if sphere else (np.abs(means[:, :2]) < 1.2).all(1)
    after = take(before, inside & ~ball)
    out = run_poses(tmp_path, before, move(after, MOVES[name]) if name in MOVES else after)
    deleted = load_labels(out / "deleted.npy").numpy()
    holes = deleted & ~(load_labels(out / "scattered.npy").numpy() if (out / "scattered.npy").exists() else False)
    assert (holes & ball).sum() > 0.95 * ball.sum() and (holes & ~ball).sum() < 0.02 * ball.sum()
    assert "around what stays: cropped, and not filled" in capsys.readouterr().out
    patched, _ = finish(out, deleted)
    assert len(patched) - (inside & ~ball).sum() == pytest.approx(7, abs=7)


def test_an_object_beside_the_rest_is_not_cropped(tmp_path):
    draws = np.random.default_rng(0)
    before, _ = room(5000, 0)
    table = draws.uniform((-1, -1, 0), (1, 1, 0.02), (4000, 3))
    means = np.concatenate([table, draws.uniform((-0.2, -0.2, 0.02), (0.2, 0.2, 0.8), (1000, 3))])
    before, vase = replace(before, means=torch.from_numpy(means).float()), np.arange(5000) >= 4000
    out = run_poses(tmp_path, before, take(before, ~vase))
    np.testing.assert_array_equal(load_labels(out / "deleted.npy"), vase)
    assert not (out / "cropped.npy").exists()


def test_a_filter_for_opacity_leaves_no_hole(tmp_path):
    before, ball = room()
    faint = (np.arange(len(before)) % 3 == 0) & ~ball
    logits = before.opacity_logits.abs() + 1
    before = replace(before, opacity_logits=torch.where(torch.from_numpy(faint), -4.0 - logits, logits))
    out = run_poses(tmp_path, before, take(before, ~ball & ~faint))
    scattered = load_labels(out / "scattered.npy").numpy()
    np.testing.assert_array_equal(scattered, faint)
    np.testing.assert_array_equal(load_labels(out / "deleted.npy"), faint | ball)


@pytest.mark.parametrize("name", ["as it was", "all"])
def test_a_scene_that_was_merged_in_is_given_back(tmp_path, name, capsys):
    before, ball = room()
    other = random_gaussians(9000, 1)
    other = replace(
        other, means=other.means + torch.tensor([5.0, 0, 0]), sh=torch.cat([other.sh, torch.zeros(9000, 12, 3)], 1)
    )
    rest = take(before, ~ball)
    after = other.zip_map(rest, lambda one, two: torch.cat([one, two]))
    movement = MOVES.get(name, Movement(1.0, np.eye(3), np.zeros(3)))
    out = run_poses(tmp_path, before, move(after, movement) if name in MOVES else after)
    np.testing.assert_array_equal(load_labels(out / "deleted.npy"), ball)
    assert "and 9000 of its splats are new: they stay" in capsys.readouterr().out
    patched, _ = finish(out, ball)
    true = move(other, movement)
    np.testing.assert_allclose(patched.means[-9000:], true.means, rtol=1e-3, atol=1e-3 * movement.scale)
    np.testing.assert_allclose(patched.sh[-9000:], true.sh, atol=1e-3)


@pytest.mark.parametrize("ending", [".ply", ".splat"])
def test_a_mirrored_scene_is_refused_by_name(tmp_path, ending):
    before, ball = room()
    after = move(take(before, ~ball), MOVES["all"])
    mirrored = replace(after, means=after.means * torch.tensor([1.0, 1.0, -1.0]))
    with pytest.raises(ValueError, match=rf"after\{ending}: it is before\.ply mirrored; save it again without"):
        run_poses(tmp_path, before, mirrored, f"after{ending}")


def test_another_scene_is_refused(tmp_path):
    before, _ = room()
    other = random_gaussians(3000, 1)
    with pytest.raises(ValueError, match=r"after\.ply: of its splats \d+% are where before\.ply has one, and too few"):
        run_poses(tmp_path, before, replace(other, sh=-other.sh))


def test_photographs_and_cameras_stay_in_the_frame_of_the_scene_before(tmp_path):
    whole, deleted = write_edited_capture(tmp_path / "s")
    remove_pictures(tmp_path / "s")
    draws = torch.Generator().manual_seed(3)
    # The capture's own splats look too much alike.
    distinct = replace(
        whole, sh=torch.rand(whole.sh.shape, generator=draws), opacity_logits=torch.rand(len(whole), generator=draws)
    )
    save_ply(tmp_path / "s" / "scene.ply", distinct)
    save_ply(tmp_path / "s" / "cleaned.ply", move(take(distinct, ~deleted), MOVES["all"]))
    (out := tmp_path / "out").mkdir()
    with pytest.warns(UserWarning, match=r"6 cameras of .*transforms\.json"):
        poses.run(poses.Params(gaussians="scene.ply", cleaned="cleaned.ply", masks="none"), out, scene=tmp_path / "s")
    np.testing.assert_array_equal(load_labels(out / "deleted.npy"), deleted)
    assert load_json(out / "movement.json")["scale"] == pytest.approx(0.04, rel=1e-4)
