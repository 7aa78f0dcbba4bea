"""Distillation, and references painted by hand or by the diffusion prior.

Each loss term changes only the Gaussians and parameters that it may reach, and all others stay bit for bit the same.
Masked Gaussians stay in their region, runs resume bit for bit, and errors name step, term and view.
"""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes.cameras import make_scene
from scenes.distill_scene import (
    ADVERSARIAL,
    HEIGHT,
    OFF,
    PLAIN,
    SDS,
    SETTINGS,
    WIDTH,
    as_leaves,
    has_changed,
    has_gradient,
    random_wall,
    square_hole,
    train_view,
    wall_camera,
)
from scenes.networks import save_small_prior
from scenes.settings import with_changes
from scenes.wall_scene import write_background, write_capture_photos

from reffusion import trace
from reffusion.distill import densification
from reffusion.distill import loop as D
from reffusion.distill.adversary import Adversary
from reffusion.distill.regions import build_region, has_changed_region
from reffusion.distill.terms.adversarial import evaluate_adversarial
from reffusion.distill.terms.reconstruction import evaluate_reconstruction
from reffusion.distill.terms.reference import evaluate_reference
from reffusion.distill.terms.sds import evaluate_sds, views_near_references
from reffusion.distill.terms.term import TermInputs
from reffusion.distill.train_view import ReferenceHole
from reffusion.gaussians.optimize import Rates, reconstruction_loss
from reffusion.inpaint.exemplar import RIM_WIDTH
from reffusion.io.arrays import load_labels, save_json, save_labels
from reffusion.io.images import load_image, load_mask, save_image
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_mask_sets, load_references, load_scene, save_mask_sets, save_scene
from reffusion.morphology import dilate
from reffusion.params.distill import Params
from reffusion.prior import inpaint
from reffusion.seeding import generator
from reffusion.splat import rasterizer
from reffusion.splat.rasterizer import render
from reffusion.trace import load_checkpoint, read_trace
from reffusion.types import PARAMETERS, MaskSet

pytestmark = pytest.mark.integration


def gradients_of(term, gaussians, masked, prior, text, view=None):
    gaussians, view = as_leaves(gaussians), view or train_view()
    if term == "sds":
        loss, rendering = evaluate_sds(gaussians, masked, view, prior, text, SDS, generator(1))
    elif term == "reference":
        loss, rendering = evaluate_reference(gaussians, masked, view.camera, view.photo, square_hole())
    else:
        reached = torch.ones_like(masked) if view.clean else ~masked
        loss, rendering = evaluate_reconstruction(gaussians, reached, view)
    loss.backward()
    return gaussians, rendering.radii > 0


@pytest.mark.parametrize("term", ["sds", "reference", "reconstruction"])
def test_forbidden_gradients_are_exactly_zero(term, prior, text):
    gaussians, masked = random_wall()
    allowed = ~masked if term == "reconstruction" else masked
    gaussians, visible = gradients_of(term, gaussians, masked, prior, text)
    got = has_gradient(gaussians)
    assert not got[~allowed].any(), "a forbidden Gaussian has a gradient"
    assert (got & allowed).sum() > 0.5 * (visible & allowed).sum(), "hardly any allowed Gaussian has a gradient"
    for name in PARAMETERS:
        assert getattr(gaussians, name).grad[allowed].ne(0).any(), name


def test_a_clean_view_reconstructs_all_gaussians(prior, text):
    gaussians, masked = random_wall()
    gaussians, visible = gradients_of("reconstruction", gaussians, masked, prior, text, train_view(clean=True))
    assert has_gradient(gaussians)[masked & visible].float().mean() > 0.5


@pytest.mark.parametrize("term", ["sds", "reconstruction"])
def test_unsupervised_pixels_of_a_photograph_change_nothing(term, prior, text):
    gaussians, masked = random_wall()
    view = train_view()
    poisoned = replace(view, photo=torch.where(view.supervises[..., None], view.photo, float("nan")))
    a, _ = gradients_of(term, gaussians, masked, prior, text, view)
    b, _ = gradients_of(term, gaussians, masked, prior, text, poisoned)
    for name in PARAMETERS:
        assert (getattr(a, name).grad == getattr(b, name).grad).all(), name


