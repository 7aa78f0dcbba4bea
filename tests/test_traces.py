"""Error over run time: traces of stages, their clock, kills and checkpoints, time budgets, the regression gate."""

import copy
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from pydantic import ValidationError
from safetensors.torch import load_file
from scenes.networks import save_small_prior
from scenes.stage_runs import run_through_initialize, trace_lines

from lab.bench import gate
from lab.bench.points import Diagram, Point, recommendation
from reffusion import trace
from reffusion.depth.background_depth import CompletionSettings
from reffusion.initialize import fill
from reffusion.io.ply import load_ply
from reffusion.io.traces import MAIN, load_trace
from reffusion.types import PARAMETERS
from runner import Refused
from runner.parameters import parse_duration, split_budget, stack_layers
from runner.pipeline import load_pipeline, load_scene_file
from stages import distill, fit, personalize

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent
NEAR = 1.7
FIT = {"iterations": 40, "sh.degree": 0, "densify.cap_max": 500, "holdout": 3, "densify.stop": 0.3}
PERSONALIZE = {
    "steps": 10, "optimizer": {"batch": 2, "lr_unet": 1e-3}, "lora": {"rank": 2, "alpha": 4}, "samples": {"size": 16},
}  # fmt: skip
OFF = {"weight": 0}
DISTILL = {"iterations": 8, "sds": OFF, "adversarial": OFF, "depth": OFF, "reference": {"weight": 1}}


@pytest.fixture(scope="module")
def initialized_folders(tmp_path_factory):
    """The folders of a small scene up to `initialize`, and of a random prior."""
    home = tmp_path_factory.mktemp("scene")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(fill, "COMPLETION", CompletionSettings(planar_share=2.0))  # no planes, so that both solvers run
        folders = run_through_initialize(home, NEAR)
    save_small_prior(home / "prior")
    return folders | {"prior": home / "prior"}


def test_the_line_of_a_violation_is_that_of_the_file(tmp_path):
    lines = ['{"seconds": 1, "iteration": 0}', '{"seconds": 2, "iter', '{"seconds": 3, "iteration": 1, "pace": 1}']
    (tmp_path / "trace.jsonl").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"line 3: unknown quantity 'pace'"):
        load_trace(tmp_path / "trace.jsonl", "fit")


def run_stage(stage: str, initialized_folders, out: Path, **changed) -> Path:
    """Run an iterative stage on the small scene into the folder `out`; return this folder."""
    out.mkdir(parents=True, exist_ok=True)
    if stage == "fit":
        fit.run(fit.Params().changed(FIT | changed), out, poses=initialized_folders["poses"])
    elif stage == "personalize":
        params = personalize.Params(**{**PERSONALIZE, "prior": str(initialized_folders["prior"]), **changed})
        poses, reference = initialized_folders["poses"], initialized_folders["reference"]
        personalize.run(params, out, poses=poses, raw_masks=poses.with_name("raw_masks"), reference=reference)
    else:
        needs = {name: folder for name, folder in initialized_folders.items() if name != "prior"}
        distill.run(distill.Params(**{**DISTILL, **changed}), out, personalize=None, **needs)
    return out


def load_result(folder: Path) -> list[torch.Tensor]:
    """Return the tensors of a stage's result. Files are not compared, because the header of a LoRA file differs."""
    if (folder / "gaussians.ply").exists():
        gaussians = load_ply(folder / "gaussians.ply")
        return [getattr(gaussians, name) for name in PARAMETERS]
    weights = load_file(folder / "pytorch_lora_weights.safetensors")
    return [weights[name] for name in sorted(weights)]


def has_same_result(one: Path, other: Path) -> bool:
    pairs = list(zip(load_result(one), load_result(other), strict=True))
    return all(torch.equal(a, b) for a, b in pairs) and trace_lines(one) == trace_lines(other)


# ------------------------------------------------------------------------------------------------------ the schema


