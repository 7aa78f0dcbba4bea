"""Captures of other programs are read with the right cameras and masks, or refused in one line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes.capture import (
    HEIGHT,
    WIDTH,
    Truth,
    convert_to_text,
    load_test_masks,
    make_truth,
    reprojection_error,
    write_capture,
    write_masks,
    write_pictures,
    write_poses_bounds,
    write_transforms,
)
from scenes.capture_checks import (
    EXACT,
    SHARE,
    assert_cameras,
    assert_message,
    change_transforms,
    rename_views,
    run_with_messages,
    set_in_frames,
    write_named_model,
)

from reffusion.capture.lens import sampling_map, undistorted_pinhole
from reffusion.capture.scene_folder import read_scene
from reffusion.io import colmap
from reffusion.io.arrays import load_json
from reffusion.io.files import BadInput
from reffusion.io.images import load_mask
from reffusion.io.ply import save_points
from reffusion.io.scene import list_objects, load_raw_masks
from reffusion.params.poses import Params
from stages.plan import poses as plan


def mask_shares(out: Path) -> dict[str, float]:
    return {
        p.relative_to(out / "masks").as_posix(): load_mask(p).mean() for p in sorted((out / "masks").rglob("*.png"))
    }


def write_textured_views(folder: Path, truth: Truth, names: dict[str, str]) -> np.ndarray:
    """Write pictures of the textured plane z = 0, and return the plane's colors at the truth's points.

    Args:
        folder: the folder to write to.
        truth: cameras and points.
        names: view -> path of its picture below `folder`.

    Returns:
        uint8 [P, 3].
    """
    generator = np.random.default_rng(0)
    waves = generator.normal(size=(12, 3)) * 7
    phases = generator.uniform(0, 2 * np.pi, 12)
    shade = lambda points: 128 + 90 * np.tanh(np.sin(points @ waves.T + phases).sum(-1) / 2)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    at = truth.lens
    for view, name in names.items():
        pose = truth.world_to_camera[view]
        local = np.stack([(columns - at.cx) / at.fx, (rows - at.cy) / at.fy, np.ones_like(rows)], -1) @ pose[:3, :3]
        center = -pose[:3, :3].T @ pose[:3, 3]
        points = center + local * (-center[2] / local[..., 2])[..., None]
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.repeat(shade(points)[..., None], 3, 2).astype(np.uint8)).save(path)
    return np.repeat(shade(truth.points)[:, None], 3, 1).astype(np.uint8)


def flat_truth(views: int = 12, points: int = 400) -> Truth:
    """Return the cameras of `make_truth` and random points on the plane z = 0 in front of them."""
    places = np.random.default_rng(5).uniform(-0.9, 0.9, (points, 3)) * (1, 1, 0)
    return replace(make_truth(views=views), points=places)


# ---------------------------------------------------------------------------------- choice among COLMAP models


def test_a_lone_model_with_another_number_is_found(tmp_path):
    truth = make_truth()
    folder = write_capture(tmp_path / "s", "colmap txt", truth)
    (folder / "sparse/0").rename(folder / "sparse/1")
    scene, _, messages = run_with_messages(folder)
    assert_cameras(scene, truth)
    assert not any("is taken" in each for each in messages)


# ------------------------------------------------------------------------------------------- names of views, folders


@pytest.mark.parametrize("name", ["day1/{}.png", "images/{}.png", "day1\\{}.png", "C:\\scans\\day1\\{}.PNG"])
def test_names_of_the_model_with_folders(tmp_path, name):
    truth = make_truth()
    folder = write_capture(tmp_path / "s", "transforms", truth)
    (folder / "transforms.json").unlink()
    write_named_model(folder / "sparse/0", truth, {view: name.format(view) for view in truth.world_to_camera})
    scene, out, _ = run_with_messages(folder)
    assert_cameras(scene, truth)
    assert len(mask_shares(out)) == 6


@pytest.mark.parametrize("flat", [False, True], ids=["model with folders", "flat model"])
def test_pictures_in_folders(tmp_path, flat):
    truth, folder = make_truth(), tmp_path / "s"
    path = {view: f"day{k % 2}/{view}.png" for k, view in enumerate(sorted(truth.world_to_camera))}
    for view, each in path.items():
        write_pictures(folder / "images" / Path(each).parent, [view])
        write_masks(folder / "masks" / Path(each).parent, [view])
    write_named_model(folder / "sparse/0", truth, {view: f"{view}.png" if flat else path[view] for view in path})
    scene, out, _ = run_with_messages(folder)
    assert_cameras(scene, truth)
    assert list_objects(out) == [] and len(load_raw_masks(out, scene.train)) == 6


def test_equal_names_in_two_folders_are_called_by_their_paths(tmp_path):
    truth, folder = make_truth(), tmp_path / "s"
    path = {view: f"cam{k % 2}/{k // 2:04d}.png" for k, view in enumerate(sorted(truth.world_to_camera))}
    for each in path.values():
        kind = "test_masks" if each == "cam0/0001.png" else "masks"
        write_pictures(folder / "images" / Path(each).parent, [Path(each).stem])
        write_masks(folder / kind / Path(each).parent, [Path(each).stem])
        (folder / kind / each).rename(folder / kind / f"{each}.png")  # COLMAP names the mask of A.png A.png.png
    write_named_model(folder / "sparse/0", truth, path)
    scene, out, _ = run_with_messages(folder, test=["cam0/0001.png"], clean=["cam1-0002"], test_masks="test_masks")
    assert_cameras(scene, rename_views(truth, {view: each[:-4].replace("/", "-") for view, each in path.items()}))
    assert scene.test == ("cam0-0001",) and scene.clean == {"cam1-0002"}
    assert set(mask_shares(out)) == {f"{view}.png" for view in scene.train}
    assert [*load_test_masks(out)] == ["cam0-0001"]
    with pytest.raises(BadInput, match=r"test: there is no view 'cam2/0001\.png'; views are named like cam"):
        read_scene(Params(test=["cam2/0001.png"]), folder)


# ----------------------------------------------------------------------------------------- Blender's files


@pytest.mark.parametrize("splits", [("train", "test"), ("train", "val"), ("train", "test", "val")])
def test_blenders_files_with_their_split(tmp_path, splits):
    truth, folder = make_truth(views=8), tmp_path / "s"
    views, flip = sorted(truth.world_to_camera), np.diag([1.0, -1, -1, 1])
    for k, split in enumerate(splits):
        mine = views[:4] if split == "train" else views[2 + 2 * k : 4 + 2 * k]
        write_pictures(folder / split, [f"r_{n}" for n in range(len(mine))])
        frames = [
            {
                "file_path": f"./{split}/r_{n}",
                "transform_matrix": (np.linalg.inv(truth.world_to_camera[v]) @ flip).tolist(),
            }
            for n, v in enumerate(mine)
        ]
        record = {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / truth.lens.fx), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(record))
    scene, _, messages = run_with_messages(folder, masks="none")
    of = {views[n]: f"train-r_{n}" for n in range(4)} | {views[4 + n]: f"{splits[1]}-r_{n}" for n in range(2)}
    assert_cameras(scene, rename_views(truth, of))
    assert sorted(scene.train) == [*of.values()][:4] and sorted(scene.test) == [*of.values()][4:]
    assert any("transforms_val.json" in each for each in messages) == (len(splits) == 3)


# -------------------------------------------------------------------------------------------- values of mask files


def test_a_palette_with_white_first(tmp_path):
    folder = write_capture(tmp_path / "s", "colmap", make_truth())
    for path in (folder / "masks").iterdir():
        Image.open(path).convert("RGB").quantize(2).save(path)
        assert Image.open(path).getpalette()[:3] == [255, 255, 255]
    assert np.allclose([*mask_shares(run_with_messages(folder)[1]).values()], SHARE)


def test_maps_of_object_numbers_ask_for_the_number(tmp_path):
    folder = write_capture(tmp_path / "s", "colmap", make_truth())
    for path in (folder / "masks").iterdir():
        numbers = np.full((HEIGHT, WIDTH), 30, np.uint8)
        numbers[40:], numbers[18:36, 24:48] = 200, 32
        Image.fromarray(numbers).save(path)
    with pytest.raises(BadInput, match=r"v00\.png: its values \(30, 32, 200\) are neither.*`masks: \{id: \.\.\.\}`"):
        run_with_messages(folder)
    assert np.allclose([*mask_shares(run_with_messages(folder, masks={"id": 32})[1]).values()], SHARE)
    both = mask_shares(run_with_messages(folder, masks={"folder": "masks", "id": [32, 200]})[1])
    assert np.allclose([*both.values()], SHARE + 32 / 72)
    with pytest.raises(BadInput, match=r"masks: all 6 masks are empty for the id 7; correct `masks: \{id: \.\.\.\}`"):
        run_with_messages(folder, masks={"id": 7})


# -------------------------------------------------------------------------- references and masks beside photographs


def test_a_reference_among_bare_photographs_is_no_view(tmp_path):
    write_pictures(tmp_path, [f"v{k:02d}" for k in range(6)] + ["reference"])
    write_masks(tmp_path / "masks", [f"v{k:02d}" for k in range(6)])
    roles = read_scene(Params(reference={"view": "v01", "image": "reference.png"}), tmp_path)[1]
    assert roles.train == tuple(f"v{k:02d}" for k in range(6))


def test_a_reference_among_the_photographs_of_poses_bounds(tmp_path):
    folder = write_capture(tmp_path / "s", "llff", make_truth())
    write_pictures(folder / "images_4", ["reference"])
    reference = {"view": "v01", "image": "images_4/reference.png"}
    assert read_scene(Params(reference=reference), folder)[1].train == tuple(f"v{k:02d}" for k in range(6))


@pytest.mark.parametrize("masks", ["images", None])
def test_masks_beside_their_photographs(tmp_path, masks):
    folder = write_capture(tmp_path / "s", "colmap", make_truth())
    for path in (folder / "masks").iterdir():
        path.rename(folder / "images" / f"{path.stem}_mask.png")
    scene, out, messages = run_with_messages(folder, masks=masks)
    assert np.allclose([*mask_shares(out).values()], SHARE) and len(scene.train) == 6
    assert not any("not in the model" in each for each in messages)


def test_photographs_are_not_their_own_masks(tmp_path):
    folder = write_capture(tmp_path / "s", "colmap", make_truth())
    with pytest.raises(
        BadInput, match=r"images: it holds photographs, and no mask beside one \(A_mask\.png beside A\.png\)"
    ):
        plan.preview(Params(masks="images"), folder)


# ---------------------------------------------------------------------------------------------- order of names, points


def test_names_that_do_not_match_are_not_paired_by_order(tmp_path):
    truth, folder = make_truth(views=12), tmp_path / "s"
    write_pictures(folder / "images", [f"{k + 1:04d}" for k in range(12)])
    write_masks(folder / "masks", [f"{k + 1:04d}" for k in range(12)])
    views = sorted(truth.world_to_camera)
    write_named_model(folder / "sparse/0", truth, {view: f"frame{k + 1}.png" for k, view in enumerate(views)})
    with pytest.raises(BadInput, match=r"none of its 12 images \(frame1\.png.*is called like a picture in .*0001\.png"):
        plan.preview(Params(), folder)


def test_renamed_copies_are_paired_in_the_order_of_names(tmp_path):
    """The copies in images_4 have other names than the model's images."""
    folder, numbers = tmp_path / "s", range(8, 20)  # as text, frame10 comes before frame8
    named = {f"image{k:03d}": name for k, name in enumerate(sorted(f"frame{n}.jpg" for n in numbers))}
    truth = rename_views(flat_truth(), dict(zip(sorted(flat_truth().world_to_camera), named, strict=True)))
    colors = write_textured_views(folder / "images_4", truth, {view: f"{view}.png" for view in named})
    write_masks(folder / "images_4/label", named)
    at, view_of = truth.lens, {name: view for view, name in named.items()}
    images = {
        n: colmap.ModelImage(f"frame{n}.jpg", 1, truth.world_to_camera[view_of[f"frame{n}.jpg"]]) for n in numbers
    }
    cameras = {1: colmap.ModelCamera("SIMPLE_PINHOLE", WIDTH, HEIGHT, (at.fx, at.cx, at.cy))}
    colmap.save_model(folder / "sparse/0", cameras, images, truth.points, colors)
    write_poses_bounds(folder, truth)
    scene, _, messages = run_with_messages(folder)
    assert_cameras(scene, truth)
    assert_message(messages, "paired with the images of images.bin in order of names")


