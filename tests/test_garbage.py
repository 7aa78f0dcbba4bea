"""The command gc lists artifacts that no plan uses.

On request, it removes these artifacts, except files that no receipt names or that were changed.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from scenes.toy_projects import make_request, write_files, write_project

from runner import Refused
from runner.execute import run_scene
from runner.fleet.compare import compare
from runner.fleet.garbage import collect_garbage
from runner.fleet.maintenance import clean, verify
from runner.keys import HASHES, Hashes

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def finished_comparison(tmp_path_factory) -> Path:
    root = write_project(tmp_path_factory.mktemp("swept"))
    compare(make_request(root), "better,none")
    return root


@pytest.fixture
def comparison_copy(finished_comparison, tmp_path) -> Path:
    shutil.copytree(finished_comparison, tmp_path / "project")
    for source in (tmp_path / "project/runs").glob("*/source"):
        source.write_text("data/toy\n")
    return tmp_path / "project"


def list_artifacts(comparison_copy: Path) -> set[str]:
    return {
        str(path.parent.relative_to(comparison_copy / "runs"))
        for path in (comparison_copy / "runs").glob("*/*/receipt.json")
    }


def test_nothing_is_listed_where_all_is_used(comparison_copy, capsys):
    before = list_artifacts(comparison_copy)
    collect_garbage(make_request(comparison_copy, ""), yes=True)
    assert capsys.readouterr().out == "nothing that no plan uses\n" and list_artifacts(comparison_copy) == before


def test_unused_artifacts_are_listed_first_and_removed_on_request(comparison_copy, capsys):
    before = list_artifacts(comparison_copy)
    text = (comparison_copy / "pipeline.yaml").read_text()
    (comparison_copy / "pipeline.yaml").write_text(text.replace("  better: {distill: {gain: 3}}\n", ""))
    (comparison_copy / "data/toy/scene.yaml").write_text(
        "stages: {distill: {gain: 0}}"
    )  # a gain of 0 leaves `distill` out, in every variant
    (comparison_copy / "runs/toy/distill/notes.txt").write_text("mine")
    (comparison_copy / "runs/toy/distill/gain.txt").write_text("changed by hand")
    (comparison_copy / "runs/toy/mine").mkdir()
    (comparison_copy / "runs/toy/mine/big.txt").write_text("no receipt")
    collect_garbage(make_request(comparison_copy, ""), yes=False)
    log = capsys.readouterr().out
    assert (
        "runs/toy/distill: left out: no gain" in log and "runs/toy@better/evaluate: there is no variant better" in log
    )
    assert "nothing was removed; yes=1 removes them" in log and list_artifacts(comparison_copy) == before
    collect_garbage(make_request(comparison_copy, ""), yes=True)
    assert list_artifacts(comparison_copy) == {"toy/poses", "toy@none/evaluate"}
    remaining = {path.name for path in (comparison_copy / "runs/toy/distill").iterdir()}
    assert remaining == {"notes.txt", "gain.txt"} and (comparison_copy / "runs/toy/mine/big.txt").exists()
    run_scene(make_request(comparison_copy), "all")
    assert "toy/evaluate" in list_artifacts(comparison_copy)


def test_older_code_counts_as_used_and_a_scene_that_is_gone_is_kept(comparison_copy, capsys):
    stage = comparison_copy / "stages/distill.py"
    stage.write_text(stage.read_text() + "\nMORE = 1\n")
    before = list_artifacts(comparison_copy)
    collect_garbage(make_request(comparison_copy, ""), yes=True)
    assert list_artifacts(comparison_copy) == before
    (comparison_copy / "data/toy").rename(comparison_copy / "data/elsewhere")
    collect_garbage(make_request(comparison_copy, ""), yes=True)
    assert "toy: kept, as it cannot be planned: its scene is not there" in capsys.readouterr().out
    assert list_artifacts(comparison_copy) == before
    with pytest.raises(Refused, match="nothing was computed for nobody"):
        collect_garbage(make_request(comparison_copy, "nobody"), yes=True)


def test_a_video_is_named_with_or_without_its_ending(tmp_path, capsys):
    root = write_project(tmp_path)
    write_files(root, {"data/clip.mp4": "a film"})
    content = Hashes(root / "runs" / HASHES).file(root / "data/clip.mp4")
    record = json.dumps({"video": str(root / "data/clip.mp4"), "content": content})
    write_files(root, {"runs/clip/frames/frames.json": record, "runs/clip/frames/number.txt": "7"})
    run_scene(make_request(root, "clip.mp4"), "all")
    before = list_artifacts(root)
    for name in ("clip.mp4", "clip", ""):
        capsys.readouterr()
        collect_garbage(make_request(root, name), yes=True)
        assert capsys.readouterr().out == "nothing that no plan uses\n" and list_artifacts(root) == before
    verify(make_request(root, "clip.mp4"))
    assert "runs/clip/distill: as it was made" in capsys.readouterr().out
    clean(make_request(root, "clip.mp4"))
    assert not list_artifacts(root)


def test_other_parameters_are_those_of_the_command(comparison_copy, capsys):
    collect_garbage(make_request(comparison_copy, "toy", set="distill.gain=7"), yes=False)
    log = capsys.readouterr().out
    assert "runs/toy/distill: to be made again: param gain 1 -> 7" in log and "runs/toy/poses" not in log