@pytest.mark.parametrize("stage", ["fit", "personalize", "distill"])
def test_a_stages_trace_follows_the_schema(initialized_folders, tmp_path, stage):
    series = load_trace(run_stage(stage, initialized_folders, tmp_path / stage) / "trace.jsonl", stage)
    found = series.pop("")
    assert not series and found[0]["iteration"] == 0
    steps = {"fit": 40, "personalize": 10, "distill": 8}[stage]
    assert found[-1]["iteration"] == steps
    assert found[-1]["reason"] == "finished" and all("reason" not in line for line in found[:-1])
    assert len(found) >= 5 and all(MAIN[stage][0] in line for line in found)


def test_fit_without_held_out_views_is_judged_by_views_before_their_step(initialized_folders, tmp_path):
    found = load_trace(run_stage("fit", initialized_folders, tmp_path / "fit", holdout=0) / "trace.jsonl", "fit")[""]
    assert MAIN["fit"] == ("psnr_held_out", "psnr") and "psnr_held_out" not in found[1]
    assert "psnr" not in found[0] and "psnr" in found[1]


def test_the_solvers_of_initialize_are_traced_against_points_they_do_not_get(initialized_folders):
    series = load_trace(initialized_folders["initialize"] / "trace.jsonl", "initialize")
    assert set(series) == {"planes a2", "completion a2", "bilateral a2"}
    steps = series["bilateral a2"]
    assert len(steps) > 3 and steps[-1]["reason"] == "converged"
    assert steps[-2]["residual"] < 1e-2 * steps[0]["residual"]
    assert all(0 <= line["disparity_error"] < 0.2 for line in steps)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"iteration": 2, "psnr": 1.0}, "no 'seconds'"),
        ({"seconds": 1.0, "iteration": 2}, "seconds fell"),
        ({"seconds": 3.0, "iteration": 1}, "iteration 1 after 1"),
        ({"seconds": 3.0, "iteration": 2, "psnr": float("nan")}, "psnr = nan"),
        ({"seconds": 3.0, "iteration": 2, "pnsr": 1.0}, "unknown quantity 'pnsr'"),
        ({"seconds": 3.0, "iteration": 2, "reason": "tired"}, "an end for the reason 'tired'"),
    ],
)
def test_what_does_not_follow_the_schema_is_refused_by_line(tmp_path, wrong, said):
    good = {"seconds": 2.0, "iteration": 1, "psnr": 20.0}
    (tmp_path / "trace.jsonl").write_text(f'{json.dumps(good)}\n{json.dumps(wrong)}\n{{"seconds": 9')
    with pytest.raises(ValueError, match=f"trace.jsonl: line 2: .*{said}"):
        load_trace(tmp_path / "trace.jsonl", "fit")
    with pytest.raises(ValueError, match="no such file"):
        load_trace(tmp_path / "none.jsonl", "fit")


