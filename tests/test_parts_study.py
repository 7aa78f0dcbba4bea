"""The study of parts: every switch finds what it replaces, leaves a part out, and is judged against the whole job."""

from __future__ import annotations

from pathlib import Path

import pytest
from scenes.capture import make_truth, write_capture
from scenes.stage_runs import run_through_initialize

from lab.studies import parts, switches
from reffusion.inpaint import exemplar
from reffusion.io.arrays import save_json
from reffusion.params.initialize import Params
from runner.resolve import Request, resolve

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def laptop_params(tmp_path_factory):
    """The parameters of all stages in the profile `laptop`."""
    folder = tmp_path_factory.mktemp("scene")
    return resolve(
        Request(ROOT, folder / "runs", str(write_capture(folder / "scene", "llff", make_truth())), profile="laptop")
    ).params


@pytest.mark.parametrize("switch", parts.PARTS.values(), ids=parts.PARTS)
def test_what_a_switch_changes_exists(switch, laptop_params):
    with switch.applied():  # a missing function or constant raises
        pass
    assert all((ROOT / "reffusion" / file).exists() for file in switch.files)
    for path, value in switch.settings.items():
        stage, *keys = path.split(".")
        current = laptop_params[stage]
        for key in keys:
            current = current[key]
        assert current != value


def test_functions_are_restored():
    before = exemplar.render_mirrors
    with switches.TEXTURE["mirror images in pictures"].applied():
        assert exemplar.render_mirrors is not before
    assert exemplar.render_mirrors is before


def test_a_part_acts_if_its_stage_writes_other_bytes(tmp_path):
    job = tmp_path / "job"
    run_through_initialize(job, 1.0)
    save_json(job / "initialize/receipt.json", {"params": Params().model_dump()})
    leave_out = lambda switch, name: parts.leave_out(switch, job, tmp_path, tmp_path / name, "initialize")[0]
    assert not leave_out(switches.Switch("initialize"), "whole")
    assert leave_out(switches.Switch("initialize", {"initialize.overlap": 0.1}), "overlap") == {
        "initialize": tmp_path / "overlap/initialize"
    }


@pytest.mark.parametrize(
    ("losses", "verdict"), [(0.01, "stays"), (0.0005, "goes"), (-0.01, "goes"), (None, "undecided")]
)
def test_a_part_is_judged_by_what_leaving_it_out_costs(tmp_path, losses, verdict):
    for index in range(8):
        folder = tmp_path / f"place-{index}"
        loss = (-1) ** index * 0.02 if losses is None else losses + 0.0001 * index
        whole = {"acts": True, "lpips_vgg": 0.3, "psnr": 20.0, "core_seconds": {"initialize": 60.0}}
        save_json(folder / f"{parts.WHOLE}.json", whole)
        save_json(folder / "refit.json", whole | {"lpips_vgg": 0.3 + loss, "core_seconds": {"initialize": 20.0}})
        save_json(folder / "overlap.json", {"acts": False, "core_seconds": {"initialize": 60.0}})
    table = parts.tabulate(tmp_path).splitlines()
    refit = next(line for line in table if line.startswith("| refit"))
    assert "8 of 8" in refit and "| -40 ± 0 |" in refit and f"| {verdict} |" in refit
    assert any(line.startswith("| overlap | 0 of 8 |") for line in table)


def test_lines_of_code_are_counted_without_comments_and_docstrings(tmp_path, monkeypatch):
    (tmp_path / "reffusion").mkdir()
    (tmp_path / "reffusion/one.py").write_text('"""Doc.\n\nMore."""\n\n# comment\na = 1\nb = (\n    2,\n)\n')
    monkeypatch.setattr(parts, "ROOT", tmp_path)
    assert parts.count_code_lines(["one.py"]) == 4
