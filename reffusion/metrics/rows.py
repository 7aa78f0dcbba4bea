"""The scores of a test run: a row for each view, their means, and the protocol that all numbers depend on."""

from __future__ import annotations

import csv
from importlib.metadata import version
from io import StringIO
from typing import Any, NamedTuple

import numpy as np

from reffusion.background import training_coverage
from reffusion.io.images import resize_image, resize_nearest
from reffusion.metrics import consistency, image_metrics
from reffusion.metrics.consistency import RenderedView
from reffusion.metrics.lpips import Lpips
from reffusion.morphology import dilate

LIBRARIES = ("torch", "numpy", "opencv-contrib-python-headless")
# Margin around the mask that the scores outside it leave out, as a share of the image's width.
OUTSIDE_MARGIN = 0.01
CONSISTENCY_COLUMNS = ("consistency", "consistency_share")


class GroundTruth(NamedTuple):
    """What a view is compared with.

    Attributes:
        picture: uint8 [H, W, 3], the view's own picture; None where the scene has none.
        shows_object: the picture shows the object.
        unseen: bool [H, W], pixels that no training view saw; None where that is not known.
    """

    picture: np.ndarray | None
    shows_object: bool
    unseen: np.ndarray | None


def score_row(
    view: RenderedView, initial: np.ndarray | None, truth: GroundTruth, models: dict[str, Lpips], longest: int = 0
) -> dict[str, Any]:
    """A view's row of per_view.csv: its size, its box and, where there is a truth, its scores.

    Args:
        initial: uint8 [H, W, 3], the render of the initialization, which is scored too; None: there is none.
        longest: px; where the pictures are larger, the box is scored once more with all pictures reduced to this
            larger side. 0: never.
    """
    camera, box = view.camera, image_metrics.mask_box(view.mask)
    row = {"view": camera.name, "width": camera.width, "height": camera.height} | dict.fromkeys(CONSISTENCY_COLUMNS)
    row |= dict(zip(("left", "top", "right", "bottom"), box or (None,) * 4, strict=True))
    if truth.picture is not None:
        margin = dilate(view.mask, OUTSIDE_MARGIN)
        scored = box is not None and not truth.shows_object
        targets = image_metrics.lpips_targets(box.crop(truth.picture), models) if scored else {}
        compared_with = truth.picture, box, targets, margin, truth.shows_object, truth.unseen
        row |= image_metrics.score_view(view.picture, *compared_with)
        if initial is not None:
            scores = image_metrics.score_view(initial, *compared_with)
            row |= {f"initialize_{column}": value for column, value in scores.items()}
        if 0 < longest < max(camera.width, camera.height) and not truth.shows_object:
            pictures = {"": view.picture} | ({"initialize_": initial} if initial is not None else {})
            row |= _score_reduced(pictures, truth.picture, view.mask, models, longest)
    return row


def _score_reduced(
    pictures: dict[str, np.ndarray], truth: np.ndarray, mask: np.ndarray, models: dict[str, Lpips], longest: int
) -> dict[str, Any]:
    """{prefix + "reduced_<score>_box"} for each prefix and picture, and the reduced size of all.

    Args:
        pictures: prefix of the columns -> uint8 [H, W, 3].
        truth: uint8 [H, W, 3].
        mask: bool [H, W].
        longest: px, the larger side to which all are reduced.
    """
    height, width = mask.shape
    factor = longest / max(width, height)
    size = max(1, round(width * factor)), max(1, round(height * factor))
    columns: dict[str, Any] = {"reduced_width": size[0], "reduced_height": size[1]}
    if (box := image_metrics.mask_box(resize_nearest(mask, size[::-1]))) is None:
        return columns
    true = box.crop(resize_image(truth, size))
    targets = image_metrics.lpips_targets(true, models)
    for prefix, picture in pictures.items():
        scores = image_metrics.score(box.crop(resize_image(picture, size)), true, targets)
        columns |= {f"{prefix}reduced_{name}_box": value for name, value in scores.items()}
    return columns


def summarize(
    rows: list[dict[str, Any]], columns: tuple[str, ...] = image_metrics.COLUMNS, infix: str = ""
) -> dict[str, Any]:
    """{"mean", "initialize", "views"}, each with `columns`: the means of the columns, the means of the columns prefixed
    with `initialize_`, and how many views have a value. `infix`: what stands before a column's name in the rows."""
    values = lambda prefix, name: [row.get(f"{prefix}{infix}{name}") for row in rows]
    return {
        "mean": {name: image_metrics.mean(values("", name)) for name in columns},
        "initialize": {name: image_metrics.mean(values("initialize_", name)) for name in columns},
        "views": {name: sum(value is not None for value in values("", name)) for name in columns},
    }


def summarize_reduced(rows: list[dict[str, Any]], longest: int) -> dict[str, Any] | None:
    """{"mean", "initialize", "views"} of `image_metrics.BOX_COLUMNS` at the reduced size, and {"protocol"}; None where
    no view was reduced."""
    sizes = sorted({f"{row['reduced_width']}x{row['reduced_height']}" for row in rows if "reduced_width" in row})
    if not sizes:
        return None
    return summarize(rows, image_metrics.BOX_COLUMNS, "reduced_") | {
        "protocol": f"renders and truth reduced to {', '.join(sizes)} px (larger side at most {longest} px) by area "
        "averaging, masks by their nearest pixel, before the box is found; all else as at full size"
    }


def to_csv(rows: list[dict[str, Any]]) -> str:
    """CSV with a line for each view. A missing value is an empty cell; the PSNR of an identical image is inf."""
    text = StringIO()
    columns = dict.fromkeys(column for row in rows for column in row)
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def add_consistency(row: dict[str, Any], view: RenderedView, following: RenderedView) -> None:
    """Fill `CONSISTENCY_COLUMNS` of a view's row by comparing the view with the next one."""
    row |= dict(zip(CONSISTENCY_COLUMNS, consistency.reprojected_color_difference(view, following), strict=True))


def summarize_consistency(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """{"consistency", "consistency_share"}: means over the pairs of consecutive views; {"pairs"}: how many could be
    compared; {"protocol"}."""
    difference, share = ([row[name] for row in rows] for name in CONSISTENCY_COLUMNS)
    return {
        "consistency": image_metrics.mean(difference),
        "consistency_share": image_metrics.mean(share),
        "pairs": sum(value is not None for value in difference),
        "protocol": consistency.PROTOCOL,
    }


def library_versions() -> dict[str, str]:
    """Library -> version, of those that the numbers depend on."""
    import reffusion

    return {"reffusion": reffusion.__version__} | {name: version(name) for name in LIBRARIES}


def protocol(rows: list[dict[str, Any]], models: dict[str, Lpips]) -> dict[str, Any]:
    """All that the numbers depend on, in words and versions."""
    return {
        **image_metrics.PROTOCOL,
        "seen": training_coverage.PROTOCOL,
        "box_dilation": image_metrics.BOX_DILATION,
        "outside_margin": OUTSIDE_MARGIN,
        "resolution": sorted({f"{row['width']}x{row['height']}" for row in rows}),
        "lpips_weights": {name: digest for model in models.values() for name, digest in model.files.items()},
        "versions": library_versions(),
    }
