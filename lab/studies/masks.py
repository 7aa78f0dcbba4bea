"""Consistent and unobserved masks against ray-cast truth: `python -m lab.studies.masks --scene data/demo`.

*Consistent* masks are the pixels that show the object, the same in all views. *Unobserved* pixels are those of them
whose background no other photograph shows. The study runs the stage `masks` twice, with the parameters and the fit of
the scene's own run: with the exact input masks, and with perturbed ones. These are each dilated, eroded or shifted at
random by up to 2 % of the image width, and a tenth of them is missing.
The study prints the intersection over union (IoU) over all training views together (including views whose mask is
missing), of the median view and of the worst view. Pixels within 2 px of the true border do not count. The scene must
be made by the generator, which alone knows the truth.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np

from reffusion import seeding
from reffusion.capture import lens
from reffusion.io.arrays import load_json
from reffusion.io.images import load_mask, save_mask
from reffusion.io.scene import load_mask_sets, load_raw_masks, load_scene
from reffusion.types import Camera, Scene
from stages import masks as masks_stage

REQUIRED_IOU = {"exact": {"consistent": 0.95, "unobserved": 0.9}, "perturbed": {"consistent": 0.90, "unobserved": 0.85}}
BORDER = 2  # pixels within this distance of the true border do not count, px
LARGEST, MISSING = 0.02, 0.1  # largest perturbation, relative to the image width; share of views without a mask


def true_never_seen(scene_folder: Path, cameras: list[Camera]) -> dict[str, np.ndarray]:
    """Load the generator's never-seen pixels, undistorted in the same way as the stage `poses` undistorts pictures.

    Args:
        scene_folder: folder of a scene made by the generator.
        cameras: undistorted cameras of the views.

    Returns:
        View name -> bool [H, W], True for pixels of the object whose background no training view shows.
    """
    truth = load_json(scene_folder / "truth/cameras.json")
    size = (truth["width"], truth["height"])
    photo = lens.Lens(*size, truth["f"], truth["f"], truth["cx"], truth["cy"], radial=(truth["k1"],))
    pictures = {}
    for camera in cameras:
        pinhole = lens.Lens(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        mask = load_mask(scene_folder / f"truth/never_seen/{camera.name}.png", size[::-1])
        pictures[camera.name] = lens.undistort_mask(mask, lens.sampling_map(photo, pinhole))
    return pictures


def perturb_mask(mask: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return a mask, bool [H, W], dilated, eroded or shifted, with equal probability, by a random distance.

    The distance is at most `LARGEST` times the image width.
    """
    distance = random.uniform(0, LARGEST * mask.shape[1])
    way = random.choice(["dilate", "erode", "shift"])
    if way == "shift":
        angle = random.uniform(0, 2 * np.pi)
        move = np.float32([[1, 0, distance * np.cos(angle)], [0, 1, distance * np.sin(angle)]])
        return cv2.warpAffine(mask.astype(np.float32), move, mask.shape[::-1]) > 0.5
    # Distance to the nearest pixel of the mask; for an erosion, to the nearest pixel outside the mask.
    border_distance = cv2.distanceTransform((~mask if way == "dilate" else mask).astype(np.uint8), cv2.DIST_L2, 5)
    return border_distance <= distance if way == "dilate" else border_distance > distance


def save_raw_masks(raw: dict[str, np.ndarray], folder: Path) -> Path:
    """Write a folder in the layout of the stage `raw_masks`, with exactly the given masks; return the folder.

    An existing folder is removed first.
    """
    shutil.rmtree(folder, ignore_errors=True)
    for name, mask in raw.items():
        save_mask(folder / "masks" / f"{name}.png", mask)
    return folder


def iou(estimates: list[np.ndarray], truth: list[np.ndarray]) -> float:
    """Return the intersection over union of all views together, without pixels near the true border.

    It is 1 if all masks are empty.

    Args:
        estimates: bool [H, W], one per view.
        truth: bool [H, W], one per view.
    """
    square = np.ones((2 * BORDER + 1,) * 2, np.uint8)
    both = either = 0
    for mask, true in zip(estimates, truth, strict=True):
        grown, shrunk = (change(true.astype(np.uint8), square) > 0 for change in (cv2.dilate, cv2.erode))
        counts = ~grown | shrunk
        both += np.count_nonzero(mask & true & counts)
        either += np.count_nonzero((mask | true) & counts)
    return both / either if either else 1.0


