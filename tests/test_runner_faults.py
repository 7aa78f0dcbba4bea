"""Faults of machines and users: kills, full disks, lost and corrupted files, locks, quotes in names.

No artifact is lost, and each error is one line. REFFUSION_SLOW=1 runs all kills and all disk sizes.
"""

# ruff: noqa: F401, F811 (fixtures are imported, and taken as arguments)

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes.capture import write_four_photos
from scenes.processes import run_module, start_module, wait_until
from scenes.toy_projects import RUNNER_FILES, make_request, write_files
from test_runner import REPO, finished_project, project, read_score, run_project, start_runner, statuses

from reffusion import trace
from runner import Refused
from runner.artifacts import diff_artifact
from runner.execute import run_scene
from runner.files import RECEIPT
from runner.fleet import compare, maintenance
from runner.keys import Hashes
from runner.plan import decide
from runner.plan_table import plan_table
from runner.resolve import Request, resolve

pytestmark = pytest.mark.integration

SLOW = os.environ.get("REFFUSION_SLOW") == "1"
KILLS, SIZES = (200, 30) if SLOW else (3, 1)
SHORT = {  # a pipeline of two stages, for tests that concern the runner alone
    **RUNNER_FILES,
    "pipeline.yaml": """
scene_keys: {}
stages: {fit: {needs: [scene]}, evaluate: {needs: [fit]}}
profiles: {laptop: {fit: {rate: 2}}}
variants: {strong: {fit: {rate: 5}}}
""",
    "stages/fit.py": RUNNER_FILES["stages/fit.py"].replace("poses", "scene"),
    "stages/evaluate.py": RUNNER_FILES["stages/evaluate.py"]
    .replace("poses: Path, fit: Path, masks: Path | None, distill: Path | None", "fit: Path")
    .replace("(distill or fit)", "fit"),
}


@pytest.fixture
def short_project(tmp_path: Path) -> Path:
    write_files(tmp_path / "project", SHORT)
    return tmp_path / "project"


OPTIONS = ("--profile", "laptop", "--root")


def assert_one_line(ended: subprocess.CompletedProcess[str]) -> str:
    """Assert that the command ended with one line of error and exit code 2; return this line."""
    errors = ended.stderr
    assert ended.returncode == 2 and errors.startswith("error: ") and errors.count("\n") == 1, (ended.stdout, errors)
    return errors


def assert_artifacts_complete(runs: Path) -> None:
    """Assert that all artifacts in the folder `runs` match their receipts, and that each compare.json is valid JSON."""
    for receipt in runs.glob("*/[a-z]*/" + RECEIPT):
        worn = diff_artifact(receipt.parent, Hashes(runs / "none"))
        assert json.loads(receipt.read_text())["files"] and not worn.describe(), receipt
    for path in runs.glob("*/compare.json"):
        json.loads(path.read_text())


# ----------------------------------------------------------------------------------------------- kills, and full disks

LONG = {
    "run": ["run", "--scene", "toy"],
    "batch": ["batch", "--data", "data"],
    "compare": ["compare", "--scene", "toy", "--variants", "full,strong"],
}


