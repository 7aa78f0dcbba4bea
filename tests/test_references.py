"""User references: pictures named in scene.yaml, painted by hand, or made by other tools.

Tested are registration, depth maps, refusals, the stage `reference`, and which stages rerun for a new reference.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from PIL import Image
from scenes import wall_scene
from scenes.capture import (
    HEIGHT,
    OPENCV,
    WIDTH,
    make_truth,
    run_stages,
    write_capture,
    write_pictures,
)
from scenes.gaussians import join_gaussians
from scenes.images import natural_noise, psnr, rectangle_mask
from scenes.planned_runs import decide_stages, pretend_to_run
from scenes.references import (
    SIZE,
    reference_entry,
    resize_and_compress,
    run_reference_stage,
    write_wall_capture,
)

from reffusion import geometry
from reffusion.capture import lens
from reffusion.capture.lenses import save_lenses
from reffusion.depth import alignment
from reffusion.io.arrays import save_json
from reffusion.io.depth_maps import load_depth
from reffusion.io.files import BadInput
from reffusion.io.images import load_image, load_mask, save_exr, save_image, save_mask
from reffusion.io.scene import load_mask_sets
from reffusion.references import adoption, agreement, color, registration, view_ranking
from reffusion.references.files import ReferenceFile
from reffusion.references.undistort import undistort_reference, undistort_reference_depth
from reffusion.types import MaskSet, Reference
from runner.execute import run_scene
from runner.fleet.maintenance import clean
from runner.keys import Hashes, code_fingerprints
from runner.plan import plan
from runner.resolve import Request
from runner.resolve import resolve as prepare_job
from stages import poses, reference
from stages.plan import poses as plan_poses
from stages.plan import reference as plan_reference

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent


def object_mask() -> np.ndarray:
    return rectangle_mask(SIZE[::-1], (40, 80), (60, 100))


def whiten_object(image: np.ndarray) -> np.ndarray:
    return np.where(object_mask()[..., None], np.uint8(250), image)


# --------------------------------------------------------------------------------------------------- registration


@pytest.mark.parametrize("how", [{}, {"crop": 0}, {"scale": 1.0, "quality": 95}, {"scale": 0.8, "crop": 12, "gain": 1}])
def test_a_picture_from_another_tool_comes_back_onto_its_photograph(how):
    truth, size = natural_noise(0), SIZE
    photo, changed = whiten_object(truth), resize_and_compress(truth, **how)
    picture = cv2.resize(changed, size, interpolation=cv2.INTER_CUBIC)
    found = registration.register(picture, photo, object_mask())
    assert found.fits and found.inlier_ratio > 0.95
    crop, (height, width) = how.get("crop", 5), changed.shape[:2]
    scale = np.array([width + crop, height + crop]) / size * np.array(size) / (width, height)
    expected = np.stack([[scale[0], 0, -crop * size[0] / width], [0, scale[1], -crop * size[1] / height]])
    moved = registration.IDENTITY if found.affine is None else found.affine
    corners = np.array([(0, 0), (160, 0), (0, 120), (160, 120)])
    error = corners @ (moved - expected)[:, :2].T + (moved - expected)[:, 2]
    assert np.abs(error).max() < 0.25, "pixels"
    result = color.recolor(registration.warp(picture, moved)[0], found.gain, found.offset)
    gain = np.full(3, 1 / how.get("gain", 0.92))
    ideal = color.recolor(registration.warp(picture, expected)[0], gain, np.zeros(3))
    assert (
        psnr(result, truth, object_mask())
        > psnr(ideal, truth, object_mask()) - 0.5
        > psnr(picture, truth, object_mask())
    )


def test_an_aligned_reference_comes_through_untouched():
    truth = natural_noise(0)
    found = registration.register(truth, whiten_object(truth), object_mask())
    assert found.is_identical and found.affine is None and (found.gain == 1).all() and not found.offset.any()
    slightly = resize_and_compress(truth, scale=1.0, crop=0, quality=70, gain=1)
    found = registration.register(slightly, whiten_object(truth), object_mask())
    assert found.fits and found.affine is None and not found.is_identical, "not resampled, cut in only"


def test_what_was_repainted_elsewhere_moves_nothing():
    truth = natural_noise(0)
    picture = resize_and_compress(truth, scale=1.0, crop=0, quality=90, gain=0.9)
    picture[90:, :50] = natural_noise(1)[90:, :50]
    found = registration.register(picture, whiten_object(truth), object_mask())
    assert found.fits and found.affine is None and found.gain == pytest.approx(1 / 0.9, abs=0.01)


def test_another_picture_fits_badly_and_a_plain_one_cannot_be_told():
    photo = whiten_object(natural_noise(0))
    found = registration.register(natural_noise(1), photo, object_mask())
    assert not found.fits and found.inlier_ratio < 0.2 and f"shows {found.inlier_ratio:.0%} of" in found.mismatch
    plain = np.full_like(photo, 90)
    found = registration.register(plain, whiten_object(plain + 20), object_mask())
    assert found.fits and np.isnan(found.inlier_ratio) and "too plain" in str(found)


def test_of_a_picture_like_its_photograph_the_hole_alone_is_taken(wall_folders, tmp_path):
    """If a reference matches its photograph, only the hole is taken from the reference.

    A corner that the user repainted far from the hole keeps the photograph's pixels.
    """
    photo = load_image(wall_folders["poses"] / "images/a2.png")
    picture = wall_scene.photo(wall_scene.CAMERAS["a2"]).copy()
    picture[:20, :20] = 255 - picture[:20, :20]
    save_image(wall_folders["scene"] / "ref.png", picture)
    made = run_reference_stage(wall_folders, tmp_path / "out", **reference_entry("a2"))["a2"]
    assert (made.image[:20, :20] == photo[:20, :20]).all()
    assert (made.image == picture)[made.mask].all()


@pytest.mark.parametrize("shown", ["object", "gray"])
def test_a_reference_that_nobody_painted_is_refused(wall_folders, tmp_path, shown):
    photo, entry = load_image(wall_folders["poses"] / "images/a2.png"), reference_entry("a2")
    sets = load_mask_sets(wall_folders["masks"], ["a2"])["a2"]
    hole = (sets.consistent | sets.invent)[..., None]
    save_image(wall_folders["scene"] / "ref.png", np.where(hole, np.uint8(128), photo) if shown == "gray" else photo)
    with pytest.raises(BadInput, match=rf"ref.png: shows the {shown}.*; paint what is behind.* `trust: true`"):
        run_reference_stage(wall_folders, tmp_path / "out", **entry)


def test_a_hole_that_surrounds_what_stays_may_show_its_photograph(tmp_path):
    photo, hole = natural_noise(0), ~object_mask()
    file = ReferenceFile("v", tmp_path / "v.png")
    adoption.check_painted(file, photo, photo, MaskSet(hole, hole, hole, hole))
    with pytest.raises(BadInput, match="shows the object"):
        adoption.check_painted(file, photo, photo, MaskSet(~hole, ~hole, ~hole, ~hole))


def test_where_no_photograph_has_a_hole_a_reference_is_asked_for(wall_folders, tmp_path):
    save_json(wall_folders["masks"] / "facts.json", {"best_reference": None})
    with pytest.raises(ValueError, match="name a training view as `reference`"):
        run_reference_stage(wall_folders, tmp_path / "out")


def test_only_the_hole_and_its_rim_are_taken():
    photo, picture, everywhere = (
        np.zeros((20, 20, 3), np.uint8),
        np.full((20, 20, 3), 200, np.uint8),
        np.ones((20, 20), bool),
    )
    hole = np.zeros((20, 20), bool)
    hole[8:12, 8:12] = True
    result = color.paste(picture, photo, hole, everywhere, margin=1, rim=3)[..., 0]
    assert (result[7:13, 8:12] == 200).all() and 0 < result[10, 14] < 200 and (result[:, 16:] == 0).all()
    lacking = color.paste(picture, photo, hole, ~hole, margin=1, rim=3)
    assert not lacking[hole].any()


def test_a_moved_reference_is_read_once_through_the_lens(tmp_path):
    """Undistortion of a reference applies the lens and an affine map in one resampling.

    The identity map changes nothing, and a depth map is undistorted and shifted like its picture.
    """
    shot = lens.from_colmap(OPENCV[0], WIDTH, HEIGHT, OPENCV[1])
    image = natural_noise(3, (WIDTH, HEIGHT))
    save_image(tmp_path / "whole.png", image)
    whole, inside = undistort_reference(ReferenceFile("v", tmp_path / "whole.png"), shot, image)
    still, _ = undistort_reference(ReferenceFile("v", tmp_path / "whole.png"), shot, image, np.eye(2, 3))
    assert inside.all() and np.abs(whole.astype(int) - still).max() <= 1
    depth = np.tile(np.linspace(1, 2, WIDTH), (HEIGHT, 1))
    np.save(tmp_path / "depth.npy", depth)
    file = ReferenceFile("v", tmp_path / "whole.png", tmp_path / "depth.npy")
    straight = undistort_reference_depth(file, shot)
    where = lens.sampling_map(shot, lens.undistorted_pinhole(shot))
    np.testing.assert_allclose(straight, 1 + (where[..., 0] - 0.5) / (WIDTH - 1), atol=0.6 / WIDTH)
    shifted = undistort_reference_depth(file, shot.pinhole, np.array([[1.0, 0, 4], [0, 1, 0]]))
    np.testing.assert_allclose(shifted[:, :-4], depth[:, 4:], rtol=1e-6)
    assert np.isnan(shifted[:, -4:]).all()


@pytest.mark.parametrize("affine", [None, np.eye(2, 3)], ids=["as it lies", "aligned"])
def test_where_a_reference_is_transparent_the_photograph_shows(tmp_path, affine):
    shot, photo = (
        lens.from_colmap("SIMPLE_PINHOLE", WIDTH, HEIGHT, (90.0, WIDTH / 2, HEIGHT / 2)),
        np.full((HEIGHT, WIDTH, 3), 200, np.uint8),
    )
    picture = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    picture[10:30, 20:40] = (90, 60, 30, 255)
    picture[40:60, 20:40] = (90, 60, 30, 51)
    Image.fromarray(picture).save(tmp_path / "v.png")
    image, inside = undistort_reference(ReferenceFile("v", tmp_path / "v.png"), shot, photo, affine)
    assert image[20, 30].tolist() == [90, 60, 30] and image[50, 30].tolist() == [178, 172, 166]
    assert (image[:9] == 200).all() and inside.sum() == 400 and inside[10:30, 20:40].all()


def test_the_orientation_of_a_reference_is_obeyed_before_its_size_is_judged(tmp_path):
    """A tag that would turn the picture away from its view's proportions is ignored."""
    shot, photo = (
        lens.from_colmap("SIMPLE_PINHOLE", WIDTH, HEIGHT, (90.0, WIDTH / 2, HEIGHT / 2)),
        np.zeros((HEIGHT, WIDTH, 3), np.uint8),
    )
    upright = natural_noise(3, (WIDTH, HEIGHT))
    tag = Image.Exif()
    tag[0x0112] = 6  # to be turned clockwise by 90 degrees
    Image.fromarray(np.rot90(upright)).save(tmp_path / "turned.png", exif=tag)
    Image.fromarray(upright).save(tmp_path / "kept.png", exif=tag)
    for name in ("turned.png", "kept.png"):
        image, _ = undistort_reference(ReferenceFile("v", tmp_path / name), shot, photo)
        assert np.array_equal(image, upright), name


