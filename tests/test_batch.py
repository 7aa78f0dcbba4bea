"""Several scenes at once on a toy pipeline: cores, memory, progress, interruptions, and reuse by a second call."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from scenes.browser import open_page
from scenes.toy_projects import COMPARE_FILES, make_request, write_project

from report import batch as page
from runner import Refused
from runner.execute import Execution, run_scene
from runner.fleet.compare import batch, compare
from runner.fleet.engine import LocalEngine, make_engine
from runner.fleet.progress import Progress
from runner.resolve import Request

pytestmark = pytest.mark.integration

REPO = Path(__file__).resolve().parent.parent
STAGE = COMPARE_FILES["stages/distill.py"].replace(
    "    time.sleep(params.pause)\n",
    """    import os
    begun = time.time()
    (out.parent.parent / f"begun-{out.parent.name}").touch()
    while len(list(out.parent.parent.glob("begun-*"))) < params.meet and time.time() < begun + 60:
        time.sleep(0.05)
    time.sleep(params.pause)
    threads, cores = os.environ.get("OMP_NUM_THREADS"), sorted(os.sched_getaffinity(0))
    with open(out.parent.parent / "spans.txt", "a") as file:
        file.write(json.dumps([begun, time.time(), threads, cores]) + "\\n")
""",
)
ONE_STAGE = """
scene_keys: {}
stages: {distill: {needs: [scene]}}
profiles: {laptop: {}}
variants: {better: {distill: {gain: 3}}}
"""


def write_projects(root: Path, pause: float = 0.0, meet: int = 0, scenes: str = "abcd") -> Path:
    """Write a toy project with the scenes a to d; scene c is unreadable.

    Args:
        root: the folder to write to.
        pause: seconds that the stage `distill` takes.
        meet: `distill` waits until this many scenes have begun `distill`.
        scenes: names of the scenes, a letter each.
    """
    write_project(root)
    (root / "stages/distill.py").write_text(
        STAGE.replace("pause: float = 0.0", f"pause: float = {pause}\n    meet: int = {meet}")
    )
    for number, name in enumerate(scenes):
        (root / "many" / name).mkdir(parents=True)
        (root / "many" / name / "number.txt").write_text("none" if name == "c" else str(10 * number))
    return root


def write_one_stage(root: Path, pause: float = 0.0, meet: int = 0, more: str = "", scenes: str = "abd") -> Path:
    """Write a toy project with the stage `distill` alone; `more` is appended to pipeline.yaml."""
    write_projects(root, pause, meet, scenes)
    (root / "pipeline.yaml").write_text(ONE_STAGE + more)
    stage = (root / "stages/distill.py").read_text()
    (root / "stages/distill.py").write_text(stage.replace("*, poses", "*, scene"))
    return root


def read_spans(root: Path) -> list[list]:
    return [json.loads(line) for line in (root / "runs/spans.txt").read_text().splitlines()]


def max_concurrent(found: list[list]) -> int:
    return max(sum(a <= begun < b for a, b, *_ in found) for begun, *_ in found)


def local_engine(cores: int, memory_mb: int = 10_000, gpus: tuple[str, ...] = ()) -> LocalEngine:
    """Return an engine with this many cores, even if the machine has fewer: a core then appears several times."""
    real = sorted(os.sched_getaffinity(0))
    return LocalEngine([real[n % len(real)] for n in range(cores)], memory_mb, list(gpus))


def test_several_at_once_and_a_second_call_runs_what_failed(tmp_path, capsys):
    root = write_projects(tmp_path, meet=3)
    assert batch(make_request(root, ""), root / "many", Execution(local_engine(4))) == 1
    output = capsys.readouterr().out
    assert "4 scenes, 4 at once, 1 core each" in output
    assert re.search(r"^\d\d:\d\d:\d\d a: distill", output, re.MULTILINE)
    assert "failed: c: poses: ValueError" in output or "failed: c: poses: invalid literal" in output
    found = read_spans(root)
    assert len(found) == 3 and max_concurrent(found) == 3
    assert {threads for _, _, threads, _ in found} == {"1"} and {len(cores) for *_, cores in found} == {1}
    runs = {run["scene"]: run for run in json.loads((root / "runs/results.json").read_text())["runs"]}
    assert runs["c"]["state"] == "failed" and "invalid literal" in runs["c"]["error"]
    assert (root / "runs/results.md").read_text().startswith("- c failed: poses: ")
    assert "c,failed," in (root / "runs/results.csv").read_text()
    assert "poses: done in" in (root / "runs/a/output.log").read_text()
    (root / "many/c/number.txt").write_text("20")
    assert batch(make_request(root, ""), root / "many", Execution(local_engine(4))) == 0
    assert len(read_spans(root)) == 4 and "failed" not in (root / "runs/results.md").read_text()
    (root / "alone").mkdir()
    for other in "ac":  # `distill` waits for three scenes
        (root / f"alone/begun-{other}").touch()
    alone = Request(root, root / "alone", str(root / "many/b"), "laptop")
    run_scene(alone, "all")
    for path in (root / "alone/b").glob("*/*.json"):
        if path.name not in ("receipt.json", "compare.json"):
            assert path.read_bytes() == (root / "runs/b" / path.relative_to(root / "alone/b")).read_bytes()


@pytest.mark.parametrize("cores, memory_mb, most", [(2, 10_000, 2), (4, 1300, 2), (4, 100, 1)])
def test_never_more_than_there_are_cores_or_memory(tmp_path, cores, memory_mb, most):
    """pipeline.yaml gives `distill` 600 MB, and 100 MB for each MB of its input, which is almost empty here.

    One stage runs alone if the engine has less than 600 MB.
    """
    root = write_one_stage(tmp_path, 0.5, more="memory: {distill: {mb: 600, each: 100}}\n")
    batch(make_request(root, ""), root / "many", Execution(local_engine(cores, memory_mb), 1))
    assert len(read_spans(root)) == 3 and max_concurrent(read_spans(root)) <= most


def test_a_stage_killed_beside_others_is_retried_alone(tmp_path):
    """`distill` of scene d is killed once while it runs beside other scenes, as when memory runs out."""
    root = write_one_stage(tmp_path, meet=3)
    stage = (root / "stages/distill.py").read_text()
    kill = """    if out.parent.name == "d" and not (out.parent.parent / "killed").exists():
        (out.parent.parent / "killed").touch()
        os.kill(os.getpid(), 9)
    while not (out.parent.parent / "killed").exists():
        time.sleep(0.05)
    time.sleep(params.pause)
