"""Scenes from which a user deleted splats in an editor.

The deleted splats are detected and take the place of masks, and the filled scene is written in the editor's format.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData
from scenes import wall_scene
from scenes.capture import make_truth
from scenes.edited_capture import EDITOR, FIELDS, plane_with_ball, remove_pictures, write_edited_capture
from scenes.stage_runs import run_masks

from reffusion.capture import cameras_around_hole
from reffusion.fit import exposure
from reffusion.gaussians import matching
from reffusion.gaussians.movement import Cloud
from reffusion.io.arrays import load_json, load_labels, save_labels
from reffusion.io.cameras import save_cameras
from reffusion.io.compressed import save_compressed
from reffusion.io.ply import load_ply, load_property_names, save_ply
from reffusion.io.scene import load_mask_sets, load_scene
from reffusion.splat import rasterizer
from reffusion.types import Gaussians, Similarity
from report import patch
from stages import masks, poses
from stages.plan import poses as planned

pytestmark = pytest.mark.integration

NEAR = 1.7  # depth of the square before the wall
HERE = Similarity(1.0, np.zeros(3))


def match_points(whole, cleaned):
    """Match Gaussians that all look the same, so that only their positions tell them apart."""
    clouds = [
        Cloud(each, np.zeros((len(each), 3)), np.zeros((len(each), 3)), np.ones(len(each))) for each in (whole, cleaned)
    ]
    return matching.match_gaussians(*clouds)


def find_scattered(points, deleted):
    return deleted & (matching.find_regions(points, deleted) < 0)


@pytest.mark.parametrize("turn", matching.AXIS_FLIPS)
def test_deleted_splats_are_found_in_any_order_quantised_and_turned(turn):
    points, deleted = plane_with_ball()
    draws = np.random.default_rng(1)
    rest = points[~deleted][draws.permutation(np.count_nonzero(~deleted))] * turn
    found = match_points(points, rest.astype(np.float16).astype(np.float64))
    np.testing.assert_array_equal(found.movement.rotation, np.diag(turn))
    assert found.found == 1
    assert np.count_nonzero(found.deleted != deleted) <= 0.002 * len(points)
    exact = match_points(points, rest)
    np.testing.assert_array_equal(exact.deleted, deleted)


def test_splats_on_each_other_are_matched_one_to_one():
    points = np.repeat(plane_with_ball(500)[0], 2, axis=0)
    assert match_points(points, np.delete(points, 7, axis=0)).deleted.nonzero()[0].tolist() in ([6], [7])


@pytest.mark.parametrize("moved", [lambda p: p + 0.3, lambda p: 1.3 * p, lambda p: p[:, [1, 2, 0]]])
def test_moved_splats_that_all_look_the_same_are_not_matched(moved):
    points, deleted = plane_with_ball()
    assert match_points(points, moved(points[~deleted])).movement is None


def test_splats_that_were_deleted_alone_are_scattered():
    points, ball = plane_with_ball()
    draws = np.random.default_rng(2)
    alone, away = np.zeros(len(points), bool), np.linalg.norm(points - (0.2, 0.1, 0.5), axis=1) > 1
    alone[draws.choice(np.flatnonzero(away), 60, replace=False)] = True
    slab = np.zeros(len(points), bool)
    slab[np.argsort(np.abs(points[:, 1] - 0.7))[:40]] = True
    assert not find_scattered(points, ball).any()
    for deleted in (alone, slab, points[:, 0] == points[7, 0]):
        np.testing.assert_array_equal(find_scattered(points, deleted), deleted)
    np.testing.assert_array_equal(find_scattered(points, ball | alone), alone)
    np.testing.assert_array_equal(find_scattered(1e4 * points, ball | alone), alone)


def test_one_layer_of_splats_on_a_wall_is_an_object():
    grid = np.stack([*np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60)), np.zeros((60, 60))], -1)
    poster = grid[20:30, 20:30] + (0.01, 0.01, 0.005)
    points = np.concatenate([grid.reshape(-1, 3), poster.reshape(-1, 3)])
    assert not find_scattered(points, np.arange(len(points)) >= 3600).any()


# ---------------------------------------------------------------------------------------------- the stage `poses`


def run_poses_after_edit(folder, **params):
    out = folder.parent / f"{folder.name}_out"
    out.mkdir(exist_ok=True)
    settings = poses.Params(gaussians="scene.ply", cleaned="cleaned.ply", **params)
    planned.preview(settings, folder)
    poses.run(settings, out, scene=folder)
    return out


@pytest.mark.parametrize("compressed", [False, True])
def test_poses_says_which_splats_were_deleted(tmp_path, compressed, capsys):
    whole, deleted = write_edited_capture(tmp_path / "s")
    if compressed:
        rest = whole.map(lambda p: p[torch.from_numpy(~deleted)])
        save_compressed(tmp_path / "s" / "cleaned.ply", rest, HERE)
    out = run_poses_after_edit(tmp_path / "s", masks="none")
    assert np.count_nonzero(load_labels(out / "deleted.npy").numpy() != deleted) <= 2 * compressed
    assert f"{deleted.sum()} of 4000 splats were deleted" in capsys.readouterr().out
    gaussians = load_ply(out / "gaussians.ply", None)
    np.testing.assert_allclose(
        load_scene(out).similarity.invert(gaussians.means.double().numpy()), whole.means, atol=1e-4
    )
    assert load_property_names(out / "gaussians.ply")[: len(EDITOR)] == EDITOR


def test_scattered_splats_leave_the_place_of_the_hole(tmp_path, capsys):
    whole, deleted = write_edited_capture(tmp_path / "s")
    away = np.linalg.norm(plane_with_ball()[0] - (0.2, 0.1, 0.5), axis=1) > 1
    alone = away & (np.cumsum(away) % 50 == 3)
    save_ply(tmp_path / "s" / "cleaned.ply", whole.map(lambda p: p[torch.from_numpy(~(deleted | alone))]))
    out = run_poses_after_edit(tmp_path / "s", masks="none")
    np.testing.assert_array_equal(load_labels(out / "deleted.npy"), deleted | alone)
    np.testing.assert_array_equal(load_labels(out / "scattered.npy"), alone)
    count = np.count_nonzero(deleted | alone)
    said, scattered = capsys.readouterr().out, f"{alone.sum()} of them scattered: they leave no region to fill"
    assert f"cleaned.ply: {count} of 4000 splats were deleted, {scattered}\n" in said


def assert_refusal(folder, message, **params):
    with pytest.raises(ValueError, match=message) as error:
        run_poses_after_edit(folder, **params)
    assert "\n" not in str(error.value)


def test_refusals_say_what_is_wrong_with_the_cleaned_scene(tmp_path):
    folder = tmp_path / "s"
    whole, _ = write_edited_capture(folder)
    rest = load_ply(folder / "cleaned.ply")
    change = lambda made: save_ply(folder / "cleaned.ply", made)
    change(whole)
    assert_refusal(folder, r"cleaned\.ply: 4000 splats, and .*scene\.ply has 4000: nothing was deleted")
    change(rest.map(lambda p: p[:0]))
    assert_refusal(folder, r"cleaned\.ply: it holds no Gaussians: everything was deleted")
    change(replace(rest, means=rest.means * torch.tensor([1.2, 1.0, 1.0])))
    assert_refusal(folder, r"cleaned\.ply: of its splats \d+% are where scene\.ply has one, .* decimated, recolored or")
    change(replace(rest, means=rest.means * torch.tensor([-1.0, 1.0, 1.0])))
    assert_refusal(folder, r"cleaned\.ply: it is scene\.ply mirrored; save it again without mirroring")
    twice = whole.map(lambda p: torch.cat([p, p[:1]]))
    save_ply(folder / "scene.ply", twice)
    (folder / "cleaned.ply").unlink()
    assert_refusal(folder, r"cleaned\.ply: no such file; correct `cleaned`")
    alone = torch.arange(len(whole)) % 50 == 7
    save_ply(folder / "scene.ply", whole)
    change(whole.map(lambda p: p[~alone]))
    assert_refusal(folder, r"cleaned\.ply: 80 scattered splats were deleted; no region to fill: each stood among "
                           r"splats that stay\. Delete a whole object, or use cleaned\.ply as it is$")  # fmt: skip
    change(rest)
    with pytest.raises(ValueError, match="cleaned: name the scene before"):
        planned.preview(poses.Params(cleaned="cleaned.ply"), folder)


# ---------------------------------------------------------------------------------------------- without photographs


@pytest.mark.parametrize("antialiased", [False, True])
def test_cameras_of_a_capture_look_at_renders(tmp_path, antialiased):
    folder = tmp_path / "s"
    whole, _ = write_edited_capture(folder)
    save_ply(folder / "scene.ply", replace(whole, antialiased=antialiased))
    remove_pictures(folder)
    with pytest.warns(UserWarning, match=r"no photographs: the 6 cameras of .*transforms\.json look at"):
        out = run_poses_after_edit(folder)
    scene, truth = load_scene(out), make_truth(scale=5.0, offset=(50.0, 0.0, 0.0))
    assert scene.train == tuple(sorted(truth.world_to_camera)) and not scene.test
    for name, pose in truth.world_to_camera.items():
        mine = scene.cameras[name].world_to_camera
        center = scene.similarity.apply(-pose[:3, :3].T @ pose[:3, 3])
        np.testing.assert_allclose(scene.cameras[name].center, center, atol=1e-9)
        np.testing.assert_allclose(mine[:3, :3], pose[:3, :3], atol=1e-9)
    seen = exposure.load_photos_in_scene_exposure(out, out, ["v02"])["v02"]
    gaussians = load_ply(out / "gaussians.ply")
    renders = {flag: rasterizer.render(replace(gaussians, antialiased=flag), scene.cameras["v02"]).color.numpy()
               for flag in (False, True)}  # fmt: skip
    np.testing.assert_allclose(seen / 255, renders[antialiased].clip(0, 1), atol=0.5 / 255 + 1e-6)
    assert gaussians.antialiased == antialiased and np.abs(renders[True] - renders[False]).max() > 0.01
    assert_refusal(folder, "scene.yaml: test: the scene has no photographs", test="every 8")
    record = json.loads((folder / "transforms.json").read_text())
    del record["w"]
    (folder / "transforms.json").write_text(json.dumps(record))
    assert_refusal(folder, r"transforms\.json: neither pictures nor w and h")


def test_a_ring_of_cameras_sees_the_hole_from_above_what_it_stands_on(tmp_path):
    folder = tmp_path / "s"
    _, deleted = write_edited_capture(folder)
    remove_pictures(folder)
    (folder / "transforms.json").unlink()
    with pytest.warns(UserWarning, match=r"no photographs: \d+ cameras around the hole"):
        out = run_poses_after_edit(folder, longest=64)
    scene, means = load_scene(out), load_ply(out / "gaussians.ply").means.double().numpy()
    hole = means[deleted].mean(0)
    assert len(scene.train) > 5 and len(load_labels(out / "deleted.npy")) == len(means)
    for camera in scene.cameras.values():
        assert (camera.width, camera.height) == (64, 48)
        at = camera.world_to_camera[:3, :3] @ (hole - camera.center)
        assert at[2] > 0 and np.abs(at[:2] / at[2]).max() < 0.2
        assert camera.center[2] > hole[2]


def test_a_walled_in_hole_is_in_sight_from_nowhere():
    draws = np.random.default_rng(0)
    hole, shell = (draws.normal(size=(count, 3)) for count in (300, 4000))
    hole, shell = (
        radius * each / np.linalg.norm(each, axis=1)[:, None] for radius, each in ((0.3, hole), (0.5, shell))
    )
    means = np.concatenate([hole, shell])
    deleted = np.arange(len(means)) < len(hole)
    with pytest.raises(ValueError, match=r"bring cameras"):
        cameras_around_hole.place_cameras(means, np.full(len(means), 0.05), np.ones(len(means), bool), deleted, 64)


# ---------------------------------------------------------------------------------------------- the stage `masks`


def test_deleted_splats_replace_votes(tmp_path):
    folder, fit, labels = wall_scene.write_poses_and_fit(tmp_path, NEAR, masks={})
    save_labels(folder / "deleted.npy", labels)
    out = run_masks(folder, fit, tmp_path / "masks")
    assert (load_labels(out / "labels.npy") | ~labels).all()
    found = load_mask_sets(out, wall_scene.CAMERAS)
    for name in wall_scene.TRAIN:
        assert wall_scene.iou(found[name].consistent, wall_scene.true_mask(wall_scene.CAMERAS[name], NEAR)) > 0.9
    assert load_json(out / "facts.json")["best_reference"] in wall_scene.TRAIN


def test_scattered_splats_are_removed_and_leave_no_hole(tmp_path):
    folder, fit, labels = wall_scene.write_poses_and_fit(tmp_path, NEAR, masks={})
    alone = ~labels & (torch.arange(len(labels)) % 400 == 0)
    save_labels(folder / "deleted.npy", labels)
    without = run_masks(folder, fit, tmp_path / "without")
    save_labels(folder / "deleted.npy", labels | alone)
    save_labels(folder / "scattered.npy", alone)
    out = run_masks(folder, fit, tmp_path / "masks")
    removed, debris = load_labels(out / "labels.npy"), load_labels(out / "debris.npy")
    assert alone.sum() > 10 and (removed | ~(labels | alone)).all() and (debris | ~alone).all()
    for name, found in load_mask_sets(out, wall_scene.CAMERAS).items():
        np.testing.assert_array_equal(found.consistent, load_mask_sets(without, [name])[name].consistent)


def test_splats_that_were_left_stay_if_they_outnumber_the_deleted_ones(tmp_path):
    """Only the rim of the square was deleted, which `inside_share` would fill by the rest of the square."""
    folder, fit, labels = wall_scene.write_poses_and_fit(tmp_path, NEAR, masks={})
    means = load_ply(fit / "gaussians.ply").means
    rim = labels & (means[:, :2].abs().amax(1) > 0.8 * wall_scene.HALF)
    save_labels(folder / "deleted.npy", rim)
    count, inside = int(rim.sum()), int((labels & ~rim).sum())
    assert inside > count
    params = masks.Params(inside_share=0.0)
    with pytest.warns(UserWarning, match=rf"splats inside the hole stay, because they are more than the {count} that"):
        out = run_masks(folder, fit, tmp_path / "masks", params)
    assert (load_labels(out / "labels.npy") & ~load_labels(out / "debris.npy")).equal(rim)
    assert len(load_json(out / "warnings.json")) == 1


@pytest.mark.parametrize("moved", [(0.0, 0.0, -9.0), (0.9, 0.3, 0.0)])
def test_gaussians_in_another_frame_than_the_cameras_are_refused(tmp_path, moved):
    folder, fit, labels = wall_scene.write_poses_and_fit(tmp_path, NEAR, masks={})
    gaussians = load_ply(fit / "gaussians.ply")
    shifted = Gaussians(gaussians.means + torch.tensor(moved), *(getattr(gaussians, name) for name in FIELDS[1:]))
    for path in (folder, fit):
        save_ply(path / "gaussians.ply", shifted)
    save_labels(folder / "deleted.npy", labels)
    with pytest.raises(ValueError, match=r"`gaussians` of scene\.yaml: .* in another frame"):
        run_masks(folder, fit, tmp_path)


# ---------------------------------------------------------------------------------------------- output for the editor


def test_the_patch_is_given_back_as_the_editor_wrote_the_scene(tmp_path):
    write_edited_capture(tmp_path / "s")
    out = run_poses_after_edit(tmp_path / "s", masks="none")
    home = tmp_path / "runs" / "s"
    home.mkdir(parents=True)
    out.rename(home / "poses")
    with pytest.raises(ValueError, match=r"scene\.ply is missing; `make scene=s patch`"):
        patch.make(home)
    similarity, result = load_scene(home / "poses").similarity, load_ply(home / "poses" / "gaussians.ply")
    before, new = load_labels(home / "poses" / "deleted.npy"), torch.arange(len(result)) >= 3900
    deleted = int(before.sum())
    (home / "initialize").mkdir()
    save_labels(home / "initialize" / "labels.npy", new)
    save_ply(home / "evaluate" / "scene.ply", replace(result, antialiased=True), similarity)
    (home / "evaluate" / "receipt.json").write_text('{"needs": {"initialize": "x", "distill": null}}')
    said = patch.make(home).splitlines()
    assert said[0] == f"{home / 'patch' / patch.WHOLE}: the whole scene, 4000 splats"
    assert said[1].endswith("the 100 new splats alone, which the whole scene contains too")
    assert said[2:] == [f"removed: the {deleted} splats that you deleted, and no others; added: 100 new splats"]
    few = before & (before.cumsum(0) <= 20)
    save_labels(home / "initialize" / "labels.npy", torch.arange(len(result)) >= 1999)
    save_labels(home / "poses" / "deleted.npy", few)
    said = patch.make(home).splitlines()
    assert said[2:] == [
        "removed: the 20 splats that you deleted, and 1981 more, haze and floaters inside or behind the hole; "
        "added: 2001 new splats",
        "warning: that is more than 100 new splats for each deleted one: unless these were large, the hole reaches far "
        "beyond them; look at the result, and delete whole objects only",
    ]
    save_labels(home / "initialize" / "labels.npy", new)
    patch.make(home)
    original = PlyData.read(str(tmp_path / "s" / "scene.ply"))["vertex"]
    whole, alone = (PlyData.read(str(home / "patch" / name))["vertex"] for name in (patch.WHOLE, patch.NEW))
    assert [p.name for p in whole.properties] == [p.name for p in original.properties]
    assert len(whole) == 4000 and len(alone) == 100
    assert all(load_ply(home / "patch" / name).antialiased for name in (patch.WHOLE, patch.NEW))
    for name in ("x", "scale_1", "f_dc_2", "f_rest_5", "rot_3", "opacity"):
        np.testing.assert_allclose(whole[name], original[name], atol=2e-5)
        np.testing.assert_array_equal(alone[name], whole[name][3900:])
    (home / "poses" / "deleted.npy").unlink()
    with pytest.raises(ValueError, match="nothing says what was deleted"):
        patch.require_deleted(home)


def test_exported_cameras_are_a_capture_without_photographs(tmp_path):
    """Cameras in the form that `export` writes can be used by `patch`, and keep their positions."""
    folder = tmp_path / "s"
    write_edited_capture(folder)
    out = run_poses_after_edit(folder, masks="none")
    for name in ("transforms.json", "images", "masks"):
        (folder / name).rename(tmp_path / name)
    save_cameras(folder, load_scene(out), "images")
    (folder / "transforms.json").unlink()
    with pytest.warns(UserWarning, match=r"no photographs: the 6 cameras of .*sparse/0"):
        again = load_scene(run_poses_after_edit(folder))
    was = load_scene(out)
    for name, camera in was.cameras.items():
        place = was.similarity.invert(camera.center)
        np.testing.assert_allclose(again.similarity.invert(again.cameras[name].center), place, atol=1e-9)