# ----------------------------------------------------------------------------------------------------- depth maps


def save_png16(path: Path, values: np.ndarray) -> None:
    Image.fromarray(values.astype(np.uint16)).save(path)


DEPTHS = {
    "disparity.png": lambda path, z: save_png16(path, 60000 / z * z.min()),
    "depth.png": lambda path, z: save_png16(path, 5000 + 20000 * (z - z.min())),
    "depth.npy": lambda path, z: np.save(path, 37.0 * z),
    "affine disparity.exr": lambda path, z: save_exr(path, 4.0 / z - 1),
}


@pytest.mark.parametrize("kind", DEPTHS)
def test_depth_of_any_kind_is_brought_to_the_scenes(tmp_path, kind):
    rng = np.random.default_rng(0)
    z = cv2.GaussianBlur(rng.uniform(0, 60, (60, 80)), (0, 0), 4) / 8
    z += 1 - z.min()
    known = np.ones_like(z, bool)
    known[20:40, 30:50] = False
    DEPTHS[kind](tmp_path / kind.split()[-1], z)
    seen = np.where(rng.random(z.shape) < 0.2, 1.5 * z, z)  # a fifth of the visible depths are outliers
    aligned, space = alignment.align_either(load_depth(tmp_path / kind.split()[-1]), np.where(known, seen, 0), known)
    np.testing.assert_allclose(aligned, z, rtol=2e-3)
    assert space == ("disparity" if "disparity" in kind else "depth")


