"""Gain of distillation over initialization: `python -m benchmarks.studies.gain runs/demo-wide runs/demo-wide@no_sds`.

For each run the study prints, as means over the test views, the box scores of result and initialization from the stage
`evaluate`, and the gradient energy of both in the box and in the mask, relative to that of the truth. An energy below 1
means too smooth, above 1 means grain or doubled edges. It also prints the shares of the masks whose background no
training view saw, from the stage `masks` and, with --scene, from the generator's truth.
The study writes gain.json, gain.md and pictures of some views to --out: fit with the object, initialization, result,
truth.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from benchmarks.studies.holes import gradient_energy
from reffusion.io.arrays import load_json, save_json
from reffusion.io.ground_truth import load_ground_truth, load_object_mask
from reffusion.io.images import load_image, save_image
from reffusion.io.scene import load_scene
from reffusion.metrics import image_metrics
from report.sheet import compose_sheet, enlarge, pick_evenly, stage_folder

ROOT = Path(__file__).resolve().parents[2]

RENDERS = {"initialization": "renders_initialize", "result": "renders"}
SCORES = {"psnr_box": 2, "ssim_box": 4, "flip_box": 4}  # column of metrics.json, digits
VIEWS = 4  # number of views on the sheet
ENLARGE = 2  # whole factor


def evaluate_run(run: Path) -> dict:
    """Score the initialization and the result of a run.

    Returns:
        "initialization" or "result" -> box scores `SCORES`, as means over the test views, and "energy_box" and
        "energy_mask": mean gradient energy of the test views in the box and in the mask, divided by that of the truth.

    Raises:
        ValueError: the run has not been evaluated, or has no ground truth.
    """
    if not (run / "evaluate" / "metrics.json").exists():
        raise ValueError(f"{run / 'evaluate/metrics.json'} is missing: run `make scene={run.name} all` first")
    scored, scene = load_json(run / "evaluate/metrics.json"), load_scene(stage_folder(run, "poses"))
    if not scored["views"]["psnr_box"]:
        raise ValueError(f"{run}: no test view has ground truth and a mask")
    energies: dict[str, list[tuple[float, float]]] = {"truth": [], **{way: [] for way in RENDERS}}
    for name in scene.test:
        mask = load_object_mask(scene.cameras[name], stage_folder(run, "raw_masks"), stage_folder(run, "masks"))
        left, top, right, bottom = image_metrics.mask_box(mask)
        box = np.zeros_like(mask)
        box[top:bottom, left:right] = True
        pictures = {"truth": load_ground_truth(scene.cameras[name], stage_folder(run, "poses"))}
        pictures |= {way: load_image(run / "evaluate" / folder / f"{name}.png") for way, folder in RENDERS.items()}
        for way, picture in pictures.items():
            energies[way].append((gradient_energy(picture, box), gradient_energy(picture, mask)))
    total = {way: np.mean(values, 0) for way, values in energies.items()}
    result = {}
    for way, column in (("initialization", "initialize"), ("result", "mean")):
        box, mask = (total[way] / total["truth"]).tolist()
        result[way] = {name: scored[column][name] for name in SCORES} | {"energy_box": box, "energy_mask": mask}
    return result


def table(runs: dict[str, dict], shares: dict[str, dict[str, float]]) -> str:
    """Return a Markdown table with a row for the initialization and one for the result of each run.

    The initialization of a variant is omitted if the scene's own run is in the table. Lines below the table state the
    shares.

    Args:
        runs: name of a run -> result of `evaluate_run`.
        shares: name of a run -> result of `unseen_shares`.
    """
    lines = ["| | PSNR box, dB | SSIM | FLIP | energy, box | energy, mask |", "|---" * 6 + "|"]
    for name, ways in runs.items():
        for way, row in ways.items():
            if way == "initialization" and "@" in name and name.split("@")[0] in runs:
                continue  # the table has the initialization of the scene's own run
            cells = [f"{row[column]:.{digits}f}" for column, digits in SCORES.items()]
            cells += [f"{row[column]:.2f}" for column in ("energy_box", "energy_mask")]
            lines.append(f"| {name}, {way} | {' | '.join(cells)} |")
    for name, share in shares.items():
        lines += ["", f"{name}, share of the masks that no training view saw: " + str(share)]
    return "\n".join(lines) + "\n"


def unseen_shares(run: Path, scene: Path | None) -> dict[str, float]:
    """Return the shares of the masks whose background no training view saw.

    Args:
        run: the run.
        scene: folder of the scene made by the generator; None if unknown.

    Returns:
        "by masks": share in the training views, from the stage `masks`. With `scene` also "by rays, <kind> views", the
        shares from the generator's truth in training and in test views.
    """
    share = {"by masks": round(load_json(stage_folder(run, "masks") / "facts.json")["unobserved_share"], 3)}
    facts = load_json(scene / "truth/facts.json")["never_seen_share"] if scene else {}
    return share | {f"by rays, {kind} views": round(value, 3) for kind, value in facts.items() if value is not None}


def save_sheet(run: Path, path: Path) -> None:
    """Save a picture of up to `VIEWS` evenly spread test views, a row each, cropped around the mask's box.

    The columns are the fit with the object, the initialization, the result and the truth.
    """
    scene = load_scene(stage_folder(run, "poses"))
    names, rows = pick_evenly(list(scene.test), VIEWS), []
    for name in names:
        camera = scene.cameras[name]
        folders = ("renders_fit", *RENDERS.values())
        pictures = [load_image(run / "evaluate" / folder / f"{name}.png") for folder in folders]
        pictures.append(load_ground_truth(camera, stage_folder(run, "poses")))
        left, top, right, bottom = image_metrics.mask_box(
            load_object_mask(camera, stage_folder(run, "raw_masks"), stage_folder(run, "masks")), 0.3
        )
        rows.append([enlarge(picture[top:bottom, left:right], ENLARGE) for picture in pictures])
    height, width = (max(cell.shape[axis] for row in rows for cell in row) for axis in (0, 1))
    room = [[np.pad(c, ((0, height - c.shape[0]), (0, width - c.shape[1]), (0, 0))) for c in row] for row in rows]
    save_image(path, compose_sheet(room, ["fit", *RENDERS, "truth"], names))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", help="runs/<scene> and runs/<scene>@<variant>, evaluated")
    parser.add_argument("--scene", type=Path, help="data/<scene> of the first, made by data/generate.py")
    parser.add_argument("--out", type=Path, default=Path("runs/gain"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    first, runs = arguments.runs[0], {run.name: evaluate_run(run) for run in arguments.runs}
    text = table(runs, {first.name: unseen_shares(first, arguments.scene)})
    for run in arguments.runs:
        save_sheet(run, arguments.out / f"{run.name}.png")
    save_json(arguments.out / "gain.json", runs)
    (arguments.out / "gain.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"error: {error}")
