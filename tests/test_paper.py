"""The table of parameters in docs/paper.md agrees with the profiles in `pipeline.yaml` and with the paper."""

import re
from fractions import Fraction
from pathlib import Path

import pytest

from runner.keys import HASHES, Hashes
from runner.pipeline import read_yaml
from runner.resolve import Request, resolve_all

ROOT = Path(__file__).resolve().parent.parent
DOC = ROOT / "docs" / "paper.md"
PROFILES = ("paper", "best", "laptop")
SD2, SDXL = "sd2-community/stable-diffusion-2-inpainting", "diffusers/stable-diffusion-xl-1.0-inpainting-0.1"
NETWORK = "depth-anything/Depth-Anything-V2-Small-hf"
SHORT = {"SD2": SD2, "SDXL": SDXL, "Depth Anything": NETWORK, "embedded": "priors/tiny", "none": None}
SHORT |= {"on": True, "off": False}
MACHINE = ("device", "dtype", "memory_gb")  # parameters that depend on the machine: docs/gpu.md
# Parameters of baselines, which are no part of the method.
BASELINES = ("lift.prior", "lift.steps", "lift.inpainter.kind", "evaluate.inpainter.kind")

# Values that the paper fixes, and the defaults of 3DGS where the paper uses them.
FIXED = {
    "poses.longest": 1600,
    "fit.iterations": 30_000,
    "fit.sh.degree": 3,
    "fit.sh.every": 1000 / 30_000,
    "fit.init.opacity": 0.1,
    "fit.init.scale": 1,
    "fit.densify.start": 500 / 30_000,
    "fit.densify.stop": 15_000 / 30_000,
    "fit.densify.every": 100,
    "fit.densify.grow_grad2d": 2e-4,
    "fit.densify.cap_growth": "immediate",
    "fit.densify.size_unit": "cameras",
    "fit.densify.prune_scale3d": 0.1,
    "fit.densify.reset_every": 3000 / 30_000,
    "fit.lr.means": 1.6e-4,
    "fit.lr.means_unit": "cameras",
    "fit.lr.scales": 5e-3,
    "fit.lr.quats": 1e-3,
    "fit.lr.sh0": 2.5e-3,
    "fit.lr.shN": 1.25e-4,
    "fit.lr.betas": (0.9, 0.999),
    "fit.random_background": False,
    "masks.vote": "count",
    "masks.tau": 1,
    "masks.tau_rendered": 0.3,
    "masks.invent": "consistent",
    "reference.inpainter.kind": "diffusion",
    "reference.prior": SDXL,
    "personalize.prior": SD2,
    "personalize.steps": 2000,
    "personalize.lora.rank": 8,
    "personalize.lora.alpha": 16,
    "personalize.lora.dropout": 0.1,
    "personalize.lora.layers": "attention",
    "personalize.optimizer.lr_unet": 2e-4,
    "personalize.optimizer.lr_text": 4e-5,
    "personalize.samples.size": 0,
    "initialize.start": "reference",
    "distill.prior": SD2,
    "distill.sds.weight": 1e-3,
    "distill.sds.patches": 2,
    "distill.sds.reaches": "masked",
    "distill.depth.weight": 0.0625,
    "distill.depth.every": 8,
    "distill.adversarial.weight": 0.03,
    "distill.adversarial.patches": 64,
    "distill.adversarial.size": 64,
    "distill.reconstruction.reaches": "unmasked",
    "distill.repaint": "consistent",
    "distill.confined": True,
}
# Features that the paper does not have, each with the value that turns the feature off.
ABSENT = {
    "poses.min_detail": 0,
    "poses.refine": False,
    "fit.exposure": "never",
    "fit.few_views": "as_many",
    "fit.init.flow_cell": 0,
    "fit.densify.per_pixel": 0,
    "masks.tidy": False,
    "masks.inside_share": 1,
    "masks.debris": False,
    "masks.remnants": False,
    "masks.shadows": False,
    "masks.negligible": 0,
    "personalize.samples.hole_share": 0,
    "personalize.samples.outside_weight": 1,
    "initialize.depth.sweep": False,
    "initialize.depth.hints": False,
    "initialize.overlap": 0,
    "initialize.tidy": False,
    "initialize.view_dependent_color": False,
    "initialize.extra_views": 0,
    "initialize.refit_steps": 0,
    "distill.sds.run": "always",
    "distill.sds.max_angle": 180,
    "distill.sds.keep_contrast": False,
    "distill.reference.weight": 0,
    "distill.reference.reaches": "masked",
    "finish.backdrop": False,
}
# What the paper says where the profile `paper` does not follow it, or where the paper gives no details.
OTHERWISE = {
    "fit.densify.cap_max": "no limit",
    "distill.densify.grow_grad2d": "changed",
    "distill.adversarial.form": "saturating",
    "distill.adversarial.penalized": "fake",
}


def flatten(params, above=""):
    """Flatten nested parameters to a dict from dotted name to value."""
    found = {}
    for name, value in params.items():
        found |= flatten(value, f"{above}{name}.") if isinstance(value, dict) else {above + name: value}
    return found


def parse_cell(cell, paper=None):
    """Return the value of a table cell. A cell `=` stands for `paper`, the value of the profile `paper`."""
    if cell == "=":
        return paper
    if cell in SHORT:
        return SHORT[cell]
    if ", " in cell:
        return [parse_cell(part) for part in cell.split(", ")]
    return float(Fraction(cell)) if re.fullmatch(r"[-+.\de/]+", cell) else cell