def test_depth_in_the_scenes_unit_stays_as_it_is():
    """A depth map in the scene's unit is not changed, because a line fitted to noisy visible depth would move it.

    A depth map in another unit is fitted.
    """
    rng = np.random.default_rng(1)
    z = 2 + 0.01 * np.arange(40)[:, None] + np.zeros((40, 40))
    seen = z * rng.normal(1.01, 0.05, z.shape)
    everywhere = np.ones(z.shape, bool)
    assert np.array_equal(alignment.align_either(z, seen, everywhere)[0], z)
    assert np.array_equal(alignment.align_either(z, 1.015 * z, everywhere)[0], z)  # although a line fits exactly
    other, _ = alignment.align_either(3 * z, seen, everywhere)
    assert 0.9 < np.median(other / z) < 1.1 and not np.array_equal(other, z)


def test_depth_that_says_nothing_of_the_scene_is_refused():
    rng = np.random.default_rng(0)
    z, everywhere = rng.uniform(1, 3, (40, 40)), np.ones((40, 40), bool)
    with pytest.raises(ValueError, match=r"does not fit what is seen|falls where"):
        alignment.align_either(rng.uniform(1, 3, (40, 40)), z, everywhere)
    holey = np.where(rng.random(z.shape) < 0.3, np.nan, z)
    aligned, _ = alignment.align_either(holey, z, everywhere)
    assert np.array_equal(np.isnan(aligned), np.isnan(holey))


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        ("eight.png", lambda p: Image.fromarray(np.eye(4, dtype=np.uint8)).save(p), "8 bits are too coarse"),
        ("flat.npy", lambda p: np.save(p, np.ones((4, 4))), "all its values are 1"),
        ("rgb.npy", lambda p: np.save(p, np.ones((4, 4, 3))), "one number for each pixel"),
        ("nothing.npy", lambda p: np.save(p, np.full((4, 4), np.nan)), "not finite"),
        ("cut.npy", lambda p: p.write_bytes(b""), "not a readable depth map"),
    ],
)
def test_what_is_no_depth_map_is_refused(tmp_path, name, write, message):
    write(tmp_path / name)
    with pytest.raises(ValueError, match=rf"{name}.*{message}"):
        load_depth(tmp_path / name)


