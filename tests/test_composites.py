"""Composites of a synthetic object and a real capture: the object's place, the changed pixels, and the table."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scenes.cameras import rotation_along

from lab.studies import composites, compositing, drawn_places, holes, placement, scoring
from reffusion.capture import lens
from reffusion.io.images import load_image, load_mask, save_image
from reffusion.io.ply import save_points

ROOT = Path(__file__).resolve().parent.parent
CAPTURES = ROOT.parent / "shared" / "data"

WIDTH, HEIGHT = 96, 72
LENS = {"fl_x": 80.0, "fl_y": 82.0, "cx": 47.0, "cy": 36.5, "k1": 0.05, "k2": -0.03, "p1": 0.002, "p2": -0.001}
PLACE = placement.Place("here", "small", "v03", (48.0, 40.0), 0.25, 60.0, train=5, test=2, near=14.0)


def arc_pose(angle: float) -> np.ndarray:
    """Return camera-to-world [4, 4] on an arc of radius 3 at height 2 above the ground y = 0; `angle` in radians."""
    center = np.array([3 * np.sin(angle), 2.0, 3 * np.cos(angle)])
    camera = np.eye(4)
    camera[:3, :3] = rotation_along(-center, (0.0, 1.0, 0.0)).T
    camera[:3, 3] = center
    return camera


@pytest.fixture(scope="module")
def captures_folder(tmp_path_factory) -> Path:
    """Write a capture of a flat ground: 8 noise photographs with lens distortion, and a frame whose file is missing."""
    folder, random = tmp_path_factory.mktemp("captures"), np.random.default_rng(0)
    frames = []
    for k, angle in enumerate(np.radians(np.linspace(-40, 40, 8))):
        matrix = arc_pose(angle) @ placement.OPENGL
        frames.append({"file_path": f"images/v{k:02d}.png", "transform_matrix": matrix.tolist()})
        photo = random.integers(60, 200, (HEIGHT, WIDTH, 3), np.uint8)
        save_image(folder / f"small/images/v{k:02d}.png", photo)
    frames.append({"file_path": "images/lost.png", "transform_matrix": np.eye(4).tolist()})
    meta = {"w": WIDTH, "h": HEIGHT, "camera_model": "OPENCV", **LENS, "frames": frames}
    (folder / "small/transforms.json").write_text(json.dumps(meta))
    ground = random.uniform(-1.5, 1.5, (4000, 3)) * [1, 0, 1]
    save_points(folder / "small/sparse_pc.ply", ground, np.full((4000, 3), 128, np.uint8))
    return folder


def write_composite(captures_folder: Path, out: Path, place=PLACE, **options) -> Path:
    compositing.write_scene(
        place, placement.load_photographs(captures_folder / place.capture), compositing.Options(**options), out
    )
    return out


def load_masks(scene: Path, folder: str = "masks") -> dict[str, np.ndarray]:
    return {path.stem: load_mask(path) for path in sorted((scene / folder).glob("*.png"))}


def project_through_lens(capture: placement.Photographs, name: str, points: np.ndarray) -> np.ndarray:
    """Project points [P, 3] to pixels [P, 2] of the view `name` by `reffusion.capture.lens`, with distortion."""
    of = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    bent = lens.from_colmap("OPENCV", WIDTH, HEIGHT, tuple(LENS[key] for key in of))
    camera = capture.cameras[name]
    seen = (points - camera[:3, 3]) @ camera[:3, :3]
    return lens.to_pixels(lens.distort(seen[:, :2] / seen[:, 2:], bent), bent)


def test_the_object_stands_on_the_ground_where_it_was_pointed_at(captures_folder):
    capture = placement.load_photographs(captures_folder / "small")
    assert sorted(capture.cameras) == [f"v{k:02d}" for k in range(8)]
    thing = placement.place_object(capture, PLACE)
    np.testing.assert_allclose(thing.normal, [0, 1, 0], atol=1e-9)
    assert abs(thing.foot[1]) < 1e-9
    image, depth = capture.project(capture.cameras["v03"], thing.foot[None])
    np.testing.assert_allclose(image[0], PLACE.pixel, atol=1e-6)
    distance = np.linalg.norm(thing.foot - capture.cameras["v03"][:3, 3])
    assert thing.height == pytest.approx(0.25 * distance) and depth[0] > 0


@pytest.mark.parametrize("shape", ["box", "ellipsoid"])
def test_masks_are_the_projected_object(captures_folder, tmp_path, shape):
    """The mask equals the convex hull of the object's projected surface, up to one pixel at the border."""
    place, capture = replace(PLACE, shape=shape), placement.load_photographs(captures_folder / "small")
    thing, scene = placement.place_object(capture, place), write_composite(captures_folder, tmp_path / "scene", place)
    unit = np.random.default_rng(1).normal(size=(4000, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True) if shape == "ellipsoid" else np.abs(unit).max(1, keepdims=True)
    surface = thing.middle + (unit * thing.half) @ thing.axes
    for name, mask in {**load_masks(scene), **load_masks(scene, "test_masks")}.items():
        outline = cv2.convexHull(np.round(16 * (project_through_lens(capture, name, surface) - 0.5)).astype(np.int32))
        hull = np.zeros(mask.shape, np.uint8)
        cv2.fillConvexPoly(hull, outline, 1, shift=4)
        ring = np.ones((3, 3), np.uint8)
        assert not (mask & (cv2.dilate(hull, ring) == 0)).any()
        assert not ((cv2.erode(hull, ring) > 0) & ~mask).any()


def test_only_masked_pixels_of_training_photographs_change(captures_folder, tmp_path):
    scene = write_composite(captures_folder, tmp_path / "scene")
    yes = yaml.safe_load((scene / "scene.yaml").read_text())
    train, test = load_masks(scene), load_masks(scene, "test_masks")
    assert len(train) == 5 and sorted(test) == sorted(yes["test"]) and not set(train) & set(test)
    assert yes["reference"]["view"] in train
    for name in (*train, *test):
        photo, truth, before = (
            load_image(folder / f"{name}.png")
            for folder in (scene / "images", scene / "truth", captures_folder / "small/images")
        )
        assert np.array_equal(truth, before)
        mask = train.get(name, np.zeros(photo.shape[:2], bool))
        assert np.array_equal(photo[~mask], before[~mask])
        assert name in test or (photo[mask] != before[mask]).any(1).mean() > 0.9


def test_a_shadow_darkens_the_ground_outside_the_masks(captures_folder, tmp_path):
    plain = write_composite(captures_folder, tmp_path / "plain")
    shaded = write_composite(captures_folder, tmp_path / "shaded", shadow=0.6)
    for name, mask in load_masks(plain).items():
        assert np.array_equal(mask, load_masks(shaded)[name])
        before, after = (load_image(s / f"images/{name}.png")[~mask].astype(int) for s in (plain, shaded))
        assert (after <= before).all()
        assert (after < 0.6 * before).any(1).sum() > 10
    for name in load_masks(plain, "test_masks"):
        assert np.array_equal(*(load_image(s / f"images/{name}.png") for s in (plain, shaded)))


def test_rough_masks_are_wrong_by_no_more_than_they_may(captures_folder, tmp_path):
    """Masks grow or shrink by at most 3 px and shift by at most 3 px, so borders move by at most 6 px per axis."""
    plain, rough = (
        write_composite(captures_folder, tmp_path / "plain"),
        write_composite(captures_folder, tmp_path / "rough", rough=3),
    )
    far, wrong = np.ones((13, 13), np.uint8), 0
    for name, mask in load_masks(plain).items():
        found = load_masks(rough)[name]
        assert not (found & (cv2.dilate(mask.astype(np.uint8), far) == 0)).any()
        assert not ((cv2.erode(mask.astype(np.uint8), far) > 0) & ~found).any()
        wrong += (found != mask).any()
        assert np.array_equal(*(load_image(s / f"images/{name}.png") for s in (plain, rough)))
    assert wrong >= 4
    exact = load_masks(plain, "test_masks")
    assert all(np.array_equal(mask, exact[name]) for name, mask in load_masks(rough, "test_masks").items())


def test_the_untouched_scene_has_the_same_views_and_nothing_to_remove(captures_folder, tmp_path):
    options = compositing.Options()
    scene, untouched = composites.make_scenes(PLACE, captures_folder, options, tmp_path)
    mtime = (untouched / "scene.yaml").stat().st_mtime_ns
    assert yaml.safe_load((untouched / "scene.yaml").read_text())["masks"] == "none"
    assert (untouched / "transforms.json").read_text() == (scene / "transforms.json").read_text()
    for name in load_masks(scene):
        same = load_image(untouched / f"images/{name}.png"), load_image(scene / f"truth/{name}.png")
        assert np.array_equal(*same)
    composites.make_scenes(PLACE, captures_folder, options, tmp_path)
    assert (untouched / "scene.yaml").stat().st_mtime_ns == mtime
    alone, _ = composites.make_scenes(PLACE, captures_folder, replace(options, reference=False), tmp_path)
    assert alone != scene and "reference" not in yaml.safe_load((alone / "scene.yaml").read_text())


def test_a_place_without_a_surface_is_an_error(captures_folder):
    capture = placement.load_photographs(captures_folder / "small")
    with pytest.raises(ValueError, match="points within"):
        placement.place_object(capture, replace(PLACE, near=0.1))
    with pytest.raises(ValueError, match="no photograph"):
        placement.place_object(capture, replace(PLACE, view="lost"))
    with pytest.raises(ValueError, match="no transforms"):
        placement.load_photographs(captures_folder)


def test_without_captures_it_is_skipped(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["composites.py", "--captures", str(tmp_path / "none")])
    assert composites.main() == 0
    output = capsys.readouterr().out
    assert len(output.splitlines()) == 1 and "skipped" in output


def test_the_sets_share_no_place_and_unknown_ones_are_named():
    names = [place.name for place in (*composites.TUNING_PLACES, *composites.REPORT_PLACES, *composites.NAMED_PLACES)]
    assert len(set(names)) == len(names) == 24
    assert composites.select_places("bear-rim,table", report=False) == (
        composites.REPORT_PLACES[4],
        composites.TUNING_PLACES[0],
    )
    with pytest.raises(ValueError, match="no place is called moon"):
        composites.select_places("moon", report=False)


def test_the_table_has_a_row_a_place():
    scores = {"lpips_vgg": 0.3, "psnr": 21.234, "ssim": 0.6, "flip": None}
    other = scores | {"lpips_vgg": 0.4}
    row = {"place": "here", **dict.fromkeys(scoring.PICTURES, scores), "seconds": 61.6, "variants": {"lift": other}}
    row |= {"sharpness": {"result": 0.8, "ceiling": None}, "uncovered": {"train": 0.001, "test": 0.0125}}
    assert "| here | 0.300 / 21.23 / 0.600 / - |" in scoring.table([row])
    assert (
        scoring.table([row])
        .splitlines()[-1]
        .endswith("| 0.80 | - | 0.10 | 1.25 | 62 | 0.400 / 21.23 / 0.600 / - | 0.75 |")
    )


def test_energy_counts_steps_whose_ends_both_lie_in_the_mask():
    picture, mask = np.zeros((4, 6, 3), np.uint8), np.zeros((4, 6), bool)
    picture[:, 3:] = 255  # one edge, between columns 2 and 3
    mask[1:3, 1:3] = True
    assert holes.gradient_energy(picture, mask) == 0  # the step crosses the border of the mask
    mask[1:3, 3] = True
    assert holes.gradient_energy(picture, mask) == pytest.approx(
        2 / 7
    )  # 2 of the 7 steps (4 horizontal, 3 vertical) in the mask


@pytest.mark.skipif(not CAPTURES.is_dir(), reason="needs the captures")
def test_drawn_places_are_those_of_the_list():
    garden = placement.load_photographs(CAPTURES / "garden")
    [places] = drawn_places.draw_places([garden], 20261130, 3, 16)
    known = {place.name: place for place in drawn_places.load_drawn_places()}
    assert [known[place.name] for place in places] == places


def test_places_of_one_use_are_disjoint():
    uses = {use: drawn_places.load_drawn_places(use) for use in ("judge", "mend", "sealed")}
    assert {use: len(places) for use, places in uses.items()} == {"judge": 12, "mend": 6, "sealed": 6}
    assert len({place.name for places in uses.values() for place in places}) == 24
    assert composites.select_places("judge", report=False) == uses["judge"]
