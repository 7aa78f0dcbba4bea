"""The runner on a toy pipeline of fast stages: reruns and their reasons, kills, locks, refusals, variants, batches."""

from __future__ import annotations

import ast
import gc
import json
import re
import shutil
import signal
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from scenes.processes import start_module, wait_until
from scenes.toy_projects import RUNNER_FILES, make_request, write_files

from runner import Failed, Refused, process, results
from runner.durations import expected_seconds, typical_seconds
from runner.execute import run_scene
from runner.fleet import compare, maintenance
from runner.keys import Hashes, code_fingerprints, fingerprint
from runner.plan import plan
from runner.plan_table import plan_table
from runner.resolve import resolve
from runner.text import format_seconds

pytestmark = pytest.mark.integration

REPO = Path(__file__).resolve().parent.parent

WORDS = ["poses", "fit", "masks", "distill", "evaluate"]


def statuses(project: Path, **options) -> dict[str, str]:
    """Return the plan as a dict from stage to the string "status reason"."""
    job = resolve(make_request(project, **options))
    return {s: f"{d.status} {d.reason}".strip() for s, d in plan(job, job.pipeline.closure("all")).items()}


def run_project(capsys, project: Path, target: str = "all", **options) -> list[str]:
    """Run the scene; return the stages that ran, in order."""
    capsys.readouterr()
    run_scene(make_request(project, **options), target)
    return [line.split(":")[0] for line in capsys.readouterr().out.splitlines() if ": done in" in line]


def read_score(project: Path, home: str = "toy") -> float:
    return json.loads((project / "runs" / home / "evaluate/metrics.json").read_text())["mean"]["psnr_box"]


