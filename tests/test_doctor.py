"""`reffusion doctor`: each inpainter fills a hole whose content is known, and what is wrong is said in plain words."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from reffusion.inpaint.classical import paste_hole, telea
from reffusion.io.images import load_image
from report import doctor

ROOT = Path(__file__).resolve().parent.parent


def test_faults_are_named_and_a_right_picture_has_none():
    case = doctor.make_case()
    fill = lambda color: paste_hole(case.image, np.full_like(case.image, color), case.hole)
    shifted = paste_hole(case.image, np.roll(case.truth, 190, 0), case.hole)  # the wall's lower end above the planks
    faults = {
        "one color": fill((120, 120, 120)),
        "still there": case.image,
        "a seam": shifted,
        "outside": np.roll(case.truth, 1, 1),
    }
    for words, picture in faults.items():
        assert words in "; ".join(doctor.find_faults(picture, case))
    for picture in (case.truth, telea(case.image, case.hole)):
        assert doctor.find_faults(picture, case) == []


@pytest.mark.integration
@pytest.mark.parametrize("key", ["exemplar", pytest.param("embedded", marks=pytest.mark.slow)])
def test_what_a_fresh_machine_has_is_plausible(key):
    case = doctor.make_case()
    assert doctor.find_problem(key) is None
    assert doctor.find_faults(doctor.run_painter(key, case).picture, case) == []


@pytest.mark.integration
def test_the_command_examines_what_is_here_and_says_what_is_not(tmp_path, monkeypatch):
    for name in ("XDG_CACHE_HOME", "HF_HOME", "TORCH_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "nothing"))
    monkeypatch.delenv("HF_HUB_CACHE", raising=False)
    entry = tmp_path / "nothing/hub/models--andraniksargsyan--migan"
    (entry / "snapshots" / "0123abc").mkdir(parents=True)
    (entry / "snapshots" / "0123abc" / "migan_pipeline_v2.onnx").write_bytes(b"no network")
    command = [sys.executable, "-m", "reffusion.command", "doctor", "--out", str(tmp_path / "sheet.png")]
    done = subprocess.run([*command, "--only", "telea", "migan"], cwd=ROOT, text=True, capture_output=True)
    lines = done.stdout.splitlines()
    assert " plausible: " in lines[0] and " s, " in lines[0] and " GB, " in lines[0], done.stdout + done.stderr
    assert "MI-GAN" in lines[1] and "IMPLAUSIBLE" in lines[1] and "migan_pipeline_v2.onnx" in lines[1]
    assert done.returncode == 1 and "Traceback" not in done.stderr
    height, width = doctor.SIZE
    assert load_image(tmp_path / "sheet.png").shape == (height, 3 * width, 3)


def test_what_is_not_here_is_said_with_what_fetches_it(tmp_path, monkeypatch, capsys):
    for name in ("XDG_CACHE_HOME", "HF_HOME", "TORCH_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "nothing"))
    monkeypatch.delenv("HF_HUB_CACHE", raising=False)
    doctor.examine(["lama", "sdxl"], doctor.make_case(), tmp_path / "sheet.png")
    lama, sdxl = capsys.readouterr().out.splitlines()[:2]
    assert "LaMa" in lama and "not here" in lama and "make weights" in lama
    assert "SDXL" in sdxl and "not here" in sdxl
