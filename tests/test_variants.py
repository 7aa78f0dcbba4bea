"""The variants of pipeline.yaml: the stages that each variant runs, skips or shares, and the results of their runs."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import wall_scene
from scenes.capture import make_truth
from scenes.capture import write_capture as write_capture
from scenes.distill_scene import OFF, PLAIN, as_leaves, has_gradient, random_wall, square_hole, train_view
from scenes.networks import save_small_prior
from scenes.planned_runs import decide_stages, pretend_to_run
from scenes.settings import with_changes
from scenes.stage_runs import run_through_masks

from reffusion import seeding, trace
from reffusion.distill import loop as D
from reffusion.distill import perceptual
from reffusion.distill.terms.lift import evaluate_lift
from reffusion.distill.terms.term import TermInputs
from reffusion.distill.train_view import ReferenceHole
from reffusion.initialize import random_init
from reffusion.io.arrays import load_json, load_labels, save_json
from reffusion.io.ground_truth import load_object_mask
from reffusion.io.images import load_image, load_mask, save_image
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_mask_sets, load_raw_masks, load_references, load_scene, save_references
from reffusion.params.distill import LiftTerm
from reffusion.types import PARAMETERS, Reference
from runner.keys import Hashes
from runner.pipeline import load_pipeline
from runner.resolve import Request, resolve
from stages import distill, evaluate, finish, fit, initialize, lift
from stages.plan import fit as plan_fit

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent
NEAR = 1.7

# Variant -> (stages that run, skipped stages without `lift`). All other stages are shared with the scene's own run.
AFTER = ("distill", "finish", "evaluate")
FILLED = ("reference", "personalize", "initialize", "distill")
PLANS = {
    "no_personalization": (AFTER, ("personalize",)),
    "no_splitting": (AFTER, ()),
    "no_reference_init": (("initialize", *AFTER), ()),
    "no_local_sds": ((), ()),  # the laptop profile lacks these three terms
    "no_adversarial": ((), ()),
    "no_depth": ((), ()),
    "no_sds": (AFTER, ("personalize",)),
    "masked": (("fit", "finish", "evaluate"), ("masks", *FILLED)),
    "remove_only": (("initialize", "finish", "evaluate"), ("reference", "personalize", "distill")),
    "inpaint_2d": (("finish", "evaluate"), FILLED),
    "lift_mse": (("lift", "initialize", *AFTER), ("personalize",)),
    "lift_perceptual": (("lift", "initialize", *AFTER), ("personalize",)),
    "lift_perceptual_diffusion": (("lift", "initialize", *AFTER), ("personalize",)),
    "sds_plain": (("initialize", *AFTER), ("personalize",)),
    "reference_guided": (AFTER, ("personalize",)),
}


# ------------------------------------------------------------------------------------------------------- the plans


WITH_SDS = "distill.sds.run=always"


@pytest.fixture(scope="module")
def resolve_finished(stages_answer_here, tmp_path_factory):
    """A function that resolves requests, by profile and variant, for a small scene after its own run.

    The folder runs/ has the files that the runner reads. Code is read once for all requests.
    """
    home = tmp_path_factory.mktemp("variants")
    scene, runs = write_capture(home / "scene", "llff", make_truth()), home / "runs"
    hashes = Hashes(runs / "hashes")
    resolve_one = lambda profile="laptop", **how: resolve(Request(ROOT, runs, str(scene), profile, **how), hashes)
    job = resolve_one(set=WITH_SDS)
    decisions = pretend_to_run(job, job.pipeline.stages)
    assert [s for s, d in decisions.items() if d.status != "cached"] == ["lift"]
    return resolve_one


def test_every_variant_has_a_plan_here():
    ours = set(load_pipeline(ROOT).variants)
    assert set(PLANS) <= ours, "a variant is gone"
    text = (ROOT / "docs" / "results.md").read_text()
    assert all(f"`{name}`" in text for name in ours), "a variant is not described in docs/results.md#variants"


@pytest.mark.parametrize("variant", PLANS)
def test_a_variant_runs_what_it_changes_and_shares_the_rest(resolve_finished, variant):
    job = resolve_finished(variant=variant, set=WITH_SDS)
    decisions = decide_stages(job, job.pipeline.stages)
    runs_here, left_out = PLANS[variant]
    assert {s for s, d in decisions.items() if d.status == "skip"} == {*left_out, *({"lift"} - set(runs_here))}
    assert {s for s, d in decisions.items() if d.status in ("run", "stale", "pending")} == set(runs_here)
    shared = {s for s, d in decisions.items() if d.status == "cached"}
    assert shared == set(decisions) - set(runs_here) - set(left_out) - {"lift"}
    assert all(decisions[s].reason == "shared with scene" for s in shared)


def test_with_the_papers_terms_every_ablation_leaves_something_out(resolve_finished):
    full = resolve_finished("paper-terms").params
    for name in PLANS:
        assert not name.startswith("no_") or resolve_finished("paper-terms", variant=name).params != full, name


def test_the_papers_terms_are_the_papers_at_the_laptops_size(resolve_finished):
    terms, laptop = resolve_finished("paper-terms").params, resolve_finished().params
    size = {"prior", "depth.steps", *(f"adversarial.{name}" for name in ("patches", "size", "width"))}
    # values that the paper leaves open
    chosen = {"iterations", "repaint", "sds.t_high_last", "sds.guidance"}
    chosen |= {"lr.masked", "lr.shape", "lr.opacities", "lr.epsilon"}
    by_size = {"adversarial.weight"}  # the paper's, for each pixel of a patch
    paper, ours, theirs = (
        by_dotted_name(p) for p in (distill.Params().model_dump(mode="json"), terms["distill"], laptop["distill"])
    )
    assert {name for name, value in ours.items() if value != paper[name]} == size | chosen | by_size
    assert all(ours[name] == theirs[name] for name in size)
    changed = {stage for stage in terms if terms[stage] != laptop[stage]}
    assert changed == {"masks", "personalize", "initialize", "distill"}
    start = resolve_finished("paper").params["initialize"]
    assert {name for name in start if start[name] != terms["initialize"][name]} == {"depth", "device"}


def by_dotted_name(params):
    """Return dotted name -> value of the parameters."""
    groups = {name: value for name, value in params.items() if isinstance(value, dict)}
    inner = {f"{name}.{each}": value for name, group in groups.items() for each, value in group.items()}
    return {name: value for name, value in params.items() if name not in groups} | inner


def test_the_papers_profile_takes_every_variant(resolve_finished):
    lifted, plain = (resolve_finished("paper", variant=v).params for v in ("lift_perceptual_diffusion", "sds_plain"))
    assert (lifted["lift"]["guidance"], lifted["lift"]["prompt"]) == (4, "A photo of a scene")
    assert "sks" not in str(plain["distill"]["prompts"]), "an unadapted prior knows sks as a rifle"


# ------------------------------------------------------------------------------------------ what the terms may reach

MSE, PATCHES = LiftTerm(weight=1), LiftTerm(weight=1, loss="perceptual")


def lifted_view(name="a", shift=0.0):
    view = train_view(name, shift)
    return replace(view, lifted=torch.rand(view.photo.shape, generator=seeding.generator(4, name)))


@pytest.mark.parametrize("how", [MSE, PATCHES], ids=["mse", "patches"])
def test_lifted_pictures_reach_only_the_gaussians_they_may(how):
    start, masked = random_wall()
    for allowed in (masked, torch.ones_like(masked)):
        gaussians = as_leaves(start)
        arguments = lifted_view(), how, perceptual.multi_scale_dssim, seeding.generator(1)
        loss, rendering = evaluate_lift(gaussians, allowed, *arguments)
        loss.backward()
        got = has_gradient(gaussians)
        assert not got[~allowed].any() and (got & masked & (rendering.radii > 0)).any()
    assert got[~masked].any(), "unconfined it reaches the unmasked ones"


def test_the_squared_error_is_that_of_the_holes_pixels():
    (gaussians, masked), view = random_wall(), lifted_view()
    loss, rendering = evaluate_lift(gaussians, masked, view, MSE, None, seeding.generator(1))
    expected = ((rendering.color - view.lifted)[square_hole()] ** 2).mean()
    assert float(loss) == pytest.approx(float(expected))
    outside = torch.where(square_hole()[..., None], view.lifted, float("nan"))
    again, _ = evaluate_lift(gaussians, masked, replace(view, lifted=outside), MSE, None, seeding.generator(1))
    assert float(again) == float(loss), "pixels outside the hole were looked at"


def has_moved(start, ended):
    return torch.stack([(getattr(ended, n) != getattr(start, n)).flatten(1).any(1) for n in PARAMETERS[:3]]).any(0)


@pytest.fixture
def check_regions_every_step(monkeypatch):
    """Make `distill` check after every step which Gaussians changed their region."""
    monkeypatch.setattr(D, "REGION_EVERY", 1)


def run_short_distill(folder, views, **changes):
    folder.mkdir()
    settings = with_changes(PLAIN, **{"iterations": 3, "sds": OFF, "checkpoint_seconds": 10, **changes})
    (start, masked), holes = random_wall(), [ReferenceHole(train_view().camera, train_view().photo, square_hole())]
    ended, labels = D.distill(start, masked, TermInputs(views, holes, start.means[masked]), settings, folder)
    return start, ended, masked, labels


def test_distillation_carries_lifted_pictures_to_masked_gaussians_only(tmp_path, check_regions_every_step):
    views = [lifted_view("a"), lifted_view("b", 0.1)]
    chosen = {"lift": {"weight": 1}, "reconstruction": {"every": 0}}
    start, ended, masked, _ = run_short_distill(tmp_path / "x", views, **chosen)
    assert has_moved(start, ended)[masked].any() and not has_moved(start, ended)[~masked].any()
    assert trace.read_trace(tmp_path / "x" / "trace.jsonl")[-1]["lift"] > 0
    with pytest.raises(ValueError, match="pictures of the stage lift"):
        run_short_distill(tmp_path / "y", [train_view()], lift={"weight": 1})
    with pytest.raises(ValueError, match="needs a distance"):
        run_short_distill(tmp_path / "z", views, lift={"weight": 1, "loss": "perceptual"})


@pytest.mark.parametrize("confined", [True, False])
def test_without_confinement_every_term_reaches_all_gaussians(tmp_path, check_regions_every_step, confined):
    views = [train_view("a"), train_view("b", 0.1)]
    photographs = {"confined": confined}
    start, ended, masked, labels = run_short_distill(tmp_path / "photographs", views, **photographs)
    assert has_moved(start, ended)[~masked].any() and has_moved(start, ended)[masked].any() != confined
    reference = {"confined": confined, "reference": {"weight": 1}, "reconstruction": {"every": 0}}
    start, ended, masked, _ = run_short_distill(tmp_path / "reference", views, **reference)
    assert has_moved(start, ended)[masked].any() and has_moved(start, ended)[~masked].any() != confined
    assert (labels == masked).all()


@pytest.mark.parametrize("reaches", ["masked", "all"])
def test_the_references_pixels_may_move_the_background_in_the_hole_too(tmp_path, check_regions_every_step, reaches):
    chosen = {"reference": {"weight": 1, "reaches": reaches}, "reconstruction": {"every": 0}}
    start, ended, masked, _ = run_short_distill(tmp_path / reaches, [train_view("a")], **chosen)
    assert has_moved(start, ended)[masked].any() and has_moved(start, ended)[~masked].any() == (reaches == "all")


# ---------------------------------------------------------------------------------------------------- the stages


@pytest.fixture(scope="module")
def masked_scene(tmp_path_factory):
    return run_through_masks(tmp_path_factory.mktemp("scene"), NEAR)


@pytest.fixture(scope="module")
def lifted_views(masked_scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("lift")
    lift.run(lift.Params(), out, **masked_scene)
    return out


def run_initialize(masked_scene, out, start, **needs):
    out.mkdir()
    needs = {"reference": None, **needs}
    initialize.run(initialize.Params(start=start), out, **masked_scene, **needs)
    return load_ply(out / "gaussians.ply"), load_labels(out / "labels.npy")


def test_lift_paints_the_hole_of_every_view_and_names_the_painter(masked_scene, lifted_views):
    sets, facts = load_mask_sets(masked_scene["masks"], wall_scene.TRAIN), load_json(lifted_views / "facts.json")
    assert facts["views"] == 5 and facts["inpainter"].startswith("OpenCV")
    for name in wall_scene.TRAIN:
        view, found = wall_scene.CAMERAS[name], load_image(lifted_views / "images" / f"{name}.png")
        outside = ~sets[name].consistent & ~sets[name].invent
        assert (found[outside] == wall_scene.photo(view)[outside]).all()
        # The square before the wall is red; what is painted continues the wall.
        error = np.abs(found.astype(int) - wall_scene.photo(view))[sets[name].invent]
        assert error.mean() < 30, name
    (best,) = load_references(lifted_views, load_scene(masked_scene["poses"]))
    assert best.camera.name == load_json(masked_scene["masks"] / "facts.json")["best_reference"]


def test_lift_goes_on_where_it_was_killed(masked_scene, lifted_views, tmp_path):
    marked = np.full((wall_scene.HEIGHT, wall_scene.WIDTH, 3), 7, np.uint8)
    save_image(tmp_path / "images" / "a0.png", marked)
    (tmp_path / "images" / ".a1.png").write_bytes(b"half a picture")
    lift.run(lift.Params(), tmp_path, **masked_scene)
    assert (load_image(tmp_path / "images" / "a0.png") == marked).all()
    for name in ("a1", "a4"):
        file = Path("images") / f"{name}.png"
        assert (tmp_path / file).read_bytes() == (lifted_views / file).read_bytes()


def test_lift_paints_a_clean_view_if_it_is_the_best(masked_scene, tmp_path):
    """A clean view has a hole if scene.yaml asks to fill pixels of this view."""
    best = load_json(masked_scene["masks"] / "facts.json")["best_reference"]
    shutil.copytree(masked_scene["poses"], tmp_path / "poses")
    views = load_json(tmp_path / "poses/views.json")
    save_json(tmp_path / "poses/views.json", views | {"clean": [best]})
    lift.run(lift.Params(), tmp_path / "lift", **masked_scene | {"poses": tmp_path / "poses"})
    (made,) = load_references(tmp_path / "lift", load_scene(tmp_path / "poses"))
    assert made.camera.name == best and made.mask.any()


def test_lift_without_a_hole_in_any_photograph_says_so(masked_scene, tmp_path):
    shutil.copytree(masked_scene["masks"], tmp_path / "masks")
    facts = load_json(tmp_path / "masks/facts.json")
    save_json(tmp_path / "masks/facts.json", facts | {"best_reference": None})
    with pytest.raises(ValueError, match="only views without a photograph have pixels to invent"):
        lift.run(lift.Params(), tmp_path / "lift", **masked_scene | {"masks": tmp_path / "masks"})


def test_lift_by_diffusion(masked_scene, tmp_path, monkeypatch):
    save_small_prior(tmp_path / "prior")
    used, paint = [], lift.inpaint.paint
    monkeypatch.setattr(
        lift.inpaint, "paint", lambda *a, **k: used.append((k["prompt"], k["guidance"])) or paint(*a, **k)
    )
    given = {"prompt": "a wall", "guidance": 4}
    params = lift.Params(inpainter="diffusion", prior=str(tmp_path / "prior"), steps=1, **given)
    (tmp_path / "out").mkdir()
    lift.run(params, tmp_path / "out", **masked_scene)
    facts = load_json(tmp_path / "out" / "facts.json")
    assert facts["inpainter"].startswith("diffusion by") and facts["views"] == 5
    assert used and set(used) == {("a wall", 4)}


def test_initialize_by_nothing_adds_no_gaussians(masked_scene, tmp_path):
    gaussians, new = run_initialize(masked_scene, tmp_path / "nothing", "nothing", reference=tmp_path / "never read")
    labels = load_labels(masked_scene["masks"] / "labels.npy")
    assert not new.any() and labels.any()
    assert (gaussians.means == load_ply(masked_scene["fit"] / "gaussians.ply").means[~labels]).all()


def test_as_many_random_gaussians_as_the_reference_has_fill_the_hole_by_their_seed(
    masked_scene, lifted_views, tmp_path
):
    shutil.copytree(lifted_views, tmp_path / "reference")
    save_json(tmp_path / "reference/facts.json", {"given": []})
    needs = {"reference": tmp_path / "reference"}
    _, filled = run_initialize(masked_scene, tmp_path / "filled", "reference", **needs)
    gaussians, new = run_initialize(masked_scene, tmp_path / "random", "random", **needs)
    assert new.sum() == filled.sum() and not (tmp_path / "random" / "depth").exists()
    at = gaussians.means[new]
    # The square, and the part of the wall that it hides from all views, were removed.
    assert (at[:, :2].abs() < 1.3 * wall_scene.HALF).all()
    assert (at[:, 2] > NEAR - 0.1).all() and (at[:, 2] < wall_scene.WALL + 0.1).all()
    with pytest.raises(ValueError, match="the stage reference, whose Gaussians it counts, was left out"):
        run_initialize(masked_scene, tmp_path / "uncounted", "random")
    again, _ = run_initialize(masked_scene, tmp_path / "again", "random", **needs)
    assert (again.means == gaussians.means).all() and (again.sh == gaussians.sh).all()


def test_random_points_lie_in_the_holes():
    box = random_init.bounding_box(np.random.default_rng(0).uniform(-1, 1, (4000, 3)))
    assert np.allclose(box, [[-1.15] * 3, [1.15] * 3], atol=0.05)
    assert np.allclose(random_init.box_at((0, 1, 2), (2, 2, 4)), [[-1, 0, 0], [1, 2, 4]])
    view, half = wall_scene.CAMERAS["a2"], np.zeros((wall_scene.HEIGHT, wall_scene.WIDTH), bool)
    half[:, : wall_scene.WIDTH // 2] = True
    holes, box = ([view], {"a2": half}), random_init.box_at((0, 0, 2), (0.5, 0.5, 0.5))
    points = random_init.sample_points(box, 300, *holes, torch.Generator())
    assert points.shape == (300, 3) and (points[:, 0] < 0).all()
    with pytest.raises(ValueError, match="do not meet"):
        random_init.sample_points(random_init.box_at((9, 9, 2), (0.1, 0.1, 0.1)), 9, *holes, torch.Generator())


def test_the_chain_of_lifted_pictures(masked_scene, lifted_views, tmp_path, monkeypatch):
    """Pictures inpainted one by one fill the wall's hole; the result is nearer to the wall than an empty hole is."""
    assert run_initialize(masked_scene, tmp_path / "initialize", "lift", lift=lifted_views)[1].any()
    with pytest.raises(ValueError, match=r"set distill.lift.weight"):
        run_initialize(masked_scene, tmp_path / "without", "lift")
    reference = tmp_path / "reference"
    mask = load_mask_sets(masked_scene["masks"], ["a2"])["a2"].invent
    save_references(reference, [Reference(wall_scene.CAMERAS["a2"], wall_scene.photo(wall_scene.CAMERAS["a2"]), mask)])
    chain = masked_scene | {"reference": reference, "personalize": None, "initialize": tmp_path / "initialize"}
    for name in ("XDG_CACHE_HOME", "TORCH_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "nothing"))  # as on a machine without weights
    for loss, perceptual_name in (("mse", None), ("perceptual", "multi-scale D-SSIM")):
        without = {"sds": OFF, "adversarial": OFF, "depth": OFF}
        params = distill.Params(iterations=2, lift={"weight": 1, "loss": loss}, **without)
        out = tmp_path / loss
        out.mkdir()
        distill.run(params, out, **chain, lift=lifted_views)
        facts = load_json(out / "facts.json")
        loss_name = facts["perceptual"] and facts["perceptual"].split(" (")[0]
        assert facts["inpainter"].startswith("OpenCV") and loss_name == perceptual_name
        assert trace.read_trace(out / "trace.jsonl")[-1]["lift"] > 0
    out = tmp_path / "evaluate"
    stages = {"initialize": chain["initialize"], "distill": tmp_path / "mse"}
    for folder in (tmp_path / "finish", out):
        folder.mkdir()
    finish.run(finish.Params(), tmp_path / "finish", poses=masked_scene["poses"], fit=masked_scene["fit"], **stages)
    raw_masks = masked_scene["poses"].with_name("raw_masks")
    evaluate.run(evaluate.Params(), out, **masked_scene, **stages, raw_masks=raw_masks, finish=tmp_path / "finish")
    summary = load_json(out / "metrics.json")
    assert summary["inpainter"].startswith("OpenCV") and summary["perceptual"] is None
    assert summary["result"] == "distill" and summary["mean"]["psnr_box"] > 20
    assert summary["consistency"]["pairs"] == 1 and summary["consistency"]["consistency"] < 0.05


def test_rendered_views_inpainted_in_2d(masked_scene, tmp_path):
    for name in ("finish", "fit", "inpainted"):
        (tmp_path / name).mkdir()
    needs = masked_scene | {"raw_masks": masked_scene["poses"].with_name("raw_masks")}
    finish.run(finish.Params(), tmp_path / "finish", poses=needs["poses"], fit=needs["fit"])
    evaluate.run(evaluate.Params(), tmp_path / "fit", **needs, finish=tmp_path / "finish")
    evaluate.run(evaluate.Params(inpaint=True), tmp_path / "inpainted", **needs, finish=tmp_path / "finish")
    before, after = (load_json(tmp_path / n / "metrics.json") for n in ("fit", "inpainted"))
    assert before["inpainter"] is None and after["inpainter"].startswith("OpenCV") and after["result"] == "fit"
    assert after["mean"]["psnr_box"] > before["mean"]["psnr_box"] + 5, "the red square is still there"
    for name in wall_scene.TEST:
        pictures = [load_image(tmp_path / n / "renders" / f"{name}.png") for n in ("fit", "inpainted")]
        mask = load_mask(masked_scene["masks"] / "consistent" / f"{name}.png")
        assert (pictures[0][~mask] == pictures[1][~mask]).all() and (pictures[0][mask] != pictures[1][mask]).any()
    raw = load_image(tmp_path / "inpainted" / "renders_fit" / "t0.png")
    assert (raw == load_image(tmp_path / "fit" / "renders" / "t0.png")).all()


def test_the_masked_fit_never_sees_a_masked_pixel(masked_scene, tmp_path):
    """Noise in the masked pixels of the photographs and another color of the object give identical Gaussians."""
    values = {"iterations": 12, "sh.degree": 0, "init.flow_cell": 6, "densify.cap_max": 1500, "densify.every": 4}
    params = fit.Params(pixels="unmasked").changed(values)
    found = []
    for seed in (0, 1):
        poses = wall_scene.write_poses_and_fit(tmp_path / f"scene{seed}", NEAR)[0]
        for name, mask in load_raw_masks(poses.with_name("raw_masks"), wall_scene.TRAIN).items():
            noise = np.random.default_rng(seed).integers(0, 256, (*mask.shape, 3), np.uint8)
            picture = np.where(mask[..., None], noise, wall_scene.photo(wall_scene.CAMERAS[name]))
            save_image(poses / "images" / f"{name}.png", picture)
        out = tmp_path / f"fit{seed}"
        out.mkdir()
        fit.run(params, out, poses=poses, raw_masks=poses.with_name("raw_masks"))
        found.append((out / "gaussians.ply").read_bytes())
    assert found[0] == found[1]
    means = load_ply(out / "gaussians.ply").means
    assert (means[:, 2] > 1.85).float().mean() > 0.95, "Gaussians stand where the object was"


def test_a_masked_fit_needs_masks_and_fits_a_scene_that_brings_gaussians(masked_scene, tmp_path):
    poses = wall_scene.write_poses_and_fit(tmp_path, NEAR, masks={})[0]
    with pytest.raises(ValueError, match=r"fit.pixels is 'unmasked', but the scene has no masks"):
        fit.run(fit.Params(iterations=1, pixels="unmasked"), tmp_path, poses=poses, raw_masks=tmp_path / "raw_masks")
    save_ply(poses / "gaussians.ply", wall_scene.wall_and_square(NEAR)[0])
    assert plan_fit.preview(fit.Params(), poses=poses)
    assert not plan_fit.preview(fit.Params(pixels="unmasked"), poses=poses)


def test_the_box_is_the_test_masks_whatever_was_left_out(masked_scene, tmp_path):
    view, mask = wall_scene.CAMERAS["a1"], load_mask(masked_scene["masks"] / "consistent" / "a1.png")
    raw_masks = masked_scene["poses"].with_name("raw_masks")
    raw = load_raw_masks(raw_masks, ["a1"])["a1"]
    assert (load_object_mask(view, raw_masks, masked_scene["masks"]) == mask).all()
    assert (load_object_mask(view, raw_masks, None) == raw).all()
    assert not load_object_mask(wall_scene.CAMERAS["t0"], raw_masks, None).any()
