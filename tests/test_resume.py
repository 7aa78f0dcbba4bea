"""Resume of a small scene, end to end: the runner is killed at random moments, and the result is that of a whole run.

It takes minutes, so it runs with `make test slow=1`; the tests of each stage with checkpoints interrupt and resume it.
RESUME_KILLS sets the number of kills: 3, or 20 before a release.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from scenes.processes import start_module

from runner.files import RECEIPT, list_files, read_json
from runner.fleet import maintenance
from runner.keys import Hashes
from runner.plan import decide
from runner.resolve import Request, resolve

pytestmark = [pytest.mark.integration, pytest.mark.slow]

ROOT = Path(__file__).resolve().parent.parent
KILLS = int(os.environ.get("RESUME_KILLS", "3"))
STAGES = ("fit", "masks", "reference", "personalize", "initialize", "distill", "finish", "evaluate")
# The order in which stages are killed. Stages with checkpoints come first.
IN_TURN = ("fit", "distill", "personalize", "masks", "evaluate", "initialize", "finish", "reference")
SMALL = (
    "fit.iterations=60 fit.checkpoint_seconds=0.2 personalize.steps=8 personalize.optimizer.batch=2 "
    "personalize.checkpoint_seconds=0.2 distill.iterations=20 distill.checkpoint_seconds=0.2 "
    "initialize.refit_steps=30 initialize.extra_views=1 distill.sds.run=always"
)


def start_run(mini_scene: Path, runs: Path, target: str) -> subprocess.Popen[str]:
    options = ("--scene", mini_scene, "--runs", runs, "--profile", "laptop", "--set", SMALL)
    one_thread = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    return start_module("runner", "run", target, *options, env=one_thread, merge_stderr=True)


def run_to_end(mini_scene: Path, runs: Path) -> tuple[dict, list[str]]:
    """Run the whole job; return its metrics, and the stages that ran."""
    process = start_run(mini_scene, runs, "all")
    output, _ = process.communicate(timeout=900)
    assert process.returncode == 0, output
    ran = [line.split(":")[0] for line in output.splitlines() if ": done in" in line]
    return json.loads((runs / mini_scene.name / "evaluate" / "metrics.json").read_text()), ran


def kill_during(mini_scene: Path, runs: Path, stage: str, delay: float) -> bool:
    """Kill the runner `delay` seconds after `stage` has begun. Return False if the runner had ended before."""
    process = start_run(mini_scene, runs, stage)
    while process.poll() is None and not list((runs / mini_scene.name).glob(f".partial-{stage}-*")):
        time.sleep(0.02)
    try:
        process.wait(delay)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
    process.communicate()
    return process.returncode == -signal.SIGKILL


def assert_outputs_match_receipts(home: Path) -> None:
    """Assert that the files of each stage's folder have the hash recorded in its receipt, as after a finished stage."""
    for stage in ("poses", *STAGES):
        if (home / stage).exists():
            found = read_json(home / stage / RECEIPT)
            assert found and Hashes(home / "none").folder(home / stage) == found["output"], stage


@pytest.fixture(scope="module")
def unbroken_run(mini_scene, tmp_path_factory) -> tuple[Path, dict]:
    """Run the scene without interruption; return its folder of results and its metrics."""
    runs = tmp_path_factory.mktemp("unbroken")
    return runs / "mini", run_to_end(mini_scene, runs)[0]


def test_killed_at_random_moments(mini_scene, unbroken_run, tmp_path):
    """Each killed stage goes on to the same result, so that no stage after it runs again."""
    (made, metrics), runs = unbroken_run, tmp_path / "broken"
    random, home = np.random.default_rng(0), runs / "mini"
    shutil.copytree(made.parent, runs)
    for stage in sorted((IN_TURN[i % len(IN_TURN)] for i in range(KILLS)), key=STAGES.index):
        delay = random.uniform(0, read_json(made / stage / RECEIPT)["seconds"])
        shutil.rmtree(home / stage, ignore_errors=True)
        while not kill_during(mini_scene, runs, stage, delay):  # compiled by now, the stage had ended before
            shutil.rmtree(home / stage)
            delay /= 2
        assert_outputs_match_receipts(home)
    assert run_to_end(mini_scene, runs) == (metrics, [stage])
    assert not list(home.glob(".partial*"))


def test_one_byte_flipped_in_each_kind_of_file_is_noticed_and_named(mini_scene, unbroken_run, tmp_path, capsys):
    """`verify` finds a changed byte in each kind of file of every stage.

    Size and time of the file are unchanged. Which stages then rerun is tested in test_runner.py.
    """
    shutil.copytree(unbroken_run[0].parent, tmp_path / "runs")
    request = Request(ROOT, tmp_path / "runs", str(mini_scene), "laptop", set=SMALL)
    assert maintenance.verify(request) == 0
    home = tmp_path / "runs" / "mini"
    files = [path for stage in ("poses", *STAGES) for path in list_files(home / stage) if path.name != RECEIPT]
    kinds = {(path.relative_to(home).parts[0], path.suffix): path for path in files}
    for path in kinds.values():
        data, then = bytearray(path.read_bytes()), path.stat().st_mtime_ns
        data[len(data) // 3] ^= 16
        path.write_bytes(data)
        os.utime(path, ns=(then, then))
    capsys.readouterr()
    assert maintenance.verify(request) == len({stage for stage, _ in kinds}) == 9
    messages = {line.split(": ")[0].rpartition("/")[2]: line for line in capsys.readouterr().out.splitlines()}
    for (stage, _), path in kinds.items():
        assert path.relative_to(home / stage).as_posix() in messages[stage] or " more changed" in messages[stage]
    assert decide(resolve(request), "poses", {}).status == "run"