def parse_rows(text):
    """Read the table as a dict from dotted name to (cell of the paper's column, values of the three profiles)."""
    found = {}
    for line in text.splitlines():
        if line.startswith("|`"):
            name, says, paper, best, laptop, _ = line.replace("`", "").split("|")[1:-1]
            assert name not in found, f"{name} twice"
            found[name] = (
                says,
                (parse_cell(paper), parse_cell(best, parse_cell(paper)), parse_cell(laptop, parse_cell(paper))),
            )
    return found


def is_same(a, b):
    if isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(is_same, a, b))
    return a == (pytest.approx(b) if isinstance(b, float) else b)


def row_errors(name, row, profile_values):
    """Return a list of messages that say where a row disagrees with the profiles or with the paper."""
    (says, stated), found = row, [profile_values[profile].get(name) for profile in PROFILES]
    if not all(map(is_same, stated, found)):
        return [f"{name}: {stated}, the profiles have {found}"]
    fixed, absent = (
        name in FIXED and is_same(stated[0], FIXED[name]),
        name in ABSENT and is_same(stated[0], ABSENT[name]),
    )
    kinds = {"=": fixed, "no": absent, "open": name not in FIXED | ABSENT | OTHERWISE}
    return (
        []
        if kinds.get(says, OTHERWISE.get(name) == says)
        else [f"{name}: '{says}' and {stated[0]} is not what the paper says"]
    )


def missing_rows(table, profile_values):
    """Return the names of parameters without a row that the paper mentions or in which the profiles differ."""
    paper = profile_values["paper"]
    differing = {name for name in paper if any(not is_same(profile_values[p][name], paper[name]) for p in PROFILES)}
    differing = {name for name in differing if not name.endswith(MACHINE) and name not in BASELINES}
    return {*differing, *FIXED, *ABSENT, *OTHERWISE} - table.keys()


@pytest.fixture(scope="module")
def profile_values():
    """Return a dict from profile to (dict from dotted name to value), resolved without a scene."""
    requests = [Request(ROOT, ROOT / "runs", "", profile=name) for name in PROFILES]
    jobs = resolve_all(requests, Hashes(ROOT / "runs" / HASHES), scene=False)
    return {job.profile: flatten(job.params) for job in jobs}


def test_table_profiles_and_paper_agree(profile_values):
    table = parse_rows(DOC.read_text())
    assert [line for name, row in table.items() for line in row_errors(name, row, profile_values)] == []
    assert missing_rows(table, profile_values) == set()


def another_value(value):
    """Return a different value of the same kind."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return 2 * value + 1
    return [*value, 1] if isinstance(value, list | tuple) else f"not {value}"


def test_a_changed_value_is_found_wherever_it_stands(profile_values):
    table = parse_rows(DOC.read_text())
    for name, (says, stated) in table.items():
        with_other = lambda profile, name=name: (
            profile_values | {profile: {name: another_value(profile_values[profile][name])}}
        )
        for k, profile in enumerate(PROFILES):
            changed = (*stated[:k], another_value(stated[k]), *stated[k + 1 :])
            assert row_errors(name, (says, changed), profile_values), f"{name} of {profile} in the table"
            assert row_errors(name, (says, stated), with_other(profile)), f"{name} of {profile} in pipeline.yaml"
        if name in OTHERWISE:
            assert row_errors(name, ("open", stated), profile_values), name
        if says in ("=", "no"):  # if table and profile change alike, FIXED and ABSENT above find it
            assert row_errors(name, (says, (another_value(stated[0]), *stated[1:])), with_other("paper")), name
    left_out = [name for name, (says, _) in table.items() if says != "open"]
    assert missing_rows({}, profile_values) >= {*left_out}


def test_best_is_paper_with_other_values_of_the_same_keys(profile_values):
    profiles = read_yaml(ROOT / "pipeline.yaml")["profiles"]
    assert flatten(profiles["paper"]).keys() == flatten(profiles["best"]).keys()
    for name in profile_values["paper"]:
        if name.endswith((*MACHINE, "prior", "model")):
            assert profile_values["best"][name] == profile_values["paper"][name], name


def test_work_is_on_the_gpu_within_24_gb_in_half_precision(profile_values):
    paper = profile_values["paper"]
    for stage in ("reference", "personalize", "distill"):
        assert paper[f"{stage}.device"] == "cuda" and paper[f"{stage}.dtype"] in ("float16", "bfloat16")
        assert 0 < paper[f"{stage}.memory_gb"] <= 22
    assert paper["personalize.dtype"] == "bfloat16"  # gradients of a mean over a batch underflow in float16


def test_constants_of_the_library():

    import torch

    from lab.gpu import random_priors
    from reffusion.gaussians.optimize import reconstruction_loss
    from reffusion.metrics import image_metrics
    from reffusion.params.base import REFINED_FROM, Prompts
    from reffusion.prior import crops, lora

    assert Prompts().texts == ["A photo of sks", "A photo of sks, cropped", ""]
    assert image_metrics.BOX_DILATION == 0.1
    assert 8 * random_priors.SD2.unet["sample_size"] == 512
    assert crops.MAX_BORDER == 0.1 and REFINED_FROM == 0.6
    assert set(lora.TEXT_ATTENTION) == {"q_proj", "k_proj", "v_proj", "out_proj"}
    assert set(lora.ATTENTION) == {"to_q", "to_k", "to_v", "to_out.0"}
    # The loss is 0.8 L1 + 0.2 (1 - SSIM). A black and a white picture have an L1 of 1 and an SSIM of almost 0.
    black, white = torch.zeros(32, 32, 3), torch.ones(32, 32, 3)
    assert float(reconstruction_loss(white, black)) == pytest.approx(0.8 + 0.2, abs=1e-3)
