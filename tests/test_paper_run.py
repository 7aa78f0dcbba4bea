"""The profile `paper` from the stage `masks` to the scores, with all loss terms.

The networks are small and have random weights; their architectures are the real ones.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import wall_scene
from scenes.networks import small_depth_model
from scenes.simulated_gpu import has_gpu
from test_paper import DOC, parse_rows

from lab.gpu import random_priors
from reffusion.depth import monocular
from reffusion.io.arrays import load_json
from reffusion.io.images import load_image
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_mask_sets, load_references, load_scene
from reffusion.io.traces import read_trace
from reffusion.params.base import Settings
from reffusion.prior.model import pipeline
from reffusion.weights import published
from runner.resolve import Request, resolve

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent
STAGES = {
    "masks": ("poses", "raw_masks", "fit"),
    "reference": ("scene", "poses", "fit", "masks"),
    "personalize": ("poses", "raw_masks", "reference"),
    "initialize": ("poses", "fit", "masks", "reference"),
    "distill": ("poses", "fit", "masks", "reference", "personalize", "initialize"),
    "finish": ("poses", "fit", "reference", "initialize", "distill"),
    "evaluate": ("poses", "raw_masks", "fit", "finish", "masks", "initialize", "distill"),
}
# The test changes only these parameters of the profile: sizes and numbers of steps (SIZES), the folders of the weights
# (WEIGHTS) and the device (HERE).
SIZES = {
    "reference": {"candidates": 2, "sampler.steps": 2},
    "personalize": {"steps": 2, "optimizer.batch": 2},
    "distill": {
        "iterations": 9,
        "densify.every": 4,
        "depth.steps": 2,
        "adversarial.patches": 4,
        "adversarial.size": 16,
        "adversarial.width": 4,
    },
}
WEIGHTS = {
    "reference": {"prior": "sdxl"},
    "personalize": {"prior": "sd2"},
    "initialize": {"depth.model": "depth"},
    "distill": {"prior": "sd2", "depth.model": "depth"},
}
# Row of the table in docs/paper.md -> the modules of reffusion/ that do its work in `paper`, of the packages that hold
# the method. Another module that runs there is a step that the paper does not have, or lacks a row.
ACTIVE = {
    "masks.vote": "masks/classification masks/voting masks/consolidation masks/regions",
    "masks.invent": "background/model background/visibility",
    "reference.prior": "prior/inpaint prior/harmonic_fill prior/model prior/diffusion prior/memory prior/windows",
    "reference.candidates": "references/completion references/files references/view_ranking depth/inpaint_depth "
    "clicks/sam_onnx",
    "personalize.steps": "prior/personalize prior/crops prior/denoising prior/validation",
    "personalize.lora.rank": "prior/lora",
    "initialize.start": "initialize/filling initialize/draft initialize/draft_operations initialize/fill "
    "initialize/unprojection initialize/origins initialize/summary",
    "initialize.depth.model": "depth/monocular depth/estimates depth/alignment depth/background_depth depth/bilateral "
    "depth/completion depth/solverlog",
    "distill.iterations": "distill/inputs distill/loop distill/train_view distill/terms/term",
    "distill.confined": "distill/regions",
    "distill.densify.every": "distill/densification",
    "distill.sds.weight": "distill/sds distill/terms/sds distill/display_range prior/levels",
    "distill.depth.weight": "distill/terms/depth distill/depth_estimator",
    "distill.adversarial.weight": "distill/terms/adversarial distill/adversary distill/discriminator",
    "distill.reconstruction.reaches": "distill/terms/reconstruction fit/exposure",
}
STANDS_FOR = {"sd2": published.SD2, "sdxl": published.SDXL, "depth": "depth-anything/Depth-Anything-V2-Small-hf"}
# On a GPU the profile's device and dtypes stay: bfloat16 for training, float16 for inpainting and distillation.
HERE = {} if has_gpu() else {"device": "cpu", "dtype": "float32"}


def photo_tensor(view) -> torch.Tensor:
    return torch.from_numpy(wall_scene.photo(view)).permute(2, 0, 1) / 255


def network_that_sees_the_tilt() -> torch.nn.Module:
    """Return a random Depth Anything whose output correlates with the tilt of the wall.

    The stages refuse a depth map that does not fit the visible depth, so the first random seed that fits is used.
    """
    tilt = -np.mgrid[: wall_scene.HEIGHT, : wall_scene.WIDTH][0].ravel()
    for seed in (28, *range(200)):
        model = small_depth_model(seed=seed)
        network = monocular.make_network(model)
        predictions = [
            monocular.predict_disparity(network, photo_tensor(wall_scene.CAMERAS[n])).numpy().ravel()
            for n in ("a0", "a2", "a4")
        ]
        if min(np.corrcoef(answer, tilt)[0, 1] for answer in predictions) > 0.5:
            return model
    raise AssertionError("no such network among 200")


def tilt_wall(fit: Path) -> None:
    """Tilt the wall in `fit`, because a wall parallel to the images would leave the scale of its depth undetermined."""
    gaussians = load_ply(fit / "gaussians.ply")
    means = gaussians.means / (1 - 0.2 * gaussians.means[:, 1:2] / wall_scene.WALL)
    save_ply(fit / "gaussians.ply", replace(gaussians, means=means))


def small_paper_params(weights: Path) -> dict[str, Settings]:
    """Return a dict from stage to the profile's parameters, changed by `SIZES`, `WEIGHTS` and `HERE`."""
    params = resolve(Request(ROOT, ROOT / "runs", "", profile="paper"), scene=False).params
    found = {}
    for stage in STAGES:
        profile = importlib.import_module(f"reffusion.params.{stage}").Params(**params[stage])
        places = {name: str(weights / folder) for name, folder in WEIGHTS.get(stage, {}).items()}
        assert profile == profile.changed({n: STANDS_FOR[folder] for n, folder in WEIGHTS.get(stage, {}).items()})
        here = {name: value for name, value in HERE.items() if name in params[stage]}
        found[stage] = profile.changed(SIZES.get(stage, {}) | places | here)
    return found