"""
    (root / "stages/distill.py").write_text(stage.replace("    time.sleep(params.pause)\n", kill))
    assert batch(make_request(root, ""), root / "many", Execution(local_engine(4))) == 0
    assert len(read_spans(root)) == 3 and max_concurrent(read_spans(root)[-1:]) == 1


def test_cores_are_as_asked_for(tmp_path):
    root = write_one_stage(tmp_path)
    batch(make_request(root, "", variant="better"), root / "many", Execution(local_engine(4), 2))
    assert {threads for _, _, threads, _ in read_spans(root)} == {"2"}
    assert (root / "runs/results@better.csv").is_file()


@pytest.mark.parametrize("gpus, threads", [(1, "6"), (2, "4")])
def test_stages_that_share_a_gpu_get_more_cores(tmp_path, gpus, threads):
    """Four scenes share twelve cores. At most as many stages as there are GPUs have one."""
    root = write_one_stage(tmp_path, 0.3, scenes="abde")
    (root / "stages/distill.py").write_text(
        (root / "stages/distill.py")
        .read_text()
        .replace("    pause: float", '    device: str = "cuda"\n    pause: float')
    )
    engine = local_engine(12, gpus=tuple("01"[:gpus]))
    assert batch(make_request(root, "", cuda=True), root / "many", Execution(engine)) == 0
    found = read_spans(root)
    assert {each for _, _, each, _ in found} == {threads} and max_concurrent(found) <= gpus


def test_variants_of_several_scenes_at_once(tmp_path):
    root = write_projects(tmp_path, 0.1, scenes="bc")
    assert (
        compare(make_request(root, ""), "better,twin", data=root / "many", execution=Execution(local_engine(4))) == 3
    )  # scene c fails with each of the three methods
    lines = (root / "runs/ran.txt").read_text().splitlines()
    assert sorted(lines) == sorted(set(lines)), "what is equal is done once"
    record = json.loads((root / "runs/compare/compare.json").read_text())
    assert [run["state"] for run in record["runs"]].count("done") == 3


def test_stopped_while_several_run(tmp_path):
    root = write_projects(tmp_path, 60)
    code = "import sys; from test_batch import *; signal.signal(signal.SIGINT, signal.default_int_handler);"
    code = f"{code} batch(make_request(Path(sys.argv[1]), ''), Path(sys.argv[1]) / 'many',"
    code = f"{code} Execution(local_engine(4)))"
    environment = {**os.environ, "PYTHONPATH": f"{REPO}:{REPO}/tests"}
    process = subprocess.Popen([sys.executable, "-c", code, str(root)], env=environment, stderr=subprocess.DEVNULL)
    until = time.monotonic() + 60
    while len(list((root / "runs").glob("*/.partial-distill-*"))) < 3:
        assert time.monotonic() < until and process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    assert process.wait(30) != 0
    assert not (root / "runs/spans.txt").exists()
    assert not subprocess.run(["pgrep", "-f", f"runner.worker run.*{root}"], capture_output=True).stdout
    (root / "stages/distill.py").write_text(COMPARE_FILES["stages/distill.py"])
    assert batch(make_request(root, ""), root / "many", Execution(local_engine(4))) == 1
    assert (root / "runs/ran.txt").read_text().count("poses") == 3


def test_work_finished_at_an_interruption_is_not_repeated(tmp_path):
    """`distill` ignores Ctrl-C and ends, so its result is kept. The next stage, `evaluate`, is not begun."""
    root = write_projects(tmp_path, 0.0)
    takes = "    import signal\n    signal.signal(2, signal.SIG_IGN)\n    (out / 'begun').touch()\n    time.sleep(2)\n"
    stage = COMPARE_FILES["stages/distill.py"].replace("    time.sleep(params.pause)\n", takes)
    (root / "stages/distill.py").write_text(stage)
    code = "import sys; from test_batch import *; signal.signal(signal.SIGINT, signal.default_int_handler);"
    code = f"{code} run_scene(make_request(Path(sys.argv[1])), 'all')"
    environment = {**os.environ, "PYTHONPATH": f"{REPO}:{REPO}/tests"}
    process = subprocess.Popen([sys.executable, "-c", code, str(root)], env=environment, stderr=subprocess.DEVNULL)
    until = time.monotonic() + 60
    while not list((root / "runs").glob("*/.partial-distill-*/begun")):
        assert time.monotonic() < until and process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    assert process.wait(30) != 0
    assert (root / "runs/toy/distill/receipt.json").exists()
    assert (root / "runs/ran.txt").read_text().split() == ["toy", "poses", "toy", "distill"]


def test_the_live_table(tmp_path):
    receipt = dict.fromkeys(("key", "params", "needs", "weights", "code", "output", "files"), "") | {"seconds": 60.0}
    for stage in ("fit", "evaluate"):
        (tmp_path / "old" / stage).mkdir(parents=True)
        (tmp_path / "old" / stage / "receipt.json").write_text(json.dumps(receipt))
    names = ["garden", "bear", "statue", "fox"]
    progress = Progress(names, [tmp_path / "old"], ["fit", "evaluate"], 2, "4 scenes")
    progress.update(0, "fit", "runs")
    progress.update(1, "fit", "waits")
    progress.end(2, "fit: masks/x.png has another size", 3.0)
    lines = progress.table(80, 24)
    assert lines[0].startswith("0 of 4 done, 1 failed, 180 s left") or lines[0].startswith(
        "0 of 4 done, 1 failed, 3 min"
    )
    assert lines[1].startswith("garden  fit          for 0 s; ") and "left of all its stages" in lines[1]
    assert lines[2].split() == ["bear", "fit", "waits", "for", "cores", "or", "memory"]
    assert lines[3] == "statue  failed: fit: masks/x.png has another size"
    assert [len(line) <= 19 for line in progress.table(20, 24)] == [True] * 4
    assert progress.table(80, 5)[-1] == "and 1 more"


def test_the_page_of_a_batch(tmp_path, capsys):
    root = write_projects(tmp_path, 0.0)
    batch(make_request(root, ""), root / "many", Execution(local_engine(2)))
    made = page.make(root / "runs/results.json")
    with open_page(made.as_uri()) as browser:
        assert "3 of 4 scenes done, 1 failed" in browser.inner_text("body")
        assert "failed: poses: " in browser.inner_text("tr:has-text('c') td.text")
        assert browser.evaluate("[...document.images].every(i => i.naturalWidth == 240)")
        assert browser.locator("img").count() == 3
    with pytest.raises(ValueError, match="`make data=FOLDER batch` writes it"):
        page.make(tmp_path / "none/results.json")


@pytest.mark.parametrize(
    "name, address, message",
    [("slrum", None, "unknown"), (None, "here:6379", "of which engine"), ("local", "here", "of which engine")],
)
def test_missing_engines_are_refused(tmp_path, name, address, message):
    with pytest.raises(Refused, match=message):
        make_engine(name, address, tmp_path, tmp_path)
