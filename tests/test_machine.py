"""Check of the machine's CUDA requirements: before any work, each missing one is reported in one line with a remedy.

The check imports no heavy modules such as torch.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from scenes.processes import fake_nvidia_smi

from lab.gpu import ready
from reffusion.io import machine
from reffusion.io.machine import Machine, find_missing
from runner import worker

ROOT = Path(__file__).resolve().parent.parent
GOOD = Machine("NVIDIA GeForce RTX 4090", 25.3, 580, "13.0", gsplat=True, extension=True, nvcc="13.0")
POOR = {
    "torch without CUDA": ({"torch_cuda": ""}, r"torch is built without CUDA: `make gpu`"),
    "old driver": (
        {"driver": 570},
        r"the NVIDIA driver is 570, and torch's CUDA 13.0 needs 580 or later: update .*, or `make gpu cuda=12`$",
    ),
    "old driver for 12": ({"driver": 470, "torch_cuda": "12.4"}, r"is 470, and torch's CUDA 12.4 needs 525"),
    "no gsplat": ({"gsplat": False, "extension": False}, r"gsplat is not installed: `make gpu`"),
    "no compiler": ({"extension": False, "nvcc": None}, r"no nvcc to build it: install CUDA toolkit 13 .*`make gpu`"),
    "another compiler": (
        {"extension": False, "nvcc": "12.8"},
        r"nvcc 12.8 cannot build it for torch's CUDA 13.0: .* `make gpu cuda=12`",
    ),
    "little memory": (
        {"gigabytes": 12.9},
        r'distill.memory_gb is 16, and .*4090 has 13 GB: set="distill.memory_gb=10"',
    ),
}


@pytest.mark.parametrize("name", list(POOR))
def test_each_missing_requirement_is_one_line_with_a_remedy(name):
    changes, pattern = POOR[name]
    (line,) = find_missing(replace(GOOD, **changes), 16.0, memory_param="distill.memory_gb")
    assert "\n" not in line
    assert re.search(pattern, line), line


def test_a_complete_machine_has_no_warning():
    assert find_missing(GOOD, 16.0) == []
    assert find_missing(replace(GOOD, extension=False, nvcc="13.0")) == [], "it is built when it is first needed"
    assert find_missing(replace(GOOD, extension=False, nvcc="")) == [], "nvcc does not say its version"
    assert find_missing(replace(GOOD, gsplat=False, extension=False), splats=False) == [], (
        "the prior alone draws nothing"
    )
    assert find_missing(replace(GOOD, driver=570, torch_cuda="12.8")) == []
    assert find_missing(Machine(gsplat=True, extension=True)) == [], "what cannot be told is not held against it"
    assert find_missing(replace(GOOD, gigabytes=8.0), 0.0) == [], "0: no limit"


@pytest.mark.parametrize(
    ("text", "driver"),
    [
        ("NVRM version: NVIDIA UNIX x86_64 Kernel Module  535.183.01  Sun May 12 19:39:15 UTC 2024\n", 535),
        ("NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  580.65.06  Release Build  (dvs)\n", 580),
        ("something else\n", None),
    ],
)
def test_the_driver_is_read_from_its_file(tmp_path, text, driver):
    (tmp_path / "version").write_text(text)
    assert machine._driver(tmp_path / "version") == driver
    assert machine._driver(tmp_path / "absent") is None


@pytest.mark.parametrize(
    ("line", "built"),
    [
        ("cuda: Optional[str] = None", ""),
        ("cuda: Optional[str] = '13.0'", "13.0"),
        ("cuda = '12.4'", "12.4"),
        ("rocm: Optional[str] = '6.0'", None),
    ],
)
def test_torch_is_asked_without_importing_it(tmp_path, monkeypatch, line, built):
    (tmp_path / "version.py").write_text(f"__version__ = '2.13.0'\ndebug = False\n{line}\ngit_version = 'a'\n")
    monkeypatch.setattr(machine, "_package", lambda name: tmp_path)
    assert machine._torch_cuda() == built


def test_a_stage_reports_missing_requirements_first(tmp_path, monkeypatch):
    """The plan's question to a stage lists what this simulated machine lacks: it has an old driver and a small GPU."""
    monkeypatch.setattr(os, "environ", fake_nvidia_smi(tmp_path, "NVIDIA GeForce GTX 1080, 8192, 470.256.02"))
    monkeypatch.chdir(ROOT)
    machine.detect.cache_clear()
    question = lambda **params: {"stage": "distill", "params": params, "takes": TAKES, "brings": []}
    began = time.perf_counter()
    problems = worker._describe(question(device="cuda", memory_gb=16))["lacks"]
    assert time.perf_counter() - began < 1
    assert any("distill.memory_gb is 16, and NVIDIA GeForce GTX 1080 has 9 GB" in line for line in problems)
    assert any("built without CUDA" in line or "needs 5" in line for line in problems)
    assert "lacks" not in worker._describe(question(device="cpu"))
    machine.detect.cache_clear()


TAKES = ["poses", "fit", "masks", "reference", "initialize", "personalize", "lift"]


def test_the_check_imports_nothing_heavy():
    code = "import sys; from reffusion.io import machine; machine.detect(); print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True).stdout == "False\n"


def test_make_gpu_ends_with_one_line_where_there_is_no_card(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["ready", "--before"])
    monkeypatch.setattr(ready, "detect", lambda: Machine(torch_cuda="13.0", nvcc="13.0"))
    assert ready.main() == 2
    assert capsys.readouterr().err.count("\n") == 1
    monkeypatch.setattr(ready, "detect", lambda: replace(GOOD, gsplat=False, extension=False))
    assert ready.main() == 0, "gsplat is installed next"


def test_compilers_fit_into_memory():
    assert [ready.compiler_jobs(16, gb) for gb in (0.5, 3.2, 64)] == [1, 3, 8] and ready.compiler_jobs(2, 64) == 2
