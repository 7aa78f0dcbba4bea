"""The stage `evaluate` on synthetic stage folders: all scores can be recomputed from the pictures that it saves."""

import csv
import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from scenes.cameras import make_camera, make_scene
from scipy import ndimage
from skimage.metrics import structural_similarity

from reffusion import seeding
from reffusion.background import training_coverage
from reffusion.io.arrays import load_json, save_json
from reffusion.io.ground_truth import load_object_mask
from reffusion.io.images import load_image, save_image, save_mask
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_scene, save_mask_sets, save_scene
from reffusion.metrics import evaluation, image_metrics, imfine, rows
from reffusion.morphology import dilate
from reffusion.splat.rasterizer import render
from reffusion.types import Gaussians, MaskSet, Scene, Similarity
from report import sheet
from stages import evaluate, finish

pytestmark = pytest.mark.integration

SIMILARITY = Similarity(0.02, np.array([500_000.0, -3.0, 40.0]))
WIDTH, HEIGHT = 48, 36


def random_blobs(count, seed=0):
    generator = seeding.generator(seed, "blobs")
    draw = lambda *shape: torch.rand(*shape, generator=generator)
    means = torch.cat([draw(count, 2) * 1.6 - 0.8, 1.5 + draw(count, 1)], 1)
    return Gaussians(means, draw(count, 4) - 0.5, draw(count, 3) - 3.2, 3 * draw(count), draw(count, 4, 3) - 0.5)


def write_stages(home):
    """Write the folders of the earlier stages; return stage name -> folder.

    Views 0 to 2 are test views, of which view 2 has no mask; views 3 to 7 are training views.
    """
    names = [f"view{i}" for i in range(8)]
    cameras = {
        name: make_camera(name, (WIDTH, HEIGHT), 40.0, (0.3 - 0.1 * i, 0.0, 0.0)) for i, name in enumerate(names)
    }
    scene = make_scene(cameras, names[:3], similarity=SIMILARITY)
    made = {name: home / name for name in ("poses", "raw_masks", "fit", "masks", "initialize", "distill")}
    rng = np.random.default_rng(0)
    save_scene(made["poses"], scene)
    for name in names:
        save_image(made["poses"] / "images" / f"{name}.png", rng.random((HEIGHT, WIDTH, 3)))
    mask, empty = np.zeros((HEIGHT, WIDTH), bool), np.zeros((HEIGHT, WIDTH), bool)
    mask[10:30, 5:35] = True
    save_mask(made["raw_masks"] / "test_masks" / "view0.png", mask)
    save_mask(made["raw_masks"] / "test_masks" / "view1.png", empty)
    other = np.zeros_like(mask)
    other[4:24, 20:48] = True
    save_mask_sets(made["masks"], {name: MaskSet(empty, other, empty, empty) for name in names})
    save_json(made["masks"] / "facts.json", {"kept": []})
    for stage, count in (("fit", 60), ("initialize", 40), ("distill", 50)):
        save_ply(made[stage] / "gaussians.ply", random_blobs(count))
    return made


def run_finish_and_evaluate(out, stage_folders, **params):
    """Run `finish` (in a folder beside `out`) and then `evaluate` (in `out`); return the content of metrics.json."""
    finished = out.with_name(f"finish-{out.name}")
    for folder in (finished, out):
        folder.mkdir()
    only_evaluate = ("raw_masks", "masks")
    finish.run(finish.Params(), finished, **{k: v for k, v in stage_folders.items() if k not in only_evaluate})
    evaluate.run(evaluate.Params(**params), out, **stage_folders, finish=finished)
    return json.loads((out / "metrics.json").read_text())


def test_while_an_object_is_kept_nothing_is_scored(tmp_path, stage_folders):
    """The test photographs show no object, so the scores of a scene with an object would be meaningless."""
    save_json(stage_folders["masks"] / "facts.json", {"kept": ["ball"]})
    found = run_finish_and_evaluate(tmp_path / "out", stage_folders)
    assert found["mean"].get("psnr_box") is None and (tmp_path / "out/renders/view0.png").exists()


