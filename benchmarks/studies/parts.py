"""What each part of a job is worth: `python -m benchmarks.studies.parts SCENE... --runs runs` (minutes a scene).

Every scene needs test views without the object. Its job runs in the profile `laptop`, and then again without a part,
or with more of it (`CHANGES`); stages before the change are shared. Compared with the whole job are its LPIPS (vgg) and
PSNR in the mask's box, its PSNR outside the mask, and its seconds; shared stages count with the seconds that they took.
The study writes parts.json, parts.md (means over scenes, with 95% intervals) and parts.png to --out. Finished jobs are
not run again.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

from reffusion.io.arrays import load_json, save_json, save_text
from report import charts, page
from report.paired_statistics import confidence_half_width

ROOT = Path(__file__).resolve().parents[2]
CHANGES = {
    "no refit": "initialize.refit_steps=0",
    "two thirds of the refit": "initialize.refit_steps=300",
    "no extra views": "initialize.extra_views=0",
    "two extra views": "initialize.extra_views=2",
    "no distillation": "distill.iterations=1",
    "SDS, personalized": "distill.sds.run=always",
    "two thirds of the fit": "fit.iterations=1267",
}
# Column of metrics.json -> heading, and the sign with which a difference is a loss
SCORES = {"lpips_vgg_box": ("LPIPS (vgg)", 1), "psnr_box": ("PSNR, dB", -1), "psnr_outside": ("outside, dB", -1)}
DIGITS = (4, 2, 2, 0)  # decimals of the scores and of the seconds


def run_job(scene: Path, runs: Path, settings: str) -> dict[str, float]:
    """Run all stages of a scene that are not finished yet; return the result's `SCORES`, and "seconds" of all stages.

    Raises:
        ValueError: the job failed, or no test view is scored.
    """
    command = ["run", "all", "--scene", str(scene), "--runs", str(runs), "--profile", "laptop", "--set", settings]
    if subprocess.run([sys.executable, "-m", "runner", *command], cwd=ROOT).returncode:
        raise ValueError(f"{scene.name}: the job failed; see above")
    mean = load_json(runs / scene.name / "evaluate/metrics.json")["mean"]
    if mean["psnr_box"] is None:
        raise ValueError(f"{scene}: no test view shows the scene without the object; take another scene")
    seconds = sum(load_json(path)["seconds"] for path in (runs / scene.name).glob("*/receipt.json"))
    return {name: mean[name] for name in SCORES} | {"seconds": seconds}


def measure(scene: Path, runs: Path, out: Path) -> dict[str, dict[str, float]]:
    """Run the whole job and all changed jobs of a scene, and return the result of `run_job` of each.

    Args:
        scene: folder of the scene.
        runs: folder of runs, with the whole jobs.
        out: folder of the changed jobs.
    """
    found = {"whole": run_job(scene, runs, "")}
    for number, (name, settings) in enumerate(CHANGES.items()):
        changed = out / str(number)
        if not (changed / scene.name).exists():
            shutil.copytree(runs / scene.name, changed / scene.name)
        found[name] = run_job(scene, changed, settings)
    return found


def tabulate(found: dict[str, dict[str, dict[str, float]]]) -> str:
    """Return a Markdown table of the changes: mean loss in each score, seconds saved, and their 95% intervals.

    Args:
        found: scene -> result of `measure`.
    """
    rows = []
    for change in CHANGES:
        cells = [change]
        for column, digits in zip((*SCORES, "seconds"), DIGITS, strict=True):
            values = np.array([each[change][column] - each["whole"][column] for each in found.values()])
            half = confidence_half_width(values)
            cells.append(f"{values.mean():+.{digits}f}" + (f"±{half:.{digits}f}" if half is not None else ""))
        rows.append(cells)
    return page.markdown_table(["change", *(title for title, _ in SCORES.values()), "seconds"], rows)


def draw(found: dict[str, dict[str, dict[str, float]]], path: Path) -> None:
    """Draw what is lost by each change against the seconds it saves: a dot for each scene, a ring for the mean."""
    figure, grid = charts.new_figure(4.2, 1, len(SCORES))
    for axes, (column, (title, sign)) in zip(grid[0], SCORES.items(), strict=True):
        for number, change in enumerate(CHANGES):
            pairs = [(each[change], each["whole"]) for each in found.values()]
            saved = [whole["seconds"] - changed["seconds"] for changed, whole in pairs]
            lost = [sign * (changed[column] - whole[column]) for changed, whole in pairs]
            axes.scatter(saved, lost, s=9, color=f"C{number}", alpha=0.5)
            axes.scatter(np.mean(saved), np.mean(lost), s=70, facecolors="none", edgecolors=f"C{number}", label=change)
        axes.axhline(0, color=charts.INK, linewidth=0.6)
        axes.axvline(0, color=charts.INK, linewidth=0.6)
        axes.set(xlabel="seconds saved", title=f"lost: {title}")
    figure.legend(
        *grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8, frameon=False
    )
    charts.save_chart(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, help="folders of scenes")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of runs, with the whole jobs")
    parser.add_argument("--out", type=Path, default=Path("runs/parts"))
    arguments = parser.parse_args()
    out, runs = arguments.out.resolve(), arguments.runs.resolve()
    out.mkdir(parents=True, exist_ok=True)
    found = {}
    for scene in arguments.scenes:
        found[scene.name] = measure(scene.resolve(), runs, out)
        save_json(out / "parts.json", found)
        save_text(out / "parts.md", tabulate(found))
        draw(found, out / "parts.png")
    print(tabulate(found))


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"error: {error}")
