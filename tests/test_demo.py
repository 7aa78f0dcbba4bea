"""The generator of synthetic scenes: layout, poses, lens and ground truth."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from test_demo_places import photograph_scene, shrink_kind

from reffusion.io import colmap
from reffusion.io.given_masks import load_given_mask
from reffusion.io.images import load_image

pytestmark = pytest.mark.integration


ROOT = Path(__file__).resolve().parents[1]


def png_stems(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.glob("*.png"))


def read_files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def project_by_truth(truth: dict, view: str, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the image points [P, 2] and the camera z [P] of scene points, from truth/cameras.json alone."""
    pose = np.array(truth["world_to_camera"][view])
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
    x, y = x / z, y / z
    bend = truth["f"] * (1 + truth["k1"] * (x * x + y * y))
    return np.stack([bend * x + truth["cx"], bend * y + truth["cy"]], 1), z


def test_same_seed_same_bytes_and_old_files_go(generate, mini_scene, tmp_path):
    again, small = tmp_path / "again", replace(generate.KINDS["mini"], test=1, train=3, node=0.4)
    others = []
    for seed in (0, 1):
        generate.generate(again, seed, small)
        others.append((again / "images_4/IMG_2003.png").read_bytes())
    assert others[0] != others[1]
    (again / "images_4" / "stale.png").write_bytes(b"")
    generate.generate(again, 0, generate.KINDS["mini"])
    assert read_files(again) == read_files(mini_scene)


def test_a_depth_map_as_a_network_gives_it(generate, tmp_path):
    kind = replace(generate.KINDS["mini"], depth_error=0.25, bend=0.0, node=0.4)
    generate.generate(tmp_path / "mono", 0, kind)
    (reference,) = yaml.safe_load((tmp_path / "mono/scene.yaml").read_text())["reference"]
    name = reference["view"]
    label = lambda view: np.atleast_3d(load_image(tmp_path / f"mono/images_4/label/{view}.png"))[..., 0] > 0
    estimate = np.load(tmp_path / "mono" / reference["depth"])
    depth, mask = np.load(tmp_path / f"mono/truth/depth/{name}.npy"), label(name)
    # Scale and offset of the disparity, by least squares where the photograph shows the scene.
    known = np.stack([estimate[~mask], np.ones((~mask).sum())], 1)
    scale, offset = np.linalg.lstsq(known, 1 / depth[~mask], rcond=None)[0]
    error = np.abs(np.log((scale * estimate + offset) * depth))
    assert scale > 0 and error[mask].max() > 0.15 and np.median(error[~mask]) < 0.06
    for path in sorted((tmp_path / "mono/truth/without_object").glob("*.png")):
        hidden = label(path.stem)
        assert np.array_equal(load_image(path)[~hidden], load_image(tmp_path / f"mono/images_4/{path.name}")[~hidden])
    assert len([*(tmp_path / "mono/truth/without_object").iterdir()]) == kind.train


def test_foreign_files_are_never_overwritten(generate, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="did not write"):
        generate.generate(tmp_path, 0, generate.KINDS["mini"])
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_layout_is_spin_nerfs(generate, mini_scene):
    kind = generate.KINDS["mini"]
    names = png_stems(mini_scene / "images_4")
    train = names[kind.test :]
    assert len(names) == kind.test + kind.train
    assert png_stems(mini_scene / "images_4/label") == train
    assert png_stems(mini_scene / "images_4/test_label") == [f"out_{k:05d}" for k in range(kind.test)]
    label = load_image(mini_scene / f"images_4/label/{train[0]}.png")
    assert label.shape[:2] == (kind.height, kind.width)
    assert set(np.unique(label)) == {0, 1}
    scene = yaml.safe_load((mini_scene / "scene.yaml").read_text())
    assert set(scene) == {"reference", "profile"} and scene["profile"] == "laptop"
    assert scene["reference"]["view"] in train
    assert load_image(mini_scene / scene["reference"]["image"]).shape == (kind.height, kind.width, 3)
    demo = generate.KINDS["demo"]
    assert (demo.test, demo.train) == (40, 60)


def test_poses_bounds_model_and_truth_agree(mini_scene, generate):
    kind = generate.KINDS["mini"]
    truth = json.loads((mini_scene / "truth/cameras.json").read_text())
    llff = np.load(mini_scene / "poses_bounds.npy")
    model = {Path(image.name).stem: image for image in colmap.load_images(mini_scene / "sparse/0/images.bin").values()}
    names = png_stems(mini_scene / "images_4")
    assert llff.shape == (len(names), 17)
    assert sorted(model) == names
    for row, name in zip(llff, names, strict=True):
        pose = np.array(truth["world_to_camera"][name])
        down, right, back, center, size = row[:15].reshape(3, 5).T
        np.testing.assert_allclose(pose[:3, :3], np.stack([right, down, -back]), atol=1e-12)
        np.testing.assert_allclose(-pose[:3, :3].T @ pose[:3, 3], center, atol=1e-12)
        np.testing.assert_allclose(size, [4 * kind.height, 4 * kind.width, 4 * truth["f"]])
        np.testing.assert_allclose(model[name].world_to_camera, pose, atol=1e-12)
    (camera,) = colmap.load_cameras(mini_scene / "sparse/0/cameras.bin").values()
    assert (camera.width, camera.height) == (4 * kind.width, 4 * kind.height)
    points = colmap.load_model_points(mini_scene / "sparse/0/points3D.bin").positions
    depths = np.concatenate([project_by_truth(truth, name, points)[1] for name in names])
    assert llff[:, 15].min() > 0
    assert llff[:, 16].max() <= depths.max()


