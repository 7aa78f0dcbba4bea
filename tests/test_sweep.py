"""gc: what no plan uses is listed, and removed where asked for; nothing that no receipt vouches for."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from test_compare import request as asked_for
from test_compare import written

from runner import Refused
from runner.compare import compare
from runner.execute import run_scene
from runner.sweep import sweep


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> Path:
    root = written(tmp_path_factory.mktemp("swept"))
    compare(asked_for(root), "better,none")
    return root


@pytest.fixture
def root(done, tmp_path) -> Path:
    shutil.copytree(done, tmp_path / "project")
    for source in (tmp_path / "project/runs").glob("*/source"):
        source.write_text("data/toy\n")
    return tmp_path / "project"


def artifacts(root: Path) -> set[str]:
    return {str(path.parent.relative_to(root / "runs")) for path in (root / "runs").glob("*/*/receipt.json")}


def test_nothing_where_all_is_used(root, capsys):
    before = artifacts(root)
    sweep(asked_for(root, ""), yes=True)
    assert capsys.readouterr().out == "nothing that no plan uses\n" and artifacts(root) == before


def test_what_is_unused_is_told_first_and_removed_when_asked_for(root, capsys):
    before = artifacts(root)
    text = (root / "pipeline.yaml").read_text()
    (root / "pipeline.yaml").write_text(text.replace("  better: {distill: {gain: 3}}\n", ""))
    (root / "data/toy/scene.yaml").write_text("stages: {distill: {gain: 0}}")  # left out now, in every variant
    (root / "runs/toy/distill/notes.txt").write_text("mine")
    (root / "runs/toy/distill/gain.txt").write_text("changed by hand")
    (root / "runs/toy/mine").mkdir()
    (root / "runs/toy/mine/big.txt").write_text("no receipt")
    sweep(asked_for(root, ""), yes=False)
    said = capsys.readouterr().out
    assert (
        "runs/toy/distill: left out: no gain" in said and "runs/toy@better/evaluate: there is no variant better" in said
    )
    assert "nothing was removed; yes=1 removes them" in said and artifacts(root) == before
    sweep(asked_for(root, ""), yes=True)
    assert artifacts(root) == {"toy/poses", "toy@none/evaluate"}
    left = {path.name for path in (root / "runs/toy/distill").iterdir()}
    assert left == {"notes.txt", "gain.txt"} and (root / "runs/toy/mine/big.txt").exists()
    run_scene(asked_for(root), "all")
    assert "toy/evaluate" in artifacts(root)


def test_older_code_counts_as_used_and_a_scene_that_is_gone_is_kept(root, capsys):
    stage = root / "stages/distill.py"
    stage.write_text(stage.read_text() + "\nMORE = 1\n")
    before = artifacts(root)
    sweep(asked_for(root, ""), yes=True)
    assert artifacts(root) == before
    (root / "data/toy").rename(root / "data/elsewhere")
    sweep(asked_for(root, ""), yes=True)
    assert "toy: kept, as it cannot be planned: its scene is not there" in capsys.readouterr().out
    assert artifacts(root) == before
    with pytest.raises(Refused, match="nothing was computed for nobody"):
        sweep(asked_for(root, "nobody"), yes=True)


def test_other_parameters_are_those_of_the_command(root, capsys):
    sweep(asked_for(root, "toy", set="distill.gain=7"), yes=False)
    said = capsys.readouterr().out
    assert "runs/toy/distill: to be made again: param gain 1 -> 7" in said and "runs/toy/poses" not in said
