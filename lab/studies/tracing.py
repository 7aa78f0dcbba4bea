"""Cost of tracing: `python -m lab.studies.tracing --run runs/demo`.

A trace measures a stage's errors at logarithmically spaced steps. The study runs `fit`, `personalize` and `distill`
with the laptop profile in pairs: with a trace, and with one measurement at the end only. It compares CPU times, which
depend little on other processes. The pairs take --steps steps (`fit` eight times as many, with every 8th view held
out). In such short runs the measured steps are a larger share, so the last column extrapolates the cost to the
profile's full length. The exit status is 1 if this cost is over 3 % of the stage's time.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from types import ModuleType

import yaml

from reffusion import trace
from reffusion.fit.reconstruction import FIRST_TRACED_STEP
from stages import distill, fit, personalize

ROOT = Path(__file__).resolve().parents[2]

# stage -> module, name of its number of steps, the stages that it needs, (measurements per octave, first measured step)
STAGES = {
    "fit": (fit, "iterations", ("poses",), (2, FIRST_TRACED_STEP)),
    "personalize": (personalize, "steps", ("poses", "raw_masks", "reference"), (1, 1)),
    "distill": (distill, "iterations", ("poses", "fit", "masks", "reference", "personalize", "initialize"), (4, 1)),
}
ALLOWED = 0.03  # largest allowed share of a stage's time


def cpu_seconds(stage: ModuleType, params: object, needs: dict[str, Path | None]) -> tuple[float, int]:
    """Run a stage in a temporary folder; return its CPU seconds and the number of lines of its trace.

    Args:
        stage: module of the stage.
        params: parameters of the stage.
        needs: stage -> its folder, for the stages that this stage needs; None for a stage that was skipped.
    """
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        stage.run(params, Path(folder), **needs)
        return time.process_time() - began, len(trace.read_trace(Path(folder) / "trace.jsonl"))


def measure_pairs(name: str, run: Path, steps: int, repeats: int) -> tuple[float, float, int, float]:
    """Run a stage several times with and without a trace.

    Args:
        name: name of the stage.
        run: runs/<scene>.
        steps: number of steps of each run.
        repeats: number of pairs.

    Returns:
        Median CPU seconds of a run without a trace, median CPU seconds of a run with a trace, the number of additional
        lines of the trace in a run, and CPU seconds per step without a trace (without the time of starting the stage).
    """
    stage, count, needs, _ = STAGES[name]
    settings = yaml.safe_load((ROOT / "pipeline.yaml").read_text())["profiles"]["laptop"][name]
    settings |= {count: steps, "checkpoint_seconds": 1e9} | ({"holdout": 8} if name == "fit" else {})
    folders = {need: run / need if (run / need).exists() else None for need in needs}
    params, every = stage.Params(**settings), trace.is_log_step
    times: dict[bool, list[float]] = {False: [], True: []}
    lines = {}
    cpu_seconds(stage, stage.Params(**settings | {count: 2}), folders)  # compiles, fills caches
    try:
        for _ in range(repeats):
            for traced in (False, True):
                trace.is_log_step = every if traced else (lambda i, last, per_octave=2, first=1: i == last)
                seconds, lines[traced] = cpu_seconds(stage, params, folders)
                times[traced].append(seconds)
    finally:
        trace.is_log_step = every
    plain, traced = (sorted(times[which])[repeats // 2] for which in (False, True))
    short = cpu_seconds(stage, stage.Params(**settings | {count: 2}), folders)[0]
    return plain, traced, lines[True] - lines[False], (plain - short) / (steps - 2)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, help="runs/<scene>, its stages up to `initialize` finished")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", nargs="+", choices=list(STAGES))
    arguments = parser.parse_args()
    over = 0
    print(f"{'stage':<12} {'without':>9} {'with':>9} {'moments':>8} {'a moment':>9} {'a step':>8} {'full length':>12}")
    for name in arguments.only or STAGES:
        steps = 8 * arguments.steps if name == "fit" else arguments.steps
        plain, traced, moments, step = measure_pairs(name, arguments.run, steps, arguments.repeats)
        profile = yaml.safe_load((ROOT / "pipeline.yaml").read_text())["profiles"]["laptop"][name]
        full = profile[STAGES[name][1]]
        moment = (traced - plain) / moments
        share = moment * sum(trace.is_log_step(i, full, *STAGES[name][3]) for i in range(full + 1)) / (full * step)
        over += share > ALLOWED
        print(f"{name:<12} {plain:7.2f} s {traced:7.2f} s {moments:8} {moment:7.3f} s {step:6.3f} s {share:12.2%}")
    return 1 if over else 0


if __name__ == "__main__":
    sys.exit(main())