def test_test_views_that_contradict_their_poses_are_named(tmp_path, stage_folders, finished_job):
    save_scene(stage_folders["poses"], replace(load_scene(stage_folders["poses"]), suspects=("view1", "view5")))
    assert run_finish_and_evaluate(tmp_path / "out", stage_folders)["suspects"] == ["view1"]
    assert load_json(finished_job / "evaluate" / "metrics.json")["suspects"] is None


def test_views_are_drawn_as_bright_as_photographs_are(stage_folders, tmp_path):
    """A test view gets the exposure of its photograph, measured outside the mask.

    A test view without a photograph gets the exposure of the neighboring training views. The consistency score is the
    same as without exposures.
    """
    names = [f"view{k}" for k in range(3, 8)]
    dark = np.diag([0.5, 0.6, 0.7]) @ np.eye(3, 4)
    (stage_folders["poses"] / "images/view2.png").unlink()
    many = random_blobs(400)
    many = replace(many, log_scales=many.log_scales + 1.0, opacity_logits=torch.full_like(many.opacity_logits, 3.0))
    save_ply(stage_folders["fit"] / "gaussians.ply", many)
    for name, gain in (("view0", [0.3, 0.4, 0.8]), ("view1", [1.0, 1.0, 1.0])):
        rendering = render(many, load_scene(stage_folders["poses"]).cameras[name])
        own, visible = 255 * rendering.color.detach().numpy() * gain, rendering.alpha.detach().numpy() > 0.9
        # Pixels where the fit is transparent, and masked pixels, must not influence the exposure.
        own[~visible] = 240
        own[10:30, 5:35] = 255
        assert 0.05 < (~visible).mean() < 0.5
        save_image(stage_folders["poses"] / f"images/{name}.png", own.clip(0, 255).round().astype(np.uint8))
    plain = run_finish_and_evaluate(tmp_path / "plain", stage_folders)
    save_json(stage_folders["fit"] / "exposures.json", {name: dark.tolist() for name in names})
    found = run_finish_and_evaluate(tmp_path / "out", stage_folders)
    for name, gain in (("view0", [0.3, 0.4, 0.8]), ("view2", [0.5, 0.6, 0.7])):
        after, before = (load_image(tmp_path / f"{k}/renders/{name}.png") for k in ("out", "plain"))
        assert np.abs(after - before * gain).max() < 2.5, name
    assert "next to it" in found["exposure"] and plain["exposure"] is None
    assert found["consistency"]["consistency"] == pytest.approx(plain["consistency"]["consistency"], abs=5e-3)


@pytest.fixture
def stage_folders(tmp_path):
    return write_stages(tmp_path)


@pytest.fixture(scope="module")
def finished_job(tmp_path_factory):
    """The folder of a scene that was evaluated without LPIPS weights; tests must not change it."""
    home = tmp_path_factory.mktemp("scene")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(home / "nothing"))
        patch.setenv("TORCH_HOME", str(home / "nothing"))
        run_finish_and_evaluate(home / "evaluate", write_stages(home))
    return home


