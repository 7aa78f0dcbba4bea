"""Masks from simulated clicks against true masks: `python -m lab.studies.clicks --runs runs/demo`.

Each run needs the stages `poses`, `raw_masks` with true masks, and `fit`. --outlines takes true masks of some views
from a file instead, such as lab/studies/bear_outlines.json: the stone bear of instruct-nerf2nerf's `bear`, drawn
by hand. The study clicks on the middle view that has a true mask, as a person would: each click is in the middle of the
largest error of this view's current mask, until the mask is good or there are --clicks clicks. Masks of all training
views are then made from these clicks. The study prints the IoU of the clicked view after each click, then the mean and
the worst IoU over all views with true masks. With --segmenter none, no segmentation network is used. --sheets writes
pictures of the masks over three views and the worst view.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage

from reffusion.clicks.corrections import apply_marks
from reffusion.clicks.events import Event
from reffusion.clicks.fitted_views import FittedViews
from reffusion.clicks.local_segmenter import load_local_segmenter
from reffusion.clicks.marks import Mark
from reffusion.clicks.propagation_with_network import iou
from reffusion.clicks.scene_masks import evidence_loader
from reffusion.clicks.scene_segmentation import segment_scene
from reffusion.clicks.segmenter import Segmenter
from reffusion.clicks.single_view import ViewEvidence
from reffusion.io.arrays import load_json
from reffusion.io.images import save_image
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_raw_masks, load_scene, load_views
from reffusion.types import Scene
from reffusion.weights.segmenters import AUTO

SHIFT = 4  # fractional bits of corner coordinates in cv2.fillPoly
GOOD_IOU = 0.94  # a person would not correct a mask whose IoU is higher
TINT = (255, 0, 160)


def next_click(mask: np.ndarray, true: np.ndarray) -> tuple[float, float, bool]:
    """Return the next click as (x, y, on the object), where the mask is most wrong.

    The click is the center, in px, of the pixel deepest inside the missing or the superfluous regions of the mask. It
    is on the object (True) if the region is missing.

    Args:
        mask: bool [H, W], current mask.
        true: bool [H, W], true mask.
    """
    depths = [ndimage.distance_transform_edt(np.pad(wrong, 1))[1:-1, 1:-1] for wrong in (mask & ~true, true & ~mask)]
    missing = bool(depths[1].max() >= depths[0].max())
    row, column = np.unravel_index(depths[missing].argmax(), true.shape)
    return column + 0.5, row + 0.5, missing


def simulate_clicks(view: ViewEvidence, true: np.ndarray, most: int) -> list[Mark]:
    """Simulate the clicks of a person on a view, starting without a mask; return them and print the IoU after each.

    Args:
        view: the view.
        true: bool [H, W], true mask.
        most: largest number of clicks. Fewer suffice if the IoU reaches `GOOD_IOU`.
    """
    marks: list[Mark] = []
    mask = np.zeros_like(true)
    while len(marks) < most and iou(mask, true) < GOOD_IOU:
        x, y, positive = next_click(mask, true)
        marks.append(Mark(np.array([[x, y]]), positive))
        began = time.monotonic()
        mask = apply_marks(view, marks, mask, first=len(marks) - 1)
        print(f"  click {len(marks)}: {iou(mask, true):.3f}, {time.monotonic() - began:.1f} s", flush=True)
    return marks


def load_outlines(path: Path, scene: Scene) -> dict[str, np.ndarray]:
    """Load true masks from a JSON file of outlines, as {view: bool [H, W]}.

    The file has a list of polygons for each view. A polygon is a list of corners [x, y] in px of the undistorted view.
    """
    masks = {}
    for name, polygons in load_json(path).items():
        painted = np.zeros((scene.cameras[name].height, scene.cameras[name].width), np.uint8)
        for polygon in polygons:
            corners = np.round((np.array(polygon) - 0.5) * 2**SHIFT).astype(np.int32)
            cv2.fillPoly(painted, [corners], 1, shift=SHIFT)
        masks[name] = painted > 0
    return masks


def evaluate_run(
    run: Path, most: int, segmenter: Segmenter | None, outlines: Path | None = None, sheet: Path | None = None
) -> str:
    """Simulate clicks on the middle view with a true mask, make masks of all views, and return a line of text.

    The line has the number of clicks, the mean and the worst IoU over the views with true masks, and the wall seconds
    of making all masks.

    Args:
        run: runs/<scene>.
        most: largest number of clicks.
        segmenter: segmentation network; None for none.
        outlines: file of true masks; None for the masks of the stage `raw_masks`.
        sheet: picture of some masks to write; None for none.

    Raises:
        ValueError: there are no true masks.
    """
    scene = load_scene(run / "poses")
    true = load_outlines(outlines, scene) if outlines else load_raw_masks(run / "raw_masks", scene.train)
    if not true:
        raise ValueError(f"{run / 'raw_masks/masks'}: no masks to compare with")
    names, gaussians = sorted(true), load_ply(run / "fit/gaussians.ply")
    view = names[len(names) // 2]
    evidence_of = evidence_loader(scene, gaussians, run / "poses", segmenter)
    marks = simulate_clicks(evidence_of(view), true[view], most)
    began, cameras = time.monotonic(), {name: scene.cameras[name] for name in scene.train if name not in scene.clean}
    estimates = segment_scene(FittedViews(gaussians, cameras, evidence_of), [Event(view, mark) for mark in marks], {})
    seconds = time.monotonic() - began
    shares = {name: iou(estimates[name], true[name]) for name in names}
    worst = min(shares, key=shares.__getitem__)
    if sheet:
        some, images = [*names[:: max(1, len(names) // 3)][:3], worst], load_views(run / "poses", names)
        save_image(sheet, np.hstack([overlay_mask(images[name], estimates[name]) for name in some]))
    mean = float(np.mean(list(shares.values())))
    return f"{run.name}: {len(marks)} clicks, mean {mean:.3f}, worst {shares[worst]:.3f} ({worst}), {seconds:.1f} s"


def overlay_mask(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return a picture with its mask tinted, uint8 [H, W, 3]."""
    return np.where(mask[..., None], 0.5 * image + 0.5 * np.array(TINT), image).round().astype(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, nargs="+", required=True)
    parser.add_argument("--clicks", type=int, default=5, help="largest number of clicks")
    parser.add_argument("--segmenter", default=AUTO, help="auto, none, or a folder")
    parser.add_argument("--outlines", type=Path, help="true masks of some views, as polygons")
    parser.add_argument("--sheets", type=Path, help="folder for pictures")
    arguments = parser.parse_args()
    segmenter = load_local_segmenter(arguments.segmenter)
    for run in arguments.runs:
        sheet = arguments.sheets / f"{run.name}.png" if arguments.sheets else None
        print(evaluate_run(run, arguments.clicks, segmenter, arguments.outlines, sheet), flush=True)


if __name__ == "__main__":
    main()