def test_the_clock_stands_while_something_is_measured(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(trace.time, "perf_counter", lambda: now[0])
    log = trace.Trace(tmp_path, start_seconds=5.0)
    now[0] += 2
    with log.pause():
        now[0] += 50
        with log.pause():
            now[0] += 7
        now[0] += 1000
        assert log.seconds == 7
        log.log(1, psnr=1.0)
        now[0] += 10
    now[0] += 3
    log.log(2, psnr=2.0)
    assert [line["seconds"] for line in trace.read_trace(log.path)] == [7, 10]
    with pytest.raises(FloatingPointError, match="step 3: psnr is nan"):
        log.log(3, psnr=float("nan"))


# --------------------------------------------------------------------------------------------------- moments and kills


def test_moments_depend_on_the_iteration_only():
    assert [i for i in range(41) if trace.is_log_step(i, 40)] == [0, 1, 2, 3, 4, 6, 8, 12, 16, 23, 32, 40]
    assert [i for i in range(41) if trace.is_log_step(i, 40, 2, 16)] == [0, 1, 16, 23, 32, 40]
    assert [i for i in range(41) if trace.is_log_step(i, 40, 1)] == [0, 1, 2, 4, 8, 16, 32, 40]


@pytest.mark.parametrize(("saving", "every"), [(3.0, 10.0), (0.01, 10.0), (30.0, 0.1)])
def test_checkpoints_cost_under_two_percent(tmp_path, monkeypatch, saving, every):
    """A step takes 0.5 s and a checkpoint `saving` s. The first checkpoint, whose cost is unknown, does not count."""
    now, spent = [0.0], []
    monkeypatch.setattr(trace.time, "monotonic", lambda: now[0])

    def slowly(folder, state):
        now[0] += saving
        spent.append(saving)

    monkeypatch.setattr(trace, "save_checkpoint", slowly)
    checkpoints, began = trace.Checkpoints(tmp_path, every), None
    for _ in range(20_000):
        now[0] += 0.5
        if checkpoints.due:
            checkpoints.save(dict)
            began = now[0] if began is None else began
    share = sum(spent[1:]) / (now[0] - began)
    assert len(spent) > 3 and share < 0.02


@pytest.mark.parametrize("stage", ["fit", "personalize", "distill"])
def test_a_slow_disk_does_not_hold_a_stage_up(initialized_folders, tmp_path, monkeypatch, stage):
    """On a simulated clock, a checkpoint takes 0.3 s. A run of less than 15 s must write only one checkpoint."""
    now, saved = [0.0], []

    def monotonic():
        now[0] += 1e-3  # each reading takes 1 ms
        return now[0]

    def slowly(folder, state):
        now[0] += 0.3
        saved.append(folder)

    monkeypatch.setattr(trace.time, "monotonic", monotonic)
    monkeypatch.setattr(trace, "save_checkpoint", slowly)
    run_stage(stage, initialized_folders, tmp_path, checkpoint_seconds=1e-9)
    assert len(saved) == 1


# ---------------------------------------------------------------------------------------------------- time budgets


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("5m", 300), ("90s", 90), ("1h30m", 5400), ("2.5m", 150), (120, 120), ("45", 45), ("1H", 3600)],
)
def test_durations_are_parsed(text, seconds):
    assert parse_duration(text, "x") == seconds


@pytest.mark.parametrize("text", ["", "m", "5 minutes", "-5m", "0", "5x", None, "5m5", [5]])
def test_invalid_durations_are_refused(text):
    with pytest.raises(Refused, match=r"scene.yaml: budget .* like 5m"):
        parse_duration(text, "scene.yaml")


def test_a_budget_is_shared_out_and_gives_way_to_what_is_said_by_name(tmp_path):
    pipeline = load_pipeline(ROOT)
    shares = {name: share["seconds"] for name, share in split_budget(pipeline, {}, 1000.0).items()}
    assert set(shares) == {"fit", "personalize", "distill"}
    assert shares == {name: pytest.approx(1000 * part) for name, part in pipeline.budget.items()}
    less = split_budget(pipeline, {"distill": {"sds": {"weight": 0}, "depth": {"weight": 0}}}, 1000.0)
    assert "personalize" not in less and sum(s["seconds"] for s in less.values()) == pytest.approx(sum(shares.values()))
    assert less["fit"]["seconds"] / less["distill"]["seconds"] == pytest.approx(shares["fit"] / shares["distill"])
    (tmp_path / "scene.yaml").write_text("budget: 5m\nstages: {fit: {seconds: 7}}\n")
    scene = load_scene_file(tmp_path, pipeline)
    assert scene.budget == "5m"
    values = stack_layers(pipeline, scene, "laptop", None, {}, split_budget(pipeline, {}, 300.0)).values
    assert values["fit"]["seconds"] == 7 and values["distill"]["seconds"] == 300 * pipeline.budget["distill"]
    with pytest.raises(Refused, match="no table `budget`"):
        split_budget(pipeline.model_copy(update={"budget": {}}), {}, 60.0)


def test_steps_that_fit_are_counted_once(tmp_path):
    tried = []

    def trial(folder, steps):
        tried.append(folder)
        seconds = [100.0] + [100.0 + 0.5 * i for i in range(steps)]  # the first step is slow
        rows = [{"seconds": s, "iteration": i} for i, s in enumerate(seconds)]
        (folder / "trace.jsonl").write_text("\n".join(map(json.dumps, rows)))

    count = lambda name, total, seconds, spent: trace.steps_within_budget(
        tmp_path / name, total, seconds, lambda: spent, trial
    )
    assert count("a", 100, 0, 5.0) == 100 and not tried, "no budget, nothing measured"
    assert count("b", 100, 30.0, 10.0) == 40
    assert count("b", 100, 30.0, 29.0) == 40 and len(tried) == 1, "read back on a resume"
    assert json.loads((tmp_path / "b" / trace.LENGTH).read_text()) == {
        "steps": 40, "of": 100, "seconds_per_step": 0.5, "seconds": 30.0,
    }  # fmt: skip
    assert count("c", 100, 1000.0, 0.0) == 100 and count("d", 101, 1.0, 50.0) == 6
    assert not any(folder.exists() for folder in tried)