def test_sparse_points_lie_on_what_the_training_views_show(mini_scene):
    """The sparse points have the colors of the pixels onto which they project.

    The colors of pixels six columns away differ far more. Poses, lens and points are therefore consistent.
    """
    truth = json.loads((mini_scene / "truth/cameras.json").read_text())
    model = colmap.load_model_points(mini_scene / "sparse/0/points3D.bin")
    errors = {0: [], 6: []}
    for name in png_stems(mini_scene / "images_4/label"):
        image = load_image(mini_scene / f"images_4/{name}.png").astype(float)
        uv, _ = project_by_truth(truth, name, model.positions)
        for shift, found in errors.items():
            column, row = np.floor(uv + np.array([shift, 0])).astype(int).T
            inside = (column >= 0) & (row >= 0) & (column < image.shape[1]) & (row < image.shape[0])
            found.append(np.abs(image[row[inside], column[inside]] - model.colors[inside]).mean(1))
    near, far = (np.median(np.concatenate(found)) for found in errors.values())
    assert near < 0.6 * far


def test_only_masked_pixels_change_when_the_object_goes(generate, mini_scene):
    view = yaml.safe_load((mini_scene / "scene.yaml").read_text())["reference"]["view"]
    photo, reference = load_image(mini_scene / f"images_4/{view}.png"), load_image(mini_scene / "reference.png")
    mask = load_given_mask(mini_scene / f"images_4/label/{view}.png")
    assert np.array_equal(photo[~mask], reference[~mask])
    assert (photo[mask] != reference[mask]).any(1).mean() > 0.9


@pytest.fixture(scope="module")
def mini_world(generate):
    """The world of `mini_scene`, and the point that its cameras look at."""
    furniture, target = generate.furnish(0, generate.KINDS["mini"])
    return generate.bake(furniture, 0, generate.KINDS["mini"]), target


def test_test_views_are_without_the_object(generate, mini_scene, mini_world):
    """A test view rendered again with the object differs inside its mask, and only inside its mask."""
    from lab.scenes import photographs

    kind, (world, target) = generate.KINDS["mini"], mini_world
    train, test = (
        photographs.path(0, kind, target, n, label) for n, label in ((kind.train, "train"), (kind.test, "test"))
    )
    middle = np.argmin(np.linalg.norm(train[:, 13:] - train[:, 13:].mean(0), axis=1))
    world = photographs.set_exposure(world, train[middle], kind)
    for k, name in enumerate(png_stems(mini_scene / "images_4")[: kind.test]):
        photo = load_image(mini_scene / f"images_4/{name}.png")
        mask = load_given_mask(mini_scene / f"images_4/test_label/out_{k:05d}.png")
        with_object, _ = photographs.shoot(world, test[k], kind, True)
        assert np.array_equal(photo[~mask], with_object[~mask])
        assert (photo[mask] != with_object[mask]).any(1).mean() > 0.9


def test_never_seen_pixels_are_never_seen(generate, mini_scene, mini_world):
    """The background of a pixel in truth/never_seen is masked or occluded in every training view.

    The test projects the background points by truth/cameras.json and not by the generator's own code.
    """
    from lab.scenes import photographs, raycast

    kind, (world, target), frame = generate.KINDS["mini"], mini_world, generate.scene_frame(0)
    truth = json.loads((mini_scene / "truth/cameras.json").read_text())
    cameras = photographs.path(0, kind, target, kind.test, "test")
    training = {
        name: load_given_mask(mini_scene / f"images_4/label/{name}.png")
        for name in png_stems(mini_scene / "images_4/label")
    }
    for k, name in enumerate(png_stems(mini_scene / "images_4")[: kind.test]):
        mask = load_given_mask(mini_scene / f"images_4/test_label/out_{k:05d}.png")
        never = load_given_mask(mini_scene / f"truth/never_seen/{name}.png")
        assert not (never & ~mask).any()
        points, _ = raycast.surface_points(world.solids, cameras[k], photographs.pixel_centers(mask), False)
        back, _ = project_by_truth(truth, name, frame.points(points))
        np.testing.assert_allclose(back, photographs.pixel_centers(mask), atol=1e-6)
        visible = np.zeros(len(points), bool)
        for view, covered in training.items():
            uv, _ = project_by_truth(truth, view, frame.points(points))
            column, row = np.floor(uv).astype(int).T
            inside = (column >= 0) & (row >= 0) & (column < kind.width) & (row < kind.height)
            visible[inside] |= ~covered[row[inside], column[inside]]
        assert visible[~never[mask]].all()
        # Up to a tenth of the points project onto unmasked pixels, but furniture that remains occludes these points.
        assert visible[never[mask]].mean() < 0.1


