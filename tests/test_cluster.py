"""Engines other than this machine: a local Ray cluster of three nodes, submitit's local executor, lost attempts."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from scenes.processes import run_module
from scenes.toy_projects import COMPARE_FILES, make_request, write_project
from test_batch import read_spans, write_projects
from test_runner_faults import assert_artifacts_complete

from runner.artifacts import restore_from_attempt
from runner.execute import Execution, run_scene
from runner.fleet.compare import compare
from runner.fleet.engine import LocalEngine, make_engine
from runner.fleet.retry import run_attempt
from runner.process import Resources, StageResult, Task
from runner.worker import INTERRUPTED

pytestmark = pytest.mark.integration

REPO = Path(__file__).resolve().parent.parent


def artifact_hashes(runs: Path) -> dict[str, str]:
    """Return the hash of each file of each artifact in `runs`, as recorded in the receipts: path -> hash."""
    receipts = {path.parent.relative_to(runs): json.loads(path.read_text()) for path in runs.glob("*/*/receipt.json")}
    return {f"{place}/{name}": file for place, each in receipts.items() for name, file in each["files"].items()}


@pytest.fixture(scope="module")
def ray_cluster():
    """Start a Ray cluster of three nodes with one core each."""
    pytest.importorskip("ray", reason="ray is not installed")
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    made.others = [made.add_node(num_cpus=1) for _ in range(2)]
    yield made
    made.shutdown()


@pytest.fixture
def ray_engine(ray_cluster, tmp_path):
    import ray

    yield make_engine("ray", ray_cluster.address, tmp_path, tmp_path / "runs")
    ray.shutdown()


# --------------------------------------------------------------------------------------------- attempts that were lost


def make_task(root: Path) -> Task:
    line = {"stage": "distill", "params": {"gain": 1, "pause": 0}, "out": str(root / "runs/toy/.partial-distill-1")}
    line |= {"needs": {"poses": str(root)}, "log": str(root / "distill.log")}
    return Task(root, line, root / "output.log")


def test_an_attempt_works_in_a_folder_of_its_own_and_goes_on_from_the_one_before(tmp_path):
    root = write_project(tmp_path)
    out = root / "runs/toy/.partial-distill-1"
    lost = out.with_name(out.name + ".0abc")
    lost.mkdir(parents=True)
    (lost / "checkpoint.pt").write_text("half")
    (lost / "checkpoint.pt.writing").write_text("ha")
    ended = run_attempt(make_task(root))
    assert ended.code == 0 and ended.answer["seconds"] >= 0
    assert (out / "checkpoint.pt").read_text() == "half" and (out / "gain.txt").exists()
    assert not (out / "checkpoint.pt.writing").exists() and not lost.exists()
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_an_attempt_given_up_as_lost_writes_nothing(tmp_path, monkeypatch):
    """While the attempt works, another attempt takes over and ends.

    The first attempt's later writes fail, and only the second attempt's files are in the result.
    """
    root = write_project(tmp_path)
    out = root / "runs/toy/.partial-distill-1"

    def work(task: Task, should_stop=None) -> StageResult:
        mine = Path(task.line["out"])
        assert mine != out and not out.exists()
        restore_from_attempt(out)
        (out / "theirs.txt").touch()
        with pytest.raises(FileNotFoundError):
            (mine / "trace.jsonl").write_text("late")
        return StageResult({}, 0)

    monkeypatch.setattr("runner.fleet.retry.run_process", work)
    run_attempt(make_task(root))
    assert [path.name for path in out.iterdir()] == ["theirs.txt"]


@pytest.mark.parametrize("heeds", [True, False])
def test_a_stopped_attempt_is_interrupted_unless_it_finished(tmp_path, heeds):
    root = write_project(tmp_path)
    out = root / "runs/toy/.partial-distill-1"
    wait = """    try:
        (out / "checkpoint.pt").touch()
        time.sleep(60)
    except KeyboardInterrupt:
        if HEEDS:
            raise
