"""The forecast of GPU costs counts operations; the time grows with the work and falls with a faster GPU."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
import torch
from scenes.capture import write_four_photos
from scenes.processes import fake_nvidia_smi

from benchmarks.gpu import counts
from reffusion.cost import estimate
from reffusion.cost.counts import COUNTS
from reffusion.params import distill, fit, personalize, reference
from runner import Refused
from runner.gpu_costs import cost_table
from runner.plan import plan
from runner.plan_table import plan_table
from runner.resolve import Request, resolve
from runner.text import format_seconds

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent
HALF = {"device": "cuda", "dtype": "float16"}
WORK = {
    "fit": (estimate.fit, fit.Params(device="cuda"), ["iterations"]),
    "reference": (estimate.reference, reference.Params(**HALF), ["candidates", "sampler.steps"]),
    "personalize": (estimate.personalize, personalize.Params(memory_gb=20, **HALF), ["steps", "optimizer.batch"]),
    "distill": (estimate.distill, distill.Params(memory_gb=16, **HALF), ["iterations", "sds.patches"]),
}


@pytest.mark.parametrize("stage", list(WORK))
def test_more_work_takes_longer_and_a_faster_card_less(stage):
    function, params, more = WORK[stage]
    work, gigabytes = function(params)
    seconds = {name: work.seconds(gpu) for name, gpu in estimate.GPUS.items()}
    assert seconds["rtx-3090"] > seconds["rtx-4090"] > seconds["h100"] > 0 and seconds["a100"] > seconds["h100"]
    assert 0 < gigabytes < 20
    for name in more:
        value = params
        for part in name.split("."):
            value = getattr(value, part)
        longer, _ = function(params.changed({name: 2 * value}))
        assert longer.seconds(estimate.GPUS["a100"]) > work.seconds(estimate.GPUS["a100"]), name


def test_each_term_of_distillation_costs():
    gpu, params = estimate.GPUS["rtx-4090"], WORK["distill"][1]
    whole = estimate.distill(params)[0].seconds(gpu)
    without = lambda name: estimate.distill(params.changed({f"{name}.weight": 0}))[0].seconds(gpu)
    assert all(without(name) < whole for name in ("sds", "depth", "adversarial"))
    narrow = [estimate.distill(params.changed({"adversarial.width": w}))[0].seconds(gpu) for w in (64, 256, 512)]
    assert narrow == sorted(narrow) and narrow[1] == pytest.approx(whole)


def test_another_prior_was_not_counted():
    assert estimate.distill(distill.Params(prior="priors/tiny", **HALF)) is None
    assert estimate.format_estimate("a100", "cpu", estimate.fit(fit.Params())) is None


@pytest.mark.skipif(os.environ.get("REFFUSION_SLOW") != "1", reason="slow: a minute")
def test_the_table_is_what_is_counted_today():
    """Checks the parts that are this project's code. `python -m benchmarks.gpu.counts` writes the table again."""
    found = {"critic 256": counts.count_critic_step(256), "loss, a million pixels": counts.count_pixel_loss()}
    found["Adam, a million Gaussians"] = counts.count_adam()
    for name, each in found.items():
        assert each["tflop"] == pytest.approx(COUNTS[name]["tflop"], rel=0.02), name
        assert each["gb"] == pytest.approx(COUNTS[name]["gb"], rel=0.05), name


def test_large_attention_matrices_do_not_count_and_large_feature_maps_do():
    """No GPU kernel writes attention matrices to memory, but large feature maps are written, as SDXL's at 1024 px."""
    queries, features = torch.zeros(1, 2, 1024, 8, device="meta"), torch.zeros(1, 4, 1024, 1024, device="meta")
    attend = torch.nn.functional.scaled_dot_product_attention
    assert counts.count_work(lambda: attend(queries, queries, queries))["gb"] < 1024**2 * 4 / 1e9
    activated = counts.count_work(lambda: torch.nn.functional.silu(features))["gb"]
    assert activated == pytest.approx(2 * 4 * features.numel() / 1e9, abs=1e-5)
    assert COUNTS["SDXL encode"]["gb"] == pytest.approx(4 * COUNTS["SD2 encode"]["gb"], rel=0.05)


def test_cards_by_any_name():
    assert estimate.find_gpu("NVIDIA GeForce RTX 4090") == "rtx-4090" and estimate.find_gpu("A100") == "a100"
    with pytest.raises(ValueError, match=r"GPU 'voodoo' is none of rtx-3090, .*h100"):
        estimate.find_gpu("voodoo")


def test_what_a_plan_prints(tmp_path, monkeypatch):
    """The machine has a small GPU and an old driver; gsplat and CUDA in torch may be missing."""
    write_four_photos(tmp_path / "row")
    monkeypatch.setattr(os, "environ", fake_nvidia_smi(tmp_path, "NVIDIA GeForce GTX 1080, 8192, 440.10"))
    monkeypatch.setattr("runner.plan.has_cuda", lambda: True)
    job = resolve(Request(ROOT, tmp_path / "runs", str(tmp_path / "row"), profile="paper"))
    decisions = plan(job, job.pipeline.closure("all"))
    printed = plan_table(job, decisions)
    for stage, memory in (("personalize", 20), ("distill", 16)):
        assert decisions[stage].status == "missing"
        assert any(f"{stage}.memory_gb is {memory}, and NVIDIA" in line for line in decisions[stage].lacks), stage
        assert f"{stage}.memory_gb is {memory}, and NVIDIA GeForce GTX 1080 has 9 GB" in printed
    assert "fit.device is cuda, and " in printed and printed.count("\n") < 40
    head, *lines = cost_table(job, decisions, "rtx-4090").splitlines()
    assert "on rtx-4090: counted operations" in head and "as timed on an H200" in head
    shape = r"    (fit|reference|personalize|distill) +[\d.]+ (s|min|h) +\d+\.\d GB"
    assert len(lines) == 5 and all(re.fullmatch(shape, line) for line in lines[:-1]), lines
    assert re.fullmatch(r"    together +[\d.]+ (s|min|h)", lines[-1])
    with pytest.raises(Refused, match="GPU 'voodoo' is none of"):
        cost_table(job, decisions, "voodoo")
    monkeypatch.setattr("runner.gpu_costs.has_cuda", lambda: False)
    assert cost_table(job, decisions, None) == "", "nothing is asked where there is no GPU"
    assert [format_seconds(s) for s in (12.3, 600, 7200)] == ["12 s", "10 min", "2.0 h"]