@pytest.mark.parametrize("name", ["demo", "wide", "360"])
def test_two_fifths_of_the_mask_are_never_seen(generate, name):
    for seed in (0, 11):
        facts = generate._facts(seed, photograph_scene(name, seed)[2])
        assert min(facts["never_seen_share"].values()) >= 0.4
        assert 0.06 < facts["mask_share"]["train"] < 0.25


def test_floating_objects_hide_nothing_from_all_views(generate, tmp_path):
    facts = generate.generate(tmp_path / "seen", 0, shrink_kind(generate.KINDS["seen"]))
    assert max(facts["never_seen_share"].values()) <= generate.MOST_NEVER_SEEN < 0.01
    assert facts["mask_share"]["train"] > 0.01
    assert "reference" not in yaml.safe_load((tmp_path / "seen/scene.yaml").read_text())


def test_too_small_a_share_is_an_error_and_writes_nothing(generate, tmp_path):
    with pytest.raises(ValueError, match="never seen"):
        generate.generate(tmp_path / "scene", 0, replace(generate.KINDS["mini"], least=0.99, node=0.4))
    assert not (tmp_path / "scene").exists()


def test_insertion_and_outpainting_are_asked_for_by_scene_files(generate, tmp_path):
    """For insertion, the reference picture shows an object that its photograph does not show.

    For outpainting, the mask covers all pixels outside the disc of a sphere.
    """
    stamp, scenes = {"width": 64, "height": 48, "samples": 1, "train": 8, "test": 3, "texture": 256}, {}
    for name in ("insert", "outpaint"):
        generate.generate(tmp_path / name, 0, replace(generate.KINDS[name], **stamp, node=0.4))
        scenes[name] = yaml.safe_load((tmp_path / name / "scene.yaml").read_text())
    folder, reference = tmp_path / "insert", scenes["insert"]["reference"][0]
    photo, picture = load_image(folder / f"images_4/{reference['view']}.png"), load_image(folder / reference["image"])
    depth, differs = np.load(folder / reference["depth"]), (photo != picture).any(-1)
    assert 0.02 < differs.mean() < 0.25 and scenes["insert"]["region"]["radius"] > 0
    assert np.median(depth[differs]) < 0.9 * np.median(depth[~differs])
    mask = load_given_mask(tmp_path / "outpaint/images_4/test_label/out_00000.png")
    assert not mask[24, 32] and mask[0, 0] and 3 <= len(scenes["outpaint"]["reference"]) <= 9
    assert scenes["outpaint"]["region"]["outside"]


def test_the_photos_layout_has_no_poses(generate, tmp_path):
    kind = replace(generate.KINDS["photos"], width=48, height=36, train=4, texture=256, node=0.4)
    generate.generate(tmp_path / "photos", 7, kind)
    assert png_stems(tmp_path / "photos/images") == png_stems(tmp_path / "photos/masks")
    assert sorted(p.name for p in (tmp_path / "photos").iterdir()) == ["images", "masks", "truth"]


def test_make_knows_every_kind_by_its_name(generate, tmp_path):
    (tmp_path / ".ready").touch()
    for kind in generate.KINDS.keys() - {"demo", "mini"}:
        words = ["make", "-n", "-C", str(ROOT), f"VENV={tmp_path}", f"data/demo-{kind}-3/.generated"]
        recipe = subprocess.run(words, capture_output=True, text=True, check=True).stdout
        assert f"--out data/demo-{kind}-3 --kind {kind} --seed 3" in recipe


def test_views_that_look_past_differ_from_the_demo_in_direction_alone(generate):
    from lab.scenes import photographs

    demo, past = generate.KINDS["mini"], replace(generate.KINDS["mini"], past=0.15)
    target = np.array([0.0, 1.0, 0.0])
    assert (photographs.path(0, demo, target, 8, "train") == photographs.path(0, past, target, 8, "train")).all()
    cameras, turned = (photographs.path(0, kind, target, 8, "test") for kind in (demo, past))
    assert (cameras[:, [0, 1, 2, 3, 13, 14, 15]] == turned[:, [0, 1, 2, 3, 13, 14, 15]]).all()
    axes, turned_axes = (each[:, 4:13].reshape(-1, 3, 3)[:, :, 2] for each in (cameras, turned))
    tangent = np.tan(np.arccos((axes * turned_axes).sum(1)))
    assert np.allclose(tangent, 0.15 * demo.width / cameras[:, 0], rtol=1e-6)