"""
    stage = COMPARE_FILES["stages/distill.py"].replace(
        "    time.sleep(params.pause)\n", wait.replace("HEEDS", str(heeds))
    )
    (root / "stages/distill.py").write_text(stage)
    ended = run_attempt(make_task(root), lambda: bool(list(out.parent.glob("*/checkpoint.pt"))))
    assert ended.code == (INTERRUPTED if heeds else 0) and bool(ended.answer) != heeds
    assert (out / "checkpoint.pt").exists() and (out / "gain.txt").exists() != heeds


def test_this_machine_goes_on_with_what_a_cluster_left(tmp_path, capsys):
    root = write_project(tmp_path)
    run_scene(make_request(root), "poses")
    (root / "data/toy/scene.yaml").write_text("stages: {distill: {gain: -1}}")
    with pytest.raises(Exception, match="a gain below 0"):
        run_scene(make_request(root), "distill")
    (partial,) = (root / "runs/toy").glob(".partial-distill-*")
    partial.rename(partial.with_name(partial.name + ".77"))
    (partial.with_name(partial.name + ".77") / "left.txt").touch()
    (root / "stages/distill.py").touch()
    with pytest.raises(Exception, match="a gain below 0"):
        run_scene(make_request(root), "distill")
    assert (partial / "left.txt").exists() and not list((root / "runs/toy").glob(".partial-distill-*.77"))


# ----------------------------------------------------------------------------------------------------------------- Ray


def write_twelve_scenes(root: Path) -> Path:
    """Write a toy project with twelve scenes."""
    write_project(root)
    for number in range(12):
        (root / f"many/s{number:02}").mkdir(parents=True)
        (root / f"many/s{number:02}/number.txt").write_text(str(10 * number))
    return root


@pytest.mark.slow
def test_twelve_scenes_with_three_variants_on_ray_are_those_of_one_machine(tmp_path, ray_engine, ray_cluster):
    """Results are equal even though one Ray node is killed while stages run on it."""
    root = write_twelve_scenes(tmp_path)
    runs = root / "runs"

    def kill() -> None:
        while len(list(runs.glob("*/distill/receipt.json"))) < 3 or not list(runs.glob("*/.partial-*.*")):
            time.sleep(0.01)
        ray_cluster.remove_node(ray_cluster.others.pop(), allow_graceful=False)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    assert (
        compare(
            make_request(root, "", cuda=ray_engine.cuda),
            "better,none",
            data=root / "many",
            execution=Execution(ray_engine, 1),
        )
        == 0
    )
    killer.join()
    ray_cluster.others.append(ray_cluster.add_node(num_cpus=1))
    assert_same_as_one_machine(root, "better,none", 300)


def assert_same_as_one_machine(root: Path, variants: str, least: int) -> None:
    """Assert that runs/ has at least `least` files, those of a local run, and that a second run repeats nothing."""
    runs = root / "runs"
    local = type(make_request(root, ""))(root, root / "alone", "", "laptop")
    assert compare(local, variants, data=root / "many", execution=Execution(LocalEngine(), 1)) == 0
    here, away = artifact_hashes(root / "alone"), artifact_hashes(runs)
    different = sorted(name for name in {*here, *away} if here.get(name) != away.get(name))
    assert len(here) >= least and not [name for name in different if not name.endswith("metrics.json")]
    for name in different:  # metrics.json contains the stages' seconds, which differ
        one, other = (json.loads((place / name).read_text()) for place in (root / "alone", runs))
        assert one["mean"] == other["mean"] and one["gaussians"] == other["gaussians"]
    assert_artifacts_complete(runs)
    times = {path: path.stat().st_mtime_ns for path in runs.glob("*/*/receipt.json")}
    assert compare(make_request(root, ""), variants, data=root / "many", execution=Execution(LocalEngine(), 1)) == 0
    assert {path: path.stat().st_mtime_ns for path in runs.glob("*/*/receipt.json")} == times


DRIVER = """
import sys
from test_cluster import *
signal.signal(signal.SIGINT, signal.default_int_handler)
from runner.fleet.compare import batch
root = Path(sys.argv[1])
engine = make_engine("ray", sys.argv[2], root, root / "runs")
sys.exit(batch(make_request(root, "", cuda=engine.cuda), root / "many", Execution(engine, 1)))
"""


@pytest.mark.slow
@pytest.mark.parametrize("send", [signal.SIGKILL, signal.SIGINT])
def test_the_driver_killed_and_started_again(tmp_path, ray_cluster, send):
    root = write_projects(tmp_path, 5.0)
    environment = {**os.environ, "PYTHONPATH": f"{REPO}:{REPO}/tests"}
    command = [sys.executable, "-c", DRIVER, str(root), ray_cluster.address]
    process = subprocess.Popen(command, env=environment)
    while len(list((root / "runs").glob("begun-*"))) < 3:  # then `poses` of the three readable scenes is done
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(send)
    process.wait(60)
    before = (root / "runs/ran.txt").read_text().splitlines()
    time.sleep(6)  # stages that outlived the driver would end within this time
    assert (root / "runs/ran.txt").read_text().splitlines() == before
    assert subprocess.run(command, env=environment, timeout=300).returncode == 1  # scene c fails
    lines = (root / "runs/ran.txt").read_text().splitlines()
    assert sorted(lines) == sorted(set(lines)) and len(lines) == 9
    assert_artifacts_complete(root / "runs")


@pytest.mark.slow
@pytest.mark.parametrize("last", ["poses", "distill", "evaluate"])
def test_work_finished_when_the_driver_is_interrupted_is_not_repeated(tmp_path, ray_cluster, last):
    root = write_projects(tmp_path)
    environment = {**os.environ, "PYTHONPATH": f"{REPO}:{REPO}/tests"}
    command = [sys.executable, "-c", DRIVER, str(root), ray_cluster.address]
    process, ran = subprocess.Popen(command, env=environment), root / "runs/ran.txt"
    while not ran.exists() or last not in ran.read_text():
        assert process.poll() is None
        time.sleep(0.002)
    process.send_signal(signal.SIGINT)
    process.wait(60)
    assert subprocess.run(command, env=environment, timeout=300).returncode == 1  # scene c fails
    lines = ran.read_text().splitlines()
    assert sorted(lines) == sorted(set(lines)) and len(lines) == 9
    assert_artifacts_complete(root / "runs")


@pytest.mark.slow
def test_ray_adds_little_and_a_stage_has_the_cores_it_was_given(tmp_path, ray_engine, capsys):
    root = write_projects(tmp_path)
    run_scene(make_request(root, str(root / "many/a"), cuda=ray_engine.cuda), "poses", None, Execution(ray_engine, 1))
    begun = time.monotonic()
    run_scene(make_request(root, str(root / "many/a"), cuda=ray_engine.cuda), "distill", None, Execution(ray_engine, 1))
    took = time.monotonic() - begun
    print(f"one stage by Ray, planning and all: {took:.2f} s")
    assert [threads for _, _, threads, _ in read_spans(root)] == ["1"]
    run_scene(make_request(root, str(root / "many/a"), cuda=False), "all")
    assert len(read_spans(root)) == 1


# --------------------------------------------------------------------------------------------------------------- Slurm


def test_slurm_by_submitits_local_executor(tmp_path, capsys):
    pytest.importorskip("submitit", reason="submitit is not installed")
    root = write_project(tmp_path)
    engine = make_engine("slurm", "local", root, root / "runs")
    folders = run_scene(make_request(root), "distill", None, Execution(engine, 1))
    assert (folders["distill"] / "gain.txt").read_text() == "1"
    (root / "stages/poses.py").write_text(
        COMPARE_FILES["stages/poses.py"].replace("    number =", "    boom\n    number =")
    )
    with pytest.raises(Exception, match="poses: NameError: name 'boom' is not defined"):
        run_scene(make_request(root), "poses", None, Execution(engine, 1))
    engine.stop()
    with pytest.raises(KeyboardInterrupt):
        engine.run(make_task(root), Resources(1, 0, 100), 0, lambda: None)


def test_a_missing_cluster_is_reported_in_one_line(tmp_path):
    pytest.importorskip("submitit", reason="submitit is not installed")
    done = run_module("runner", "run", "--scene", "x", "--engine", "slurm")
    if shutil.which("srun"):
        pytest.skip("there is a Slurm here")
    assert done.returncode == 2 and "address=local tries it without a cluster" in done.stderr
    assert done.stderr.count("\n") == 1 and not (tmp_path / "runs").exists()