def test_the_depth_of_an_object_alone_is_a_depth_map(tmp_path):
    depth = np.full((40, 40), np.nan, np.float32)
    depth[10:20, 10:20] = np.arange(100).reshape(10, 10) + 1
    np.save(tmp_path / "thing.npy", depth)
    assert np.array_equal(load_depth(tmp_path / "thing.npy"), depth, equal_nan=True)


# ------------------------------------------------------------------------------------- refusals, before any work


REFUSALS = [
    ("unknown view", reference_entry("q"), (), "reference: there is no view 'q'.*v0"),
    ("missing file", reference_entry("v01", "no.png"), (), r"no\.png: no such file; correct `reference`"),
    ("missing depth", reference_entry("v01", depth="no.npy"), (), r"no\.npy: no such file"),
    ("depth of another kind", reference_entry("v01", depth="note.txt"), (), r"note\.txt: a depth map is a 16-bit"),
    ("other proportions", reference_entry("v01", "tall.png"), (), r"tall\.png: 72x96"),
    (
        "two for a view",
        {"reference": [*reference_entry("v01").values(), *reference_entry("v01.png").values()]},
        (),
        "two for the view 'v01'",
    ),
    ("test view", reference_entry("v01") | {"test": ["v01"]}, (), r"ref\.png: 'v01' is a test view"),
    (
        "neither",
        reference_entry("v01") | {"train": ["v00", "v02", "v03"], "test": ["v04"]},
        (),
        "'v01' is neither a training",
    ),
    ("painting of no view", {}, ["zebra.png"], r"painted/zebra\.png: no view is called 'zebra'"),
    ("painting of a test view", {"test": ["v01"]}, ["v01.png"], r"painted/v01\.png: 'v01' is a test view"),
    ("two paintings", {}, ["v01.png", "v01.jpg"], r"v01\.png: there is v01\.jpg too"),
    ("depth alone", {}, ["v01_depth.png"], r"v01_depth\.png: a depth map without a painting"),
    ("no picture", {}, ["v01.psd"], r"v01\.psd: no picture"),
]


