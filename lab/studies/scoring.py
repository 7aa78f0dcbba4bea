"""Scores of a composite's result beside those of its ceiling and of Telea's method, and a sheet of pictures.

A *composite* is a real capture into whose photographs a synthetic object is drawn, see `composites.py`. Its *ceiling*
is a fit to the photographs without the object. Scores are measured in the *box*, the bounding box of a view's mask, 10
% wider on each side. A pixel is *uncovered* if no Gaussian covers it well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lab.studies.holes import gradient_energy
from reffusion.inpaint import classical
from reffusion.io.arrays import load_json
from reffusion.io.ground_truth import load_object_mask
from reffusion.io.images import load_image
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene
from reffusion.metrics import image_metrics, lpips
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Scene
from report import page
from report.sheet import compose_sheet

MIN_ALPHA = 0.9  # a pixel is uncovered if its alpha is lower
BLACK, LIT = 0.06, 0.15  # a pixel is uncovered too if its brightest channel is below BLACK and the truth's above LIT
SHEET_MARGIN = 0.6  # margin of a sheet's crop on each side, relative to the box
ROW = 200  # height of a sheet's rows, px
COLUMNS = {"lpips_vgg": 3, "psnr": 2, "ssim": 3, "flip": 3}  # column -> digits
PICTURES = ("result", "initialize", "ceiling", "telea")  # methods that each row of the table scores


@dataclass(frozen=True)
class Run:
    """Finished run of a scene, or of a variant of a scene.

    Attributes:
        folder: runs/<scene> or runs/<scene>@<variant>.
        scene: scene of the stage `poses`.
        metrics: content of metrics.json of the stage `evaluate`.
        base: folder of the scene's own run, if this is a variant; else None.
    """

    folder: Path
    scene: Scene
    metrics: dict
    base: Path | None = None

    @classmethod
    def load(cls, folder: Path) -> Run:
        """Load a scene's own run."""
        return cls(folder, load_scene(folder / "poses"), load_json(folder / "evaluate/metrics.json"))

    @classmethod
    def load_variant(cls, base: Run, folder: Path) -> Run:
        """Load the run of a variant; `base` is the scene's own run, whose stages the variant shares in part."""
        return cls(folder, base.scene, load_json(folder / "evaluate/metrics.json"), base.folder)

    def stage(self, name: str) -> Path:
        """Return the folder of a stage; for a stage that a variant shares, the folder in the scene's own run."""
        own = self.folder / name
        return own if own.exists() or self.base is None else self.base / name

    def picture(self, name: str, kind: str = "renders") -> np.ndarray:
        """Load a render of a test view by the stage `evaluate`, uint8 [H, W, 3]; `kind` is the folder of renders."""
        return load_image(self.folder / "evaluate" / kind / f"{name}.png")

    def truth(self, name: str) -> np.ndarray:
        """Load a view's photograph, uint8 [H, W, 3]; for test views it is the ground truth."""
        return load_image(self.stage("poses") / f"images/{name}.png")

    def mask(self, name: str) -> np.ndarray:
        """Load the pixels of the object in a view, bool [H, W], from its test mask if it has one.

        Other views have a consistent mask, computed by the stage `masks`, or the raw mask if the run has no such stage.
        """
        masks = self.stage("masks")
        return load_object_mask(self.scene.cameras[name], self.stage("raw_masks"), masks if masks.exists() else None)

    def seconds(self) -> float:
        """Return the sum of the seconds of all stages except `evaluate`, from the receipts in the run's folder.

        For a variant this leaves out the stages that it shares.
        """
        receipts = [load_json(path) for path in sorted(self.folder.glob("*/receipt.json"))]
        return sum(receipt["seconds"] for receipt in receipts if receipt["stage"] != "evaluate")

    def gaussians(self) -> Gaussians:
        """Load the Gaussians of the result."""
        return load_ply(self.stage(self.metrics["result"]) / "gaussians.ply")


def score_place(run: Run, ceiling: Run, variants: Mapping[str, Run]) -> dict[str, Any]:
    """Score a place: return its row of the table as a dictionary.

    Args:
        run: run of the place.
        ceiling: run on the same views without the object.
        variants: name -> run of a variant.

    Returns:
        For each of `PICTURES` the mean scores `COLUMNS` over the boxes of the test views. "sharpness": gradient energy
        of "result" and "ceiling" in the box, relative to the truth's. "uncovered": in the result, the largest uncovered
        share of a view's mask among the views of "train" and of "test". "seconds" of the run. "variants": name -> mean
        scores `COLUMNS` of the variant's result.
    """
    row: dict[str, Any] = {
        "result": _means(run.metrics["mean"]),
        "initialize": _means(run.metrics["initialize"]),
        "ceiling": _means(ceiling.metrics["mean"]),
        "telea": _telea(run),
        "sharpness": {"result": _sharpness(run), "ceiling": _sharpness(ceiling)},
        "uncovered": {
            "train": _worst(run, {name: _untouched(run, ceiling, name) for name in run.scene.train}),
            "test": _worst(run, {name: run.truth(name) for name in run.scene.test}),
        },
        "seconds": run.seconds(),
        "variants": {name: _means(each.metrics["mean"]) for name, each in variants.items()},
    }
    return row


def _means(of: dict[str, float | None]) -> dict[str, float | None]:
    return {column: of[f"{column}_box"] for column in COLUMNS}


