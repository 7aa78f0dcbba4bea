"""Whole jobs with wrong masks that `masks.refine` redraws: `python -m lab.studies.rough_masks --places table`.

The study takes places of `lab.studies.composites`, with their true reference. Each kind of fault changes the
masks of the training views: `wrong-3` and `wrong-8` dilate, erode or shift each mask by 3 or 8 px, `missing` deletes
the mask of every second view. A job with `masks.refine` on such masks is compared with the job on the exact masks,
for each seed of fit and distillation. The study prints PSNR and LPIPS (vgg) in the bounding boxes of the masks, and
the mean and the worst IoU of the redrawn masks with the exact ones.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np

from lab.studies import compositing
from lab.studies.composites import ROOT, make_scenes, select_places
from reffusion import seeding
from reffusion.clicks.propagation_with_network import iou
from reffusion.io.arrays import load_json
from reffusion.io.images import load_image, save_image
from reffusion.io.scene import load_mask_sets, load_raw_masks, load_scene

FAULTS = ("wrong-3", "wrong-8", "missing")


def spoil_mask(mask: np.ndarray, distance: int, random: np.random.Generator) -> np.ndarray:
    """Return a mask, uint8 [H, W], dilated, eroded or shifted, with equal probability, by `distance` px."""
    kind = random.integers(3)
    if kind < 2:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * distance + 1, 2 * distance + 1))
        return (cv2.dilate if kind else cv2.erode)(mask, disc)
    angle = random.uniform(0, 2 * np.pi)
    right, down = distance * np.cos(angle), distance * np.sin(angle)
    return cv2.warpAffine(mask, np.float32([[1, 0, right], [0, 1, down]]), mask.shape[::-1], flags=cv2.INTER_NEAREST)


def spoil_scene(scene: Path, fault: str, out: Path) -> Path:
    """Write a copy of a scene with a fault in its masks, and return its folder.

    Args:
        scene: folder of a scene with the folder `masks`.
        fault: one of `FAULTS`.
        out: folder of scenes.
    """
    spoiled, random = out / f"{scene.name}-{fault}", np.random.default_rng(seeding.seed_for(0, fault))
    shutil.rmtree(spoiled, ignore_errors=True)
    shutil.copytree(scene, spoiled)
    for k, path in enumerate(sorted((spoiled / "masks").iterdir())):
        if fault == "missing" and k % 2:
            path.unlink()
        elif fault != "missing":
            save_image(path, spoil_mask(load_image(path)[..., 0], int(fault.split("-")[1]), random))
    return spoiled


def run_job(scene: Path, runs: Path, seed: int, refine: bool, shared: Path | None = None) -> Path:
    """Run all stages of a scene that are not finished yet, and return the folder of the run.

    Args:
        scene: folder of the scene.
        runs: folder of runs.
        seed: seed of fit and distillation.
        refine: True redraws the masks.
        shared: run of the same photographs; its stages are taken over as far as their inputs are equal. None for none.

    Raises:
        ValueError: the job failed.
    """
    run, settings = runs / scene.name, f"fit.seed={seed} distill.seed={seed} masks.refine={str(refine).lower()}"
    if shared and not run.exists():
        shutil.copytree(shared, run, ignore=shutil.ignore_patterns("source"))
    command = ["run", "all", "--scene", str(scene), "--runs", str(runs), "--profile", "laptop", "--set", settings]
    if subprocess.run([sys.executable, "-m", "runner", *command], cwd=ROOT).returncode:
        raise ValueError(f"{scene.name}: the job failed; see above")
    return run


def score_run(run: Path, exact: Path) -> str:
    """Return a run's scores in the boxes, and the IoU of the masks that it used with the exact ones, as text.

    Args:
        run: folder of a finished run.
        exact: run with the exact masks.
    """
    mean, train = load_json(run / "evaluate/metrics.json")["mean"], load_scene(exact / "poses").train
    true, used = load_raw_masks(exact / "raw_masks", train), load_mask_sets(run / "masks", train)
    shares = [iou(used[name].raw, true[name]) for name in train]
    scores = f"{mean['psnr_box']:.2f} dB, LPIPS {mean['lpips_vgg_box']:.4f}"
    return f"{run.name}: {scores}, IoU {np.mean(shares):.3f}, worst {min(shares):.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=Path, default=Path("../shared/data"), help="folder of nerfstudio captures")
    parser.add_argument("--places", default="table,bear-rock", help="names, separated by commas")
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds")
    parser.add_argument("--out", type=Path, default=Path("runs/rough_masks"))
    arguments = parser.parse_args()
    out = arguments.out.resolve()
    for place in select_places(arguments.places, report=False):
        scene, _ = make_scenes(place, arguments.captures, compositing.Options(), out)
        spoiled = [spoil_scene(scene, fault, out / "scenes") for fault in FAULTS]
        for seed in range(arguments.seeds):
            runs = out / f"seed-{seed}"
            exact = run_job(scene, runs, seed, refine=False)
            print(f"seed {seed}, {score_run(exact, exact)}", flush=True)
            shared = exact
            for each in spoiled:
                shared = run_job(each, runs, seed, True, shared)
                print(f"seed {seed}, {score_run(shared, exact)}", flush=True)


if __name__ == "__main__":
    main()
