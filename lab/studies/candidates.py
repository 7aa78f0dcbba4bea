"""Scores of the reference's candidates against the truth, and whether the lowest misfit selects the best candidate.

Without a given reference, the stage `reference` composes several candidates from patches of the photographs, one per
seed, and selects the one with the lowest misfit of patches. The study scores all candidates in the box of their hole,
for several seeds and for each place that has a run without a given reference and a run on the untouched photographs.

`python -m lab.studies.candidates --runs runs/composites/runs`, after `lab.studies.composites --alone`

The study prints for each score the mean candidate, the selected one and the best one. It writes candidates.json and
sheets (truth, selected candidate, other candidates) to --out.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

import numpy as np

from reffusion.io.arrays import load_json, save_json
from reffusion.io.images import load_image, save_image
from reffusion.io.scene import load_mask_sets
from reffusion.metrics import image_metrics, lpips
from reffusion.params.reference import Params
from stages import reference

SCORES = {
    "lpips_vgg": min,
    "lpips_alex": min,
    "psnr": max,
    "ssim": max,
    "flip": min,
}  # score -> function that returns the best value


def score_candidates(run: Path, untouched: Path, out: Path, seed: int, models: dict[str, lpips.Lpips]) -> dict | None:
    """Make the candidates of a place anew and score them.

    Args:
        run: run of the place without a given reference.
        untouched: run on the same views without the object, which has the truth.
        out: folder for the candidates and the sheet; emptied first.
        seed: seed of the candidates.
        models: name of a network -> LPIPS.

    Returns:
        "view": the reference's view; "taken": index of the selected candidate; and for each of `SCORES` the list of all
        candidates' scores. None if the place has no candidates or nothing had to be invented.
    """
    if not (run / "reference/candidates.json").is_file() or not load_json(run / "masks/facts.json")["invent_pixels"]:
        return None
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    params = load_json(run / "reference/receipt.json")["params"] | {"seed": seed, "reference": None}
    needs = {name: run / name for name in ("poses", "fit", "masks")}
    reference.run(Params(**params), out, scene=out, **needs)
    facts = load_json(out / "candidates.json")
    view, chosen = facts["view"], facts["chosen"]
    pixels = load_mask_sets(run / "masks", [view])[view]
    truth, sheet = load_image(untouched / f"poses/images/{view}.png"), load_image(out / "candidates.png")
    candidates = np.split(sheet, sheet.shape[1] // truth.shape[1], 1)
    box = image_metrics.mask_box(pixels.invent)
    true = box.crop(truth)
    targets = image_metrics.lpips_targets(true, models)
    scores = [image_metrics.score(box.crop(each), true, targets) for each in candidates]
    order = [chosen, *(k for k in range(len(candidates)) if k != chosen)]
    save_image(out / "sheet.png", np.concatenate([true, *(box.crop(candidates[k]) for k in order)], 1))
    return {"view": view, "taken": chosen, **{name: [each[name] for each in scores] for name in SCORES}}


def table(rows: list[dict]) -> str:
    """Return a Markdown table with a row per score.

    The columns are the means over all places and seeds of the mean candidate, the selected candidate and the best one;
    the share of cases in which the selected candidate is the best; and this share for a random selection.
    """
    lines = ["| score | mean candidate | taken | best | taken is best | by chance |", "|---" * 6 + "|"]
    for name, best in SCORES.items():
        complete = [row for row in rows if None not in row[name]]
        values = [(np.mean(row[name]), row[name][row["taken"]], best(row[name])) for row in complete]
        means = [f"{value:.4f}" for value in np.mean(values, 0)]
        hit = np.mean([score == best for _, score, best in values])
        chance = np.mean([1 / len(row[name]) for row in complete])
        lines.append(f"| {name} | {' | '.join(means)} | {hit:.2f} | {chance:.2f} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs/composites/runs"))
    parser.add_argument("--out", type=Path, default=Path("runs/candidates"))
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    models = {net: model for net in ("vgg", "alex") if (model := lpips.load(net)[0])}
    rows = []
    for untouched in sorted(arguments.runs.glob("*-untouched")):
        run = arguments.runs / f"{untouched.name.removesuffix('-untouched')}-alone"
        for seed in range(arguments.seeds):
            out = arguments.out / f"{run.name}-{seed}"
            row = score_candidates(run, untouched, out, 10 * seed, models) if run.is_dir() else None
            if row:
                rows.append({"place": run.name, "seed": seed, **row})
                print(run.name, seed, row["taken"], [round(value, 4) for value in row["lpips_vgg"]], flush=True)
    if not rows:
        print(f"error: no finished places with an untouched run in {arguments.runs}", file=sys.stderr)
        return 1
    save_json(arguments.out / "candidates.json", rows)
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
