"""Seconds and memory of every stage against views and pixels: `python -m lab.studies.growth` (takes hours).

The scenes are made rooms of 30 to 300 training views of 0.3 megapixels, and of 30 views of 0.3 to 2 megapixels.
--largest adds a scene with the most views and the most pixels. Settings are the profile's, with a tenth of its steps
(the number of steps depends neither on views nor on pixels) and no limit on picture size. The study writes growth.json
and growth.png to --out: CPU seconds and memory of each stage, and the exponent, the slope of a line fitted to them in
log-log axes; 1 means linear growth. Finished jobs are not run again.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lab.scenes.generate import generate
from lab.scenes.kinds import KINDS
from reffusion.io.arrays import load_json, save_json
from report import charts

ROOT = Path(__file__).resolve().parents[2]
STAGES = (
    "poses",
    "raw_masks",
    "fit",
    "masks",
    "reference",
    "initialize",
    "personalize",
    "distill",
    "finish",
    "evaluate",
)
VIEWS, PIXELS = (30, 60, 120, 300), (0.3, 0.6, 1.2, 2.0)  # megapixels
WIDE, HIGH = 4, 3  # aspect ratio of the pictures
SHORT_JOB = (
    "fit.iterations=190 personalize.steps=15 distill.iterations=15 initialize.refit_steps=30 poses.longest=4000 "
)
SHORT_JOB += "distill.sds.run=always"
SAMPLES, TEST = 1, 4  # rays per side of a pixel (with 1, large scenes are made in minutes); number of test views


def make_room(views: int, megapixels: float, folder: Path) -> Path:
    """Make a room with the given number and size of training views, unless it exists, and return its folder.

    The room's folder is inside `folder`.
    """
    unit = (megapixels * 1e6 / (WIDE * HIGH)) ** 0.5
    scene = folder / f"{views}-views-{megapixels}-mp"
    if not (scene / "truth/facts.json").exists():
        size = {"width": round(WIDE * unit), "height": round(HIGH * unit)}
        generate(scene, 0, replace(KINDS["demo"], **size, train=views, test=TEST, samples=SAMPLES))
    return scene


def run_stages(scene: Path, runs: Path, profile: str, last: str) -> dict[str, dict[str, float]]:
    """Run the stages of a scene one by one up to the stage `last`, and measure their costs.

    Args:
        scene: folder of the scene.
        runs: folder of runs, which also keeps the measured costs. If it has costs of the scene in this profile, up to
            this last stage, nothing is run, and these costs are returned.
        profile: name of the profile.
        last: last stage to run.

    Returns:
        Stage -> "cpu" (CPU seconds of all its processes), "seconds" (wall time) and "mb" (peak memory). Skipped stages
        are missing.

    Raises:
        RuntimeError: a stage failed.
    """
    record, costs = runs / f"{scene.name}-{profile}-{last}.json", {}
    if record.exists():
        return load_json(record)
    for stage in STAGES[: STAGES.index(last) + 1]:
        command = [sys.executable, "-m", "runner", "run", stage, "--scene", str(scene), "--runs", str(runs)]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        if subprocess.run([*command, "--profile", profile, f"--set={SHORT_JOB}"], cwd=ROOT).returncode:
            raise RuntimeError(f"{scene.name}: {stage} failed; see above")
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        receipt = runs / scene.name / stage / "receipt.json"
        if receipt.exists():
            values = load_json(receipt)
            cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            costs[stage] = {"cpu": cpu, "seconds": values["seconds"], "mb": values["peak_memory_mb"]}
    save_json(record, costs)
    return costs


def growth_exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Return the exponent p with which the values grow, as size^p, by a least-squares fit to the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def draw(costs: dict[str, dict[str, dict[str, list[float]]]], path: Path) -> None:
    """Draw CPU seconds and memory against the number of views and against the number of pixels, one line per stage.

    Args:
        costs: what grows, in words -> stage -> {"size", "cpu", "mb"}, a list of one value per scene each.
        path: PNG to write.
    """
    figure, grid = charts.new_figure(5.6, 2, 2)
    for row, (of, stages) in zip(grid, costs.items(), strict=True):
        for axes, what in zip(row, ("cpu", "mb"), strict=True):
            for stage, cost in stages.items():
                axes.plot(
                    cost["size"], cost[what], "o-", label=f"{stage} {growth_exponent(cost['size'], cost[what]):.2f}"
                )
            axes.set(xscale="log", yscale="log", xlabel=of, ylabel={"cpu": "CPU seconds", "mb": "memory (MB)"}[what])
            charts.use_plain_log_ticks(axes)
            axes.legend(frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    charts.save_chart(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, nargs="+", default=VIEWS)
    parser.add_argument("--pixels", type=float, nargs="+", default=PIXELS, help="megapixels")
    parser.add_argument("--profile", default="laptop")
    parser.add_argument("--last", choices=STAGES, default=STAGES[-1], help="last stage to run")
    parser.add_argument("--largest", action="store_true", help="also run the most views with the most pixels")
    parser.add_argument("--out", type=Path, default=ROOT / "runs/growth")
    arguments = parser.parse_args()
    out = arguments.out.resolve()
    os.makedirs(out / "runs", exist_ok=True)
    axes = {
        f"training views of {arguments.pixels[0]} megapixels": [
            (views, arguments.pixels[0]) for views in arguments.views
        ],
        f"megapixels of {arguments.views[0]} views": [(arguments.views[0], each) for each in arguments.pixels],
    }
    costs: dict[str, dict[str, dict[str, list[float]]]] = {}
    for axis, (of, scenes) in enumerate(axes.items()):
        stages = costs.setdefault(of, {})
        for size in scenes:
            by_stage = run_stages(make_room(*size, out / "scenes"), out / "runs", arguments.profile, arguments.last)
            for stage, cost in by_stage.items():
                row = stages.setdefault(stage, {"size": [], "cpu": [], "seconds": [], "mb": []})
                row["size"].append(size[axis])
                for what in ("cpu", "seconds", "mb"):
                    row[what].append(cost[what])
        for stage, row in stages.items():
            cpu, mb = (growth_exponent(row["size"], row[what]) for what in ("cpu", "mb"))
            print(f"{of}, {stage}: CPU {cpu:.2f}, memory {mb:.2f}")
    save_json(out / "growth.json", costs)
    draw(costs, out / "growth.png")
    if arguments.largest:
        scene = make_room(arguments.views[-1], arguments.pixels[-1], out / "scenes")
        print(json.dumps(run_stages(scene, out / "runs", arguments.profile, arguments.last), indent=1))


if __name__ == "__main__":
    main()
