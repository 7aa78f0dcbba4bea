"""The command `reffusion patch before.ply after.ply --out patched.ply`.

Tested are refusals, the scene folder that the command writes, the output, and the cameras placed around a hole.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes.edited_capture import remove_pictures, write_edited_capture
from scenes.processes import run_module
from scenes.random_scene import random_gaussians
from test_patch import match_points

from reffusion.capture import cameras_around_hole
from reffusion.io.arrays import load_labels
from reffusion.io.files import BadInput
from reffusion.io.ply import check_can_save, load_ply, load_property_names, save_ply, save_splats
from reffusion.io.scene import load_scene
from reffusion.types import Similarity
from report import export, patch, patch_files
from stages import poses
from stages.plan import poses as planned

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent
FRAME = Similarity(0.31, np.array([1.5, -20.0, 4.0]))


@pytest.fixture
def splat_files(tmp_path):
    """Write before.ply with 300 splats and after.ply with 250 of them; return both paths."""
    made = random_gaussians(300, 1)
    save_ply(tmp_path / "before.ply", made)
    save_ply(tmp_path / "after.ply", made.map(lambda p: p[50:]))
    return tmp_path / "before.ply", tmp_path / "after.ply"


def parse_arguments(before, after, out, **others) -> argparse.Namespace:
    values = {"scene": None, "variant": "", "runs": Path(before).parent / "runs", "cameras": None, "profile": "laptop"}
    values |= {"budget": None, "set": "", **others}
    return argparse.Namespace(files=[before, after], out=out, **values)


def test_arguments_that_do_not_fit_are_named(splat_files, tmp_path):
    before, after = splat_files
    out = tmp_path / "patched.ply"
    (tmp_path / "s.usdz").write_bytes(bytes(4096))
    for files, others, message in (
        ([before], {}, f"{before}: name two files, the scene before and after the object was deleted"),
        ([before, after], {"out": None}, "--out: name the file to write, as --out patched.ply"),
        ([before, after], {"scene": "x"}, "--scene, --variant: a scene's folder names its files in scene.yaml; give "
         "it, or two files"),
        ([before, tmp_path / "s.usdz"], {}, f"{tmp_path / 's.usdz'}: .usdz is not read; save the scene as .ply in the "
         "program that wrote it"),
        ([before, tmp_path / "no.ply"], {}, f"{tmp_path / 'no.ply'}: no such file"),
        ([before, after], {"out": tmp_path / "x.obj"}, f"{tmp_path / 'x.obj'}: .obj is not written; one of .ply, "
         ".compressed.ply, .spz, .splat, .glb is"),
        ([before, after], {"out": tmp_path / "no" / "x.ply"}, f"{tmp_path / 'no'}: no such folder"),
        ([before, after], {"cameras": tmp_path / "no"}, f"{tmp_path / 'no'}: no such folder; --cameras names one with "
         "transforms.json or sparse/0"),
    ):  # fmt: skip
        arguments = parse_arguments(before, after, **{"out": out} | others)
        arguments.files = files
        with pytest.raises(BadInput) as refused:
            patch_files.check_arguments(arguments)
        assert str(refused.value) == message


def test_a_scene_or_two_files_must_be_named(monkeypatch):
    monkeypatch.setattr("sys.argv", ["patch"])
    with pytest.raises(SystemExit) as ended:
        patch.main()
    message = "name a scene (--scene), or two files: reffusion patch before.ply after.ply --out out.ply"
    assert str(ended.value) == f"error: {message}"


def test_a_stage_that_refuses_ends_the_command(splat_files, tmp_path):
    before, after = splat_files
    words = ("--out", tmp_path / "x.ply", "--runs", tmp_path / "runs", "--profile", "laptop")
    ended = run_module("reffusion.command", "patch", after, before, *words)
    folder = patch_files.find_folder(tmp_path / "runs", after, before)
    assert (ended.returncode, ended.stderr) == (
        2,
        f"error: poses: {folder / 'after/before.ply'}: nothing was deleted: all splats of after.ply are there "
        f"(all of it in {tmp_path / 'runs' / folder.name}/poses.log)\n",
    )
    assert not (tmp_path / "x.ply").exists()


def test_the_folder_is_a_scene_and_keeps_what_a_person_painted(tmp_path):
    """A call with two files, and a later call with their cameras too, use the same folder.

    The later call keeps pictures that a user painted into the folder.
    """
    made = tmp_path / "made"
    _, deleted = write_edited_capture(made)
    remove_pictures(made)
    args = parse_arguments(made / "scene.ply", made / "cleaned.ply", tmp_path / "out.ply")
    patch_files.check_arguments(args)
    folder = patch_files.write_scene_folder(args)
    assert folder == patch_files.find_folder(args.runs, *args.files) and folder.name.startswith("scene-patch-")
    content = (folder / "scene.yaml").read_text()
    assert content == 'gaussians: "before/scene.ply"\ncleaned: "after/cleaned.ply"\nmasks: none\n'
    params = poses.Params(gaussians="before/scene.ply", cleaned="after/cleaned.ply", masks="none", longest=64)
    assert "cameras around the hole look at renders" in planned.preview(params, folder)[0]
    (folder / "painted").mkdir()
    (folder / "painted" / "around_00.png").write_text("mine")
    (made / "cameras").mkdir()
    (made / "transforms.json").rename(made / "cameras" / "transforms.json")
    time = (folder / "scene.yaml").stat().st_mtime_ns
    again = patch_files.write_scene_folder(parse_arguments(*args.files, args.out, cameras=made / "cameras"))
    assert again == folder and (folder / "painted" / "around_00.png").read_text() == "mine"
    assert (folder / "scene.yaml").stat().st_mtime_ns == time
    assert "no photographs: 6 cameras of transforms.json" in planned.preview(params, folder)[0]
    (out := tmp_path / "poses").mkdir()
    with pytest.warns(UserWarning, match="no photographs"):
        poses.run(params, out, scene=folder)
    np.testing.assert_array_equal(load_labels(out / "deleted.npy").numpy(), deleted)
    assert len(load_scene(out).train) == 6
    patch_files.write_scene_folder(args)
    assert not (folder / "transforms.json").exists()


@pytest.mark.parametrize(
    ("ending", "within"), [(".ply", 1e-6), (".splat", 1e-6), (".glb", 1e-6), (".spz", 2e-5), (".compressed.ply", 0.2)]
)
def test_the_suffix_chooses_the_format(tmp_path, ending, within):
    if ending in (".spz", ".compressed.ply"):
        pytest.importorskip("gsply")
    made, path = random_gaussians(300, 1), tmp_path / f"out{ending}"
    check_can_save(path)
    save_splats(path, made, FRAME, ("x", "y", "z", "opacity"))
    read, means = load_ply(path), torch.from_numpy(FRAME.invert(made.means.double().numpy())).float()
    nearest = torch.cdist(means, read.means).argmin(1)
    assert sorted(nearest.tolist()) == list(range(300))
    np.testing.assert_allclose(read.means[nearest], means, atol=within)
    sizes = made.log_scales - np.float32(np.log(FRAME.scale))
    np.testing.assert_allclose(read.log_scales[nearest], sizes, atol=0.04)
    if ending == ".ply":
        assert load_property_names(path)[:4] == ("x", "y", "z", "opacity")


def test_export_writes_the_scene_with_the_object_too(tmp_path):
    pytest.importorskip("gsply")

    from test_export import random_scene_in_frame

    from reffusion.io.scene import save_scene

    home, gaussians = tmp_path / "s", random_gaussians(200, 1)
    save_scene(home / "poses", random_scene_in_frame())
    save_ply(home / "evaluate" / "scene.ply", random_gaussians(300, 1), FRAME)
    save_ply(home / "fit" / "gaussians.ply", gaussians)
    lines = export.make(home)
    before, cameras = home / "export/with_object.ply", home / "export/cameras"
    assert next(line for line in lines if line.startswith(str(before))) == (
        f"{before}: the scene with the object, to be edited: delete something in an editor, save the rest as "
        f"AFTER.ply, and `reffusion patch {before} AFTER.ply --cameras {cameras} --out patched.ply` fills the hole"
    )
    torch.testing.assert_close(load_ply(before, FRAME).means, gaussians.means, rtol=0, atol=1e-5)
    frames = json.loads((cameras / "transforms.json").read_text())["frames"]
    assert len(frames) == 3


# ---------------------------------------------------------------------------------------------- matching


def test_many_splats_are_matched_by_their_exact_places():
    draws = np.random.default_rng(0)
    points = draws.normal(size=(200_000, 3)).astype(np.float32).astype(np.float64)
    points[1000:1010] = points[2000:2010]  # ten pairs of splats at equal positions
    points[5] = (0.0, -0.0, 0.0)
    deleted = draws.random(len(points)) < 0.1
    deleted[[5, *range(1000, 1010)]], deleted[2000:2010] = False, True
    rest = points[~deleted][draws.permutation(np.count_nonzero(~deleted))] * (-1, -1, 1)
    found = match_points(points, rest)
    assert found.found == 1 and found.movement.rotation.diagonal().tolist() == [-1, -1, 1]
    twins = [*range(1000, 1010), *range(2000, 2010)]
    np.testing.assert_array_equal(np.delete(found.deleted, twins), np.delete(deleted, twins))
    assert found.deleted[twins].sum() == 10


def test_some_splats_that_moved_a_little_are_still_found():
    draws = np.random.default_rng(0)
    points = draws.normal(size=(5000, 3))
    deleted = np.arange(len(points)) < 100
    rest = points[~deleted].copy()
    rest[:40] += 1e-5
    found = match_points(points, rest)
    assert found.found == 1
    np.testing.assert_array_equal(found.deleted, deleted)


# ---------------------------------------------------------------------------------------------- cameras


def sample_room(*walls: str) -> tuple[np.ndarray, np.ndarray]:
    """Sample splats of a floor, of the named walls, and of a ball on the floor before the place of the back wall.

    Returns:
        The means of the splats, [N, 3], and bool [N], True for the splats of the ball.
    """
    draws = np.random.default_rng(0)
    sheets = [draws.uniform((-1, -1, 0), (1, 1, 0), (6000, 3))]
    sheets += [draws.uniform((-1, 1, 0), (1, 1, 1), (6000, 3))] if "back" in walls else []
    sheets += [draws.uniform((-1, -1, 0), (-1, 1, 1), (6000, 3))] if "left" in walls else []
    ball = draws.normal(size=(400, 3))
    ball = (0.0, 0.6, 0.25) + 0.25 * ball / np.linalg.norm(ball, axis=1)[:, None]
    means = np.concatenate([ball, *sheets])
    return means, np.arange(len(means)) < len(ball)


@pytest.mark.parametrize("walls", [(), ("back",), ("back", "left")])
def test_cameras_of_an_open_room_stand_in_it(walls):
    means, deleted = sample_room(*walls)
    found = cameras_around_hole.place_cameras(means, np.full(len(means), 0.02), np.ones(len(means), bool), deleted, 96)
    assert len(found.lenses) >= 3
    for pose in found.world_to_camera.values():
        place = -pose[:3, :3].T @ pose[:3, 3]
        assert place[2] > 0.05, "under the floor"
        assert "back" not in walls or place[1] < 1, "behind the wall"
        assert "left" not in walls or place[0] > -1, "behind the wall"
        assert np.linalg.norm(means[~deleted] - place, axis=1).min() > 0.25 * 0.24, "in a surface"


# ---------------------------------------------------------------------------------------------- the whole command


@pytest.mark.slow
def test_the_command_fills_a_hole_and_goes_on(tmp_path):
    means, deleted = sample_room("back")
    count = len(means)
    draw = lambda *shape: torch.rand(*shape, generator=torch.Generator().manual_seed(0))
    made = random_gaussians(count, 0)
    whole = type(made)(
        torch.from_numpy(means).float(), made.quaternions, torch.full((count, 3), np.log(0.03)).float(),
        torch.full((count,), 4.0), draw(count, 1, 3) - 0.5, antialiased=True,
    )  # fmt: skip
    save_ply(tmp_path / "before.ply", whole)
    save_ply(tmp_path / "after.ply", whole.map(lambda p: p[torch.from_numpy(~deleted)].flip(0)))
    words = [
        tmp_path / "before.ply",
        tmp_path / "after.ply",
        "--out",
        tmp_path / "out.ply",
        "--runs",
        tmp_path / "runs",
    ]
    words += ["--profile", "laptop", "--set", "poses.longest=96 initialize.refit_steps=20 distill.iterations=4"]
    first = run_module("reffusion.command", "patch", *words)
    assert first.returncode == 0, first.stdout + first.stderr
    assert f"{tmp_path / 'out.ply'}: the whole scene" in first.stdout and "painted" in first.stdout
    patched = load_ply(tmp_path / "out.ply")
    assert len(patched) > np.count_nonzero(~deleted) and patched.antialiased
    assert f"removed: the {deleted.sum()} splats that you deleted, and " in first.stdout
    again = run_module("reffusion.command", "patch", *words)
    assert again.returncode == 0 and "not run yet" not in again.stdout
    with pytest.raises(BadInput):
        load_ply(tmp_path)
