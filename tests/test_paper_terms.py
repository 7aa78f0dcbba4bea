"""Details in which the code follows the paper: supervision, references, prompts, masks, step sizes, colors.

C is the mask of the removed object in a view (consistent mask), I the mask of the invented pixels (invent mask).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import wall_scene
from scenes.cameras import make_camera, yaw
from scenes.distill_scene import random_wall, train_view, wall_camera
from scenes.networks import save_small_prior
from scenes.settings import with_changes
from scenes.stage_runs import run_masks
from scipy.ndimage import binary_erosion

from reffusion.background.model import Background
from reffusion.capture import image_detail
from reffusion.distill import inputs, loop
from reffusion.distill.adversary import Adversary
from reffusion.distill.display_range import clamp_to_display
from reffusion.distill.terms import adversarial, sds
from reffusion.distill.terms.depth import _downscale
from reffusion.fit import step
from reffusion.fit.preparation import limit_sh_degree
from reffusion.gaussians.optimize import Rates
from reffusion.geometry import cameras_extent, project, sample_nearest, unproject
from reffusion.initialize import draft_operations
from reffusion.initialize.draft import Draft
from reffusion.initialize.fill import fill_reference
from reffusion.io.arrays import load_labels
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_mask_sets, load_references, load_scene, save_mask_sets
from reffusion.masks.consolidation import clean_mask
from reffusion.params.base import Prompts
from reffusion.params.distill import Params, SdsTerm
from reffusion.params.fit import LearningRates
from reffusion.prior import diffusion, lora
from reffusion.seeding import generator
from reffusion.types import MaskSet, Reference
from reffusion.workspace import Workspace
from runner.keys import HASHES, Hashes
from runner.resolve import Request, resolve_all
from stages import fit, initialize, masks, personalize, reference
from stages.plan import reference as plan_reference

ROOT = Path(__file__).resolve().parent.parent
NEAR = 1.6


# --------------------------------------------------------------------------------------------------------- supervision


@pytest.fixture(scope="module")
def load_views_with(tmp_path_factory):
    """Return a function that loads the training views for changed parameters, and the masks C and I, bool [H, W].

    I lies beside C. View a3 has no I; view a4 is clean, which means that its photograph does not show the object.
    """
    home = tmp_path_factory.mktemp("insertion")
    poses, fitted, _ = wall_scene.write_poses_and_fit(home, NEAR, clean=("a4",))
    hidden, invent, none = (np.zeros((wall_scene.HEIGHT, wall_scene.WIDTH), bool) for _ in range(3))
    hidden[20:40, 10:30], invent[20:40, 50:70] = True, True
    sets = {name: MaskSet(none, hidden, none, none if name == "a3" else invent) for name in wall_scene.CAMERAS}
    save_mask_sets(home / "masks", sets)
    space = Workspace(poses, fitted, home / "masks")

    def made(**changes):
        views = inputs.load_train_views(with_changes(Params(), **changes), space)
        return {view.camera.name: view for view in views}

    return made, torch.from_numpy(hidden), torch.from_numpy(invent)


def test_photographs_do_not_supervise_where_an_object_is_drawn(load_views_with):
    made, hidden, invent = load_views_with
    views = made()
    assert torch.equal(views["a0"].supervises, ~(hidden | invent)) and torch.equal(views["a3"].supervises, ~hidden)
    assert views["a4"].clean and views["a4"].supervises.all()
    _, _, not_seen = _downscale(views["a0"], 10_000)  # the mask of the depth term
    assert torch.equal(not_seen, hidden | invent)


def test_a_view_without_invented_pixels_is_distilled_where_c_is_repainted(load_views_with):
    made, hidden, _ = load_views_with
    assert not made(repaint="invent")["a3"].repaint.any()
    views = made(repaint="consistent")
    assert torch.equal(views["a3"].repaint, hidden) and not views["a4"].repaint.any()


def test_the_refit_is_not_supervised_where_an_object_is_drawn(tmp_path, monkeypatch):
    found = {}
    monkeypatch.setattr(draft_operations, "refit", lambda scene, exact, known, *_: found.update(known.hidden) or scene)
    masked, invent = np.eye(4, dtype=bool), np.eye(4, dtype=bool)[::-1]
    background = Background([type("View", (), {"camera": wall_camera(), "masked": masked})], {})
    scene = type("Scene", (), {"clean": (), "camera_only": ()})
    sets = {"a": MaskSet(masked, masked, invent, invent)}
    draft = Draft(None, torch.zeros(0, dtype=torch.uint8))
    draft_operations.refit_draft(draft, 1, scene, background, [], sets, True, tmp_path)
    assert (found["a"] == masked | invent).all()


def test_a_clean_view_can_be_a_reference(tmp_path):
    """The stages `reference` and `initialize` accept a reference whose view is clean (it does not show the object).

    The reference's hole is C, although the view has no invented pixels, and `initialize` fills the hole.
    """
    paths = {name: tmp_path / name for name in ("scene", "poses", "fit", "masks", "reference", "initialize")}
    poses, fitted, _ = wall_scene.write_poses_and_fit(tmp_path, NEAR, clean=("a2",))
    wall_scene.write_capture_photos(paths["scene"], poses, wall_scene.CAMERAS)
    for name in ("reference", "initialize"):
        paths[name].mkdir()
    run_masks(poses, fitted, paths["masks"], masks.Params(invent="consistent"))
    spec = {"view": "a2", "image": "images/a2.png"}
    params = reference.Params(reference=spec)
    reference.run(params, paths["reference"], **{k: paths[k] for k in ("scene", "poses", "fit", "masks")})
    (found,) = load_references(paths["reference"], load_scene(poses))
    sets = load_mask_sets(paths["masks"], ["a2"])["a2"]
    assert not sets.invent.any() and (found.mask == sets.consistent).all() and found.mask.sum() > 100
    needs = {k: paths[k] for k in ("poses", "fit", "masks", "reference")}
    initialize.run(initialize.Params(), paths["initialize"], **needs)
    assert load_labels(paths["initialize"] / "labels.npy").any()


def test_a_picture_that_teaches_reaches_personalization_only(tmp_path):
    """The paper's sparse views: "Ours (LoRA)" learns pictures that are neither unprojected nor reconstructed."""
    paths = {name: tmp_path / name for name in ("scene", "poses", "fit", "masks", "prior")}
    poses, fitted, _ = wall_scene.write_poses_and_fit(tmp_path, NEAR)
    wall_scene.write_capture_photos(paths["scene"], poses, wall_scene.CAMERAS)
    run_masks(poses, fitted, paths["masks"], masks.Params(invent="consistent"))
    save_small_prior(paths["prior"])
    raw_masks = poses.with_name("raw_masks")
    learnt = []
    for number, teach in enumerate(([], ["images/a4.png"])):
        found, adapted = tmp_path / f"reference-{number}", tmp_path / f"personalize-{number}"
        found.mkdir()
        adapted.mkdir()
        params = reference.Params(reference={"view": "a2", "image": "images/a2.png", "trust": True}, teach=teach)
        reference.run(params, found, **{k: paths[k] for k in ("scene", "poses", "fit", "masks")})
        assert [each.camera.name for each in load_references(found, load_scene(poses))] == ["a2"]
        params = personalize.Params(prior=str(paths["prior"]), steps=2, lora={"rank": 2})
        personalize.run(params, adapted, poses=poses, raw_masks=raw_masks, reference=found)
        learnt.append((adapted / lora.LORA_FILE).read_bytes())
    assert learnt[0] != learnt[1]
    with pytest.raises(ValueError, match=r"a9\.png: no such file; correct `teach`"):
        plan_reference.preview(reference.Params(teach=["images/a9.png"]), scene=paths["scene"])