def write_reference_capture(folder: Path, painted=()) -> Path:
    """Write a capture with the files that `REFUSALS` names; return `folder`. `painted` are file names in painted/."""
    write_capture(folder, "transforms", make_truth())
    write_pictures(folder, ["ref"])
    write_pictures(folder, ["tall"], (HEIGHT, WIDTH))
    (folder / "note.txt").write_text("")
    for name in painted:
        (folder / "painted").mkdir(exist_ok=True)
        shutil.copy(folder / "ref.png", folder / "painted" / name)
    return folder


@pytest.mark.parametrize(("params", "painted", "message"), [r[1:] for r in REFUSALS], ids=[r[0] for r in REFUSALS])
def test_references_are_refused_before_any_work(tmp_path, params, painted, message):
    folder = write_reference_capture(tmp_path / "s", painted)
    with pytest.raises(ValueError, match=message):
        plan_poses.preview(poses.Params(**params), folder)


# The stage `reference` cannot know whether a view without a pose exists in the capture. Its messages for such views
# therefore differ from those of the preview of `poses`.
UNPLACED = {
    "unknown view": r"ref\.png: its view 'q' could not be placed.*v0",
    "neither": r"ref\.png: its view 'v01' could not be placed, or is neither a training",
    "painting of no view": r"painted/zebra\.png: its view 'zebra' could not be placed",
}


@pytest.mark.parametrize(("name", "params", "painted", "message"), REFUSALS, ids=[r[0] for r in REFUSALS])
def test_references_are_refused_by_what_poses_wrote(tmp_path, name, params, painted, message):
    folder = write_reference_capture(tmp_path / "s", painted)
    spec = params.get("reference")
    _, placed = run_stages(folder, **{key: value for key, value in params.items() if key != "reference"})
    for layout in ("images", "masks"):
        shutil.rmtree(folder / layout)  # the stage must not read the capture
    (folder / "transforms.json").unlink()
    with pytest.raises(ValueError, match=UNPLACED.get(name, message)):
        plan_reference.preview(reference.Params(reference=spec), scene=folder, poses=placed)
    needs = {"scene": folder, "poses": placed, "fit": tmp_path, "masks": tmp_path}
    with pytest.raises(ValueError, match=UNPLACED.get(name, message)):
        reference.run(reference.Params(reference=spec), tmp_path / "out", **needs)
    assert not (tmp_path / "out").exists()


def test_the_stage_reads_nothing_of_the_capture(tmp_path):
    """The code of the stage `reference` includes no reader of captures, so a change of a reader does not rerun it."""
    code = code_fingerprints(ROOT, "reference", Hashes(tmp_path / "hashes.json"))
    readers = ("reffusion/capture/layouts/", "reffusion/capture/load.py", "reffusion/capture/roles.py")
    assert "reffusion/references/files.py" in code and not [path for path in code if path.startswith(readers)]
    assert any(path.startswith(readers) for path in code_fingerprints(ROOT, "poses", Hashes(tmp_path / "hashes.json")))


def test_paintings_stand_for_named_references_and_masks_beside_them_are_passed_over(tmp_path):
    folder = write_capture(tmp_path / "s", "transforms", make_truth())
    write_pictures(folder, ["ref", "painted/v01", "painted/v01_mask", "painted/v03", "painted/v03_depth"])
    named_too = [{"view": "v01", "image": "ref.png"}, {"view": "v02", "image": "ref.png"}]
    assert "v01 (painted), v02, v03 (painted)" in plan_poses.preview(poses.Params(reference=named_too), folder)[-1]
    params = reference.Params(reference=named_too)
    (note,) = plan_reference.preview(params, scene=folder)
    assert note == "takes over the scene's reference: no diffusion here"
    _, placed = run_stages(folder)
    (note,) = plan_reference.preview(params, scene=folder, poses=placed)
    assert "v01 (painted), v02, v03 (painted)" in note
    assert not plan_reference.needed_weights(reference.Params(), frozenset({"painted"}))


def test_a_view_without_a_pose_is_named(tmp_path):
    folder = write_capture(tmp_path / "s", "transforms", make_truth())
    write_pictures(folder, ["ref"])
    save_lenses(tmp_path, {"v00": make_truth().lens}, False, {})
    save_json(tmp_path / "views.json", {"train": ["v00"], "test": [], "clean": []})
    with pytest.raises(ValueError, match=r"ref\.png: its view 'v01' could not be placed"):
        plan_reference.preview(reference.Params(**reference_entry("v01")), scene=folder, poses=tmp_path)
    write_pictures(folder, ["painted/v00", "painted/v01_mask"])  # a mask that the user copied too
    (note,) = plan_reference.preview(reference.Params(), scene=folder, poses=tmp_path)
    assert "v00 (painted)" in note