def test_scores_are_those_of_the_saved_pictures(finished_job):
    out = finished_job / "evaluate"
    summary = load_json(out / "metrics.json")
    cameras = load_scene(finished_job / "poses").cameras
    boxes = {"view0": image_metrics.Box(2, 8, 38, 32), "view1": None, "view2": image_metrics.Box(17, 2, 48, 26)}
    train = [cameras[name] for name in load_scene(finished_job / "poses").train]
    fit = load_ply(finished_job / "fit" / "gaussians.ply")
    hidden = {
        camera.name: load_object_mask(camera, finished_job / "raw_masks", finished_job / "masks") for camera in train
    }
    seen_by = training_coverage.render_coverage_views(fit, train, hidden)
    for kind, renders in (("mean", "renders"), ("initialize", "renders_initialize")):
        scored = [
            image_metrics.score_view(
                load_image(out / renders / f"{name}.png"),
                load_image(finished_job / "poses" / "images" / f"{name}.png"),
                box,
                mask=dilate(load_object_mask(cameras[name], finished_job / "raw_masks", finished_job / "masks"), 0.01),
                unseen=training_coverage.unseen_pixels(fit, cameras[name], seen_by),
            )
            for name, box in boxes.items()
        ]
        for column in image_metrics.COLUMNS:
            assert summary[kind][column] == image_metrics.mean([row[column] for row in scored]), (kind, column)
    assert summary["mean"]["psnr_box"] != summary["initialize"]["psnr_box"]
    assert summary["views"]["psnr_box"] == 2 and summary["views"]["psnr_full"] == 3
    assert summary["mean"]["lpips_vgg_box"] is None and "make weights" in summary["lpips_unavailable"]
    assert summary["gaussians"] == {"fit": 60, "initialize": 40, "distill": 50}
    assert summary["rendered"] == "3 test views" and summary["protocol"]["resolution"] == ["48x36"]

    table = list(csv.DictReader((out / "per_view.csv").read_text().splitlines()))
    assert [row["view"] for row in table] == ["view0", "view1", "view2"]
    assert table[0]["left"] == "2" and table[1]["left"] == "" and table[1]["psnr_box"] == ""
    box_scores = [float(row["psnr_box"]) for row in table if row["psnr_box"]]
    assert np.mean(box_scores) == pytest.approx(summary["mean"]["psnr_box"])
    assert load_image(out / "side_by_side" / "view0.png").shape == (HEIGHT, 3 * WIDTH + 8, 3)


def score_as_freeinpaint_does(picture, truth, mask):
    """Compute PSNR and SSIM by the protocol imfine_bbox_v1 with Pillow, SciPy and scikit-image."""
    resize = lambda array, how: np.asarray(Image.fromarray(array).resize((504, 280), how))
    islands = ndimage.label(resize(mask.astype(np.uint8) * 255, Image.Resampling.NEAREST) > 0, np.ones((3, 3)))[0]
    largest = max(ndimage.find_objects(islands), key=lambda box: (islands[box] > 0).sum())
    picture, truth = (resize(each, Image.Resampling.LANCZOS)[largest].astype(float) for each in (picture, truth))
    luma = [np.round(each @ [0.299, 0.587, 0.114]) for each in (picture, truth)]
    window = dict(gaussian_weights=True, sigma=1.5, win_size=11, use_sample_covariance=False)
    ssim = structural_similarity(*luma, data_range=255, **window)
    return 10 * np.log10(1 / (np.mean((picture - truth) ** 2) / 255**2 + 1e-8)), ssim