@pytest.mark.parametrize("stage", ["fit", pytest.param("personalize", marks=pytest.mark.slow), "distill"])
def test_a_budget_shortens_a_stage_and_its_schedule(initialized_folders, tmp_path, stage):
    """A budget of 1 ms gives the smallest number of steps, a twentieth. The trial run must not change the result."""
    steps = {"fit": 2, "personalize": 1, "distill": 1}[stage]
    out = run_stage(stage, initialized_folders, tmp_path / "short", seconds=1e-3)
    assert trace_lines(out)[-1]["iteration"] == steps
    assert json.loads((out / trace.LENGTH).read_text())["steps"] == steps
    expected = run_stage(
        stage, initialized_folders, tmp_path / "asked", **{"steps" if stage == "personalize" else "iterations": steps}
    )
    assert has_same_result(out, expected)


@pytest.mark.parametrize(
    "made", [lambda b: fit.Params(lr={"betas": b}), lambda b: personalize.Params(optimizer={"betas": b})]
)
@pytest.mark.parametrize("betas", [(1.0, 0.999), (0.9, -0.1), (0.9, 1.5)])
def test_betas_are_parts(made, betas):
    with pytest.raises(ValidationError, match=r"less than 1|greater than or equal to 0"):
        made(betas)


# -------------------------------------------------------------------------------------------------------- the gate


def points_of_baselines(baselines: dict) -> list[Diagram]:
    """Return the committed baselines in the form of new measurements."""
    return [
        Diagram(name, "", "", None, [Point(*key.rsplit(", ", 1), 0.0, *value) for key, value in points.items()])
        for name, points in baselines["diagrams"].items()
    ]


def test_the_gate_sees_a_planted_regression():
    baselines = gate.load(ROOT / "lab" / "bench" / "baselines.json")
    diagrams, unit = points_of_baselines(baselines), baselines["machine_unit"]
    assert gate.regressions(diagrams, unit, baselines) == []
    assert gate.regressions(diagrams, 2 * unit, baselines) == [], "a machine half as fast may take twice as long"
    name, key = "bilateral", "8 px, converged"
    better = copy.deepcopy(baselines)
    better["diagrams"][name][key][0] *= 0.95
    assert [key in line and "error" in line for line in gate.regressions(diagrams, unit, better)] == [True]
    faster = copy.deepcopy(baselines)
    faster["diagrams"][name][key][1] /= 3
    assert [key in line and "ms" in line for line in gate.regressions(diagrams, unit, faster)] == [True]
    assert gate.regressions(diagrams, unit / 3, baselines), "the same times on a machine three times as fast"
    slow = [replace(d, points=[replace(p, seconds=9.0) for p in d.points]) for d in diagrams]
    again = [gate.take_faster(one, other) for one, other in zip(slow, diagrams, strict=True)]
    assert gate.regressions(slow, unit, baselines) and gate.regressions(again, unit, baselines) == []
    more = copy.deepcopy(baselines)
    more["diagrams"][name]["8 px, step 0"] = [1.0, 1.0]
    assert "was not measured" in gate.regressions(diagrams, unit, more)[0]
    with pytest.raises(ValueError, match="--write-baselines"):
        gate.load(ROOT / "lab" / "none.json")


def test_the_recommended_setting_is_the_cheapest_that_is_as_good_as_the_best():
    points = [Point("a", "fine", 0, 1.0, 9.0), Point("a", "good", 0, 1.05, 2.0), Point("a", "rough", 0, 3.0, 1.0)]
    diagram = Diagram("d", "", "", ("a", "good"), points)
    assert "a good" in recommendation(diagram) and "It is the default" in recommendation(diagram)
    other = recommendation(replace(diagram, default=("a", "rough")))
    assert "The default, a rough, has 3" in other