def scores(artifact: Path, scene: Scene, truth: dict[str, dict[str, np.ndarray]]) -> dict[str, dict[str, float]]:
    """Return {kind of mask: {"together", "median", "worst"}}: IoUs of all training views together and of single views.

    Args:
        artifact: folder of the stage `masks`.
        scene: the scene of the stage `poses`.
        truth: kind of mask ("consistent", "unobserved") -> view -> bool [H, W].
    """
    sets, results = load_mask_sets(artifact, scene.train), {}
    for kind, true in truth.items():
        masks, truths = [getattr(sets[name], kind) for name in scene.train], [true[name] for name in scene.train]
        each = [iou([mask], [truth_mask]) for mask, truth_mask in zip(masks, truths, strict=True)]
        results[kind] = {"together": iou(masks, truths), "median": float(np.median(each)), "worst": min(each)}
    return results


def measure(scene_folder: Path, run: Path, out: Path, seed: int) -> dict[str, dict[str, dict[str, float]]]:
    """Run the stage `masks` with exact and with perturbed input masks, and measure the results.

    Args:
        scene_folder: folder of a scene made by the generator.
        run: runs/<scene>, with the stages up to `masks`.
        out: folder for the resulting masks.
        seed: seed of the perturbations.

    Returns:
        "exact" or "perturbed" -> kind of mask -> IoU, see `scores`. "perturbed" has also the kind "input", with only
        "together": the perturbed input masks that are not missing, against the exact ones.
    """
    scene = load_scene(run / "poses")
    exact = load_raw_masks(run / "raw_masks", scene.train)
    cameras = [scene.cameras[name] for name in scene.train]
    truth = {"consistent": exact, "unobserved": true_never_seen(scene_folder, cameras)}
    random = np.random.default_rng(seeding.seed_for(seed, "perturbed masks"))
    kept = random.permutation(len(scene.train))[round(MISSING * len(scene.train)) :]
    noisy = {scene.train[k]: perturb_mask(exact[scene.train[k]], random) for k in sorted(kept)}
    params = masks_stage.Params(**load_json(run / "masks/receipt.json")["params"])
    results = {}
    for kind, raw in (("exact", exact), ("perturbed", noisy)):
        artifact = out / kind
        shutil.rmtree(artifact, ignore_errors=True)
        artifact.mkdir(parents=True)
        raw_masks = save_raw_masks(raw, out / f"raw_masks-{kind}")
        masks_stage.run(params, artifact, poses=run / "poses", raw_masks=raw_masks, fit=run / "fit")
        results[kind] = scores(artifact, scene, truth)
    results["perturbed"]["input"] = {"together": iou(list(noisy.values()), [exact[n] for n in noisy])}
    return results


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, required=True, help="folder of a scene made by `reffusion demo`")
    parser.add_argument("--run", type=Path, help="default: runs/<scene's name>")
    parser.add_argument("--out", type=Path, help="default: runs/masks/<scene's name>")
    parser.add_argument("--seed", type=int, default=0, help="of the perturbations")
    parser.add_argument("--check", action="store_true", help="exit with 1 if a required IoU is missed")
    arguments = parser.parse_args()
    name = arguments.scene.resolve().name
    run, out = arguments.run or Path("runs") / name, arguments.out or Path("runs/masks") / name
    for path in (arguments.scene / "truth/cameras.json", run / "masks/receipt.json"):
        if not path.exists():
            raise ValueError(f"{path} is missing: make the scene by `reffusion demo`, and run `make scene=... masks`")
    results = measure(arguments.scene, run, out, arguments.seed)
    (out / "masks.json").write_text(json.dumps(results, indent=1))
    missed = 0
    for kind, required in REQUIRED_IOU.items():
        for mask, least in required.items():
            row = results[kind][mask]
            missed += row["together"] < least
            numbers = f"{row['together']:.3f}, median view {row['median']:.3f}, worst {row['worst']:.3f}"
            print(f"{kind:9} {mask:10} IoU {numbers} (required: {least})")
    print(f"the perturbed masks themselves: {results['perturbed']['input']['together']:.3f}")
    return int(arguments.check and missed > 0)


if __name__ == "__main__":
    sys.exit(main())