@pytest.mark.parametrize("shape", [(280, 504), (420, 630), (90, 160)], ids=["that size", "larger", "smaller"])
def test_imfine_scores_are_those_of_an_independent_implementation(shape):
    rng = np.random.default_rng(0)
    truth = cv2.resize(rng.integers(0, 256, (9, 16, 3), np.uint8), shape[::-1], interpolation=cv2.INTER_CUBIC)
    noisy = np.clip(truth + rng.normal(0, 12, truth.shape), 0, 255).astype(np.uint8)
    mask, (height, width) = np.zeros(shape, bool), shape
    mask[height // 5 : height // 2, width // 6 : width // 2] = True
    mask[-height // 8 :, -width // 6 :] = True  # a smaller island, which the protocol leaves out
    found = imfine.score_view(noisy, truth, mask, {})
    psnr, ssim = score_as_freeinpaint_does(noisy, truth, mask)
    assert found == {
        "imfine_bbox_v1_psnr": pytest.approx(psnr, abs=1e-6),
        "imfine_bbox_v1_ssim": pytest.approx(ssim, abs=1e-6),
    }
    assert imfine.score_view(noisy, truth, mask & False, {}) == {}
    assert imfine.score_view(truth, truth, mask, {})["imfine_bbox_v1_psnr"] == pytest.approx(80)


def test_imfine_scores_of_a_run_are_those_of_its_saved_pictures(finished_job):
    out = finished_job / "evaluate"
    metrics = load_json(out / "metrics.json")
    found = metrics["imfine_bbox_v1"]
    assert metrics["leftovers"]["share"] is None and "make weights" in metrics["leftovers"]["unavailable"]
    masks = {"view0": np.s_[10:30, 5:35], "view2": np.s_[4:24, 20:48]}  # view1 has an empty mask
    scores = []
    for name, place in masks.items():
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[place] = True
        truth = load_image(finished_job / "poses" / "images" / f"{name}.png")
        scores.append(score_as_freeinpaint_does(load_image(out / "renders" / f"{name}.png"), truth, mask)[0])
    assert found["views"] == {"psnr": 2, "ssim": 2, "lpips_alex": 0}
    assert found["mean"]["psnr"] == pytest.approx(np.mean(scores)) and found["mean"]["lpips_alex"] is None


def test_the_scene_is_exported_in_its_own_frame(finished_job):
    exported, result = (
        load_ply(finished_job / "evaluate" / "scene.ply"),
        load_ply(finished_job / "distill" / "gaussians.ply"),
    )
    if (completed := finished_job / "finish-evaluate" / "completed" / "distill.ply").exists():
        result = load_ply(completed)
    back = SIMILARITY.apply(exported.means.double().numpy())
    # 500 km from the origin, float32 resolves 0.03 units of the scene's own frame: 6e-4 in the normalized frame.
    assert np.abs(back - result.means.double().numpy()).max() < 1e-3
    sizes = exported.log_scales - result.log_scales
    assert torch.allclose(sizes, torch.full_like(sizes, -np.log(0.02)), atol=1e-5)


def test_an_identical_view_is_infinite_in_the_table_and_capped_in_the_mean(finished_job, tmp_path, stage_folders):
    for view in ("view0", "view1", "view2"):
        picture = load_image(finished_job / "evaluate" / "renders" / f"{view}.png")
        save_image(stage_folders["poses"] / "images" / f"{view}.png", picture)
    summary = run_finish_and_evaluate(tmp_path / "again", stage_folders)
    assert summary["mean"]["psnr_full"] == summary["mean"]["psnr_box"] == image_metrics.PSNR_CAP
    assert summary["mean"]["flip_full"] == 0.0 and summary["mean"]["ssim_box"] == pytest.approx(1.0)
    assert "inf" in (tmp_path / "again" / "per_view.csv").read_text()


def test_without_distill_the_initialization_is_the_result(tmp_path, stage_folders):
    out = tmp_path / "out"
    summary = run_finish_and_evaluate(out, stage_folders | {"distill": None})
    assert summary["result"] == "initialize" and summary["mean"] == summary["initialize"]
    assert (out / "renders" / "view0.png").read_bytes() == (out / "renders_initialize" / "view0.png").read_bytes()


def test_nothing_removed_scores_the_fit_on_the_full_image(tmp_path, stage_folders):
    for path in (stage_folders["raw_masks"] / "test_masks").iterdir():
        path.unlink()
    summary = run_finish_and_evaluate(
        tmp_path / "out", {stage: stage_folders[stage] for stage in ("poses", "raw_masks", "fit")}
    )
    assert summary["result"] == "fit" and summary["mean"]["psnr_box"] is None
    assert summary["mean"]["psnr_full"] > 0 and set(summary["initialize"].values()) == {None}


def test_without_test_views_the_training_cameras_are_rendered_and_not_scored(tmp_path, stage_folders):
    scene = load_scene(stage_folders["poses"])
    every = tuple(scene.cameras)
    untested = Scene(scene.cameras, every, (), scene.clean, scene.points, scene.point_colors, scene.similarity)
    save_scene(stage_folders["poses"], untested)
    out = tmp_path / "out"
    summary = run_finish_and_evaluate(out, stage_folders)
    assert summary["rendered"] == "8 training views"
    assert set(summary["mean"].values()) == {None} and set(summary["views"].values()) == {0}
    assert sorted(path.stem for path in (out / "renders").iterdir()) == list(every)
    assert load_image(out / "side_by_side" / "view0.png").shape[1] == 2 * WIDTH + 4
    assert len((out / "per_view.csv").read_text().splitlines()) == 9


def test_of_many_training_views_every_second():
    names = tuple(f"v{i:03d}" for i in range(70))
    scene = Scene({}, names, (), frozenset(), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), SIMILARITY)
    assert evaluation.views_to_render(scene) == (names[::2], "training (one in 2)")


def test_a_test_view_without_picture_is_rendered_and_one_of_another_size_refused(tmp_path, stage_folders):
    picture = stage_folders["poses"] / "images" / "view1.png"
    picture.unlink()
    summary = run_finish_and_evaluate(tmp_path / "out", stage_folders)
    assert summary["views"]["psnr_full"] == 2 and (tmp_path / "out" / "renders" / "view1.png").exists()
    save_image(picture, np.zeros((HEIGHT, WIDTH + 1, 3)))
    with pytest.raises(ValueError, match=r"view1.png: 49x36 px, its camera 48x36"):
        run_finish_and_evaluate(tmp_path / "again", stage_folders)


def test_a_held_out_view_that_shows_the_object_is_scored_outside_its_mask_only(tmp_path, monkeypatch, stage_folders):
    shutil.copytree(stage_folders["raw_masks"] / "test_masks", stage_folders["raw_masks"] / "masks")
    (stage_folders["raw_masks"] / "masks" / "view1.png").unlink()
    monkeypatch.setattr(rows, "OUTSIDE_MARGIN", 0.05)
    summary = run_finish_and_evaluate(tmp_path / "out", stage_folders)
    assert summary["views"]["psnr_outside"] == 3 and summary["views"]["psnr_full"] == 2  # view0 shows the object
    with open(tmp_path / "out" / "per_view.csv") as file:
        row = next(csv.DictReader(file))
    assert row["view"] == "view0" and row["psnr_box"] == "" and row["left"] == "2"
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[8:32, 3:37] = True  # the mask dilated by 2 px; the corners, which dilation rounds, are ignored
    picture, truth = (
        load_image(p / "view0.png") for p in (tmp_path / "out/renders", stage_folders["poses"] / "images")
    )
    nearly = image_metrics.score_outside(picture, truth, mask)
    assert float(row["psnr_outside"]) == pytest.approx(nearly["psnr_outside"], abs=0.05)
    assert summary["protocol"]["outside_margin"] == 0.05


def test_the_contact_sheet_shows_each_picture_enlarged_without_blur(finished_job, tmp_path):
    path = sheet.make(finished_job, tmp_path / "sheet.png", views=["view0", "view2"], scale=3)
    picture = load_image(path)
    ours = np.kron(load_image(finished_job / "evaluate" / "renders" / "view2.png"), np.ones((3, 3, 1), np.uint8))
    bottom, right = (size - sheet.GAP for size in picture.shape[:2])
    assert (picture[bottom - 3 * HEIGHT : bottom, right - 3 * WIDTH : right] == ours).all()


def test_the_contact_sheet_of_a_variant_takes_shared_stages_from_the_scene(finished_job, tmp_path):
    shutil.copytree(finished_job / "evaluate", tmp_path / "scene@variant" / "evaluate")
    shutil.copytree(finished_job / "poses", tmp_path / "scene" / "poses")
    path = sheet.make(tmp_path / "scene@variant", tmp_path / "variant.png")
    assert path.read_bytes() == sheet.make(finished_job, tmp_path / "own.png").read_bytes()


def test_the_sheet_names_what_is_missing(finished_job, tmp_path):
    with pytest.raises(ValueError, match="no pictures; run `make scene=nowhere evaluate` first"):
        sheet.make(tmp_path / "nowhere", tmp_path / "sheet.png")
    with pytest.raises(ValueError, match=r"has no view9; it has view0 ... view2"):
        sheet.make(finished_job, tmp_path / "sheet.png", views=["view0", "view9"])
