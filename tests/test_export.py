"""Exported scenes: other libraries read the same cameras, points and Gaussians from the files."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from scenes.images import render_color
from scenes.random_scene import random_gaussians, random_scene

from reffusion.io.cameras import save_cameras
from reffusion.io.compressed import save_compressed
from reffusion.io.files import BadInput
from reffusion.io.images import save_image
from reffusion.io.ply import load_ply, save_ply, save_splats
from reffusion.io.scene import save_scene
from reffusion.io.splat_transform import PACKAGE, save_for_web
from reffusion.io.splats import summarize_splats
from reffusion.types import Camera, Gaussians, Similarity
from report import export

KNOWS_ANTIALIASED = "@playcanvas/splat-transform@3.7.0"  # `PACKAGE` neither reads nor writes this flag
FRAME = Similarity(0.31, np.array([1.5, -20.0, 4.0]))


def random_scene_in_frame():
    return replace(random_scene(), similarity=FRAME)


def visible_gaussians(camera: Camera, degree: int = 2):
    """Return 300 Gaussians in front of a camera, in the normalized frame."""
    made = random_gaussians(300, degree)
    at = torch.tensor([0.0, 0.0, 4.0]) + made.means
    pose = torch.from_numpy(camera.world_to_camera).float()
    means = (at - pose[:3, 3]) @ pose[:3, :3]
    return type(made)(means, made.quaternions, made.log_scales - 2, made.opacity_logits, made.sh)


def test_colmap_and_nerfstudio_see_the_scene_as_we_do(tmp_path):
    """The exported .ply and cameras, which are in the scene's own frame, give the renderings of the normalized frame.

    The cameras are read from the COLMAP model and from transforms.json.
    """
    import pycolmap

    scene = random_scene_in_frame()
    save_cameras(tmp_path, scene, "images")
    model = pycolmap.Reconstruction(str(tmp_path / "sparse/0"))
    frames = {f["file_path"]: f for f in json.loads((tmp_path / "transforms.json").read_text())["frames"]}
    places = np.array([point.xyz for point in model.points3D.values()])
    np.testing.assert_allclose(places[np.argsort(list(model.points3D))], FRAME.invert(scene.points), rtol=1e-12)
    cloud = PlyData.read(str(tmp_path / "sparse_pc.ply"))["vertex"]
    np.testing.assert_allclose(np.stack([cloud[a] for a in "xyz"], 1), FRAME.invert(scene.points), rtol=1e-12)
    assert len(model.images) == len(frames) == len(scene.cameras)
    for image in model.images.values():
        camera = scene.cameras[image.name.removesuffix(".png")]
        made = visible_gaussians(camera)
        save_ply(tmp_path / "scene.ply", made, FRAME)
        own = load_ply(tmp_path / "scene.ply")
        pinhole, frame = model.cameras[image.camera_id], frames[f"images/{image.name}"]
        pose = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        by_colmap = Camera("c", pinhole.width, pinhole.height, *pinhole.params, pose)
        to_world = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        lens = [frame[key] for key in ("fl_x", "fl_y", "cx", "cy")]
        by_nerfstudio = Camera("n", frame["w"], frame["h"], *lens, np.linalg.inv(to_world))
        assert render_color(made, camera).max() > 0.1
        for other in (by_colmap, by_nerfstudio):
            np.testing.assert_allclose(render_color(own, other), render_color(made, camera), atol=2e-4)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_compressed_file_holds_the_same_by_gsply(tmp_path, degree):
    gsply, made = pytest.importorskip("gsply"), random_gaussians(700, degree)
    path = tmp_path / "scene.compressed.ply"
    save_compressed(path, made, FRAME)
    read = gsply.plyread(str(path))
    means = FRAME.invert(made.means.double().numpy())
    off = np.linalg.norm(means[:, None] - read.means[None], axis=-1)
    nearest = off.argmin(1)
    assert sorted(nearest) == list(range(700)) and off.min(1).max() < 0.02
    np.testing.assert_allclose(read.scales[nearest], made.log_scales.numpy() - np.log(FRAME.scale), atol=5e-3)
    unit = made.quaternions / made.quaternions.norm(dim=1, keepdim=True)
    assert np.abs((read.quats[nearest] * unit.numpy()).sum(1)).min() > 0.9999
    np.testing.assert_allclose(read.sh0[nearest], made.sh[:, 0].numpy(), atol=0.03)
    if degree:
        np.testing.assert_allclose(read.shN[nearest], made.sh[:, 1:].numpy(), atol=1 / 64)
    assert summarize_splats(path).count == 700
    ours = load_ply(path, FRAME)
    np.testing.assert_allclose(ours.means[nearest], made.means, atol=0.01)
    np.testing.assert_allclose(ours.sh[nearest], made.sh, atol=0.03)


def test_a_compressed_file_that_is_cut_off_is_refused(tmp_path):
    pytest.importorskip("gsply")
    path = tmp_path / "scene.compressed.ply"
    save_compressed(path, random_gaussians(300, 1), FRAME)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(BadInput, match=r"scene\.compressed\.ply: cut off"):
        load_ply(path)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_splat_transform_reads_both_files(tmp_path, degree):
    if not (npx := shutil.which("npx")):
        pytest.skip("there is no npm")
    made = random_gaussians(700, degree)
    save_compressed(tmp_path / "scene.compressed.ply", made, FRAME)
    save_ply(tmp_path / "scene.ply", made, FRAME)
    for name, within in (("scene.ply", 1e-5), ("scene.compressed.ply", 0.02)):
        back = tmp_path / f"{within}.ply"
        command = [npx, "--yes", "@playcanvas/splat-transform", str(tmp_path / name), str(back)]
        subprocess.run(command, check=True, capture_output=True)
        vertex = PlyData.read(str(back))["vertex"]
        means = FRAME.invert(made.means.double().numpy())
        off = np.linalg.norm(means[:, None] - np.stack([vertex[a] for a in "xyz"], 1)[None], axis=-1)
        nearest = off.argmin(1)
        assert sorted(nearest) == list(range(700)) and off.min(1).max() < within
        np.testing.assert_allclose(vertex["scale_1"][nearest], made.log_scales[:, 1] - np.log(FRAME.scale), atol=5e-3)
        np.testing.assert_allclose(vertex["f_dc_1"][nearest], made.sh[:, 0, 1], atol=0.03)
        if degree:
            rest = vertex[f"f_rest_{(degree + 1) ** 2 - 1}"][nearest]
            np.testing.assert_allclose(rest, made.sh[:, 1, 1], atol=1 / 64 + 1e-6)


# ---------------------------------------------------------------------------------------------- the command


def test_export_writes_and_lists_all_files(tmp_path):
    pytest.importorskip("gsply")
    home = tmp_path / "s"
    with pytest.raises(ValueError, match=r"scene\.ply is missing; `make scene=s export`"):
        export.make(home)
    save_scene(home / "poses", random_scene_in_frame())
    for name in ("a", "b"):
        save_image(home / "poses" / "images" / f"{name}.png", np.zeros((8, 12, 3), np.uint8))
    save_ply(home / "evaluate" / "scene.ply", replace(random_gaussians(300, 1), antialiased=True), FRAME)
    lines = export.make(home)
    assert "300 Gaussians of degree 1" in lines[0] and "Mip-Splatting" in lines[0]
    assert "3 pinholes" in lines[4] and "2 undistorted photographs" in lines[4] and len(lines) == 6
    assert load_ply(home / "export/scene.spz", FRAME).antialiased and "scene.html: not written" in lines[5]
    assert (home / "export/scene.ply").read_bytes() == (home / "evaluate/scene.ply").read_bytes()
    (home / "export/cameras/note.txt").write_text("mine")
    export.make(home)
    assert (home / "export/cameras/note.txt").read_text() == "mine"


def write_result(home: Path) -> tuple[Gaussians, Camera]:
    """Write what `export` reads; return its Gaussians and a camera that sees them, in the normalized frame.

    Their harmonics have a size as in captures: .spz stores values in [-1, 1], and .sog clusters them.
    """
    scene = random_scene_in_frame()
    camera = replace(scene.cameras["a"], width=96, height=64, fx=84.0, fy=90.0, cx=48.8, cy=31.2)
    made = visible_gaussians(camera, 3)
    made = replace(made, sh=torch.cat([made.sh[:, :1], 0.1 * made.sh[:, 1:]], 1).clamp(-1, 1))
    save_scene(home / "poses", scene)
    save_ply(home / "evaluate" / "scene.ply", made, FRAME)
    return made, camera


def check_reading(path: Path, made: Gaussians, camera: Camera, turn=(1, 1, 1)) -> None:
    """Check positions, sizes, opacities and colors that another library read, and how they render.

    Args:
        turn: signs of the axes of the frame in which it gives them.
    """
    read, signs = load_ply(path, Similarity(FRAME.scale, FRAME.offset * turn)), torch.tensor(turn)
    nearest = torch.cdist(made.means * signs, read.means).argmin(1)
    assert sorted(nearest.tolist()) == list(range(300))
    back = read.map(lambda values: values[nearest])
    np.testing.assert_allclose(back.means, made.means * signs, atol=1e-3)
    np.testing.assert_allclose(back.log_scales, made.log_scales, atol=0.05)
    np.testing.assert_allclose(back.opacity_logits.sigmoid(), made.opacity_logits.sigmoid(), atol=0.01)
    np.testing.assert_allclose(back.sh[:, 0], made.sh[:, 0], atol=0.05)
    turned = replace(camera, world_to_camera=camera.world_to_camera @ np.diag([*turn, 1]))
    seen, true = np.clip(render_color(back, turned), 0, 1), np.clip(render_color(made, camera), 0, 1)
    assert true.max() > 0.5 and -10 * np.log10(((true - seen) ** 2).mean()) > 35


def test_niantics_library_reads_spz(tmp_path):
    """It gives the frame of the file, in which y points up and z backwards."""
    pytest.importorskip("gsply")
    forge, home = pytest.importorskip("gaussforge").GaussForge(), tmp_path / "s"
    made, camera = write_result(home)
    export.make(home)
    read = forge.convert((home / "export/scene.spz").read_bytes(), "spz", "ply")
    (tmp_path / "up.ply").write_bytes(read["data"])
    check_reading(tmp_path / "up.ply", made, camera, (1, -1, -1))


@pytest.mark.slow
def test_other_libraries_read_sog_and_spz(tmp_path):
    """GaussForge reads the .sog of splat-transform, which reads the .spz of gsply."""
    pytest.importorskip("gsply")
    forge, home = pytest.importorskip("gaussforge").GaussForge(), tmp_path / "s"
    made, camera = write_result(home)
    try:
        export.make(home, sog=True)
    except BadInput as error:
        pytest.skip(f"no npm, or no network: {error}")
    page = (home / "export/scene.html").read_text()
    assert "<canvas" in page or "canvas" in page
    assert not re.search(r"""(?:src|href)=["']https?:""", page), "it needs no network"
    read = forge.convert((home / "export/scene.sog").read_bytes(), "sog", "ply")
    (tmp_path / "sog.ply").write_bytes(read["data"])
    command = ["npm", "exec", "--yes", f"--package={PACKAGE}", "--", "splat-transform"]
    spz = home / "export/scene.spz"
    subprocess.run([*command, str(spz), str(tmp_path / "spz.ply")], check=True, capture_output=True)
    for name in ("sog.ply", "spz.ply"):
        check_reading(tmp_path / name, made, camera)


