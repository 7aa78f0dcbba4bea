"""Exported scenes: other libraries read the same cameras, points and Gaussians from the files."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import replace

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
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import save_scene
from reffusion.io.splats import summarize_splats
from reffusion.types import Camera, Similarity
from report import export

FRAME = Similarity(0.31, np.array([1.5, -20.0, 4.0]))


def random_scene_in_frame():
    return replace(random_scene(), similarity=FRAME)


def visible_gaussians(camera: Camera, degree: int = 2):
    """Return 300 Gaussians in front of a camera, in the normalised frame."""
    made = random_gaussians(300, degree)
    at = torch.tensor([0.0, 0.0, 4.0]) + made.means
    pose = torch.from_numpy(camera.world_to_camera).float()
    means = (at - pose[:3, 3]) @ pose[:3, :3]
    return type(made)(means, made.quaternions, made.log_scales - 2, made.opacity_logits, made.sh)


def test_colmap_and_nerfstudio_see_the_scene_as_we_do(tmp_path):
    """The exported .ply and cameras, which are in the scene's own frame, give the renderings of the normalised frame.

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


@pytest.mark.skipif(os.environ.get("REFFUSION_SLOW") != "1", reason="asks npm; set REFFUSION_SLOW=1")
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
    assert "3 pinholes" in lines[2] and "2 undistorted photographs" in lines[2] and len(lines) == 3
    assert (home / "export/scene.ply").read_bytes() == (home / "evaluate/scene.ply").read_bytes()
    (home / "export/cameras/note.txt").write_text("mine")
    export.make(home)
    assert (home / "export/cameras/note.txt").read_text() == "mine"


def test_far_away_positions_stay_exact_and_are_reported(tmp_path):
    far = Similarity(0.5, np.array([4e6, 5e5, 0.0]))
    save_ply(tmp_path / "scene.ply", random_gaussians(20, 0), far)
    assert "many editors read floats only" in export.viewer_caveats(tmp_path / "scene.ply", False)
    assert export.viewer_caveats(tmp_path / "scene.ply", False).count(";") == 1