def test_without_overlap_new_gaussians_lie_in_the_hole(tmp_path):
    paths = {name: tmp_path / name for name in ("scene", "poses", "fit", "masks", "reference")}
    poses, fitted, _ = wall_scene.write_poses_and_fit(tmp_path, NEAR)
    wall_scene.write_capture_photos(paths["scene"], poses, wall_scene.CAMERAS)
    paths["reference"].mkdir()
    run_masks(poses, fitted, paths["masks"], masks.Params(invent="consistent"))
    spec = {"view": "a2", "image": "images/a2.png", "trust": True}
    needs = {k: paths[k] for k in ("scene", "poses", "fit", "masks")}
    reference.run(reference.Params(reference=spec), paths["reference"], **needs)
    scene, hole = load_scene(poses), load_mask_sets(paths["masks"], ["a2"])["a2"].consistent
    beyond = []
    for overlap in (0, 0.05):
        out = tmp_path / str(overlap)
        out.mkdir()
        params = initialize.Params(overlap=overlap, tidy=False)
        initialize.run(params, out, **{k: paths[k] for k in ("poses", "fit", "masks", "reference")})
        means = load_ply(out / "gaussians.ply").means[load_labels(out / "labels.npy")]
        inside, _ = sample_nearest(hole, project(means.double().numpy(), scene.cameras["a2"])[0])
        beyond.append((~inside).mean())
    assert beyond[0] == 0 < beyond[1]


