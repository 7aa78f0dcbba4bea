"""Scores of a composite's result beside its ceiling and Telea's method, uncovered pixels, and a sheet of pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.studies.holes import gradient_energy
from reffusion.inpaint import classical
from reffusion.io.arrays import load_json
from reffusion.io.ground_truth import load_object_mask
from reffusion.io.images import load_image
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene
from reffusion.metrics import image_metrics, lpips
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Scene

MIN_ALPHA = 0.9  # a pixel is uncovered below this alpha
BLACK, LIT = 0.06, 0.15  # or if its brightest channel is below BLACK where the truth's is above LIT
SHEET_MARGIN = 0.6  # margin of a sheet's crop on each side, relative to the box
ROW = 200  # height of a sheet's rows, px
COLUMNS = {"lpips_vgg": 3, "psnr": 2, "ssim": 3, "flip": 3}  # column -> digits
PICTURES = ("result", "initialize", "ceiling", "telea")


@dataclass(frozen=True)
class Run:
    """A finished job: its folder, its scene, and the metrics of evaluate."""

    folder: Path
    scene: Scene
    metrics: dict
    base: Path | None = None

    @classmethod
    def load(cls, folder: Path) -> Run:
        return cls(folder, load_scene(folder / "poses"), load_json(folder / "evaluate/metrics.json"))

    @classmethod
    def load_variant(cls, base: Run, folder: Path) -> Run:
        """Load a variant's run, which shares with `base` the stages for which it has no folder."""
        return cls(folder, base.scene, load_json(folder / "evaluate/metrics.json"), base.folder)

    def stage(self, name: str) -> Path:
        """Folder of a stage; the base run's if a variant has none."""
        own = self.folder / name
        return own if own.exists() or self.base is None else self.base / name

    def picture(self, name: str, kind: str = "renders") -> np.ndarray:
        """uint8 [H, W, 3]: a test view as evaluate rendered it."""
        return load_image(self.folder / "evaluate" / kind / f"{name}.png")

    def truth(self, name: str) -> np.ndarray:
        """uint8 [H, W, 3]: a test view's photograph."""
        return load_image(self.stage("poses") / f"images/{name}.png")

    def mask(self, name: str) -> np.ndarray:
        """bool [H, W]: pixels of the object, from the test mask of a test view, else the consistent mask."""
        masks = self.stage("masks")
        return load_object_mask(self.scene.cameras[name], self.stage("raw_masks"), masks if masks.exists() else None)

    def seconds(self) -> float:
        """Of all stages but evaluate, by their receipts."""
        receipts = [load_json(path) for path in sorted(self.folder.glob("*/receipt.json"))]
        return sum(receipt["seconds"] for receipt in receipts if receipt["stage"] != "evaluate")

    def gaussians(self) -> Gaussians:
        """The result's Gaussians."""
        return load_ply(self.stage(self.metrics["result"]) / "gaussians.ply")


def score_place(run: Run, ceiling: Run, variants: Mapping[str, Run]) -> dict[str, Any]:
    """A place's row of the table.

    PICTURES -> means of COLUMNS over the test views' boxes (+ 10 %); "sharpness" of result and ceiling; "uncovered",
    the worst view's share, of "train" and "test"; "seconds" of the job; "variants", COLUMNS of each.
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
    """Scores of Telea's filling of the test masks in our own renders: our surroundings, no method in the mask."""
    rows, (vgg, _) = [], lpips.load("vgg")
    models = {"vgg": vgg} if vgg else {}
    for name in run.scene.test:
        mask = run.mask(name)
        box = image_metrics.mask_box(mask)
        if box is not None:
            painted = classical.telea(run.picture(name), mask)
            truth = box.crop(run.truth(name))
            rows.append(image_metrics.score(box.crop(painted), truth, image_metrics.lpips_targets(truth, models)))
    return {column: image_metrics.mean([row.get(column) for row in rows]) for column in COLUMNS}