def _telea(run: Run) -> dict[str, float | None]:
    """Score the run's own renders of the test views with their masks filled by Telea's method."""
    rows, (vgg, _) = [], lpips.load("vgg")
    models = {"vgg": vgg} if vgg else {}
    for name in run.scene.test:
        mask = run.mask(name)
        box = image_metrics.mask_box(mask)
        if box is not None:
            # A baseline without any 3D method inside the mask; the pixels outside are those of the run's result.
            painted = classical.telea(run.picture(name), mask)
            truth = box.crop(run.truth(name))
            rows.append(image_metrics.score(box.crop(painted), truth, image_metrics.lpips_targets(truth, models)))
    return {column: image_metrics.mean([row.get(column) for row in rows]) for column in COLUMNS}


def _sharpness(run: Run) -> float | None:
    """Return the mean gradient energy of the renders in the box relative to the truth's; below 1 is too smooth."""
    shares = []
    for name in run.scene.test:
        box = image_metrics.mask_box(run.mask(name))
        if box is not None:
            ours, true = box.crop(run.picture(name)), box.crop(run.truth(name))
            whole = np.ones(true.shape[:2], bool)
            shares.append(gradient_energy(ours, whole) / max(gradient_energy(true, whole), 1e-9))
    return image_metrics.mean(shares)


def _untouched(run: Run, ceiling: Run, name: str) -> np.ndarray | None:
    """Load a training view's photograph without the object, from the ceiling's run; None if its size differs."""
    picture, camera = ceiling.truth(name), run.scene.cameras[name]
    return picture if picture.shape[:2] == (camera.height, camera.width) else None


def _worst(run: Run, truths: dict[str, np.ndarray | None]) -> float | None:
    """Return the largest uncovered share of a mask; `truths` has photographs without the object, None if unknown."""
    gaussians = run.gaussians()
    worst = [
        uncovered_share(gaussians, run.scene.cameras[name], run.mask(name), truth) for name, truth in truths.items()
    ]
    return max((share for share in worst if share is not None), default=None)  # None: all masks are empty


def uncovered_share(gaussians: Gaussians, camera: Camera, mask: np.ndarray, truth: np.ndarray | None) -> float | None:
    """Return the share in [0, 1] of a mask's pixels that are uncovered; None for an empty mask.

    A pixel is uncovered if its alpha is below `MIN_ALPHA`, or if it is nearly black where the truth is not.

    Args:
        gaussians: the result.
        camera: camera of the view.
        mask: bool [H, W].
        truth: uint8 [H, W, 3]; None if unknown.
    """
    import torch

    if not mask.any():
        return None
    with torch.no_grad():
        drawing = rasterizer.render(gaussians, camera)
    bare = drawing.alpha.cpu().numpy() < MIN_ALPHA
    if truth is not None:
        bare |= (drawing.color.cpu().numpy().max(2) < BLACK) & (truth.max(2) / 255.0 > LIT)
    return float(bare[mask].mean())


def comparison_sheet(run: Run, ceiling: Run) -> np.ndarray:
    """Return a picture, uint8 [H, W, 3], with a row per test view that has a mask, cropped around the mask's box.

    The columns are the truth, the fit's render with the object, our result, the ceiling, and the absolute difference
    between our result and the truth.
    """
    rows = {}
    for name in run.scene.test:
        box, same = (image_metrics.mask_box(of.mask(name), SHEET_MARGIN) for of in (run, ceiling))
        if box is None or same is None:
            continue
        truth, ours = box.crop(run.truth(name)), box.crop(run.picture(name))
        difference = cv2.absdiff(truth, ours)
        panels = [truth, box.crop(run.picture(name, "renders_fit")), ours, same.crop(ceiling.picture(name)), difference]
        sizes = [(round(panel.shape[1] * ROW / panel.shape[0]), ROW) for panel in panels]
        rows[name] = [cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p, size in zip(panels, sizes, strict=True)]
    return compose_sheet([*rows.values()], ["truth", "with the object", "ours", "ceiling", "difference"], [*rows])


def table(rows: list[dict]) -> str:
    """Return a Markdown table with a row per place.

    Scores are LPIPS (vgg) / PSNR / SSIM / FLIP; uncovered shares are in percent. Each variant has a column of its
    scores, and a column of the full method's LPIPS divided by the variant's.

    Args:
        rows: results of `score_place`, with the place's name in "place".
    """
    variants = list(rows[0]["variants"]) if rows else []
    heads = [*PICTURES, "sharpness", "its ceiling", "uncovered, train %", "test %", "seconds"]
    heads += [head for name in variants for head in (name, f"LPIPS, ours / {name}")]
    lines = []
    for row in rows:
        cells = [_scores(row[way]) for way in PICTURES]
        cells += [_number(row["sharpness"][way], 2) for way in ("result", "ceiling")]
        cells += [_number(row["uncovered"][split], 2, 100) for split in ("train", "test")]
        cells.append(_number(row["seconds"], 0))
        for each in row["variants"].values():
            ours, theirs = row["result"]["lpips_vgg"], each["lpips_vgg"]
            cells += [_scores(each), _number(ours / theirs if ours and theirs else None, 2)]
        lines.append([row["place"], *cells])
    return page.markdown_table(["place", *heads], lines)


def _scores(of: dict[str, float | None]) -> str:
    return " / ".join(_number(of[column], digits) for column, digits in COLUMNS.items())


def _number(value: float | None, digits: int, factor: float = 1.0) -> str:
    return "-" if value is None else f"{value * factor:.{digits}f}"
