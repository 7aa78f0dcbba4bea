"""Expected against measured seconds of whole jobs: `python -m lab.studies.estimates SCENE...` (minutes a scene).

The scenes run one after the other in the profile `laptop`. Before each, the runner's plan is recorded: its seconds are
what a user reads before the job, after the receipts of earlier scenes have told how fast this machine is. The study
writes estimates.json and estimates.md to --runs. Finished jobs are not run again.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from lab.studies.scene_priors import run_study
from reffusion.io.arrays import load_json, save_json, save_text
from report import page

ROOT = Path(__file__).resolve().parents[2]


def measure(scene: Path, runs: Path) -> tuple[float, float]:
    """Run a scene's job unless it is finished, and return the seconds that its plan expected, and those that it took.

    A stage without a known time counts in neither.

    Raises:
        ValueError: the plan or the job failed.
    """
    words = ["--scene", str(scene), "--runs", str(runs), "--profile", "laptop"]
    if not (runs / scene.name / "evaluate" / "receipt.json").exists():
        for command in (["plan", "--record"], ["run", "all"]):
            if subprocess.run([sys.executable, "-m", "runner", *command, *words], cwd=ROOT).returncode:
                raise ValueError(f"{scene.name}: `{command[0]}` failed; see above")
    expected = taken = 0.0
    for stage, entry in load_json(runs / scene.name / "plan.json")["stages"].items():
        receipt = runs / scene.name / stage / "receipt.json"
        if entry.get("seconds") and receipt.exists():
            expected, taken = expected + entry["seconds"], taken + load_json(receipt)["seconds"]
    return expected, taken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, help="folders of scenes")
    parser.add_argument("--runs", type=Path, default=Path("runs/estimates"), help="folder of runs, empty at first")
    arguments = parser.parse_args()
    runs, found = arguments.runs.resolve(), {}
    for scene in arguments.scenes:
        expected, taken = found[scene.name] = measure(scene.resolve(), runs)
        rows = [[name, f"{plan:.0f}", f"{real:.0f}", f"{plan / real:.2f}"] for name, (plan, real) in found.items()]
        save_json(runs / "estimates.json", found)
        save_text(runs / "estimates.md", page.markdown_table(["scene", "expected, s", "taken, s", "ratio"], rows))
        print(f"{scene.name}: expected {expected:.0f} s, took {taken:.0f} s", flush=True)


if __name__ == "__main__":
    run_study(main)