def _sharpness(run: Run) -> float | None:
    """Mean over the test views of the gradient energy in the box over that of the truth; 1 is as sharp."""
    shares = []
    for name in run.scene.test:
        box = image_metrics.mask_box(run.mask(name))
        if box is not None:
            ours, true = box.crop(run.picture(name)), box.crop(run.truth(name))
            whole = np.ones(true.shape[:2], bool)
            shares.append(gradient_energy(ours, whole) / max(gradient_energy(true, whole), 1e-9))
    return image_metrics.mean(shares)


def _untouched(run: Run, ceiling: Run, name: str) -> np.ndarray | None:
    """A training view's photograph without the object, from the ceiling's fit; None if its size differs."""
    picture, camera = ceiling.truth(name), run.scene.cameras[name]
    return picture if picture.shape[:2] == (camera.height, camera.width) else None


def _worst(run: Run, truths: dict[str, np.ndarray | None]) -> float | None:
    """Largest uncovered share over the named views."""
    gaussians = run.gaussians()
    worst = [
        uncovered_share(gaussians, run.scene.cameras[name], run.mask(name), truth) for name, truth in truths.items()
    ]
    return max((share for share in worst if share is not None), default=None)


def uncovered_share(gaussians: Gaussians, camera: Camera, mask: np.ndarray, truth: np.ndarray | None) -> float | None:
    """Share of a mask's pixels, bool [H, W], that nothing covers; None for an empty mask.

    A pixel is uncovered if alpha is below MIN_ALPHA, or if it is near black and the truth, uint8 [H, W, 3], is not.
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
    """uint8 [H, W, 3], a row per test view around its box.

    Columns: truth, with the object (the fit's render), ours, ceiling, absolute difference between ours and the truth.
    """
    rows = []
    for name in run.scene.test:
        box, same = (image_metrics.mask_box(of.mask(name), SHEET_MARGIN) for of in (run, ceiling))
        if box is None or same is None:
            continue
        truth, ours = box.crop(run.truth(name)), box.crop(run.picture(name))
        difference = cv2.absdiff(truth, ours)
        panels = [truth, box.crop(run.picture(name, "renders_fit")), ours, same.crop(ceiling.picture(name)), difference]
        rows.append(_row(panels))
    width = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(row, ((0, 4), (0, width - row.shape[1]), (0, 0))) for row in rows])


def _row(panels: list[np.ndarray]) -> np.ndarray:
    """Panels side by side, scaled to a height of ROW px, with 4 px of black between them."""
    scaled = [cv2.resize(p, (round(p.shape[1] * ROW / p.shape[0]), ROW), interpolation=cv2.INTER_AREA) for p in panels]
    return np.concatenate([np.pad(p, ((0, 0), (0, 4), (0, 0))) for p in scaled], 1)


def table(rows: list[dict]) -> str:
    """Markdown table with a row per place.

    Scores are LPIPS (vgg) / PSNR / SSIM / FLIP, shares in percent; each variant has its scores and the ratio of our
    LPIPS to its.
    """
    variants = list(rows[0]["variants"]) if rows else []
    heads = [*PICTURES, "sharpness", "its ceiling", "uncovered, train %", "test %", "seconds"]
    heads += [head for name in variants for head in (name, f"LPIPS, ours / {name}")]
    lines = ["| place | " + " | ".join(heads) + " |", "|---" * (len(heads) + 1) + "|"]
    for row in rows:
        cells = [_scores(row[way]) for way in PICTURES]
        cells += [_number(row["sharpness"][way], 2) for way in ("result", "ceiling")]
        cells += [_number(row["uncovered"][split], 2, 100) for split in ("train", "test")]
        cells.append(_number(row["seconds"], 0))
        for each in row["variants"].values():
            ours, theirs = row["result"]["lpips_vgg"], each["lpips_vgg"]
            cells += [_scores(each), _number(ours / theirs if ours and theirs else None, 2)]
        lines.append(f"| {row['place']} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _scores(of: dict[str, float | None]) -> str:
    return " / ".join(_number(of[column], digits) for column, digits in COLUMNS.items())


def _number(value: float | None, digits: int, factor: float = 1.0) -> str:
    return "-" if value is None else f"{value * factor:.{digits}f}"