@pytest.mark.parametrize("layout", ["colmap", "transforms"])
@pytest.mark.parametrize("change", ["none", "moved", "scaled", "turned"])
def test_points_of_another_frame_are_not_used(tmp_path, layout, change):
    truth, folder = flat_truth(views=6), tmp_path / "s"
    colors = write_textured_views(folder / "images", truth, {view: f"{view}.png" for view in truth.world_to_camera})
    write_masks(folder / "masks", truth.world_to_camera)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    points = {
        "none": truth.points,
        "moved": truth.points + 1000,
        "scaled": truth.points / 2,
        "turned": truth.points @ turn.T,
    }[change]
    if layout == "colmap":
        names = {view: f"{view}.png" for view in truth.world_to_camera}
        write_named_model(folder / "sparse/0", replace(truth, points=points), names)
        images, cameras = (load(folder / f"sparse/0/{stem}.bin") for load, stem in
                           ((colmap.load_images, "images"), (colmap.load_cameras, "cameras")))  # fmt: skip
        colmap.save_model(folder / "sparse/0", cameras, images, points, colors)
    else:
        write_transforms(folder, truth)
        save_points(folder / "sparse_pc.ply", points, colors)
    capture, _ = read_scene(Params(), folder)
    messages = " ".join(capture.warnings)
    assert len(capture.poses.points) == (400 if change == "none" else 0)
    assert ("not in the frame of the cameras and are not used" in messages) == (change != "none")


