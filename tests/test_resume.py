"""A miniature scene end to end, the runner killed at random moments: the result must not show it.

RESUME_KILLS sets the number of kills: 3, to spare time; 20 before a release.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from runner.files import RECEIPT, read_json
from runner.keys import Hashes

ROOT = Path(__file__).resolve().parent.parent
KILLS = int(os.environ.get("RESUME_KILLS", "3"))
STAGES = ("fit", "masks", "reference", "personalize", "initialize", "distill", "evaluate")
IN_TURN = ("fit", "distill", "personalize", "masks", "evaluate", "initialize", "reference")  # those that resume first
SMALL = (
    "fit.iterations=120 fit.checkpoint_seconds=0.2 personalize.steps=16 personalize.optimizer.batch=2 "
    "personalize.checkpoint_seconds=0.2 distill.iterations=40 distill.checkpoint_seconds=0.2"
)


def start(scene: Path, runs: Path, target: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "runner", "run", target, "--scene", str(scene), "--runs", str(runs)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    return subprocess.Popen(
        [*command, "--profile", "laptop", "--set", SMALL],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(scene: Path, runs: Path) -> dict:
    process = start(scene, runs, "all")
    output, _ = process.communicate(timeout=900)
    assert process.returncode == 0, output
    metrics = json.loads((runs / scene.name / "evaluate" / "metrics.json").read_text())
    metrics.pop("seconds")
    return metrics


def kill_during(scene: Path, runs: Path, stage: str, delay: float) -> bool:
    """Kill the runner `delay` seconds after `stage` has begun; False where the stage had ended before."""
    process = start(scene, runs, stage)
    while process.poll() is None and not list((runs / scene.name).glob(f".partial-{stage}-*")):
        time.sleep(0.02)
    try:
        process.wait(delay)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
    process.communicate()
    return process.returncode == -signal.SIGKILL


def assert_whole(home: Path) -> None:
    """Every artifact in place is one that a stage finished."""
    for stage in ("poses", *STAGES):
        if (home / stage).exists():
            found = read_json(home / stage / RECEIPT)
            assert found and Hashes(home / "none").folder(home / stage) == found["output"], stage


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scene") / "mini"
    command = [sys.executable, str(ROOT / "data/generate.py"), "--kind", "mini", "--seed", "0", "--out", str(folder)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder


def test_killed_at_random_moments(scene, tmp_path):
    unbroken = finish(scene, tmp_path / "unbroken")
    seconds = {stage: read_json(tmp_path / "unbroken/mini" / stage / RECEIPT)["seconds"] for stage in STAGES}
    random = np.random.default_rng(0)
    killed = 0
    for stage in sorted((IN_TURN[i % len(IN_TURN)] for i in range(KILLS)), key=STAGES.index):
        killed += kill_during(scene, tmp_path / "broken", stage, random.uniform(0, seconds[stage]))
        assert_whole(tmp_path / "broken/mini")
    assert finish(scene, tmp_path / "broken") == unbroken
    assert killed >= KILLS // 2  # the others came too late, their stage was done
    assert not list((tmp_path / "broken/mini").glob(".partial*"))