def replace_text(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.fixture(scope="module")
def finished_project(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("finished")
    write_files(root, RUNNER_FILES)
    run_scene(make_request(root), "all")
    return root


@pytest.fixture
def project(finished_project: Path, tmp_path: Path) -> Path:
    """Return the folder of a toy project in which all stages are done."""
    shutil.copytree(finished_project, tmp_path / "project")
    return tmp_path / "project"


@pytest.fixture
def empty_project(tmp_path: Path) -> Path:
    write_files(tmp_path / "project", RUNNER_FILES)
    return tmp_path / "project"


def start_runner(project: Path, *arguments: str) -> subprocess.Popen[str]:
    """Start a process of the runner that runs the stage `fit`.

    The process handles Ctrl-C as in a terminal: a shell lets its background jobs ignore the signal SIGINT.
    """
    options = ("--root", project, "--profile", "laptop", *arguments)
    return start_module("runner", "run", "fit", *options, merge_stderr=True, preexec_fn=restore_ctrl_c)


def restore_ctrl_c() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


# -------------------------------------------------------------------------------------------------------------- reruns


def test_first_run_and_receipts(project):
    assert read_score(project) == 10.0  # 3 steps of 2, plus the scene's number 4
    receipt = json.loads((project / "runs/toy/fit/receipt.json").read_text())
    assert receipt["params"] == {"iterations": 3, "rate": 2, "pause": 0.0, "device": "cpu"}
    assert receipt["profile"] == "laptop" and receipt["peak_memory_mb"] > 0 and receipt["versions"]["python"]
    assert list(receipt["code"]) == [
        "reffusion/__init__.py", "reffusion/numbers.py", "reffusion/optimize.py", "stages/fit.py"
    ]  # fmt: skip
    assert not list((project / "runs/toy").glob(".partial*")) and not list((project / "runs/toy").glob(".old*"))
    assert (project / "runs/toy/profile").read_text() == "laptop\n"


def test_the_expected_time_follows_the_table_then_this_machine_then_the_scene(capsys, empty_project):
    """The laptop's table says 100 s a step; the toy's stages take milliseconds."""
    facts = "{'views': [['a', 'b'], ['c'], [], []], 'brings_poses': True, 'megapixels': 0.3}"
    with open(empty_project / "stages/poses.py", "a") as file:
        file.write(f"\ndef scene_facts(params, scene):\n    return {facts}\n")
    rates = "{fit: {base: 0, step: 100, steps: iterations}, distill: {base: 30}, evaluate: {base: 10, test: 5}}"
    rates = f"{{poses: {{base: 1, view: 2}}, masks: {{base: 1}}, {rates[1:]}"
    with open(empty_project / "pipeline.yaml", "a") as file:
        file.write(f"durations: {{laptop: {rates}}}\n")
    job = resolve(make_request(empty_project))
    factor = typical_seconds(job, "masks")  # 1 on two cores
    assert typical_seconds(job, "poses") == pytest.approx(5 * factor)
    assert typical_seconds(job, "fit") == pytest.approx(300 * factor)
    total = (5 + 300 + 1 + 15 + 30) * factor
    plan_text = plan_table(job, plan(job, job.pipeline.closure("all")))
    assert f"together about {format_seconds(total)}" in plan_text
    capsys.readouterr()
    run_scene(make_request(empty_project), "fit")
    assert re.search(r"\nfit: not run yet; about \d min\n", capsys.readouterr().out)
    job = resolve(make_request(empty_project))
    taken = [json.loads((empty_project / f"runs/toy/{stage}/receipt.json").read_text()) for stage in ("poses", "fit")]
    assert 3 * factor < expected_seconds(job, "distill") < 8 * factor, "faster than 30 s, as the stages before"
    assert expected_seconds(job, "fit") == taken[1]["seconds"], "as in its last run"


def test_fresh_plan(empty_project):
    states = statuses(empty_project)
    assert states["poses"] == states["fit"] == "run not run yet"
    assert states["masks"].startswith("pending left out if the scene has no masks")
    assert states["distill"].startswith("pending") and states["evaluate"].startswith("run")
    job = resolve(make_request(empty_project))
    assert "reads one number" in plan_table(job, plan(job, ["poses"]))
    # The plan writes no files but the cache of hashes.
    assert not (empty_project / "runs").exists() or not (empty_project / "runs/toy").exists()


def test_a_second_call_runs_nothing(project, capsys):
    assert run_project(capsys, project) == []
    assert set(statuses(project).values()) == {"cached"}


def test_parameter_reruns_its_stage_and_what_depends_on_it(project, capsys):
    states = statuses(project, set="fit.iterations=5")
    assert states["poses"] == "cached" and states["fit"] == "run param iterations 3 -> 5"
    assert states["masks"].startswith("stale waits for fit") and states["evaluate"].startswith("stale")
    assert statuses(project, set="fit.iterations=5 masks.threshold=99")["masks"] == "run param threshold 100 -> 99"
    assert run_project(capsys, project, set="fit.iterations=5") == ["fit", "masks", "distill", "evaluate"]
    assert read_score(project) == 14.0


def test_identical_output_stops_a_rerun(project, capsys):
    """`masks` reruns and its output is the same as before, so `distill` and `evaluate` do not rerun."""
    assert run_project(capsys, project, set="masks.threshold=99") == ["masks"]
    (project / "data/toy/number.txt").write_text("-4")  # the stage writes the absolute value
    assert statuses(project, set="masks.threshold=99")["poses"] == "run the scene's files changed"
    assert run_project(capsys, project, set="masks.threshold=99") == ["poses"]


def test_a_stage_depends_on_those_files_of_the_scene_that_it_says_it_reads(project, capsys):
    replace_text(
        project / "stages/poses.py",
        "def preview(",
        """def scene_files(params, scene, files):
    return [path for path in files if path.parent.name != "drafts"]

def preview(""",
    )
    run_project(capsys, project, "poses")
    write_files(project, {"data/toy/drafts/idea.txt": "?"})
    assert set(statuses(project).values()) == {"cached"}
    write_files(project, {"data/toy/notes/idea.txt": "?"})
    assert statuses(project)["poses"] == "run the scene's files changed"


def test_a_stage_depends_on_facts_that_it_takes_from_other_files(project, capsys):
    replace_text(
        project / "stages/poses.py",
        "def preview(",
        """def scene_files(params, scene, files):
    return [path for path in files if path.parent.name != "drafts"]

def scene_facts(params, scene):
    return {"drafts": sorted(path.name for path in scene.glob("drafts/*"))}

def preview(""",
    )
    run_project(capsys, project, "poses")
    write_files(project, {"data/toy/drafts/idea.txt": "?"})
    assert statuses(project)["poses"] == "run the scene's drafts changed"
    run_project(capsys, project, "poses")
    write_files(project, {"data/toy/drafts/idea.txt": "!"})
    assert set(statuses(project).values()) == {"cached"}


def test_a_stage_reruns_once_an_optional_need_exists(project, capsys):
    """If the optional need disappears again, as on another machine, the artifact that was made with it stays valid."""
    replace_text(
        project / "stages/evaluate.py",
        "def run(",
        """def unavailable(params):
    return [] if Path(__file__).with_name("metric.txt").exists() else ["the metric"]

def run(""",
    )
    assert run_project(capsys, project) == ["evaluate"] and set(statuses(project).values()) == {"cached"}
    write_files(project, {"stages/metric.txt": ""})
    assert statuses(project)["evaluate"] == "run the metric is on this machine now"
    assert run_project(capsys, project) == ["evaluate"]
    (project / "stages/metric.txt").unlink()
    assert set(statuses(project).values()) == {"cached"}


def test_a_stage_that_reads_the_scene_refuses_before_its_other_needs_are_made(empty_project):
    replace_text(
        empty_project / "pipeline.yaml", "masks:\n    needs: [poses, fit]", "masks:\n    needs: [scene, poses, fit]"
    )
    replace_text(
        empty_project / "stages/masks.py",
        "def run(params: Params, out: Path, *,",
        """def preview(params, *, scene, poses, fit):
    assert poses is None and fit is None
    if (scene / "wrong").exists():
        raise ValueError(f"{scene / 'wrong'}: remove it")
    return ["looked at the scene"]

def run(params: Params, out: Path, *, scene: Path,""",
    )
    assert statuses(empty_project)["masks"].startswith("pending")
    write_files(empty_project, {"data/toy/wrong": ""})
    assert "remove it" in statuses(empty_project)["masks"]
    with pytest.raises(Refused, match=r"masks: .*wrong: remove it"):
        run_scene(make_request(empty_project), "all")
    assert not (empty_project / "runs/toy/poses").exists()


def test_exported_files_outlive_their_artifact(project, capsys):
    replace_text(project / "pipeline.yaml", "masks:\n    needs", "masks:\n    export: [drafts]\n    needs")
    replace_text(
        project / "stages/masks.py",
        "    invent = ",
        """    (out / "drafts").mkdir()
    for name in ("a", "b", "c")[: params.threshold % 10]:
        (out / "drafts" / name).write_text(str(params.threshold))
    invent = """,
    )
    read_drafts = lambda: {path.name: path.read_text() for path in (project / "runs/toy/drafts").iterdir()}
    run_project(capsys, project, "masks", set="masks.threshold=102")
    assert read_drafts() == {"a": "102", "b": "102"}
    (project / "runs/toy/drafts/a").write_text("drawn")
    (project / "runs/toy/drafts/mine").write_text("too")
    run_scene(make_request(project, set="masks.threshold=103"), "masks")
    assert read_drafts() == {"a": "drawn", "b": "103", "c": "103", "mine": "too"}
    assert "toy/drafts/a was changed by hand: kept" in capsys.readouterr().out
    run_project(capsys, project, "masks", set="masks.threshold=101")
    assert read_drafts() == {"a": "drawn", "mine": "too"}


def test_code_edits(project, capsys):
    optimize = project / "reffusion/optimize.py"
    replace_text(optimize, "# forwards", "# onwards")
    replace_text(optimize, "One step.", "A step.")
    replace_text(project / "stages/fit.py", 'description="steps"', 'description="how many"')
    replace_text(project / "reffusion/unused.py", "1", "2")
    assert run_project(capsys, project) == []
    replace_text(project / "reffusion/numbers.py", "a + b", "a + b + 1")
    assert statuses(project)["fit"] == "run code of reffusion/numbers.py changed"
    trusted = statuses(project, trust=True)
    assert trusted["fit"] == "cached trusted although code of reffusion/numbers.py changed"
    assert trusted["evaluate"] == "cached"
    assert statuses(project, trust=True, set="fit.rate=3")["fit"].startswith("run param rate 2 -> 3")
    assert run_project(capsys, project, "fit") == ["fit"]


def test_fingerprint():
    same = ["def f(a):\n    return a", 'def f(a):\n    "Doc."\n    # why\n    return a', "def f( a ):\n\n  return (a)"]
    assert len({fingerprint(ast.parse(text)) for text in same}) == 1
    assert fingerprint(ast.parse("def f(a):\n    return a or 1")) != fingerprint(ast.parse(same[0]))
    assert fingerprint(ast.parse("x = '''a'''")) != fingerprint(ast.parse("x = '''b'''"))


def test_scenes_of_a_batch_read_code_at_once(tmp_path):
    """A garbage collection inside `ast.parse` lets another thread run, which CPython 3.11 does not survive."""
    threshold, let_others_run = gc.get_threshold(), lambda *_: time.sleep(1e-6)
    gc.set_threshold(50)
    gc.callbacks.append(let_others_run)
    try:
        with ThreadPoolExecutor(6) as pool:
            read = lambda n: code_fingerprints(REPO, "evaluate", Hashes(tmp_path / str(n)))
            assert len({str(sorted(code.items())) for code in pool.map(read, range(6))}) == 1
    finally:
        gc.callbacks.remove(let_others_run)
        gc.set_threshold(*threshold)


def test_readmes_and_scripts_in_a_weights_folder_do_not_count(project):
    before = statuses(project)
    for name in ("README.md", "train.py", "held_out.png"):
        (project / "weights" / name).write_text("about it")
    assert statuses(project) == before
    (project / "weights/config.json").write_text("{}")
    assert statuses(project)["distill"] == "run weights prior changed"


def test_weights_profile_and_hand_edits(project, capsys):
    (project / "weights/model.bin").write_text("v")
    assert statuses(project)["distill"] == "run weights prior changed"
    (project / "weights/model.bin").write_text("w")
    # Artifacts depend on the values that a profile sets, and not on its name.
    paper = statuses(project, profile="paper")
    assert paper["poses"] == "cached" and paper["fit"] == "run param rate 2 -> 1"
    assert statuses(project, profile=None) == statuses(project)  # the first run recorded its profile
    (project / "runs/toy/fit/gaussians.ply").write_text("11")
    assert statuses(project, keep=True)["fit"] == "cached gaussians.ply changed"
    assert run_project(capsys, project, keep=True) == ["masks", "distill", "evaluate"] and read_score(project) == 11.0
    # After one run with keep=True, the edited file stays without this option.
    assert statuses(project)["fit"] == "cached gaussians.ply by hand" and run_project(capsys, project) == []
    assert run_project(capsys, project, set="fit.rate=3") == ["fit", "masks", "distill", "evaluate"]
    assert (project / "runs/toy/kept/fit/gaussians.ply").read_text() == "11"


def test_skipped_and_provided_stages(project, capsys):
    assert run_project(capsys, project, set="masks.threshold=1") == ["masks", "evaluate"]
    assert statuses(project, set="masks.threshold=1")["distill"] == "skip nothing to invent"
    assert statuses(project, set="distill.gain=0")["distill"] == "skip no gain"
    write_files(project, {"data/toy/scene.yaml": "shift: 1\ngaussians: mine.ply\n", "data/toy/mine.ply": "50"})
    assert statuses(project)["fit"] == "provided the scene brings `gaussians`"
    run_project(capsys, project)
    assert read_score(project) == 50.0
    write_files(project, {"data/toy/unmasked": ""})
    run_project(capsys, project)
    states = statuses(project)
    assert states["masks"] == "skip the scene has no masks" and states["distill"].startswith("skip")


def test_the_scenes_own_file_stands_for_a_stage_only_while_its_parameter_allows(project, capsys):
    replace_text(project / "pipeline.yaml", "artifact: poses}", "artifact: poses, param: fit.rate, equals: 2}")
    write_files(project, {"data/toy/scene.yaml": "gaussians: mine.ply\n", "data/toy/mine.ply": "50"})
    assert statuses(project)["fit"] == "provided the scene brings `gaussians`"
    run_project(capsys, project, set="fit.rate=3")
    # 13 is 3 steps of 3, plus the scene's number 4.
    assert statuses(project, set="fit.rate=3")["fit"] == "cached" and read_score(project) == 13.0
    replace_text(project / "pipeline.yaml", "param: fit.rate", "param: fit.rat")
    with pytest.raises(Refused, match=r"a condition asks for fit\.rat, which is not there"):
        statuses(project)


def test_a_condition_may_ask_for_two_parameters(project):
    one, both = "{param: distill.gain, equals", "{param: [distill.gain, poses.shift], equals"
    write_files(project, {"pipeline.yaml": RUNNER_FILES["pipeline.yaml"].replace(one, both)})
    assert statuses(project, set="distill.gain=0 poses.shift=0")["distill"] == "skip no gain"
    assert not statuses(project, set="distill.gain=0 poses.shift=1")["distill"].startswith("skip")
    write_files(
        project, {"pipeline.yaml": RUNNER_FILES["pipeline.yaml"].replace(one, both.replace("shift", "nothing"))}
    )
    with pytest.raises(Refused, match=r"poses\.nothing, which is not there"):
        statuses(project, set="distill.gain=0")


def test_a_condition_may_hold_for_some_parameters_only_and_name_facts(project, capsys):
    plain = "{fact: masks.invent, equals: 0, reason: nothing to invent}"
    named = '{fact: masks.invent, equals: 0, only: {distill.gain: 2}, reason: "nothing to gain: {invent} of 9"}'
    write_files(project, {"pipeline.yaml": RUNNER_FILES["pipeline.yaml"].replace(plain, named)})
    nothing = "masks.threshold=1 "
    assert statuses(project, set=nothing + "distill.gain=2")["distill"].endswith(
        "if nothing to gain: known after masks"
    )
    assert statuses(project, set=nothing + "distill.gain=3")["distill"].startswith("run")
    run_project(capsys, project, set=nothing + "distill.gain=2")
    assert statuses(project, set=nothing + "distill.gain=2")["distill"] == "skip nothing to gain: 0 of 9"
    assert statuses(project, set=nothing + "distill.gain=3")["distill"].startswith("run")


def test_scene_yaml_stages_rerun_only_their_stage(project, capsys):
    write_files(project, {"data/toy/scene.yaml": "profile: laptop\nstages: {distill: {gain: 3}}\n"})
    assert run_project(capsys, project) == ["distill", "evaluate"]
    assert run_project(capsys, project, set="distill.gain=4") == ["distill", "evaluate"]
    assert read_score(project) == 40.0


def test_files_outside_the_scene_count(project, capsys):
    write_files(project, {"data/toy/scene.yaml": "gaussians: ../../mine.ply\n", "mine.ply": "50"})
    run_project(capsys, project, "poses")
    write_files(project, {"mine.ply": "60"})
    assert run_project(capsys, project, "poses") == ["poses"]
    assert (project / "runs/toy/poses/gaussians.ply").read_text() == "60"


def test_variants_share_what_they_do_not_change(project, capsys):
    assert run_project(capsys, project, variant="strong") == ["distill", "evaluate"]
    assert sorted(p.name for p in (project / "runs/toy@strong").iterdir() if p.is_dir()) == ["distill", "evaluate"]
    assert read_score(project, "toy@strong") == 50.0 and read_score(project) == 10.0
    assert set(statuses(project, variant="same").values()) == {"cached shared with toy"}
    same = make_request(project, variant="same")
    folder = run_scene(same, "all")["evaluate"]
    (folder / "scene.ply").touch()
    results.show_results("evaluate", folder, same)
    output = capsys.readouterr().out
    assert "runs/toy/evaluate/: metrics.json" in output
    assert "make scene=toy variant=same view    make scene=toy variant=same report" in output


# ----------------------------------------------------------------------------------------------- kills, locks, swaps


def kill_in_fit(project: Path, steps: int, send: int) -> tuple[int, str]:
    """Start a long fit and send the runner the signal `send` after a checkpoint. Return exit code and output."""
    process = start_runner(project, "--scene", "toy", "--set", f"fit.pause=0.1 fit.iterations={steps}")
    wait_until(lambda: any((p / "checkpoint.pt").exists() for p in (project / "runs/toy").glob(".partial-fit-*")))
    process.send_signal(send)
    output, _ = process.communicate(timeout=30)
    return process.returncode, output


def test_a_killed_run_leaves_the_old_artifact_and_resumes(project, capsys):
    options = {"set": "fit.pause=0.1 fit.iterations=8"}
    code, _ = kill_in_fit(project, 8, signal.SIGKILL)
    assert code == -signal.SIGKILL
    assert (project / "runs/toy/fit/gaussians.ply").read_text() == "10"
    assert statuses(project, **options)["fit"].endswith("goes on where it stopped")
    assert run_project(capsys, project, "fit", **options) == ["fit"]
    assert int((project / "runs/toy/fit/trace.jsonl").read_text()) > 0  # the step from which the stage resumed
    assert (project / "runs/toy/fit/gaussians.ply").read_text() == "20"
    assert not list((project / "runs/toy").glob(".partial*"))


def test_ctrl_c(project):
    code, output = kill_in_fit(project, 1000, signal.SIGINT)
    assert code == 130 and "the same command goes on from here" in output and "Traceback" not in output
    assert not list((project / "runs/toy").glob(".partial-fit-*/receipt.json"))


def test_two_runners_on_one_scene(project):
    first = start_runner(project, "--scene", "toy", "--set", "fit.pause=0.2", "--set", "fit.iterations=8")
    wait_until(lambda: list((project / "runs/toy").glob(".partial-fit-*")))
    first.send_signal(signal.SIGSTOP)  # stopped until the second runner waits for the lock
    with pytest.raises(Refused, match=f"toy is in use by process {first.pid}"):
        maintenance.clean(make_request(project))
    second = start_runner(project, "--scene", "toy", "--set", "fit.pause=0.2 fit.iterations=8")
    output = second.stdout.readline()
    first.send_signal(signal.SIGCONT)
    output += second.communicate(timeout=60)[0]
    assert first.wait(timeout=60) == 0 and second.returncode == 0
    assert f"in use by process {first.pid}: waiting" in output and "done in" not in output


@pytest.mark.parametrize("moment", ["after the old is moved", "after the new is moved", "while the old is deleted"])
def test_killed_in_the_swap(project, finished_project, capsys, moment):
    """A runner is killed while it replaces an old artifact by a new one.

    The next run finds the complete new artifact, whatever the moment of the kill, and runs no stage again.
    """
    home, five = project / "runs/toy", {"target": "fit", "set": "fit.iterations=5"}
    assert run_project(capsys, project, **five) == ["fit"]
    shutil.copytree(home / "fit", home / "new")
    shutil.rmtree(home / "fit")
    if moment == "after the old is moved":
        shutil.copytree(finished_project / "runs/toy/fit", home / ".old-fit")
        key = json.loads((home / "new/receipt.json").read_text())["key"]
        (home / "new").rename(home / f".partial-fit-{key}")
    else:
        old = ".gone-.old-fit" if moment == "while the old is deleted" else ".old-fit"
        shutil.copytree(finished_project / "runs/toy/fit", home / old)
        (home / "new").rename(home / "fit")
        if moment == "while the old is deleted":
            (home / old / "receipt.json").unlink()
    assert run_project(capsys, project, **five) == []
    assert (home / "fit/gaussians.ply").read_text() == "14"
    assert not list(home.glob(".[gop]*")) and not (home / "kept").exists()


def test_a_failing_stage_keeps_the_rest(project, capsys):
    write_files(project, {"data/toy/broken": ""})
    with pytest.raises(Failed, match=r"poses: .*toy: it is broken \(all of it in .*poses.log\)$"):
        run_scene(make_request(project), "all")
    assert "Traceback" in (project / "runs/toy/poses.log").read_text()
    assert read_score(project) == 10.0
    (project / "data/toy/broken").unlink()
    assert run_project(capsys, project) == []


# ---------------------------------------------------------------------------------------------------------- refusals

REFUSALS = {
    "unknown scene": ({}, {"scene": "toi"}, r"unknown scene 'toi'.*data/toi.*known: toy"),
    "unknown stage": ({}, {"set": "fitt.rate=1"}, r"set: unknown stage 'fitt'; did you mean 'fit'"),
    "unknown parameter": ({}, {"set": "fit.rat=1"}, r"set: stage fit: unknown parameter 'rat'; did you mean 'rate'"),
    "ill-typed": ({}, {"set": "fit.rate=fast"}, r"set: fit.rate = 'fast': .*integer"),
    "out of range": ({}, {"set": "fit.iterations=0"}, r"set: fit.iterations = 0: .*greater than or equal to 1"),
    "no equals sign": ({}, {"set": "fit.rate"}, r"'fit.rate' is not of the form stage.parameter=value"),
    "variant": ({}, {"variant": "x"}, r"pipeline.yaml: unknown variant 'x'; known: strong, same"),
    "profile": ({}, {"profile": "laptp"}, r"unknown profile 'laptp'; did you mean 'laptop'"),
    "scene.yaml key": ({"data/toy/scene.yaml": "shft: 1"}, {}, r"toy/scene.yaml: unknown key 'shft'; .*'shift'"),
    "scene.yaml value": ({"data/toy/scene.yaml": "shift: a"}, {}, r"toy/scene.yaml: poses.shift = 'a'"),
    "scene.yaml stage": ({"data/toy/scene.yaml": "stages: {fi: {}}"}, {}, r"scene.yaml: stages: unknown stage 'fi'"),
    "scene.yaml syntax": ({"data/toy/scene.yaml": "a: [1"}, {}, r"toy/scene.yaml: not valid YAML"),
    "scene.yaml list": ({"data/toy/scene.yaml": "- 1"}, {}, r"scene.yaml: expected `key: value`"),
    "weights": ({}, {"set": "distill.prior=./none"}, r"distill.prior: no weights at .*none; name a folder, a file"),
    "no GPU": ({}, {"set": "fit.device=cuda"}, r"fit: fit.device is cuda, .*no CUDA driver: profile=laptop"),
    "missing input": ({"data/void/x": ""}, {"scene": "void"}, r"poses: .*void: no number.txt; write one"),
    "pipeline": ({"pipeline.yaml": "stages: {a: {needs: [b]}}"}, {}, r"pipeline.yaml: "),
    "pipeline need": (
        {"pipeline.yaml": "scene_keys: {}\nprofiles: {}\nstages: {a: {needs: [b]}}"}, {},
        r"pipeline.yaml: stage a names 'b', which is not a stage before it"),
    "no stage file": (
        {"pipeline.yaml": "scene_keys: {}\nprofiles: {laptop: {}}\nstages: {lost: {needs: [scene]}}"}, {},
        r"stages/lost.py: no such file"),
    "broken stage": ({"stages/fit.py": "import nowhere"}, {}, r"stages/fit.py: ModuleNotFoundError"),
    "broken library": ({"reffusion/numbers.py": "def"}, {}, r"numbers.py:1: not valid Python"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSALS)
def test_refused_in_one_line_before_any_work(empty_project, case):
    files, options, message = REFUSALS[case]
    write_files(empty_project, files)
    with pytest.raises(Refused, match=message) as caught:
        run_scene(make_request(empty_project, **{"scene": "toy", **options}), "all")
    assert "\n" not in str(caught.value)
    assert not list((empty_project / "runs").glob("*/*/receipt.json"))


def test_a_cache_made_on_a_gpu_holds_without_one(project, monkeypatch):
    monkeypatch.setattr("runner.plan.has_cuda", lambda: True)
    run_scene(make_request(project, set="fit.device=cuda"), "fit")
    monkeypatch.setattr("runner.plan.has_cuda", lambda: False)
    assert statuses(project, set="fit.device=cuda")["fit"].startswith("cached")
    assert statuses(project, set="fit.device=cuda fit.rate=9")["fit"].startswith("missing")


def test_two_folders_of_one_name(project, tmp_path):
    write_files(tmp_path, {"elsewhere/toy/number.txt": "4"})
    with pytest.raises(Refused, match=r"two scenes are called 'toy': .*data/toy.*elsewhere/toy"):
        resolve(make_request(project, scene=str(tmp_path / "elsewhere/toy")))
    shutil.rmtree(project / "data/toy")  # now the scene is moved and has no copy
    assert set(statuses(project, scene=str(tmp_path / "elsewhere/toy")).values()) == {"cached"}


def test_clean(project, capsys):
    run_scene(make_request(project, variant="strong"), "distill")
    maintenance.clean(make_request(project, variant="strong"))
    assert (project / "runs/toy").exists() and not (project / "runs/toy@strong").exists()
    maintenance.clean(make_request(project, scene=str(project / "data/toy")))
    assert not (project / "runs/toy").exists()
    assert "removing" in (log := capsys.readouterr().out) and "runs/toy: distill, evaluate, fit, masks, poses" in log
    maintenance.clean(make_request(project))
    assert "nothing was computed for toy" in capsys.readouterr().out
    run_scene(make_request(project), "fit")
    shutil.rmtree(project / "data/toy")
    maintenance.clean(make_request(project))
    assert not (project / "runs/toy").exists()


def test_clean_removes_only_what_it_was_asked_for_by_name(project):
    run_scene(make_request(project, variant="strong"), "distill")
    write_files(project, {"runs/mine/notes.txt": "no scene's"})
    before = sorted(project.rglob("*"))
    for name in ("*", "to*", "[t]oy", ".locks", "..", ".", "/", "data/..", "toy@strong", "tyo", "toys", "mine"):
        with pytest.raises(Refused, match="toy"):
            maintenance.clean(make_request(project, scene=name))
    for variant in ("*", "../toy", "string"):
        with pytest.raises(Refused, match=r"unknown variant .*strong"):
            maintenance.clean(make_request(project, variant=variant))
    assert sorted(project.rglob("*")) == before


def test_clean_and_a_rerun_leave_what_people_put_there(project, tmp_path, capsys):
    mine = {"notes.txt": "1", "fit/notes.txt": "2", "to_paint/a.png": "3", "report/x.txt": "5"}
    pages = ("report/index.html", "adapted/sheet.png", "adapted/view/adapted.png", "sds-variance/sds_variance.json")
    write_files(project / "runs/toy", dict.fromkeys(pages, "a page") | mine)
    write_files(tmp_path, {"elsewhere/fit/gaussians.ply": "4"})
    (project / "runs/toy/linked").symlink_to(tmp_path / "elsewhere")
    assert statuses(project)["fit"] == "cached notes.txt added"
    assert run_project(capsys, project, "fit", set="fit.rate=3") == ["fit"]
    assert (project / "runs/toy/fit/notes.txt").read_text() == "2"
    (project / "runs/toy/poses/number.txt").write_text("9")
    maintenance.clean(make_request(project))
    assert "kept, as it was not made by the runner: " in capsys.readouterr().out
    home = project / "runs/toy"
    remaining = {path.relative_to(home).as_posix() for path in home.rglob("*") if path.is_file()}
    assert remaining == {"notes.txt", "report/x.txt", "fit/notes.txt", "to_paint/a.png", "poses/number.txt"}
    assert (tmp_path / "elsewhere/fit/gaussians.ply").read_text() == "4"
    assert run_project(capsys, project, "fit") == ["poses", "fit"]
    assert (home / "fit/notes.txt").exists() and (home / "kept/poses/number.txt").read_text() == "9"


# ------------------------------------------------------------------------------------------------------------- batch


def test_batch_goes_on_after_a_failed_scene(project, capsys):
    write_files(project, {"data/bad/number.txt": "1", "data/bad/broken": "", "data/wide/number.txt": "6"})
    assert compare.batch(make_request(project, scene=""), project / "data") == 1
    output = capsys.readouterr().out
    assert "failed: bad: poses: " in output and "2 of 3 scenes done" in output
    lines = (project / "runs/results.csv").read_text().split()
    assert lines[0] == "scene,state,psnr_box,lpips_vgg_box"
    rows = {line.split(",")[0]: line.split(",")[1:] for line in lines[1:]}
    assert rows["toy"] == ["done", "10.0000", ""] and rows["wide"] == ["done", "12.0000", ""]
    assert rows["bad"] == ["failed", "", ""]
    assert (project / "runs/results.md").read_text().splitlines()[-1] == "| mean of 2 |  | 11.0000 |  |"


WEIGHTS = """

def needed_weights(params, brings):
    from reffusion.need import Need
    here = Path("fetched.txt").exists()
    if "gaussians" in brings:
        return []
    return [Need("acme/net", None if here else "acme/net is not here", 2_600_000_000),
            Need("metric.pth", None if here else "metric.pth is not here", 5000, optional=True)]
"""
NEED = """
from dataclasses import dataclass
from pathlib import Path

@dataclass
class Need:
    name: str
    problem: str | None
    bytes: int | None = None
    can_download: bool = True
    optional: bool = False

    def fetch(self):
        if Path("unreachable").exists():
            raise ValueError(f"{self.name}: nobody answers")
        Path("fetched.txt").write_text("x")
"""


def test_missing_weights_are_reported_before_any_work_and_fetched(empty_project, capsys):
    from runner.fleet.weights import fetch_weights

    source = empty_project / "stages" / "distill.py"
    source.write_text(source.read_text() + WEIGHTS)
    (empty_project / "reffusion" / "need.py").write_text(NEED)
    assert (
        statuses(empty_project)["distill"]
        == "missing acme/net is not here; `make weights profile=laptop` fetches it (2.6 GB)"
    )
    with pytest.raises(Refused, match="acme/net is not here"):
        run_scene(make_request(empty_project), "all")
    output = capsys.readouterr().out
    assert "toy (profile laptop: asked for)" in output
    assert "weights to fetch: 2.6 GB, by `make weights profile=laptop`" in output
    assert not (empty_project / "runs" / "toy" / "poses").exists()

    everything = make_request(empty_project, scene="")
    assert fetch_weights(everything, offline=True) == 1
    output = capsys.readouterr().out
    assert "to fetch         2.6 GB  acme/net  (distill)" in output and "5 kB  metric.pth" in output
    (empty_project / "unreachable").touch()
    assert fetch_weights(everything, offline=False) == 2
    (empty_project / "unreachable").unlink()
    assert fetch_weights(everything, offline=False) == 0 and (empty_project / "fetched.txt").exists()
    assert fetch_weights(everything, offline=False) == 0
    assert "to fetch: about 0 bytes" in capsys.readouterr().out
    assert not statuses(empty_project)["distill"].startswith("missing")


# ------------------------------------------------------------------------------------------------- nested parameters

NESTED = """
from pathlib import Path
from pydantic import BaseModel, ConfigDict, Field

class Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

class Lora(Part):
    rank: int = Field(4, ge=1)
    model: str = Field("weights", json_schema_extra={"weights": True})

class Sds(Part):
    weight: float = 1.0
    lora: Lora = Lora()

class Params(Part):
    gain: int = 1
    sds: Sds = Sds()
    extra: str | dict | list | None = None
    checkpoint_seconds: float = Field(60.0, json_schema_extra={"keyed": False})

def run(params: Params, out: Path, *, fit: Path, masks: Path) -> None:
    (out / "gaussians.ply").write_text(str(int((fit / "gaussians.ply").read_text()) * params.gain))
"""
NESTING = {
    "stages/distill.py": NESTED,
    "pipeline.yaml": RUNNER_FILES["pipeline.yaml"]
    .replace("{param: distill.gain, equals: 0", "{param: distill.sds.weight, equals: 0")
    .replace("poses: [shift, gaussians]", "poses: [shift, gaussians], distill: [extra]")
    .replace("laptop: {fit: {rate: 2}}", "laptop: {fit: {rate: 2}, distill: {sds: {weight: 0.5, lora: {rank: 8}}}}")
    .replace("same: {}", "same: {}, ranked: {distill: {sds: {lora: {rank: 2}}}}"),
}


def resolve_params(project: Path, stage: str = "distill", **options) -> dict:
    return resolve(make_request(project, **options)).params[stage]


def test_groups_merge_layer_over_layer(empty_project):
    write_files(
        empty_project,
        {**NESTING, "data/toy/scene.yaml": "extra: {view: a, depth: b}\nstages: {distill: {sds: {weight: 2}}}"},
    )
    model = {"model": "weights"}
    assert resolve_params(empty_project)["sds"] == {"weight": 2.0, "lora": {"rank": 8, **model}}
    assert resolve_params(empty_project, variant="ranked")["sds"] == {"weight": 2.0, "lora": {"rank": 2, **model}}
    params = resolve_params(
        empty_project, variant="ranked", set="distill.sds.lora.rank=3 distill.sds.weight=4 distill.gain=2"
    )
    assert params["sds"] == {"weight": 4.0, "lora": {"rank": 3, **model}} and params["gain"] == 2
    assert resolve_params(empty_project)["extra"] == {"view": "a", "depth": "b"}
    # `extra` is a single value and not a group of parameters, so the new value replaces the whole old one.
    assert resolve_params(empty_project, set="distill.extra='{view: c}'")["extra"] == {"view": "c"}
    assert resolve_params(empty_project, set="distill.extra=[1,2]")["extra"] == ["1", "2"]


def test_nested_parameters_rerun_and_leave_out_by_their_dotted_names(empty_project, capsys):
    write_files(empty_project, NESTING)
    run_project(capsys, empty_project, "distill")
    states = statuses(empty_project, set="distill.sds.lora.rank=9 distill.sds.weight=3")
    assert states["distill"] == "run param sds.lora.rank 8 -> 9, param sds.weight 0.5 -> 3.0"
    assert statuses(empty_project, set="distill.sds.weight=0")["distill"] == "skip no gain"
    lost = statuses(empty_project, set="distill.sds.lora.model=./none")["distill"]
    assert lost.startswith("missing distill.sds.lora.model: no weights at ")
    (empty_project / "weights/model.bin").write_text("v")
    assert statuses(empty_project)["distill"] == "run weights sds.lora.model changed"


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ("distill.sds.wieght=1", r"set: stage distill: unknown parameter 'sds.wieght'; did you mean 'sds.weight'\?"),
        ("distill.sds_weight=1", r"set: stage distill: unknown parameter 'sds_weight'; did you mean 'sds.weight'\?"),
        ("distill.sdss.weight=1", r"set: stage distill: unknown parameter 'sdss.weight'; did you mean 'sds.weight'\?"),
        ("distill.sds.lora.rank=0", r"set: distill.sds.lora.rank = 0: .*greater than or equal to 1"),
        ("distill.sds=1", r"set: distill.sds = 1: "),
        ("distill.sds.=1", r"is not of the form stage.parameter=value"),
    ],
)
def test_wrong_nested_parameters_are_named_with_their_layer(empty_project, asked, message):
    write_files(empty_project, NESTING)
    with pytest.raises(Refused, match=message):
        resolve(make_request(empty_project, set=asked))


def test_the_layer_that_asked_last_is_named(empty_project):
    write_files(empty_project, {**NESTING, "data/toy/scene.yaml": "stages: {distill: {sds: {weight: much}}}"})
    with pytest.raises(Refused, match=r"toy/scene.yaml: stages: distill.sds.weight = 'much'"):
        resolve(make_request(empty_project, set="distill.sds.lora.rank=3"))
    with pytest.raises(Refused, match=r"set: distill.sds.weight = 'more'"):
        resolve(make_request(empty_project, set="distill.sds.weight=more"))


# -------------------------------------------------------------------------------------------------------------- keys


def test_a_parameter_that_is_no_part_of_the_key_reruns_nothing(empty_project, capsys):
    write_files(empty_project, NESTING)
    run_project(capsys, empty_project, "distill")
    assert statuses(empty_project, set="distill.checkpoint_seconds=5")["distill"] == "cached"
    receipt = json.loads((empty_project / "runs/toy/distill/receipt.json").read_text())
    assert receipt["params"]["checkpoint_seconds"] == 60.0 and receipt["unkeyed"] == ["checkpoint_seconds"]


def test_profiles_that_set_the_same_share_artifacts_and_old_receipts_hold(project, capsys):
    replace_text(project / "pipeline.yaml", "paper: {}", "paper: {fit: {rate: 2}}")
    assert set(statuses(project, profile="paper").values()) == {"cached"}
    # Imitate receipts of older versions, in which the profile was a part of the key.
    for path in (project / "runs/toy").glob("*/receipt.json"):
        found = json.loads(path.read_text())
        del found["unkeyed"]
        path.write_text(json.dumps(found | {"key": "0" * 20}))
    assert run_project(capsys, project, profile="paper") == []
    assert statuses(project, set="fit.rate=3")["fit"] == "run param rate 2 -> 3"


# ---------------------------------------------------------------------------------------------- plan modules of stages

PLANNED = {
    "stages/plan/__init__.py": "",
    "stages/plan/fit.py": """
from pydantic import BaseModel, ConfigDict, Field

class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    iterations: int = Field(3, ge=1)
    rate: int = 1

def preview(params, poses):
    return [f"{params.iterations} steps"]
""",
    "stages/fit.py": """
import heavy
from typing import TYPE_CHECKING
from reffusion.optimize import step
if TYPE_CHECKING:
    from stages.plan.fit import Params

def run(params: "Params", out, *, poses):
    number = 0
    for _ in range(params.iterations):
        number = step(number, params.rate)
    (out / "gaussians.ply").write_text(str(number + int((poses / "number.txt").read_text())))
""",
    "heavy.py": "import os\nopen(os.environ['HEAVY'], 'a').write('x')\n",
}


def test_a_stage_is_described_in_its_plan_module_and_that_is_no_part_of_its_code(empty_project, capsys, monkeypatch):
    imported = empty_project / "imported.txt"
    monkeypatch.setenv("HEAVY", str(imported))
    write_files(empty_project, PLANNED)
    run_scene(make_request(empty_project), "poses")
    job = resolve(make_request(empty_project))
    assert "3 steps" in plan_table(job, plan(job, ["poses", "fit"])) and not imported.exists()
    # Only the process that runs the stage imports `heavy`.
    assert "fit" in run_project(capsys, empty_project) and imported.read_text() == "x"
    assert read_score(empty_project) == 10.0
    code = json.loads((empty_project / "runs/toy/fit/receipt.json").read_text())["code"]
    assert "stages/fit.py" in code and not any("plan" in name for name in code)
    replace_text(empty_project / "stages/plan/fit.py", 'steps"]', 'steps of"]')
    assert set(statuses(empty_project).values()) == {"cached"}
    replace_text(empty_project / "stages/plan/fit.py", "rate: int = 1", "rate: int = 1\n    slope: int = 1")
    assert statuses(empty_project)["fit"] == "run param slope is new"
    replace_text(empty_project / "stages/fit.py", "import heavy", "import heavy\nfrom stages.plan import fit")
    # Now the stage imports its plan module, so this module is a part of the stage's code.
    assert "stages/plan/fit.py" in code_fingerprints(empty_project, "fit", Hashes(empty_project / "hashes"))


def test_a_run_that_does_not_fit_its_needs_is_refused_without_importing_it(empty_project, monkeypatch):
    monkeypatch.setenv("HEAVY", str(empty_project / "imported.txt"))
    write_files(empty_project, PLANNED)
    replace_text(empty_project / "stages/fit.py", "*, poses", "*, poses, masks")
    with pytest.raises(Refused, match=r"stages/fit.py: run\(\) and pipeline.yaml do not agree on its needs: masks"):
        run_scene(make_request(empty_project), "fit")
    assert not (empty_project / "imported.txt").exists()


# ------------------------------------------------------------------------------------------------- questions to stages


@pytest.fixture
def worker_starts(monkeypatch) -> list[str]:
    """Return a list that collects the purpose of each process that the runner starts to import stages."""
    started, start = [], process.start_worker
    monkeypatch.setattr(process, "start_worker", lambda *args, **how: started.append(args[1]) or start(*args, **how))
    return started


def test_stages_are_asked_once_for_the_same_inputs(project, capsys, worker_starts):
    assert compare.compare(make_request(project), "full,same") == 0
    assert len(worker_starts) == 1 and ": done in" not in capsys.readouterr().out
    replace_text(project / "data/toy/number.txt", "4", "5")
    assert compare.compare(make_request(project), "full,same") == 0
    # The scene changed, so stages are asked again which files they read and what they will do.
    assert len(worker_starts) > 2


def test_descriptions_of_parameters_are_cached_until_the_code_changes(project, worker_starts):
    statuses(project)  # the first call in this folder fills the cache
    del worker_starts[:]
    assert set(statuses(project).values()) == {"cached"} and worker_starts == []
    assert statuses(project, set="fit.rate=3")["fit"] == "run param rate 2 -> 3" and worker_starts == ["describe"] * 2
    # The description of parameters is cached; the preview of a stage that will run is asked again.
    assert statuses(project, set="fit.rate=3")["fit"].startswith("run") and worker_starts == ["describe"] * 3
    replace_text(project / "stages/fit.py", "rate: int = 1", "rate: int = 1\n    slope: int = 1")
    assert statuses(project)["fit"] == "run param slope is new, code of stages/fit.py changed"
    assert statuses(project, set="fit.slope=2")["poses"] == "cached"
    write_files(project, {"stages/fit.py": "import nowhere"})
    with pytest.raises(Refused, match=r"stages/fit.py: ModuleNotFoundError"):
        statuses(project)


def test_a_stage_that_cannot_be_imported_any_more_is_refused_before_any_work(empty_project):
    replace_text(empty_project / "stages/distill.py", "from pydantic", "import installed\nfrom pydantic")
    write_files(empty_project, {"installed.py": ""})
    assert statuses(empty_project)["distill"].startswith("pending")
    (empty_project / "installed.py").unlink()
    with pytest.raises(Refused, match=r"stages/distill.py: ModuleNotFoundError.*installed"):
        run_scene(make_request(empty_project), "all")
    assert not (empty_project / "runs/toy/poses").exists()


def test_which_files_a_stage_reads_is_asked_again_only_where_something_changed(project):
    reads = "def scene_files(params, scene, files):\n    {}\n    return files\n\ndef preview("
    replace_text(project / "stages/poses.py", "def preview(", reads.format("open('asked.txt', 'a').write('x')"))
    for _ in range(2):
        statuses(project)
    assert (project / "asked.txt").read_text() == "x"
    write_files(project, {"data/toy/new.txt": ""})
    assert (
        statuses(project)["poses"].startswith("run the scene's files changed")
        and (project / "asked.txt").read_text() == "xx"
    )
    replace_text(project / "stages/poses.py", "return files", "return files[:1]")
    statuses(project)
    assert (project / "asked.txt").read_text() == "xxx"