def test_nothing_matched_is_not_zero_pixels(tmp_path, capsys):
    _, out, _ = run_with_messages(write_capture(tmp_path / "s", "colmap", make_truth()), refine=True)
    assert "cameras as given: optical flow matches nothing between the views" in capsys.readouterr().out
    assert load_json(out / "refine.json") == {"before": None, "after": None}


# ----------------------------------------------------------- Unicode names, unreadable files, camera models


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<html>404</html>", r"not a readable image; save it anew as JPEG or PNG \(UnidentifiedImageError"),
        ("version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "a pointer of Git LFS, not the file; download"),
    ],
)
def test_files_that_are_no_pictures_are_named(tmp_path, monkeypatch, content, message):
    folder = write_capture(tmp_path / "s", "colmap", make_truth())
    Image.init()  # registers every format before the table of formats is replaced
    monkeypatch.setattr(Image, "OPEN", {kind: opener for kind, opener in Image.OPEN.items() if kind != "HEIF"})
    (folder / "images/v01.png").write_text(content)
    with pytest.raises(BadInput, match=rf"v01\.png: {message}"):
        plan.preview(Params(), folder)


@pytest.mark.parametrize(
    ("model", "params"), [("SIMPLE_FISHEYE", (90.0, 48.0, 36.0)), ("FISHEYE", (90.0, 91.0, 47.0, 36.5))]
)
@pytest.mark.parametrize("text", [False, True])
def test_colmaps_fisheyes_without_coefficients(tmp_path, model, params, text):
    truth = make_truth((model, params))
    folder = write_capture(tmp_path / "s", "transforms", truth)
    (folder / "transforms.json").unlink()
    cameras = {1: colmap.ModelCamera(model, WIDTH, HEIGHT, params)}
    images = {k: colmap.ModelImage(f"{v}.png", 1, pose) for k, (v, pose) in enumerate(truth.world_to_camera.items(), 1)}
    colmap.save_model(folder / "sparse/0", cameras, images, truth.points, np.full((60, 3), 99, np.uint8))
    if text:
        (folder / "sparse/0/cameras.txt").write_text(f"1 {model} {WIDTH} {HEIGHT} {' '.join(map(str, params))}\n")
        (folder / "sparse/0/cameras.bin").unlink()
    scene, _, _ = run_with_messages(folder)
    assert reprojection_error(scene, truth) < EXACT
    # A pixel of the undistorted picture is read where an equidistant fisheye shows the pixel's direction.
    pinhole = undistorted_pinhole(truth.lens)
    at = sampling_map(truth.lens, pinhole)[10, 20]
    x, y = (20.5 - pinhole.cx) / pinhole.fx, (10.5 - pinhole.cy) / pinhole.fy
    stretch = np.arctan(np.hypot(x, y)) / np.hypot(x, y)
    fx, fy, cx, cy = params if len(params) == 4 else (params[0], *params)
    np.testing.assert_allclose(at, (fx * x * stretch + cx, fy * y * stretch + cy), atol=1e-9)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", ["SIMPLE_DIVISION", "DIVISION", "EUCM", "EQUIRECTANGULAR"])