def test_the_aligned_estimate_holds_in_the_whole_hole_unless_hints_are_asked_for(tmp_path):
    """Other views confirm the wall's depth in a part of the hole, in which the depth model errs by a fifth.

    The view of the reference looks at the wall obliquely, since a constant depth would fix no scale.
    """
    poses, fitted, _ = wall_scene.write_poses_and_fit(tmp_path, NEAR)
    run_masks(poses, fitted, tmp_path / "masks", masks.Params(invent="consistent"))
    space = Workspace(poses, fitted, tmp_path / "masks")
    size = wall_scene.WIDTH, wall_scene.HEIGHT
    camera = make_camera("oblique", size, wall_scene.FOCAL, (-1.0, 0.0, 0.0), yaw(0.45))
    rays = unproject(np.ones((camera.height, camera.width)), camera) - camera.center
    depth = wall_scene.WALL / rays[..., 2]
    hole = wall_scene.is_behind_square(camera.center + depth[..., None] * rays, camera, NEAR)
    given = Reference(camera, np.full((*hole.shape, 3), 128, np.uint8), hole)
    shares = []
    for hints in (False, True):
        params = initialize.Params(depth={"hints": hints}, tidy=False)
        background = replace(space.background, masks={camera.name: hole})
        draft, disparity = Draft.start(space.remaining), np.where(hole, 1.2, 1.0) / depth
        filled = fill_reference(params, draft, given, background, disparity=disparity)
        inside = binary_erosion(hole, iterations=3)  # the step at the border may move by a pixel
        shares.append(np.isclose((filled.depth / depth)[inside], 1 / 1.2, rtol=0.02).mean())
    assert shares[0] > 0.98 and shares[1] < 0.9


def test_a_hidden_pixel_is_not_examined_where_all_of_c_is_invented(tmp_path):
    """`paper` uses neither unobserved pixels nor planes. A stage that does has the planes searched when it runs."""
    poses, fitted, _ = wall_scene.write_poses_and_fit(tmp_path, NEAR)
    spaces = {}
    for invent in ("consistent", "auto"):
        run_masks(poses, fitted, tmp_path / invent, masks.Params(invent=invent, shadows=False, debris=False))
        spaces[invent] = Workspace(poses, fitted, tmp_path / invent)
    every, some = (spaces[invent].mask_sets["a2"] for invent in ("consistent", "auto"))
    assert (every.consistent == some.consistent).all() and some.unobserved.sum() < every.unobserved.sum()
    assert (every.unobserved == every.consistent).all() and (every.invent == every.consistent).all()
    assert spaces["consistent"].background.planes, "found when asked for"
    for late, early in zip(*(spaces[invent].background.planes for invent in spaces), strict=True):
        assert np.allclose(late.normal, early.normal) and late.offset == pytest.approx(early.offset)


# ---------------------------------------------------------------------------------------------------- input of a prior


def test_without_personalization_the_lora_is_missing_and_the_prompts_are_plain_words():
    requests = [Request(ROOT, ROOT / "runs", "", profile="paper", variant=v) for v in (None, "no_personalization")]
    full, ablated = resolve_all(requests, Hashes(ROOT / "runs" / HASHES), scene=False)
    changed = [stage for stage in full.params if full.params[stage] != ablated.params[stage]]
    assert changed == ["personalize", "distill"]
    assert ablated.params["personalize"] == full.params["personalize"] | {"steps": 0}
    plain = {"whole": "A photo of a scene", "crop": "A photo of a scene, cropped"}
    assert ablated.params["distill"] == full.params["distill"] | {"prompts": plain}


def test_prompts_of_the_prior(prior, monkeypatch):
    monkeypatch.setattr(inputs, "load_prior", lambda *_, **__: prior)
    for prompts in (Prompts(), Prompts(whole="a wall", crop="a brick")):
        _, embeddings = inputs.load_adapted_prior(Params(prompts=prompts), None)
        assert torch.equal(embeddings, diffusion.embed_text(prior, prompts.texts))
    assert not torch.equal(embeddings, diffusion.embed_text(prior, Prompts().texts))


