"""What `plan` says of a profile for GPUs on a machine without a fitting one, and of the time on a named GPU."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import pytest
from scenes.capture import write_four_photos
from scenes.processes import fake_nvidia_smi

from runner import Refused
from runner.durations import typical_seconds
from runner.plan import plan
from runner.plan_table import plan_table
from runner.resolve import Request, resolve

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent


def resolve_photos(tmp_path: Path, profile: str = "paper", **options):
    """Resolve a job of four photographs."""
    if not (tmp_path / "row").exists():
        write_four_photos(tmp_path / "row")
    return resolve(Request(ROOT, tmp_path / "runs", str(tmp_path / "row"), profile=profile, **options))


def test_what_a_machine_with_a_small_gpu_and_an_old_driver_lacks(tmp_path, monkeypatch):
    """gsplat and CUDA in torch may be missing, too."""
    monkeypatch.setattr(os, "environ", fake_nvidia_smi(tmp_path, "NVIDIA GeForce GTX 1080, 8192, 440.10"))
    monkeypatch.setattr("runner.plan.has_cuda", lambda: True)
    job = resolve_photos(tmp_path)
    decisions = plan(job, job.pipeline.closure("all"))
    printed = plan_table(job, decisions)
    for stage, memory in (("personalize", 20), ("distill", 16)):
        assert decisions[stage].status == "missing"
        assert any(f"{stage}.memory_gb is {memory}, and NVIDIA" in line for line in decisions[stage].lacks), stage
        assert f"{stage}.memory_gb is {memory}, and NVIDIA GeForce GTX 1080 has 9 GB" in printed
    assert "fit.device is cuda, and " in printed and printed.count("\n") < 40
    assert "together" not in printed, "nothing can run"


def test_time_on_a_named_gpu(tmp_path):
    """Twice the steps take nearly twice the time, a slower GPU longer; a CPU stage of another profile is not timed."""
    job = resolve_photos(tmp_path, gpu="rtx-4090")
    printed = plan_table(job, plan(job, job.pipeline.closure("all")))
    for stage in ("fit", "reference", "personalize", "distill"):
        assert re.search(rf"missing +{stage} +~[\d.]+ (s|min|h) ", printed), printed
    total = re.search(r"together about ([\d.]+) h and the time of poses, .*; GPU: rtx-4090", printed)
    assert total and 2 < float(total[1]) < 6
    fast, slow = (typical_seconds(replace(job, gpu=gpu), "fit") for gpu in ("h100", "rtx-3090"))
    assert fast < typical_seconds(job, "fit") < slow
    longer = typical_seconds(resolve_photos(tmp_path, gpu="h100", set="fit.iterations=60000"), "fit")
    assert 1.8 < longer / fast < 2
    with pytest.raises(Refused, match=r"unknown GPU 'voodoo'; known: rtx-3090, .*h200"):
        resolve_photos(tmp_path, gpu="voodoo")


def test_views_of_half_the_side_take_a_quarter_of_the_time_of_steps(tmp_path):
    """The photographs are 32 px wide, which `poses.longest` reduces."""

    def step_seconds(settings: str) -> float:
        jobs = (
            resolve_photos(tmp_path, "laptop", set=f"{settings} fit.iterations={n}") for n in (1_000_000, 2_000_000)
        )
        once, twice = (typical_seconds(job, "fit") for job in jobs)
        return twice - once

    assert step_seconds("poses.longest=32") == pytest.approx(4 * step_seconds("poses.longest=16"), rel=0.01)
