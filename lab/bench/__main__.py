"""Work-precision diagrams of the kernels: `python -m lab.bench --out runs/bench` (`make bench`).

A work-precision diagram shows the error of a method against its time, for several settings. The diagrams are:

  footprint, cutoff   the float32 rasterizer against its float64 oracle; the cost of skipping faint contributions
  bilateral           the fast bilateral solver along its iterations, by cell size
  completion          depth completion by a thin plate, by the size of its grid
  alignment           plain and robust alignment of depth, by the share of outliers

The command prints the recommended setting of each diagram. It writes a PNG for each diagram, and precision.json with
the error and the seconds of every point: CPU seconds with one thread, except for `cutoff` (a count of the work times a
time per pair). --gate compares the points with baselines.json beside this file. The
exit status is then 1 if a point has no baseline, was not measured, or is worse: if its error exceeds the diagram's
tolerance (2 to 50 % above the baseline), or its time, relative to a fixed computation on the same machine, is more than
twice the baseline's. Diagrams with such points are measured up to two more times, and the shortest times count.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"  # read when numpy and torch are loaded

import torch

from lab.bench import alignment, gate, solvers, splat
from lab.bench.draw import draw
from lab.bench.points import recommendation

ROOT = Path(__file__).resolve().parents[2]

RETRIES = 2  # additional measurements of diagrams that fail the gate
BASELINES = Path(__file__).with_name("baselines.json")
DIAGRAMS = {
    "footprint": splat.footprint_diagram,
    "cutoff": splat.cutoff_diagram,
    "bilateral": solvers.bilateral_diagram,
    "completion": solvers.completion_diagram,
    "alignment": alignment.diagram,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/bench"))
    parser.add_argument("--gate", action="store_true", help="fail if a point is worse than its baseline")
    parser.add_argument("--write-baselines", action="store_true", help="store the measured values as baselines")
    parser.add_argument("--baselines", type=Path, default=BASELINES)
    parser.add_argument("--only", nargs="+", choices=list(DIAGRAMS), default=list(DIAGRAMS), help="these diagrams")
    arguments = parser.parse_args()
    baselines = gate.load(arguments.baselines) if arguments.gate else None  # a missing file is reported before any work
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    unit, diagrams = gate.machine_unit(), []
    for name in arguments.only:
        diagram = DIAGRAMS[name]()
        diagrams.append(diagram)
        draw(diagram, arguments.out / f"{name}.png")
        print(recommendation(diagram), flush=True)
    unit = min(unit, gate.machine_unit())  # the less disturbed measurement
    measured = gate.baseline_table(diagrams, unit)
    (arguments.out / "precision.json").write_text(json.dumps(measured, indent=1) + "\n")
    print(f"pictures and precision.json in {arguments.out}/; machine unit {1e3 * unit:.1f} ms")
    if arguments.write_baselines:
        old = json.loads(arguments.baselines.read_text())["diagrams"] if arguments.baselines.exists() else {}
        measured["diagrams"] = old | measured["diagrams"]
        arguments.baselines.write_text(json.dumps(measured, indent=1) + "\n")
    worse = gate.regressions(diagrams, unit, baselines) if baselines else []
    for _ in range(RETRIES if worse else 0):  # on a busy machine, a point is slow only if it is slow repeatedly
        named = {line.split(":")[0] for line in worse}
        diagrams = [gate.take_faster(d, DIAGRAMS[d.name]()) if d.name in named else d for d in diagrams]
        worse = gate.regressions(diagrams, unit, baselines)
    for line in worse:
        print(f"regression: {line}", file=sys.stderr)
    if baselines and not worse:
        print(f"gate: all {sum(len(d.points) for d in diagrams)} points hold")
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