@pytest.mark.integration
@pytest.mark.slow
def test_splat_transform_and_we_keep_that_splats_are_antialiased(tmp_path):
    pytest.importorskip("gsply")
    if not shutil.which("npm"):
        pytest.skip("there is no npm")
    made = replace(random_gaussians(300, 1), antialiased=True)
    for ending in (".ply", ".compressed.ply", ".spz"):
        save_splats(tmp_path / f"ours{ending}", made, FRAME)
    try:
        save_for_web(tmp_path / "ours.sog", tmp_path / "ours.ply", True)
    except BadInput as error:
        pytest.skip(f"npm cannot fetch splat-transform: {error}")
    ours, theirs = (".ply", ".compressed.ply", ".spz", ".sog"), (".compressed.ply", ".spz")
    convert = "splat-transform --quiet --overwrite --gpu cpu"
    lines = [f"{convert} ours{each} from{each.replace('.', '_')}.ply" for each in ours]
    lines += [f"{convert} ours.ply theirs{each}" for each in theirs]
    command = ["npm", "exec", "--yes", "--fetch-retries=0", f"--package={KNOWS_ANTIALIASED}", "-c", " && ".join(lines)]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    if ended.returncode and not (tmp_path / "from_ply.ply").exists():
        pytest.skip(f"npm cannot fetch or start {KNOWS_ANTIALIASED}: {ended.stderr[-200:]}")
    assert ended.returncode == 0, ended.stderr
    for path in [tmp_path / f"from{each.replace('.', '_')}.ply" for each in ours]:
        assert b"\ncomment SplatRenderMode: mip\n" in path.read_bytes(), path.name
    for each in theirs:
        assert summarize_splats(tmp_path / f"theirs{each}").antialiased, each


def test_without_node_the_message_says_what_writes_sog(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BadInput, match=r"scene\.sog: .*splat-transform.* needs Node; install Node 18 or later"):
        save_for_web(tmp_path / "scene.sog", tmp_path / "scene.ply", False)


def test_coordinates_too_large_for_spz_are_refused(tmp_path):
    pytest.importorskip("gsply")
    far = Similarity(0.5, np.array([5e6, 0.0, 0.0]))
    with pytest.raises(BadInput, match=r"s\.spz: a \.spz holds coordinates up to 4194304"):
        save_splats(tmp_path / "s.spz", random_gaussians(20, 0), far)


def test_far_away_positions_stay_exact_and_are_reported(tmp_path):
    far = Similarity(0.5, np.array([4e6, 5e5, 0.0]))
    save_ply(tmp_path / "scene.ply", random_gaussians(20, 0), far)
    assert "many editors read floats only" in export.viewer_caveats(tmp_path / "scene.ply", False)
    assert export.viewer_caveats(tmp_path / "scene.ply", False).count(";") == 1
