"""Effect of a stroke of the brush on the other views: `python -m lab.studies.strokes --runs runs/demo`.

Each run needs the stages `poses`, `raw_masks` with true masks, and `fit`. Every mask loses the fifth of the object that
lies farthest in a random direction, `--trials` directions for each run. With --erase, every mask contains the
surroundings near the object's end in this direction instead. In the view that shows the largest wrong region, a
straight stroke of 40 px is painted along this region, and this view's mask is propagated to the others. The study
prints the gain of IoU in this view, the mean and the least gain in the other views that show the wrong part, the ratio
of mean and own gain, and the least IoU of all other views.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage

from lab.studies.clicks import overlay_mask
from reffusion import seeding
from reffusion.clicks.events import Event
from reffusion.clicks.fitted_views import FittedViews
from reffusion.clicks.local_segmenter import load_local_segmenter
from reffusion.clicks.marks import Mark
from reffusion.clicks.propagation_with_network import count_all_votes, iou
from reffusion.clicks.scene_masks import evidence_loader
from reffusion.clicks.scene_segmentation import correct_scene
from reffusion.io.images import save_image
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_raw_masks, load_scene
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians
from reffusion.weights.segmenters import AUTO

CUT = 0.2  # share of the object's Gaussians that the masks lose
RIGHT = 0.99  # views whose masks have a higher IoU do not show the wrong part
LENGTH, RADIUS = 40.0, 8.0  # length of the stroke and radius of the brush, px


@torch.no_grad()
def spoil_masks(
    gaussians: Gaussians, cameras: dict[str, Camera], true: dict[str, np.ndarray], direction: np.ndarray, erase: bool
) -> dict[str, np.ndarray]:
    """Return masks, view -> bool [H, W], that are wrong at the object's end in a direction.

    Args:
        gaussians: the fit, with the object.
        cameras: the views of the masks.
        true: view -> bool [H, W], true masks.
        direction: [3].
        erase: False if the masks lack the end of the object, True if they contain its surroundings.
    """
    labels = count_all_votes(gaussians, cameras, true).shares > 0.5
    means = gaussians.means.detach().double().cpu().numpy()
    along = means @ direction
    if erase:
        end = means[labels][along[labels] > np.quantile(along[labels], 1 - CUT)].mean(0)
        size = np.linalg.norm(means[labels] - means[labels].mean(0), axis=1).mean()
        wrong = ~labels & (np.linalg.norm(means - end, axis=1) < size)
    else:
        wrong = labels & (along > np.quantile(along[labels], 1 - CUT))
    shares = torch.as_tensor(np.stack([wrong, ~wrong], -1)).to(gaussians.means)
    spoiled = {}
    for name, mask in true.items():
        features = rasterizer.render(gaussians, cameras[name], sh_degree=0, features=shares).features.numpy()
        shown = features[..., 0] > features[..., 1]
        spoiled[name] = mask | shown if erase else mask & ~shown
    return spoiled


def paint_stroke(wrong: np.ndarray, positive: bool) -> Mark:
    """Return a stroke of `LENGTH` px along the longest axis of a region, bool [H, W], through its deepest pixel."""
    depth = ndimage.distance_transform_edt(np.pad(wrong, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(depth.argmax(), depth.shape)
    middle = np.array([column + 0.5, row + 0.5])
    pixels = np.argwhere(wrong)[:, ::-1] + 0.5
    axis = np.linalg.svd(pixels - pixels.mean(0), full_matrices=False)[2][0]
    return Mark(middle + np.linspace(-0.5, 0.5, 9)[:, None] * LENGTH * axis, positive, RADIUS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, nargs="+", required=True)
    parser.add_argument("--trials", type=int, default=3, help="number of directions for each run")
    parser.add_argument("--erase", action="store_true", help="masks that are too large, instead of too small")
    parser.add_argument("--segmenter", default=AUTO, help="auto, none, or a folder")
    parser.add_argument("--sheets", type=Path, help="folder for pictures: the view with the stroke, and five others")
    arguments = parser.parse_args()
    segmenter, ratios = load_local_segmenter(arguments.segmenter), []
    for run in arguments.runs:
        scene, gaussians = load_scene(run / "poses"), load_ply(run / "fit/gaussians.ply")
        true = load_raw_masks(run / "raw_masks", scene.train)
        cameras = {name: scene.cameras[name] for name in true}
        views = FittedViews(gaussians, cameras, evidence_loader(scene, gaussians, run / "poses", segmenter))
        for trial in range(arguments.trials):
            direction = np.random.default_rng(seeding.seed_for(trial, "cut")).normal(size=3)
            masks = spoil_masks(gaussians, cameras, true, direction, arguments.erase)
            name = max(true, key=lambda view: int((true[view] ^ masks[view]).sum()))
            if iou(true[name], masks[name]) > RIGHT:
                continue  # nothing stands around this end of the object
            stroke = paint_stroke(true[name] ^ masks[name], not arguments.erase)
            after = correct_scene(views, [Event(name, stroke)], 1, masks, (), {})
            gains = {view: iou(after[view], true[view]) - iou(masks[view], true[view]) for view in true}
            shown = [view for view in true if view != name and iou(masks[view], true[view]) < RIGHT]
            others = np.array([gains[view] for view in shown])
            ratios.append(others.mean() / gains[name])
            text = f"own {gains[name]:+.3f}, others {others.mean():+.3f} ({others.min():+.3f} and more)"
            least = min(iou(after[view], true[view]) for view in true if view != name)
            print(f"{run.name} {trial}: {text}, ratio {ratios[-1]:.2f}, least IoU {least:.3f}", flush=True)
            if arguments.sheets:
                some = [name, *sorted(shown, key=gains.__getitem__)[:: max(1, len(shown) // 4)][:5]]
                rows = [
                    np.hstack([overlay_mask(views.evidence_of(view).image, each[view]) for view in some])
                    for each in (true, masks, after)
                ]
                save_image(arguments.sheets / f"{run.name}-{trial}.png", np.vstack(rows))
    print(f"half or more in {sum(ratio >= 0.5 for ratio in ratios)} of {len(ratios)}")


if __name__ == "__main__":
    main()
