"""The scores of a test run: a line for each view, and what all the numbers depend on."""

from __future__ import annotations

import csv
from importlib.metadata import version
from io import StringIO
from typing import Any, NamedTuple

import numpy as np

from reffusion.background import training_coverage
from reffusion.io.images import resize_image, resize_nearest
from reffusion.metrics import consistency, image_metrics
from reffusion.metrics.consistency import Shown
from reffusion.metrics.lpips import Lpips
from reffusion.morphology import dilate

LIBRARIES = ("torch", "numpy", "opencv-contrib-python-headless")
OUTSIDE_MARGIN = 0.01  # how much wider than the mask is left out of the scores outside it, / image width
CONSISTENCY = ("consistency", "consistency_share")


class Truth(NamedTuple):
    """What a view is compared with.

    Attributes:
        picture: uint8 [H, W, 3], its own; None where the scene has none.
        shows_object: the picture has the object in it.
        unseen: bool [H, W], pixels that no training view saw; None where that is not known.
    """

    picture: np.ndarray | None
    shows_object: bool
    unseen: np.ndarray | None


def row_of(
    shown: Shown, initial: np.ndarray | None, truth: Truth, models: dict[str, Lpips], longest: int = 0
) -> dict[str, Any]:
    """A view's line of per_view.csv: its box, and its scores and those of the initialization, uint8 [H, W, 3], where
    there is a truth.

    Args:
        longest: the box is also scored with pictures reduced to this larger side in px, where theirs is larger.
    """
    camera, box = shown.camera, image_metrics.mask_box(shown.mask)
    row = {"view": camera.name, "width": camera.width, "height": camera.height} | dict.fromkeys(CONSISTENCY)
    row |= dict(zip(("left", "top", "right", "bottom"), box or (None,) * 4, strict=True))
    if truth.picture is not None:
        margin = dilate(shown.mask, OUTSIDE_MARGIN)
        scored = box is not None and not truth.shows_object
        targets = image_metrics.lpips_targets(box.crop(truth.picture), models) if scored else {}
        given = truth.picture, box, targets, margin, truth.shows_object, truth.unseen
        row |= image_metrics.score_view(shown.picture, *given)
        if initial is not None:
            scores = image_metrics.score_view(initial, *given)
            row |= {f"initialize_{column}": value for column, value in scores.items()}
        if 0 < longest < max(camera.width, camera.height) and not truth.shows_object:
            pictures = {"": shown.picture} | ({"initialize_": initial} if initial is not None else {})
            row |= _score_reduced(pictures, truth.picture, shown.mask, models, longest)
    return row


def _score_reduced(
    pictures: dict[str, np.ndarray], truth: np.ndarray, mask: np.ndarray, models: dict[str, Lpips], longest: int
) -> dict[str, Any]:
    """`REDUCED` of each picture, its key before it, and the size of all."""
    height, width = mask.shape
    factor = longest / max(width, height)
    size = max(1, round(width * factor)), max(1, round(height * factor))
    found: dict[str, Any] = {"reduced_width": size[0], "reduced_height": size[1]}
    if (box := image_metrics.mask_box(resize_nearest(mask, size[::-1]))) is None:
        return found
    true = box.crop(resize_image(truth, size))
    targets = image_metrics.lpips_targets(true, models)
    for key, picture in pictures.items():
        scores = image_metrics.score(box.crop(resize_image(picture, size)), true, targets)
        found |= {f"{key}reduced_{name}_box": value for name, value in scores.items()}
    return found


def summarize_reduced(rows: list[dict[str, Any]], longest: int) -> dict[str, Any] | None:
    """{"mean", "initialize", "views"} of `metrics.BOX_COLUMNS` at the reduced size, and {"protocol"}; None without."""
    sizes = sorted({f"{row['reduced_width']}x{row['reduced_height']}" for row in rows if "reduced_width" in row})
    if not sizes:
        return None
    values = lambda key, name: [row.get(f"{key}reduced_{name}") for row in rows]
    return {
        "mean": {name: image_metrics.mean(values("", name)) for name in image_metrics.BOX_COLUMNS},
        "initialize": {name: image_metrics.mean(values("initialize_", name)) for name in image_metrics.BOX_COLUMNS},
        "views": {name: sum(value is not None for value in values("", name)) for name in image_metrics.BOX_COLUMNS},
        "protocol": f"renders and truth reduced to {', '.join(sizes)} px (larger side at most {longest} px) by area "
        "averaging, masks by their nearest pixel, before the box is found; all else as at full size",
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, dict[str, float | int | None]]:
    """{"mean", "initialize", "views"}, each with `COLUMNS`: the means of the columns, of the columns that start with
    `initialize_`, and how many views have a value."""
    values = {
        prefix + name: [row.get(prefix + name) for row in rows]
        for prefix in ("", "initialize_")
        for name in image_metrics.COLUMNS
    }
    return {
        "mean": {name: image_metrics.mean(values[name]) for name in image_metrics.COLUMNS},
        "initialize": {name: image_metrics.mean(values[f"initialize_{name}"]) for name in image_metrics.COLUMNS},
        "views": {name: sum(value is not None for value in values[name]) for name in image_metrics.COLUMNS},
    }


def table(rows: list[dict[str, Any]]) -> str:
    """CSV, a line a view; a value that does not exist is empty, an identical image's PSNR is inf."""
    text = StringIO()
    columns = dict.fromkeys(column for row in rows for column in row)
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def versions() -> dict[str, str]:
    """The libraries that the numbers depend on."""
    import reffusion

    return {"reffusion": reffusion.__version__} | {name: version(name) for name in LIBRARIES}


def add_consistency(row: dict[str, Any], shown: Shown, following: Shown) -> None:
    """Into the line of a view, how far it agrees with the next."""
    row |= dict(zip(CONSISTENCY, consistency.difference(shown, following), strict=True))


def consistency_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """{"consistency", "consistency_share"}: means over the pairs of neighbours; {"pairs"}: how many could be compared;
    {"protocol"}."""
    difference, share = ([row[name] for row in rows] for name in CONSISTENCY)
    return {
        "consistency": image_metrics.mean(difference),
        "consistency_share": image_metrics.mean(share),
        "pairs": sum(value is not None for value in difference),
        "protocol": consistency.PROTOCOL,
    }


def protocol(rows: list[dict[str, Any]], models: dict[str, Lpips]) -> dict[str, Any]:
    """All that the numbers depend on, in words and versions."""
    return {
        **image_metrics.PROTOCOL,
        "seen": training_coverage.PROTOCOL,
        "box_dilation": image_metrics.BOX_DILATION,
        "outside_margin": OUTSIDE_MARGIN,
        "resolution": sorted({f"{row['width']}x{row['height']}" for row in rows}),
        "lpips_weights": {name: digest for model in models.values() for name, digest in model.files.items()},
        "versions": versions(),
    }