def test_densification_probe_of_unmasked_gaussians_stays_zero(prior, text):
    gaussians, masked = random_wall()
    probe = torch.zeros(len(gaussians), 2, requires_grad=True)
    evaluate_sds(as_leaves(gaussians), masked, train_view(), prior, text, SDS, generator(1), probe)[0].backward()
    assert (probe.grad[~masked] == 0).all() and (probe.grad[masked] != 0).any()


def test_sds_without_patches_and_with_guidance(prior, text):
    gaussians, masked = random_wall()
    for settings in ({"patches": 0}, {"guidance": 2.0}, {"hole_only": True}):
        moved = as_leaves(gaussians)
        evaluate_sds(moved, masked, train_view(), prior, text, with_changes(SDS, **settings), generator(1))[
            0
        ].backward()
        assert torch.isfinite(moved.means.grad).all() and moved.means.grad[masked].ne(0).any()


@pytest.mark.parametrize("reaches", ["masked", "all"])
def test_the_critic_reaches_spherical_harmonics_only(reaches):
    gaussians, masked = random_wall()
    moved, view = as_leaves(gaussians), train_view()
    adversary, chosen = Adversary(ADVERSARIAL, seed=0), masked | (reaches == "all")
    loss, rendering, metrics = evaluate_adversarial(
        moved, chosen, view, view.photo, square_hole(), adversary, generator(1)
    )
    loss.backward()
    assert all(getattr(moved, name).grad is None for name in PARAMETERS if name != "sh")
    got, visible = moved.sh.grad.flatten(1).ne(0).any(1), rendering.radii > 0
    assert got[~masked].any() == (reaches == "all")
    assert got[masked & visible].float().mean() > 0.5, "hardly any masked Gaussian has a gradient"
    assert moved.sh.grad[masked][:, 1:].ne(0).any(), "the view-dependent coefficients have none"
    assert metrics["adversarial"] == loss.item() and metrics["critic_loss"] > 0 and metrics["critic_slope"] > 0


def test_the_adversarial_gradient_is_that_of_the_patches_by_finite_differences():
    gaussians, masked = random_wall()
    moved, view = as_leaves(gaussians), train_view()
    adversary = Adversary(ADVERSARIAL, seed=0, rate=1e-12)  # the critic stays nearly constant
    term = lambda g: evaluate_adversarial(g, masked, view, view.photo, square_hole(), adversary, generator(2))[0]
    term(moved).backward()
    direction = torch.randn(gaussians.sh.shape, generator=generator(8)) * masked[:, None, None]
    step = 2e-3
    values = [float(term(replace(gaussians, sh=gaussians.sh + sign * step * direction))) for sign in (1, -1)]
    by_hand = (values[0] - values[1]) / (2 * step)
    assert (moved.sh.grad * direction).sum().item() == pytest.approx(by_hand, rel=0.02)


def test_only_gaussians_that_changed_region_are_found():
    gaussians, masked = random_wall(600)
    region = build_region(gaussians.means, masked)
    assert not has_changed_region(region, gaussians.means, masked).any(), "an initialization is in its regions"
    moved = gaussians.means.clone()
    a, b = torch.nonzero(masked)[0, 0], torch.nonzero(~masked)[0, 0]
    moved[a] = torch.tensor([0.55, 0.4, 0.05])  # a masked Gaussian, far outside its region
    middle = ((gaussians.means[:, :2].norm(dim=1)) + 10 * ~masked).argmin()
    moved[b] = gaussians.means[middle]  # an unmasked Gaussian, inside the region of the masked ones
    assert set(torch.nonzero(has_changed_region(region, moved, masked))[:, 0].tolist()) == {int(a), int(b)}
    slightly = gaussians.means + region.voxel * 0.9
    assert not has_changed_region(region, slightly, masked)[masked].any(), "there is room to move in"
    assert has_changed_region(region, torch.full_like(moved, 1e6), masked).tolist() == masked.tolist()
    single = build_region(gaussians.means[:1], torch.tensor([True]))
    assert not has_changed_region(single, gaussians.means[:1], torch.tensor([True])).any()


# ------------------------------------------------------------------------------------------ whole runs


def run_distill(folder, prior, text, settings=SETTINGS, views=None, gaussians=None):
    folder.mkdir(exist_ok=True)
    start, masked = random_wall()
    views = views or [train_view("a"), train_view("b", 0.1), train_view("c", -0.1, clean=True)]
    initial, holes = gaussians or start, [ReferenceHole(wall_camera(), train_view().photo, square_hole())]
    inputs = TermInputs(views, holes, initial.means[masked], prior, text)
    return D.distill(initial, masked, inputs, settings, folder)