@pytest.fixture(scope="module")
def run_of_paper(tmp_path_factory):
    """Run all stages; return a dict from stage to its output folder, and the modules of reffusion/ that did work."""
    home, ran = tmp_path_factory.mktemp("paper"), set()
    paths = {name: home / name for name in ("scene", "poses", "raw_masks", "fit", *STAGES)}
    for name, shape in (("sd2", random_priors.SD2), ("sdxl", random_priors.SDXL)):
        prior = random_priors.build_prior(random_priors.shrink(shape), torch.float32)
        pipeline(replace(prior, zero_empty=True)).save_pretrained(home / name)
    network_that_sees_the_tilt().save_pretrained(home / "depth")
    wall_scene.write_poses_and_fit(home, 1.5)
    wall_scene.write_capture_photos(paths["scene"], paths["poses"], wall_scene.CAMERAS)
    tilt_wall(paths["fit"])
    params = small_paper_params(home)
    for stage, needs in STAGES.items():
        paths[stage].mkdir(exist_ok=True)
        module = importlib.import_module(f"stages.{stage}")
        if stage != "evaluate":  # which only measures
            sys.setprofile(lambda frame, event, _: ran.add(frame.f_code) if event == "call" else None)
        try:
            module.run(params[stage], paths[stage], **{need: paths[need] for need in needs})
        finally:
            sys.setprofile(None)
    package = str(ROOT / "reffusion") + os.sep
    # Imports, terms that are built and found to be off, and what is read are no work.
    files = {code.co_filename for code in ran if code.co_name not in ("<module>", "build", "from_arrays")}
    return paths, {name.removeprefix(package).removesuffix(".py") for name in files if name.startswith(package)}


@pytest.fixture
def stage_outputs(run_of_paper):
    return run_of_paper[0]


def test_nothing_runs_that_the_table_of_the_docs_does_not_list(run_of_paper):
    """The modules that do work from `masks` to `finish` are those of `ACTIVE`, each by a row that the paper has."""
    says = {name: row[0] for name, row in parse_rows(DOC.read_text()).items()}
    assert [row for row in ACTIVE if says.get(row, "no") == "no"] == []
    listed = {module for modules in ACTIVE.values() for module in modules.split()}
    packages = {module.split("/")[0] for module in listed} | {"background", "clicks", "fit", "inpaint", "references"}
    assert {module for module in run_of_paper[1] if module.split("/")[0] in packages} == listed


def test_the_consistent_mask_is_the_mask_of_every_term(stage_outputs):
    sets = load_mask_sets(stage_outputs["masks"], wall_scene.CAMERAS)
    assert all((each.invent == each.consistent).all() and each.invent.any() for each in sets.values())
    scene = load_scene(stage_outputs["poses"])
    (reference,) = load_references(stage_outputs["reference"], scene)
    name = load_json(stage_outputs["masks"] / "facts.json")["best_reference"]
    assert reference.camera.name == name and (reference.mask == sets[name].consistent).all()
    photo = load_image(stage_outputs["poses"] / "images" / f"{name}.png")
    outside = ~reference.mask
    assert (reference.image[outside] == photo[outside]).all() and (reference.image != photo).any()


def test_personalization_leaves_the_papers_lora(stage_outputs):
    header = (stage_outputs["personalize"] / "pytorch_lora_weights.safetensors").read_bytes()
    facts = json.loads(header[8 : 8 + int.from_bytes(header[:8], "little")])
    shapes = {name.rpartition(".lora")[0]: each["shape"] for name, each in facts.items() if "lora_A" in name}
    assert {shape[0] for shape in shapes.values()} == {8} and any("text_encoder" in name for name in shapes)
    lora = json.loads(facts["__metadata__"]["lora_adapter_metadata"])
    assert [lora[f"{part}.{name}"] for part in ("unet", "text_encoder") for name in ("r", "lora_alpha")] == [8, 16] * 2


def test_every_term_works_and_masked_gaussians_multiply(stage_outputs):
    lines = read_trace(stage_outputs["distill"] / "trace.jsonl")
    last, first = lines[-1], lines[0]
    assert last["iteration"] == 9 and last["reason"] == "finished"
    assert last["sds_gradient_max"] > 0 and last["depth"] > 0 and last["reconstruction"] > 0
    # The slope is the R1 penalty of the critic.
    assert last["adversarial"] > 0 and last["critic_slope"] > 0
    assert not [name for name in last if name.startswith("depth_skipped")]
    assert last["masked_gaussians"] > first["masked_gaussians"]
    assert last["gaussians"] - last["masked_gaussians"] == first["gaussians"] - first["masked_gaussians"]
    assert load_json(stage_outputs["initialize"] / "facts.json")["floaters"] == 0
    assert (
        not (stage_outputs["initialize"] / "extra_views").exists()
        and not (stage_outputs["initialize"] / "shadows").exists()
    )


def test_the_scores_are_those_of_a_scene_with_noise_in_its_hole(stage_outputs):
    mean = load_json(stage_outputs["evaluate"] / "metrics.json")["mean"]
    assert mean["psnr_outside"] > 30 > 20 > mean["psnr_box"] > 5
    assert {path.stem for path in (stage_outputs["evaluate"] / "renders").iterdir()} == set(wall_scene.TEST)