def test_the_plan_says_that_guidance_needs_a_prompt(tmp_path):
    preview = lambda **params: plan_reference.preview(reference.Params(**params), scene=tmp_path)
    (note,) = preview(sampler={"guidance": 6.5})
    assert note == "reference.prompt is empty: reference.sampler.guidance has no effect"
    assert preview(sampler={"guidance": 6.5}, prompt="a lawn") == preview() == []


# ---------------------------------------------------------------------------------------------- the stage's artifact


def test_a_reference_from_another_tool_ends_near_the_clean_one(wall_folders, tmp_path):
    truth, mask = wall_scene.photo(wall_scene.CAMERAS["a2"]), wall_scene.true_mask(wall_scene.CAMERAS["a2"], 1.6)
    save_image(wall_folders["scene"] / "clean.png", truth)
    Image.fromarray(resize_and_compress(truth, quality=95)).save(wall_folders["scene"] / "far.jpg", quality=80)
    clean_one = run_reference_stage(wall_folders, tmp_path / "clean", **reference_entry("a2", "clean.png"))["a2"]
    assert np.array_equal(clean_one.image, truth) and clean_one.depth is None
    far = run_reference_stage(wall_folders, tmp_path / "far", **reference_entry("a2", "far.jpg"))["a2"]
    assert psnr(far.image, truth, mask) > 33 and np.array_equal(far.mask, clean_one.mask)
    away = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9))) == 0
    assert np.array_equal(far.image[away], truth[away]), "the photograph elsewhere"
    save_image(wall_folders["scene"] / "other.png", natural_noise(5, (wall_scene.WIDTH, wall_scene.HEIGHT)))
    with pytest.raises(ValueError, match=r"other\.png: does not fit its view 'a2'.*shows \d+% of .*another view"):
        run_reference_stage(wall_folders, tmp_path / "other", **reference_entry("a2", "other.png"))


def test_depth_of_a_reference_reaches_its_artifact(wall_folders, tmp_path):
    truth = wall_scene.photo(wall_scene.CAMERAS["a2"])
    save_image(wall_folders["scene"] / "clean.png", truth)
    depth = np.add.outer(np.zeros(2 * wall_scene.HEIGHT), np.linspace(1000, 60000, 2 * wall_scene.WIDTH))
    save_png16(wall_folders["scene"] / "depth.png", depth)
    found = run_reference_stage(
        wall_folders, tmp_path / "out", **reference_entry("a2", "clean.png", depth="depth.png")
    )["a2"]
    assert (
        found.depth.shape == found.mask.shape
        and np.corrcoef(found.depth.ravel(), depth[1::2, 1::2].ravel())[0, 1] > 0.999
    )


def test_pictures_to_paint_are_exported_and_paintings_are_read_back(wall_folders, tmp_path):
    first = run_reference_stage(wall_folders, tmp_path / "first")
    assert list(first) == ["a2"]
    laid_out = tmp_path / "first" / "to_paint"
    lines = [line.split() for line in (laid_out / "ranked.txt").read_text().splitlines() if line[0] != "#"]
    assert lines[0][0] == "1." and lines[0][2] == "100%" and len(lines) == 1, "one view sees all of so flat a hole"
    view = lines[0][1]
    picture, mask = load_image(laid_out / f"{view}.png"), load_mask(laid_out / f"{view}_mask.png")
    photo, hidden = wall_scene.photo(wall_scene.CAMERAS[view]), wall_scene.true_mask(wall_scene.CAMERAS[view], 1.6)
    assert (
        np.array_equal(mask, wall_scene.true_unobserved(wall_scene.CAMERAS[view], 1.6))
        and (picture[mask] == view_ranking.GRAY).all()
    )
    assert np.array_equal(picture[~hidden], photo[~hidden]) and psnr(picture, photo, hidden & ~mask) > 20

    shutil.copytree(laid_out, wall_folders["scene"] / "painted", ignore=shutil.ignore_patterns("*.txt"))
    painted = np.where(mask[..., None], photo, picture)
    save_image(wall_folders["scene"] / "painted" / f"{view}.png", painted)
    again = run_reference_stage(wall_folders, tmp_path / "again")
    assert list(again) == [view] and np.array_equal(again[view].image, painted)
    assert f"1. {view}  100%  (painted)" in (tmp_path / "again" / "to_paint" / "ranked.txt").read_text()