@pytest.mark.parametrize("off", [{"adversarial": OFF}, {"sds": OFF}], ids=["SDS beside the other terms", "a critic"])
def test_any_number_of_threads_gives_the_same_bits(prior, text, tmp_path, off):
    before, found = torch.get_num_threads(), []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        try:
            found.append(run_distill(tmp_path / str(threads), prior, text, with_changes(SETTINGS, **off))[0])
            assert torch.get_num_threads() == threads
        finally:
            torch.set_num_threads(before)
    for name in PARAMETERS:
        assert (getattr(found[0], name) == getattr(found[1], name)).all(), name


def test_interrupted_distillation_resumes_to_the_same_gaussians(prior, text, tmp_path, monkeypatch):
    monkeypatch.setattr(trace, "WORK_PER_CHECKPOINT", 0)  # write a checkpoint after every step
    monkeypatch.setattr(D, "REGION_EVERY", 2)
    monkeypatch.setattr(D, "DENSIFIED_UNTIL", 1.0)
    whole, labels = run_distill(tmp_path / "whole", prior, text)
    assert labels.sum() > random_wall()[1].sum(), "densification added no masked Gaussian"
    real = D.take_step

    def interrupted(optimizer, step, *others):
        if step == 3:
            raise KeyboardInterrupt
        return real(optimizer, step, *others)

    monkeypatch.setattr(D, "take_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_distill(tmp_path / "broken", prior, text)
    assert load_checkpoint(tmp_path / "broken")["step"] == 3
    monkeypatch.setattr(D, "take_step", real)
    resumed, resumed_labels = run_distill(tmp_path / "broken", prior, text)
    assert (labels == resumed_labels).all()
    for name in PARAMETERS:
        assert (getattr(whole, name) == getattr(resumed, name)).all(), name
    lines = [
        [{k: v for k, v in r.items() if k != "seconds"} for r in read_trace(tmp_path / f / "trace.jsonl")]
        for f in ("whole", "broken")
    ]
    assert lines[0] == lines[1] and lines[0][-1]["iteration"] == 6
    assert lines[0][-1]["sds_gradient_max"] >= lines[0][-1]["sds_gradient_mean"] > 0
    assert {"adversarial", "critic_loss", "critic_slope"} <= lines[0][-1].keys()


def test_densification_needs_large_gradients_and_is_bounded(prior, text, tmp_path, monkeypatch):
    monkeypatch.setattr(densification, "PRUNED_OPACITY", 0.0)
    monkeypatch.setattr(D, "DENSIFIED_UNTIL", 1.0)
    masked = int(random_wall()[1].sum())

    def count_new(name, weight, every=2):
        densify = {"every": every, "max_growth": 1.25}
        settings = with_changes(PLAIN, iterations=6, confined=False, sds={"weight": weight}, densify=densify)
        _, labels = run_distill(tmp_path / name, prior, text, settings)
        return int(labels.sum()) - masked

    assert count_new("small gradients", 1e-9) == 0
    assert count_new("large gradients", 1e3) == round(0.25 * masked)
    assert count_new("never", 1e3, every=0) == 0


def test_a_gaussian_is_split_from_a_share_of_the_cameras_extent_on_as_in_3dgs(prior, text, tmp_path):
    """The extent of these cameras is 0.055: a new Gaussian of 0.005 is large by it, and small beside the distance 1."""
    start = random_wall()[0]
    start = replace(start, log_scales=torch.full_like(start.log_scales, math.log(0.005)))
    views, smallest = [train_view("a"), train_view("b", 0.1)], {}
    for unit in ("distance", "cameras"):
        changes = {"sds": {"weight": 1e3}, "densify": {"every": 2}, "lr": {"means_unit": unit, "shape": 0}}
        settings = with_changes(SETTINGS, iterations=4, confined=False, adversarial=OFF, reference=OFF, **changes)
        after, labels = run_distill(tmp_path / unit, prior, text, settings, views, start)
        smallest[unit] = float(after.log_scales[labels].exp().min())
    assert smallest["distance"] == pytest.approx(0.005) and smallest["cameras"] == pytest.approx(0.005 / 1.6)


def test_each_set_of_gaussians_moves_by_its_own_terms_only(prior, text, tmp_path):
    start, masked = random_wall()
    views, never = [train_view("a"), train_view("b", 0.1)], {"every": 0}
    one, labels = run_distill(tmp_path / "sds", prior, text, with_changes(PLAIN, reconstruction=never), views)
    assert (labels == masked).all() and (one.means[~masked] == start.means[~masked]).all()
    assert (one.sh[masked] != start.sh[masked]).any()
    two, _ = run_distill(tmp_path / "reconstruction", None, None, with_changes(PLAIN, sds=OFF), views)
    assert (two.means[masked] == start.means[masked]).all() and (two.sh[~masked] != start.sh[~masked]).any()
    alone = with_changes(
        PLAIN, adversarial=ADVERSARIAL.model_dump() | {"reaches": "masked"}, sds=OFF, reconstruction=never
    )
    three, _ = run_distill(tmp_path / "adversarial", None, None, alone, views)
    for name in PARAMETERS:
        still = ~masked if name == "sh" else torch.ones_like(masked)
        assert (getattr(three, name)[still] == getattr(start, name)[still]).all(), name
    assert (three.sh[masked] != start.sh[masked]).any()


def test_distillation_may_reach_the_background_too_but_not_what_does_not_show(prior, text, tmp_path):
    start, masked = random_wall()
    settings = with_changes(PLAIN, iterations=2, reconstruction={"every": 0}, sds={"reaches": "all"})
    view = train_view("a")
    moved = has_changed(start, run_distill(tmp_path / "all", prior, text, settings, [view])[0])
    visible = rasterizer.accumulate(start, view.camera, torch.ones(*square_hole().shape, 1))[:, 0] > 0
    assert (moved & masked).any() and (moved & ~masked).any() and not (moved & ~visible).any()


def test_views_far_from_every_reference_are_not_distilled(prior, text, tmp_path):
    start, masked = random_wall()
    near, far = train_view("a"), train_view("b", 0.5)  # `far` is 26 degrees away from the reference
    distilled = lambda degrees: views_near_references([near, far], [wall_camera()], start.means[masked], degrees)
    assert [distilled(x) for x in (1, 20, 35, 180)] == [{"a"}, {"a"}, {"a", "b"}, {"a", "b"}]
    for degrees in (20, 35):
        settings = with_changes(PLAIN, iterations=3, reconstruction={"every": 0}, sds={"max_angle": degrees})
        ended, _ = run_distill(tmp_path / str(degrees), prior, text, settings, [far])
        assert has_changed(start, ended).any() == (degrees == 35)
        logged = ["sds_gradient_mean" in line for line in read_trace(tmp_path / str(degrees) / "trace.jsonl")[1:]]
        assert logged == [degrees == 35] * len(logged)


def test_the_logged_gradient_is_that_of_sds_alone(prior, text, tmp_path):
    logged = {}
    for name, others in (("alone", {"adversarial": OFF, "reference": OFF}), ("beside others", {})):
        settings = with_changes(SETTINGS, iterations=1, confined=False, **others)
        run_distill(tmp_path / name, prior, text, settings, [train_view("a")])
        logged[name] = read_trace(tmp_path / name / "trace.jsonl")[-1]["sds_gradient_mean"]
    assert logged["alone"] == pytest.approx(logged["beside others"])


def test_photographs_may_reach_the_masked_gaussians_that_show_outside_the_hole(tmp_path):
    """With `reaches="shown"`, a Gaussian moves only if it contributes to a pixel outside the hole."""
    start, masked = random_wall()
    view = train_view("a")
    outside = rasterizer.accumulate(start, view.camera, (~square_hole())[..., None].float())[:, 0] > 0
    assert (masked & outside).any() and (masked & ~outside).any()
    for reaches in ("unmasked", "shown"):
        settings = with_changes(PLAIN, iterations=2, sds=OFF, reconstruction={"reaches": reaches})
        moved = has_changed(start, run_distill(tmp_path / reaches, None, None, settings, [view])[0])
        assert not (moved & ~outside).any() and (moved & ~masked).any()
        assert (moved & masked).any() == (reaches == "shown")


def test_the_reference_term_draws_the_reference(prior, text, tmp_path):
    start, masked = random_wall()
    alone = {"sds": OFF, "reference": {"weight": 1.0}, "reconstruction": {"every": 0}}
    settings, views = with_changes(PLAIN, iterations=40, checkpoint_seconds=1e9, **alone), [train_view()]
    target, _ = random_wall()
    with torch.no_grad():
        image = render(replace(target, sh=target.sh + 0.5), wall_camera()).color.clamp(0, 1)
    inputs = TermInputs(views, [ReferenceHole(wall_camera(), image, square_hole())], start.means[masked])
    ended, _ = D.distill(start, masked, inputs, settings, tmp_path, Rates(sh_dc=0.03))
    records = read_trace(tmp_path / "trace.jsonl")
    assert records[-1]["reference_psnr"] > records[0]["reference_psnr"] + 1
    assert len(ended) == len(start)


def test_the_reference_term_is_that_of_the_whole_view():
    start, masked = random_wall()
    image, chosen = torch.rand(HEIGHT, WIDTH, 3, generator=generator(3)), torch.ones_like(masked)
    part, whole = as_leaves(start), as_leaves(start)
    loss, _ = evaluate_reference(part, chosen, wall_camera(), image, square_hole())
    expected = reconstruction_loss(render(whole, wall_camera()).color, image, square_hole())
    loss.backward()
    expected.backward()
    # Not exactly equal: the term renders a crop, and gradients are clamped at the border of the rendered image.
    assert float(loss) == pytest.approx(float(expected), rel=1e-3)
    for name in PARAMETERS:
        apart = (getattr(part, name).grad - getattr(whole, name).grad).norm()
        assert apart < 0.01 * getattr(whole, name).grad.norm(), name
    nothing, _ = evaluate_reference(part, chosen, wall_camera(), image, torch.zeros_like(square_hole()))
    assert float(nothing) == 0


def test_nan_names_step_term_and_view(prior, text, tmp_path):
    broken = replace(prior, alphas_cumprod=torch.full_like(prior.alphas_cumprod, float("nan")))
    with pytest.raises(FloatingPointError, match=r"step 0, SDS, view 'a'"):
        run_distill(tmp_path / "x", broken, text, views=[train_view()])
    bad = replace(train_view(), photo=torch.full((HEIGHT, WIDTH, 3), float("nan")))
    with pytest.raises(FloatingPointError, match=r"step 0, reconstruction, view 'a'"):
        run_distill(tmp_path / "y", None, None, with_changes(PLAIN, sds=OFF), [bad])
    alone = with_changes(SETTINGS, sds=OFF, reference=OFF)
    (tmp_path / "z").mkdir()
    # NaN outside the hole: the critic's patches extend over the border of the hole.
    beside = torch.where(square_hole()[..., None], train_view().photo, float("nan"))
    start, masked = random_wall()
    holes = [ReferenceHole(wall_camera(), beside, each) for each in (square_hole(), torch.zeros_like(square_hole()))]
    full, empty = (TermInputs([train_view()], [each], start.means[masked]) for each in holes)
    with pytest.raises(FloatingPointError, match=r"step 0, adversarial, view 'a': the critic's loss"):
        D.distill(start, masked, full, alone, tmp_path / "z")
    with pytest.raises(ValueError, match="reference's hole"):
        D.distill(start, masked, empty, alone, tmp_path / "z")
    with pytest.raises(ValueError, match="prior"):
        run_distill(tmp_path / "z", None, None)


# ------------------------------------------------------------------------------------------ the reference


def test_painting_keeps_known_pixels_and_a_candidates_picture_is_its_seeds(prior):
    image = torch.rand(3, HEIGHT, WIDTH, generator=generator(5)) * 2 - 1
    options = {"prompt": "", "steps": 2, "start": 1.0, "finest": 0.6, "guidance": 0.0}
    pair = inpaint.paint(prior, image, square_hole(), seeds=[0, 1], **options)
    assert pair.shape == (2, 3, HEIGHT, WIDTH) and torch.isfinite(pair).all()
    assert (pair[:, :, ~square_hole()] == image[:, ~square_hole()]).all()
    assert (pair[0] != pair[1]).any()
    assert (inpaint.paint(prior, image, square_hole(), seeds=[1], **options)[0] == pair[1]).all()
    other = torch.where(square_hole(), torch.rand(HEIGHT, WIDTH, generator=generator(6)), image)
    assert (inpaint.paint(prior, other, square_hole(), seeds=[1], **options)[0] == pair[1])[:, square_hole()].all()


def test_painting_starts_from_the_hole_filled_with_the_colors_around_it(prior):
    image, size = torch.full((3, 16, 16), 0.3), prior.native_size
    assert size == 16
    hole = torch.zeros(16, 16, dtype=torch.bool)
    hole[4:12, 4:12] = True
    hollow = torch.where(hole, -1.0, image)
    options = {"prompt": "", "seeds": [0], "steps": 4, "guidance": 0.0, "finest": 1 / prior.timesteps}
    difference = lambda start: float(
        (inpaint.paint(prior, hollow, hole, start=start, **options)[0] - image).abs().max()
    )
    assert difference(1 / prior.timesteps) < 0.1 < difference(1.0)


def test_painting_works_on_views_smaller_and_larger_than_the_prior(prior):
    for height, width in ((10, 13), (16, 16), (36, 34)):
        mask = torch.zeros(height, width, dtype=torch.bool)
        mask[-14:-3, 2:9] = True
        painted = inpaint.paint(
            prior, torch.zeros(3, height, width), mask, prompt="", seeds=[0], steps=1, start=1, finest=0.5, guidance=1
        )
        assert painted.shape == (1, 3, height, width) and (painted[:, :, ~mask] == 0).all()


@pytest.mark.parametrize("shape", [(16, 16), (40, 64), (75, 33)])
def test_windows_cover_any_hole(shape):
    for seed in range(20):
        mask = torch.rand(*shape, generator=generator(7, seed)) > (0.2, 0.99)[seed % 2]
        covered = torch.zeros_like(mask)
        for top, left in inpaint.windows_over(mask, 16):
            assert 0 <= top <= shape[0] - 16 and 0 <= left <= shape[1] - 16
            covered[top : top + 16, left : left + 16] = True
        assert (covered | ~mask).all()


def test_levels_double_up_to_the_view():
    assert inpaint.level_sizes(240, 320, 64) == [(128, 171), (240, 320)]
    assert inpaint.level_sizes(1200, 1600, 512) == [(1024, 1365), (1200, 1600)]
    assert inpaint.level_sizes(400, 300, 512) == [(683, 512)]


def test_the_seam_prefers_the_candidate_that_continues_its_surroundings():
    ramp = torch.linspace(-1, 1, WIDTH).expand(3, HEIGHT, WIDTH)
    wrong = torch.where(square_hole(), torch.tensor(0.9), ramp)
    assert int(inpaint.seam_score(torch.stack([wrong, ramp, wrong]), square_hole()).argmin()) == 1


# ------------------------------------------------------------------------------------------ the stages


@pytest.fixture
def stage_folders(tmp_path):
    """The folders of a small scene's stages, filled up to `initialize`, and the folder of a small prior."""
    gaussians, masked = random_wall()
    cameras = {name: wall_camera(name, shift) for name, shift in (("a", 0.0), ("b", 0.1), ("t", 0.05))}
    scene = make_scene(cameras, ("t",), points=np.zeros((4, 3)))
    names = ("scene", "poses", "raw_masks", "fit", "masks", "initialize", "reference", "personalize", "distill")
    paths = {name: tmp_path / name for name in names}
    for path in paths.values():
        path.mkdir()
    save_scene(paths["poses"], scene)
    for name, view in cameras.items():
        save_image(paths["poses"] / "images" / f"{name}.png", render(gaussians, view).color.clamp(0, 1).numpy())
    write_capture_photos(paths["scene"], paths["poses"], cameras)
    pixels = square_hole().numpy()
    save_mask_sets(paths["masks"], {name: MaskSet(pixels, pixels, pixels, pixels) for name in cameras})
    save_json(paths["masks"] / "facts.json", {"best_reference": "b"})
    save_labels(paths["masks"] / "labels.npy", masked)
    save_labels(paths["initialize"] / "labels.npy", masked)
    for stage in ("fit", "initialize"):
        save_ply(paths[stage] / "gaussians.ply", gaussians)
    write_background(paths["poses"], paths["fit"], paths["masks"])
    save_small_prior(tmp_path / "prior")
    return paths | {"prior": str(tmp_path / "prior")}


def select_folders(stage_folders, *names):
    return {name: stage_folders[name] for name in names}


def test_stages_chain_through_files_with_the_scenes_own_reference(stage_folders):
    from stages import distill, personalize, reference
    from stages.plan import reference as plan

    picture = load_image(stage_folders["poses"] / "images" / "a.png")
    save_image(stage_folders["scene"] / "done" / "a.png", picture)
    params = reference.Params(prior="nowhere/at-all", reference={"view": "a", "image": "done/a.png", "trust": True})
    assert "reference a:" in plan.preview(params, **select_folders(stage_folders, "scene", "poses"))[0]
    reference.run(params, stage_folders["reference"], **select_folders(stage_folders, "scene", "poses", "fit", "masks"))
    assert (load_image(stage_folders["reference"] / "references" / "a.png") == picture).all()
    assert (load_mask(stage_folders["reference"] / "masks" / "a.png") == square_hole().numpy()).all()

    learning = personalize.Params(prior=stage_folders["prior"], steps=2, optimizer={"batch": 2}, samples={"size": 8})
    personalize.run(
        learning, stage_folders["personalize"], **select_folders(stage_folders, "poses", "raw_masks", "reference")
    )
    assert (stage_folders["personalize"] / "pytorch_lora_weights.safetensors").exists()

    needs = select_folders(stage_folders, "poses", "fit", "masks", "reference", "personalize", "initialize")
    critic = {"patches": 4, "size": 8, "width": 4}
    distill.run(
        distill.Params(prior=stage_folders["prior"], iterations=2, adversarial=critic),
        stage_folders["distill"],
        **needs,
    )
    result = load_ply(stage_folders["distill"] / "gaussians.ply")
    labels = load_labels(stage_folders["distill"] / "labels.npy")
    assert len(result) == len(labels) and labels.any()
    for stage in ("personalize", "distill"):
        assert (
            read_trace(stage_folders[stage] / "trace.jsonl") and not (stage_folders[stage] / "checkpoint.pt").exists()
        )


def test_reference_inpaints_the_best_view_and_keeps_all_else(stage_folders):
    from stages import reference

    params = reference.Params(prior=stage_folders["prior"], candidates=2, sampler={"steps": 2})
    reference.run(params, stage_folders["reference"], **select_folders(stage_folders, "scene", "poses", "fit", "masks"))
    (found,) = load_references(stage_folders["reference"], load_scene(stage_folders["poses"]))
    photo = load_image(stage_folders["poses"] / "images" / "b.png")
    assert found.camera.name == "b" and (found.image[~found.mask] == photo[~found.mask]).all()
    assert load_image(stage_folders["reference"] / "candidates.png").shape == (HEIGHT, 2 * WIDTH, 3)
    record = json.loads((stage_folders["reference"] / "candidates.json").read_text())
    assert record["chosen"] == int(np.argmin(record["seams"]))
    with pytest.raises(ValueError, match="choose"):
        third = params.model_copy(update={"choose": 2})
        reference.run(
            third, stage_folders["reference"], **select_folders(stage_folders, "scene", "poses", "fit", "masks")
        )


def test_a_reference_made_of_pieces_of_itself_needs_no_prior(stage_folders, tmp_path):
    from stages import reference
    from stages.plan import reference as plan

    params = reference.Params(inpainter="exemplar", prior="no/such-model", prompt="a vase")
    assert not plan.needed_weights(params, frozenset())
    (note,) = plan.preview(params, scene=stage_folders["scene"])
    assert "a vase" in note and "not read" in note
    reference.run(params, stage_folders["reference"], **select_folders(stage_folders, "scene", "poses", "fit", "masks"))
    (found,) = load_references(stage_folders["reference"], load_scene(stage_folders["poses"]))
    photo = load_image(stage_folders["poses"] / "images" / "b.png")
    rim = dilate(load_mask_sets(stage_folders["masks"], ["b"])["b"].consistent, RIM_WIDTH)
    assert found.mask.any() and (found.image[~found.mask & ~rim] == photo[~found.mask & ~rim]).all()


def test_weights_are_asked_for_by_the_terms_that_use_them():
    from stages.plan import distill as plan

    names = lambda **changes: [n.name for n in plan.needed_weights(with_changes(plan.Params(), **changes), frozenset())]
    prior = Params().prior
    assert names() == names(sds=OFF) == names(depth=OFF) == [prior] and names(sds=OFF, depth=OFF) == []
    assert names(depth={"model": "a/network"}) == [prior, "a/network"]
    assert names(depth={"model": "a/network", "weight": 0}) == [prior]