@pytest.mark.parametrize("what", LONG)
def test_killed_at_random_moments(short_project, what):
    write_files(short_project, {"data/toy/scene.yaml": "stages: {fit: {pause: 0.1}}"})
    if what == "batch":
        write_files(short_project, {"data/wide/number.txt": "6"})
    arguments = [str(short_project / "data") if word == "data" else word for word in LONG[what]]
    random, killed = np.random.default_rng(len(what)), 0
    while killed < -(-KILLS // 3):
        process = start_module("runner", *arguments, *OPTIONS, short_project)
        try:
            process.wait(random.uniform(0.2, 4 if SLOW else 1.5))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            killed += 1
        else:  # the process had ended before the kill
            shutil.rmtree(short_project / "runs")
        process.communicate()
        assert_artifacts_complete(short_project / "runs")
    ended = run_module("runner", *arguments, *OPTIONS, short_project, timeout=120)
    assert ended.returncode == 0, ended.stderr
    assert_artifacts_complete(short_project / "runs")
    assert read_score(short_project) == 10.0
    if what == "batch":
        assert (
            read_score(short_project, "wide") == 12.0
            and "toy,done,10.0000" in (short_project / "runs/results.csv").read_text()
        )
    if what == "compare":
        assert read_score(short_project, "toy@strong") == 19.0
        runs = json.loads((short_project / "runs/toy/compare.json").read_text())["runs"]
        assert [run["state"] for run in runs] == ["done"] * 2
    remaining = {
        path.name for home in (short_project / "runs").iterdir() for path in home.glob("*") if home.name != ".locks"
    }
    assert not [name for name in remaining if name.startswith(".")] and "kept" not in remaining


@contextmanager
def mounted_disk(folder: Path):
    """Mount a disk in memory at `folder`, and unmount it at the end.

    Yields a function that remounts the disk with an option, such as "size=1m" or "ro" (read-only).
    """
    folder.mkdir(exist_ok=True)
    mount = lambda *how: subprocess.run(["mount", "-t", "tmpfs", *how, "none", str(folder)], capture_output=True)
    if shutil.which("mount") is None or mount("-o", "size=1m").returncode:
        pytest.skip("no tmpfs can be mounted here")
    try:
        yield lambda how: subprocess.run(["mount", "-o", f"remount,{how}", str(folder)], check=True)
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_full_disk(short_project):
    random, command = np.random.default_rng(0), ("run", "--scene", "toy", *OPTIONS, short_project)
    with mounted_disk(short_project / "runs") as remount:
        for _ in range(SIZES):
            used = shutil.disk_usage(short_project / "runs").used // 1024
            remount(f"size={used + 4 * random.integers(1, 20)}k")
            result = run_module("runner", *command, timeout=120)
            assert result.returncode == 0 or "make room" in assert_one_line(result)
            assert_artifacts_complete(short_project / "runs")
            if SLOW and random.random() < 0.3:
                shutil.rmtree(short_project / "runs/toy", ignore_errors=True)
        remount("size=1m")
        assert run_module("runner", *command, timeout=120).returncode == 0 and read_score(short_project) == 10.0


@pytest.mark.parametrize("size", [700, 0, 60, 300, 1000][: 5 if SLOW else 1])
def test_files_that_cannot_be_written_whole(short_project, size):
    limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
    command = ("run", "--scene", "toy", *OPTIONS, short_project)
    assert "make room" in assert_one_line(run_module("runner", *command, timeout=120, preexec_fn=limit))
    assert_artifacts_complete(short_project / "runs")


def test_a_folder_that_is_only_read(project):
    kept = project / "made"
    (project / "runs").rename(kept)
    with mounted_disk(project / "runs") as remount:
        shutil.copytree(kept, project / "runs", dirs_exist_ok=True)
        remount("ro")
        planned, ran, cleaned = (
            run_module("runner", command, "--scene", "toy", *OPTIONS, project, timeout=120)
            for command in ("plan", "run", "clean")
        )
        assert planned.returncode == 0 and "cached    evaluate" in planned.stdout
        assert "Read-only file system; runs=FOLDER" in assert_one_line(ran)
        assert "Read-only file system; runs=FOLDER" in assert_one_line(cleaned)


# --------------------------------------------------------------------------------------- lost, corrupted, edited files


def flip_byte(path: Path, quietly: bool = False) -> None:
    """Flip a bit in the middle of a file, which keeps its size; `quietly` keeps its modification time, too."""
    data, then = bytearray(path.read_bytes()), path.stat().st_mtime_ns
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    if quietly:
        os.utime(path, ns=(then, then))


def test_missing_and_changed_files_are_named_and_made_again(project, capsys):
    made = [path for path in (project / "runs/toy").rglob("*.*") if path.suffix in (".ply", ".png", ".json", ".txt")]
    before = {path: path.read_bytes() for path in made if path.name != RECEIPT}
    (project / "runs/toy/evaluate/metrics.json").unlink()
    (project / "runs/toy/masks/facts.json").unlink()
    flip_byte(project / "runs/toy/fit/gaussians.ply")
    states = statuses(project)
    assert states["fit"] == "run gaussians.ply changed since (keep=1 keeps it)" and states["poses"] == "cached"
    assert states["masks"] == "run facts.json missing" and states["evaluate"] == "run metrics.json missing"
    flip_byte(project / "runs/toy/poses/masks/a.png")
    # `distill` does not rerun: its artifact is undamaged, and its needs are made again with equal content.
    assert run_project(capsys, project) == ["poses", "fit", "masks", "evaluate"]
    assert {path: path.read_bytes() for path in before} == before
    assert {path.name for path in (project / "runs/toy/kept").rglob("*.*")} == {"gaussians.ply", "a.png"}


def test_verify_hashes_everything(project, capsys):
    assert maintenance.verify(make_request(project)) == 0 and "runs/toy/fit: as it was made" in capsys.readouterr().out
    files = [path for path in (project / "runs/toy").glob("*/*") if path.is_file() and path.suffix in (".ply", ".json")]
    files = sorted((path for path in files if path.name != RECEIPT), key=lambda path: path.name == "facts.json")
    for path in (project / "data/toy/number.txt", *files):
        flip_byte(path, quietly=True)
        assert path.name == "facts.json" or set(statuses(project).values()) == {"cached"}  # size and time are unchanged
    assert maintenance.verify(make_request(project)) == len(files) + 1
    output = capsys.readouterr().out
    assert all(f"toy/{path.parent.name}: {path.name} changed" in output for path in files)
    assert "data/toy/number.txt: its content changed, its size and time did not" in output and "keep=1" in output
    assert (
        statuses(project)["poses"].startswith("run the scene's files changed")
        and "gaussians.ply changed" in statuses(project)["fit"]
    )
    for spoiled in ("{", "[]", "{}"):
        (project / "runs/toy/masks" / RECEIPT).write_text(spoiled)
        assert (
            maintenance.verify(make_request(project))
            and "masks: receipt.json cannot be read" in capsys.readouterr().out
        )


@pytest.mark.parametrize("how", ["a byte", "half", "nothing", "text"])
def test_a_damaged_checkpoint_means_a_fresh_start(tmp_path, capsys, how):
    state = {"step": 3, "values": torch.arange(5000.0)}
    trace.save_checkpoint(tmp_path, state)
    found = trace.load_checkpoint(tmp_path)
    assert found["step"] == 3 and torch.equal(found["values"], state["values"]) and not capsys.readouterr().out
    path = tmp_path / "checkpoint.pt"
    if how == "a byte":
        flip_byte(path)
    else:
        path.write_bytes({"half": path.read_bytes()[: path.stat().st_size // 2], "nothing": b"", "text": b"no"}[how])
    assert trace.load_checkpoint(tmp_path) is None and not path.exists()
    assert "checkpoint.pt is damaged: from the start" in capsys.readouterr().out


def test_empty_records_count_as_missing(project):
    for name in ("source", "profile"):
        (project / "runs/toy" / name).write_text("")
    (project / "runs/.hashes.json").write_text("[]")
    assert set(statuses(project).values()) == {"cached"}
    assert (
        "no CUDA driver" in resolve(make_request(project, profile=None)).why or resolve(make_request(project)).profile
    )


# --------------------------------------------------------------------------------------------------------------- locks


def test_a_lock_that_is_lost_while_a_stage_works(project):
    process = start_runner(project, "--scene", "toy", "--set", "fit.pause=0.1 fit.iterations=8")
    wait_until(lambda: list((project / "runs/toy").glob(".partial-fit-*")))
    (project / "runs/.locks/toy").unlink()
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 2 and "its lock in .locks was removed" in output and "Traceback" not in output
    assert (project / "runs/toy/fit/gaussians.ply").read_text() == "10"
    assert statuses(project, set="fit.pause=0.1 fit.iterations=8")["fit"].endswith("goes on where it stopped")


def test_another_machine(project, capsys):
    write_files(project, {"runs/.locks/toy": "77 elsewhere\n"})
    run_project(capsys, project)
    run_scene(make_request(project), "all")
    assert "elsewhere" not in capsys.readouterr().out and not (project / "runs/.locks/toy").read_text()
    write_files(project, {"runs/.locks/toy": "77 elsewhere\n"})
    run_scene(make_request(project), "all")
    assert "toy was last in use on elsewhere; is it still?" in capsys.readouterr().out


# ---------------------------------------------------------------------------------------------- input files of a stage


def test_pictures_outside_the_scene_count_and_are_listed(tmp_path):
    scene, pictures = tmp_path / "data/row", tmp_path / "pictures"
    write_four_photos(scene)
    (scene / "images").rename(pictures)
    record = json.loads((scene / "transforms.json").read_text())
    for number, frame in enumerate(record["frames"]):
        name = Path(frame["file_path"]).name
        frame["file_path"] = f"../../pictures/{name}" if number else str(pictures / name)
    (scene / "transforms.json").write_text(json.dumps(record))
    job = lambda: resolve(Request(REPO, tmp_path / "runs", str(scene), "laptop"))
    before = decide(resolved := job(), "poses", {})
    assert f"read outside the scene's folder: {pictures} (4 files)" in plan_table(resolved, {"poses": before})
    shutil.copy(scene / "masks/v2.png", pictures / "v3.png")
    assert decide(job(), "poses", {}).inputs.key != before.inputs.key


def test_a_folder_above_the_scene_and_a_pipe_are_refused(project):
    for folder in ("/", "..", "../.."):
        write_files(project, {"data/toy/scene.yaml": f"gaussians: {folder}\n"})
        with pytest.raises(Refused, match="holds the scene itself"):
            statuses(project)
    write_files(project, {"data/toy/scene.yaml": ""})
    os.mkfifo(project / "data/toy/a.png")
    with pytest.raises(Refused, match=r"toy/a\.png: neither a file nor a folder"):
        statuses(project)


# ---------------------------------------------------------------------------------------------------------- many scenes

UNREADABLE = {
    "a": "shift: [1",
    "b": "shift: 2022-08-19",
    "c": "shift: !!python/object:os.system {}",
    "d": "shift: &a [*a]",
    "e": "[" * 3000,
    "f": "shift: \x07",
    "g": "stages: 7",
}


def test_scenes_that_cannot_be_read_are_rows_that_failed(project, capsys):
    for name, text in UNREADABLE.items():
        write_files(project, {f"data/{name}/number.txt": "1", f"data/{name}/scene.yaml": text})
    (project / "data/h").mkdir()
    (project / "data/h/scene.yaml").write_bytes(b"\xff\xfe\x00")
    assert compare.batch(make_request(project, scene=""), project / "data") == 8
    rows = dict(line.split(",")[:2] for line in (project / "runs/results.csv").read_text().splitlines())
    assert rows.pop("toy") == "done" and [rows[name] for name in "abcdefgh"] == ["failed"] * 8
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("bad", ["toy", "toy-1"])
def test_compare_goes_on_after_a_scene_that_cannot_be_read(project, bad):
    write_files(project, {"data/toy-1/number.txt": "4", f"data/{bad}/scene.yaml": "shift: [1"})
    if bad == "toy":  # let the artifacts of toy serve toy-1
        (project / "runs/toy").rename(project / "runs/toy-1")
        (project / "runs/toy-1/source").unlink()
    assert compare.compare(make_request(project), "full", 2) == 1
    states = {run["scene"]: run["state"] for run in json.loads((project / "runs/toy/compare.json").read_text())["runs"]}
    assert states.pop(bad) == "failed" and list(states.values()) == ["done"]
    with pytest.raises(Refused):  # no run was possible
        compare.compare(make_request(project, set="fit.rat=1"), "full", 2)


# ---------------------------------------------------------------------------------------------------------------- make

TYPED = (
    "it's",
    'a "b"',
    "'; touch pwned; '",
    '"; touch pwned; "',
    "$(shell touch pwned)",
    "`touch pwned`",
    "$(touch pwned)",
)


@pytest.fixture
def stub_environment(tmp_path) -> Path:
    """Make a stub of the Python environment, whose commands only print their arguments; return its folder."""
    (tmp_path / "bin").mkdir()
    for name in ("reffusion", "python"):
        (tmp_path / "bin" / name).write_text('#!/bin/sh\nfor each in "$@"; do printf "%s|" "$each"; done; echo\n')
        (tmp_path / "bin" / name).chmod(0o755)
    for name in (".ready", ".ready-dev", ".ready-view", ".lpips"):
        (tmp_path / name).touch()
    return tmp_path


@pytest.mark.parametrize("typed", TYPED)
def test_typed_names_are_never_run_as_commands(stub_environment, typed):
    def made(*words: str) -> str:
        done = subprocess.run(
            ["make", "-s", "-C", str(REPO), f"VENV={stub_environment}", *words], capture_output=True, text=True
        )
        assert not list(REPO.glob("pwned*")), words
        return done.stdout

    assert made(f"scene={typed}", "plan") == f"plan|--scene={typed}|\n"
    names = ("variant", "runs", "profile", "budget", "set")
    options = "|".join(f"--{name}={typed}" for name in names)
    assert made("scene=x", *(f"{name}={typed}" for name in names), "all") == f"run|all|--scene=x|{options}|\n"
    assert f"--variants={typed}|--seeds={typed}|" in made("scene=x", f"variants={typed}", f"seeds={typed}", "compare")
    assert made("scene=x", f"port={typed}", "view") == f"view|--scene=x|--port={typed}|\n"
    assert made(f"data={typed}", "batch") == f"batch|--data={typed}|\n"
    assert made(f"scene=demo-1{typed}", "plan").startswith(f"plan|--scene=demo-1{typed}|")
    assert f"--out=data/{typed}|--seed={typed}|" in made(f"name={typed}", f"seed={typed}", "demo")
    assert "which scene" not in made("plan", typed)


def test_a_quote_in_a_scenes_name(short_project, capsys):
    name = 'anna\'s "room"'
    (short_project / "data/toy").rename(short_project / "data" / name)
    assert run_project(capsys, short_project, "fit", scene=name) == ["fit"]
    assert run_project(capsys, short_project, "fit", scene=str(short_project / "data" / name), variant="strong") == [
        "fit"
    ]
    maintenance.clean(make_request(short_project, scene=name))
    assert not list((short_project / "runs").glob("[!.]*"))