def test_views_are_ranked_by_what_they_cover_beyond_those_before():
    """Each next view in the ranking is the one that covers most of the hole not covered by the views before.

    Cameras a and b see the same part of a wall. Camera c sees another part, which the image border cuts off.
    """

    def hole(name: str, x: float, columns: slice) -> view_ranking.Hole:
        camera = wall_scene.front_camera(name, x)
        pixels = np.zeros((wall_scene.HEIGHT, wall_scene.WIDTH), bool)
        pixels[20:40, columns] = True
        return view_ranking.Hole(camera, pixels, np.full(pixels.shape, wall_scene.WALL))

    holes = {"a": hole("a", 0.0, slice(10, 40)), "b": hole("b", 0.0, slice(12, 36)), "c": hole("c", 2.0, slice(10, 25))}
    found = view_ranking.rank_views(holes, [], 3)
    assert [each.view for each in found] == ["a", "c"]
    assert [each.share for each in found] == pytest.approx([54 / 69, 15 / 69])
    assert [each.view for each in view_ranking.rank_views(holes, ["b"], 3)] == ["b", "c", "a"]


# -------------------------------------------------------------------------------------------------------------- reruns


STAGES = ("poses", "raw_masks", "fit", "masks", "reference")


def test_a_new_reference_reruns_nothing_before_its_stage(stages_answer_here, tmp_path):
    folder, hashes = write_wall_capture(tmp_path / "wall"), Hashes(tmp_path / "hashes")
    request = Request(ROOT, tmp_path / "runs", str(folder), profile="laptop")

    def words() -> dict[str, str]:
        return {stage: each.status for stage, each in decide_stages(prepare_job(request, hashes), STAGES).items()}

    done = dict.fromkeys(STAGES, "cached")
    assert words()["poses"] == "run"
    pretend_to_run(job := prepare_job(request, hashes), STAGES)
    assert job.pipeline.stages["reference"].export == ("to_paint",) and words() == done
    write_pictures(folder, ["lying about", "truth/a0"])
    np.save(folder / "lying about.npy", np.zeros(3))
    assert words() == done
    write_pictures(folder / "painted", ["a2"])
    assert words() == done | {"reference": "run"}
    pretend_to_run(prepare_job(request, hashes), STAGES)
    assert words() == done
    (folder / "scene.yaml").write_text(yaml.safe_dump(reference_entry("a0", "truth/a0.png")))
    assert words() == done | {"reference": "run"}
    save_image(folder / "images" / "a4.png", wall_scene.photo(wall_scene.CAMERAS["a4"]))
    assert words()["poses"] == "run", "a photograph is none of these"
    clean(request)
    assert not (tmp_path / "runs/wall").exists() and (folder / "painted/a2.png").is_file()


SMALL = "poses.refine=false fit.iterations=20 fit.densify.cap_max=1000 masks.invent=consistent masks.inside_share=1"


@pytest.mark.slow
def test_saved_masks_rerun_neither_poses_nor_the_fit(tmp_path):
    folder = write_wall_capture(tmp_path / "wall")
    masks = {path: path.read_bytes() for path in (folder / "masks").iterdir()}
    request = Request(ROOT, tmp_path / "runs", str(folder), profile="laptop", set=SMALL)

    def words() -> dict[str, str]:
        job = prepare_job(request)
        return {stage: each.status for stage, each in plan(job, job.pipeline.closure("masks")).items()}

    before = dict.fromkeys(("poses", "fit"), "cached")
    (folder / "scene.yaml").write_text("masks: none\n")
    shutil.rmtree(folder / "masks")
    run_scene(request, "fit")
    assert words() == before | {"raw_masks": "cached", "masks": "skip"}
    (folder / "masks").mkdir()
    (folder / "scene.yaml").unlink()
    for path, content in masks.items():
        path.write_bytes(content)
    assert words() == before | {"raw_masks": "run", "masks": "pending"}
    run_scene(request, "raw_masks")
    last = max(masks)
    save_mask(last, np.roll(load_image(last)[..., 0] > 0, 2, 0))
    assert words()["raw_masks"] == "run" and words()["poses"] == "cached"
    last.unlink()  # a view without a mask is still a training view
    assert words()["raw_masks"] == "run" and words()["poses"] == "cached"
    (folder / "scene.yaml").write_text("test: [a0]\n")
    assert words()["poses"] == "run"