def test_other_models_of_colmap_4_are_refused_by_name(tmp_path, model, text):
    folder = write_capture(tmp_path / "s", "colmap", make_truth())
    params = (90.0, 90.0, 48.0, 36.0, 0.1, 1.0)[: colmap.MODELS[model]]
    images = colmap.load_images(folder / "sparse/0/images.bin")
    cameras = {1: colmap.ModelCamera(model, WIDTH, HEIGHT, params)}
    if text:
        convert_to_text(folder / "sparse/0")
        (folder / "sparse/0/cameras.txt").write_text(f"1 {model} {WIDTH} {HEIGHT} {' '.join(map(str, params))}\n")
    else:
        colmap.save_model(folder / "sparse/0", cameras, images, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    with pytest.raises(
        BadInput, match=rf"cameras\.(bin|txt): camera model {model} is not understood; convert it to one of"
    ):
        plan.preview(Params(), folder)


def test_windows_paths_in_transforms(tmp_path):
    truth = make_truth()
    folder = write_capture(tmp_path / "s", "transforms", truth)
    save_points(folder / "colmap/sparse_pc.ply", truth.points, np.full((60, 3), 99, np.uint8))
    change_transforms(folder, lambda record: record.update(ply_file_path=".\\colmap\\sparse_pc.ply"))
    set_in_frames(folder, "file_path", lambda view: f"D:\\captures\\room\\images\\{view}.png")
    capture, _ = read_scene(Params(), folder)
    assert len(capture.poses.points) == 60 and not capture.warnings and len(capture.pictures) == 6


# -------------------------------------------------- mask and depth files of transforms.json, 16 bits


@pytest.mark.parametrize("place", ["keep", "masks"])
def test_mask_path_and_depth_file_path(tmp_path, place):
    """The folder may be called `masks`, as ours is, whose masks have the opposite sign."""
    truth, folder = flat_truth(views=6), tmp_path / "s"
    write_textured_views(folder / "images", truth, {view: f"{view}.png" for view in truth.world_to_camera})
    write_masks(folder / place, truth.world_to_camera)
    write_transforms(folder, truth)
    for view in truth.world_to_camera:
        Image.fromarray(255 - np.array(Image.open(folder / f"{place}/{view}.png"))).save(folder / f"{place}/{view}.png")
        pose, at = truth.world_to_camera[view], truth.lens
        rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        rays = np.stack([(columns - at.cx) / at.fx, (rows - at.cy) / at.fy, np.ones_like(rows)], -1) @ pose[:3, :3]
        depth = -(-pose[:3, :3].T @ pose[:3, 3])[2] / rays[..., 2]
        (folder / "depth").mkdir(exist_ok=True)
        Image.fromarray(np.round(1000 * depth).astype(np.uint16)).save(folder / f"depth/{view}.png")
    set_in_frames(folder, "mask_path", lambda view: f"{place}/{view}.png")
    set_in_frames(folder, "depth_file_path", lambda view: f"./depth/{view}.png")
    scene, out, messages = run_with_messages(folder)
    assert np.allclose([*mask_shares(out).values()], SHARE)
    assert_message(messages, "mask_path of transforms.json: black, which training ignores, is taken for the object")
    points = scene.similarity.invert(scene.points)
    assert len(points) > 5000 and np.abs(points[:, 2]).max() < 2e-3, "on the plane z = 0, to the millimetre"
    assert_message(messages, f"{len(points)} points are made of the depth maps (depth_file_path) of transforms.json")


def test_pictures_that_no_frame_lists_are_named_and_need_no_masks(tmp_path):
    folder = write_capture(tmp_path / "s", "transforms", make_truth())
    change_transforms(folder, lambda record: record["frames"].pop())  # they are listed from the last to the first
    scene, _, messages = run_with_messages(folder)
    assert len(scene.cameras) == 5
    assert_message(messages, "1 pictures are not in transforms.json and are left out: v00.png")


def test_views_with_masks_of_only_some_objects_are_named(tmp_path):
    folder = write_capture(tmp_path / "s", "transforms", make_truth())
    boxes = (folder / "masks").rename(folder / "box")
    (folder / "masks").mkdir()
    boxes.rename(folder / "masks/box")
    write_masks(folder / "masks/ball", [path.stem for path in sorted((folder / "masks/box").iterdir())[1:]])
    _, _, messages = run_with_messages(folder)
    said = "1 training views have masks of only some objects, which do not count: v00; add empty masks"
    assert_message(messages, said)
