"""Structure from motion on renders of a room's corner and, with REFFUSION_SLOW=1 (takes minutes), on photographs."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from scenes.capture import real_capture
from scenes.capture_checks import pose_errors
from scenes.room import render_room_corner, room_textures, room_walk, speckle_texture

from reffusion.capture import sfm
from reffusion.capture.layouts.capture import Poses
from reffusion.capture.load import load_capture
from reffusion.io.arrays import load_json
from reffusion.io.images import save_image, save_mask
from reffusion.io.scene import load_scene
from stages import poses

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[1]


def assert_accepted(scene, truth: dict[str, np.ndarray]) -> None:
    shifts, degrees = pose_errors({name: camera.world_to_camera for name, camera in scene.cameras.items()}, truth)
    assert degrees.max() < 0.5 and np.median(shifts) < 1.0 and shifts.max() < 2.0


def run_poses(folder: Path, out: Path, **params):
    out.mkdir()
    poses.run(poses.Params(**params), out, scene=folder)
    return load_scene(out)


def reconstruct_with_threads(threads: int, photographs: dict[str, Path], work: Path) -> Poses:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return sfm.reconstruct(photographs, 640, work / "work", seed=0).poses
    finally:
        torch.set_num_threads(before)


def test_a_walk_past_a_corner(tmp_path, capsys):
    """All six views of the corner are placed. The unrelated view "stray" is named, and left out with its mask.

    The poses must not depend on the number of threads.
    """
    generator, truth = np.random.default_rng(0), room_walk(6)
    textures = room_textures(generator)
    folder = tmp_path / "s"
    for name, pose in truth.items():
        save_image(folder / f"{name}.png", render_room_corner(pose, textures))
    save_image(folder / "stray.png", speckle_texture(generator)[:150, :200].astype(np.uint8))
    for name in (*truth, "stray"):
        save_mask(folder / "masks" / f"{name}.png", np.eye(150, 200, dtype=bool))
    with pytest.warns(UserWarning, match="1 views were not placed and are left out: stray"):
        scene = run_poses(folder, tmp_path / "out")
    facts = load_json(tmp_path / "out" / "sfm.json")
    assert (facts["placed"], facts["photographs"], facts["lenses"]) == (6, 7, 1)
    assert facts["points"] == len(scene.points) and 2 < facts["mean_track_length"] < 6
    assert 0.05 < facts["mean_residual_px"] < 0.6
    output = capsys.readouterr().out
    assert f"structure from motion: 6 of 7 photographs, 1 lens, {facts['points']:,} points in " in output
    assert sorted(scene.cameras) == sorted(truth) == list(scene.train)
    assert_accepted(scene, truth)
    again, once_more = (
        reconstruct_with_threads(threads, {n: folder / f"{n}.png" for n in truth}, tmp_path) for threads in (1, 3)
    )
    assert all(np.array_equal(again.world_to_camera[n], once_more.world_to_camera[n]) for n in truth)
    assert np.array_equal(again.points, once_more.points)
    assert len(scene.points) > 300 and "stray" not in scene.cameras
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "images", "lenses.json", "sfm.json", "sparse", "transform.json", "views.json", "warnings.json",
    ]  # fmt: skip


def test_views_that_do_not_belong_together_are_named(tmp_path):
    for name in ("a", "b", "c"):
        save_image(tmp_path / "s" / "images" / f"{name}.jpg", np.full((60, 80, 3), 90, np.uint8))
    with pytest.raises(ValueError, match=r"placed 0 of 3 views.*not a, b, c\. Take more photos"):
        run_poses(tmp_path / "s", tmp_path / "out", masks="none")


UPRIGHT, ACROSS = (150, 200), (200, 150)  # width and height in px of a phone's photographs in portrait and landscape


def write_walk(folder: Path, sizes: Sequence[tuple[int, int]], endings: Sequence[str]) -> dict[str, np.ndarray]:
    """Write a photograph of `room_walk` for each size (W, H) and file ending to folder/images.

    Returns:
        View name -> true pose [4, 4] from world to camera.
    """
    generator, truth = np.random.default_rng(0), room_walk(len(sizes))
    textures = room_textures(generator)
    (folder / "images").mkdir(parents=True)
    for (name, pose), size, ending in zip(truth.items(), sizes, endings, strict=True):
        picture = Image.fromarray(render_room_corner(pose, textures, size))
        picture.save(folder / "images" / f"{name}.{ending}", **{"webp": {"lossless": True}}.get(ending, {}))
    return truth


def test_photographs_of_every_kind_are_placed(tmp_path):
    """Among the photographs are WebP and TIFF files. COLMAP cannot read their EXIF data, or not even the pictures."""
    endings = ("webp", "webp", "tiff", "bmp", "png", "webp")
    truth = write_walk(tmp_path / "s", [ACROSS] * 6, endings)
    scene = run_poses(tmp_path / "s", tmp_path / "out", masks="none")
    assert sorted(scene.cameras) == sorted(truth)
    assert_accepted(scene, truth)


def test_photographs_of_two_orientations_are_placed(tmp_path):
    """Portrait and landscape photographs of one phone share a lens, and its focal length is estimated within 2 %."""
    sizes = [ACROSS, UPRIGHT, UPRIGHT, ACROSS, UPRIGHT, ACROSS, UPRIGHT, UPRIGHT]
    truth = write_walk(tmp_path / "s", sizes, ["png"] * 8)
    scene = run_poses(tmp_path / "s", tmp_path / "out", masks="none")
    assert sorted(scene.cameras) == sorted(truth)
    assert_accepted(scene, truth)
    assert [(c.width, c.height) for _, c in sorted(scene.cameras.items())] == sizes
    assert load_json(tmp_path / "out" / "sfm.json")["lenses"] == 1
    assert [camera.fx for camera in scene.cameras.values()] == pytest.approx([170] * 8, rel=0.02)


def test_which_views_share_a_lens(tmp_path):
    """Views share a lens if their sizes agree (in portrait or landscape) and their EXIF focal lengths agree."""

    def written(name: str, size: tuple[int, int], film: float | None) -> Path:
        exif = Image.Exif()
        if film:
            exif.get_ifd(0x8769)[0xA405] = film
        Image.new("L", size).save(tmp_path / name, exif=exif)
        return tmp_path / name

    photos = {"a": (ACROSS, 28), "b": (ACROSS, 28), "c": (UPRIGHT, 28), "d": (ACROSS, 56), "e": (UPRIGHT, None)}
    photos |= {"f": ((150, 150), 28), "g": (ACROSS, None)}
    groups = sfm.group_by_lens({n: written(f"{n}.webp", *how) for n, how in photos.items()}, tmp_path)
    assert [group for group, _ in groups] == [["f"], ["e", "g"], ["a", "b", "c"], ["d"]]
    film = 1.25 / 43.27  # for 4:3: the longer side's share of the diagonal, divided by the film's diagonal in mm
    assert [focal for _, focal in groups][1:] == [None, pytest.approx(28 * film, 1e-3), pytest.approx(56 * film, 1e-3)]


@pytest.mark.parametrize("ending", ["jpg", "webp", "png", "tiff"])
def test_focal_length_from_exif(tmp_path, ending):
    path = tmp_path / f"photo.{ending}"

    def focal(maker: str = "", model: str = "", **tags) -> float | None:
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = maker, model
        exif.get_ifd(0x8769).update({int(tag[1:], 16): value for tag, value in tags.items()})
        Image.new("RGB", (360, 240)).save(path, exif=exif.tobytes())
        return sfm.relative_focal_length(path, tmp_path)

    assert focal(xA405=28) == pytest.approx(28 / 36, rel=0.01)
    # 18 mm on a camera whose sensor width COLMAP knows (23.6 mm), then on a camera whose file states the resolution
    assert focal("NIKON CORPORATION", "NIKON D90", x920A=IFDRational(18)) == pytest.approx(18 / 23.6, rel=0.01)
    resolution = {"xA20E": IFDRational(360 / 2.36), "xA210": 3}
    assert focal("a", "b", x920A=IFDRational(18), **resolution) == pytest.approx(18 / 23.6, rel=0.01)
    assert focal("Canon", "of no table", x920A=IFDRational(18)) is None
    assert focal(xA405=0) is None and focal() is None
    assert sorted(file.name for file in tmp_path.iterdir()) == [path.name]


@pytest.mark.slow
def test_demo_photos(tmp_path):
    """All photographs of the generated demo scene are placed at their true poses."""
    made = [sys.executable, "-m", "lab.scenes.generate", "--out", str(tmp_path / "s"), "--kind", "photos"]
    subprocess.run(made, check=True, cwd=ROOT)
    record = json.loads((tmp_path / "s" / "truth" / "cameras.json").read_text())
    truth = {name: np.array(pose) for name, pose in record["world_to_camera"].items()}
    scene = run_poses(tmp_path / "s", tmp_path / "out")
    assert sorted(scene.cameras) == sorted(truth)
    assert_accepted(scene, truth)


@pytest.mark.slow
def test_bear(tmp_path):
    """A dozen neighboring photographs get the capture's poses, which COLMAP estimated from 96 photographs."""
    capture = load_capture(real_capture("bear"))
    names = sorted(capture.pictures)[:24:2]
    (tmp_path / "s" / "images").mkdir(parents=True)
    for name in names:
        shutil.copy(capture.pictures[name], tmp_path / "s" / "images")
    scene = run_poses(tmp_path / "s", tmp_path / "out", masks="none")
    assert sorted(scene.cameras) == names
    assert_accepted(scene, {name: center_principal_ray(capture.poses, name) for name in names})


def center_principal_ray(source: Poses, name: str) -> np.ndarray:
    """Return the view's pose [4, 4], rotated so that the camera looks along the ray through the middle of its picture.

    The pictures of the capture `bear` are crops whose principal point is 17 px off the middle. Structure from motion
    assumes a principal point in the middle and compensates by a rotation of the camera (1.8 degrees), which the
    comparison must not count as an error.
    """
    lens = source.lenses[name]
    ray = np.array([(lens.width / 2 - lens.cx) / lens.fx, (lens.height / 2 - lens.cy) / lens.fy, 1.0])
    ray /= np.linalg.norm(ray)
    axis = np.cross(ray, [0.0, 0.0, 1.0])
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(4)
    turn[:3, :3] += skew + skew @ skew / (1 + ray[2])
    return turn @ source.world_to_camera[name]