def test_a_photograph_that_is_also_a_reference_still_counts_for_poses(tmp_path):
    folder = write_capture(tmp_path / "s", "transforms", make_truth())
    write_pictures(folder, ["ref"])
    (folder / "scene.yaml").write_text("")
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    read = plan_poses.scene_files(poses.Params(), folder, files)
    assert folder / "images/v00.png" in read and folder / "transforms.json" in read
    assert folder / "ref.png" not in read and folder / "scene.yaml" not in read
    of_reference = plan_reference.scene_files(
        reference.Params(**reference_entry("v00", "images/v00.png")), folder, files
    )
    assert of_reference == [folder / "images/v00.png"]
    scene, _ = run_stages(folder)
    assert len(scene.cameras) == 6


def test_contradicting_references_are_detected():
    """References of two views of a wall agree if they show the same wall, and contradict if one has other colors."""
    views = [wall_scene.front_camera("a", -0.2), wall_scene.front_camera("b", 0.2)]
    depth = np.full((wall_scene.HEIGHT, wall_scene.WIDTH), wall_scene.WALL)
    hole = np.zeros_like(depth, bool)
    hole[20:52, 24:72] = True
    painted = {}
    for view in views:
        points = geometry.unproject(depth, view)
        painted[view.name] = np.round(255 * wall_scene.wall_color(points[..., 0], points[..., 1])).astype(np.uint8)
    holes = {view.name: view_ranking.Hole(view, hole, depth) for view in views}
    alike = [Reference(view, painted[view.name], hole) for view in views]
    assert agreement.color_difference(*alike, *holes.values()) < agreement.CONTRADICTION / 4
    other = replace(alike[1], image=np.where(hole[..., None], 255 - alike[1].image, alike[1].image))
    ((first, second, unlike),) = agreement.find_contradictions([alike[0], other], holes)
    assert (first, second) == ("a", "b") and unlike > 2 * agreement.CONTRADICTION


def test_objects_in_front_of_a_scene_are_compared_at_their_own_depth():
    """References that insert an object are compared at the depth of the object, which their depth maps give.

    The object is a striped square before a wall and a step. The references agree at its depth, but not at the depth of
    the wall. Without depth maps, no comparison is possible.
    """
    near, step = 1.4, 1.7
    floor = wall_scene.rectangle_gaussians(step, 2.0, 0.25, wall_scene.wall_color)
    floor = replace(floor, means=floor.means + torch.tensor([0.0, 0.6, 0.0]))
    wall = wall_scene.rectangle_gaussians(wall_scene.WALL, 2.0, 1.4, wall_scene.wall_color)
    scene = join_gaussians(wall, floor)
    references = []
    for view in (wall_scene.front_camera("a", -0.2), wall_scene.front_camera("b", 0.2)):
        mask = wall_scene.true_mask(view, near)
        wide = geometry.unproject(np.full(mask.shape, step), view)[..., 1] > 0.35
        depth = np.where(mask, near, np.where(wide, step, wall_scene.WALL))
        points = geometry.unproject(depth, view)
        stripe = np.where((points[..., :1] * 12).astype(int) % 2 == 0, [0.9, 0.1, 0.1], [0.1, 0.9, 0.1])
        image = np.where(mask[..., None], stripe, wall_scene.wall_color(points[..., 0], points[..., 1]))
        references.append(Reference(view, np.round(255 * image).astype(np.uint8), mask, 3 * depth))
    cameras, nothing = [each.camera for each in references], np.zeros((wall_scene.HEIGHT, wall_scene.WIDTH), bool)
    hidden = {camera.name: nothing for camera in cameras}
    holes = view_ranking.find_holes(scene, cameras, hidden, {each.camera.name: each.mask for each in references})
    measured = agreement.refine_hole_depth(holes, references, scene, hidden)
    assert set(measured) == {"a", "b"} and not agreement.find_contradictions(references, measured)
    assert agreement.find_contradictions(references, holes)  # the stripes differ at the wall's depth
    assert agreement.refine_hole_depth(holes, [replace(each, depth=None) for each in references], scene, hidden) == {}
    other = replace(references[1], image=references[1].image[..., [2, 0, 1]])
    assert agreement.find_contradictions([references[0], other], measured)