def test_guidance_of_the_empty_prompt_changes_nothing_and_costs_nothing(prior, monkeypatch):
    noise = torch.randn(2, 9, 16, 16, generator=generator(0, "guidance"))
    noisy, condition, at = noise[:, :4], noise[:, 4:], torch.tensor([300, 700])
    empty = diffusion.embed_text(prior, ["", ""])
    rows = []
    predict = diffusion.raw_prediction
    monkeypatch.setattr(diffusion, "raw_prediction", lambda p, z, *rest: rows.append(len(z)) or predict(p, z, *rest))
    with torch.no_grad():
        plain = diffusion.predict_with_guidance(prior, noisy, at, condition, empty, None, 0.0)
        guided = diffusion.predict_with_guidance(prior, noisy, at, condition, empty, empty, 7.5)
    assert rows == [2, 2] and all(torch.equal(a, b) for a, b in zip(plain, guided, strict=True))


def test_colors_above_1_are_shown_as_1_and_may_only_come_back():
    color = torch.tensor([-0.2, 0.5, 1.5, 1.5], requires_grad=True)
    display = clamp_to_display(color)
    assert torch.equal(display, torch.tensor([0.0, 0.5, 1.0, 1.0]))
    (display * torch.tensor([1.0, 1.0, 1.0, -1.0])).sum().backward()  # an optimization step goes against the gradient
    assert color.grad.tolist() == [0, 1, 1, 0]


def test_no_term_shows_a_prior_or_a_critic_colors_above_1(prior, monkeypatch):
    gaussians, masked = random_wall()
    bright = replace(gaussians, sh=gaussians.sh + 3)
    seen = []
    encode, patches = diffusion.encode, adversarial.draw_patches
    monkeypatch.setattr(diffusion, "encode", lambda p, images: seen.append(float(images.max())) or encode(p, images))
    watched = lambda image, *rest: seen.append(float(image.max()) * 2 - 1) or patches(image, *rest)
    monkeypatch.setattr(adversarial, "draw_patches", watched)
    with torch.no_grad():
        text = diffusion.embed_text(prior, Prompts().texts)
    sds.evaluate_sds(bright, masked, train_view(), prior, text, SdsTerm(guidance=0), generator(0, "bright"))
    critic = Params(adversarial={"patches": 4, "size": 8, "width": 4}).adversarial
    adversary = Adversary(critic, 0)
    view = train_view()
    adversarial.evaluate_adversarial(bright, masked, view, view.photo, view.repaint, adversary, generator(0, "bright"))
    assert len(seen) >= 4 and max(seen) <= 1 + 1e-5


# ------------------------------------------------------------------------------------------------------------- the fit


def test_positions_step_by_the_cameras_extent_as_3dgs_has_it():
    cameras = [wall_camera("a", -0.3), wall_camera("b", 0.3), wall_camera("c", 0.0)]
    assert cameras_extent(cameras) == pytest.approx(1.1 * 0.3)
    for unit, factor in (("distance", 1.0), ("cameras", 1.1 * 0.3)):
        rates = step.learning_rates(LearningRates(means_unit=unit), cameras)
        ours = loop.rates_of(Params(lr={"means_unit": unit}).lr, cameras)
        for each in (rates, ours):
            assert (each.means, each.means_last) == pytest.approx((1.6e-4 * factor, 1.6e-6 * factor))
            assert replace(each, means=Rates.means, means_last=Rates.means_last) == Rates()


def test_what_the_paper_does_not_do_can_be_left_out(monkeypatch):
    monkeypatch.setattr(image_detail, "choose_sh_degree", lambda *_: (0, 1.0))
    scene = type("Scene", (), {"points": None, "cameras": {}, "train": ()})
    degree = lambda few_views: limit_sh_degree(fit.Params(few_views=few_views), scene).sh.degree
    assert [degree(each) for each in ("as_many", "fewer_harmonics", "surfaces")] == [3, 0, 0]
    speck = np.zeros((100, 200), bool)
    speck[50, 50] = True
    assert not clean_mask(masks.Params(), speck).any() and clean_mask(masks.Params(tidy=False), speck).sum() == 1
