"""Scores of the rendered views: one row for each view, the means over views, and the protocol of the measurement."""

from __future__ import annotations

import csv
from importlib.metadata import version
from io import StringIO
from typing import Any, NamedTuple

import numpy as np

from reffusion.background import training_coverage
from reffusion.io.images import fitting_size, resize_image, resize_nearest
from reffusion.metrics import consistency, image_metrics, imfine, leftovers
from reffusion.metrics.consistency import RenderedView
from reffusion.metrics.lpips import Lpips
from reffusion.morphology import dilate

LIBRARIES = ("torch", "numpy", "opencv-contrib-python-headless")
# Share of the image's width: the mask grows by this margin before pixels outside it are scored.
OUTSIDE_MARGIN = 0.01
CONSISTENCY_COLUMNS = ("consistency", "consistency_share")


class GroundTruth(NamedTuple):
    """The picture with which a rendered view is compared.

    Attributes:
        picture: uint8 [H, W, 3], the photograph of the view; None if the scene has none.
        shows_object: True if the picture shows the object.
        unseen: bool [H, W], True = no training view shows the surface of this pixel; None if unknown.
    """

    picture: np.ndarray | None
    shows_object: bool
    unseen: np.ndarray | None


def score_row(
    view: RenderedView, initial: np.ndarray | None, truth: GroundTruth, models: dict[str, Lpips], longest: int = 0
) -> dict[str, Any]:
    """Return the row of a view in per_view.csv: its size, its mask's box and, if there is a ground truth, its scores.

    The `CONSISTENCY_COLUMNS` are None until `add_consistency` fills them.

    Args:
        view: the rendered view; its mask is the object.
        initial: uint8 [H, W, 3], the rendering of the initialization (the scene before `distill`), which is scored in
            the columns `initialize_*`; None if there is none.
        truth: the ground truth.
        models: name of the network ("alex" or "vgg") -> LPIPS network.
        longest: px. If the picture's larger side exceeds this, the box is also scored after all pictures are reduced to
            this larger side, in the columns `reduced_*` and `initialize_reduced_*`, unless the ground truth shows the
            object. 0 for never.
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
        if scored:
            row |= imfine.score_view(view.picture, truth.picture, view.mask, models)
        if 0 < longest < max(camera.width, camera.height) and not truth.shows_object:
            pictures = {"": view.picture} | ({"initialize_": initial} if initial is not None else {})
            row |= _score_reduced(pictures, truth.picture, view.mask, models, longest)
    return row


def _score_reduced(
    pictures: dict[str, np.ndarray], truth: np.ndarray, mask: np.ndarray, models: dict[str, Lpips], longest: int
) -> dict[str, Any]:
    """Score the mask's box of pictures (by prefix of the columns), reduced to `longest` px on the larger side."""
    size = fitting_size(mask.shape[1], mask.shape[0], longest)
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
    """Summarize columns over all views.

    Args:
        rows: the rows of `score_row`.
        columns: names of the columns.
        infix: text that precedes a column's name in the rows, after `initialize_`; for example "reduced_".

    Returns:
        "mean": column -> mean over the views that have a value (`image_metrics.mean`), None if none has. "initialize":
        the same for the column `initialize_<column>`. "views": column -> number of views that have a value in the
        column itself.
    """
    values = lambda prefix, name: [row.get(f"{prefix}{infix}{name}") for row in rows]
    return {
        "mean": {name: image_metrics.mean(values("", name)) for name in columns},
        "initialize": {name: image_metrics.mean(values("initialize_", name)) for name in columns},
        "views": {name: sum(value is not None for value in values("", name)) for name in columns},
    }


def summarize_reduced(rows: list[dict[str, Any]], longest: int) -> dict[str, Any] | None:
    """Summarize the scores of the box at reduced size: `summarize` of `image_metrics.BOX_COLUMNS`, and "protocol".

    The result is None if no view was reduced.

    Args:
        longest: px, the larger side after the reduction, for the text of the protocol.
    """
    sizes = sorted({f"{row['reduced_width']}x{row['reduced_height']}" for row in rows if "reduced_width" in row})
    if not sizes:
        return None
    return summarize(rows, image_metrics.BOX_COLUMNS, "reduced_") | {
        "protocol": f"renders and truth reduced to {', '.join(sizes)} px (larger side at most {longest} px) by area "
        "averaging, masks by their nearest pixel, before the box is found; all else as at full size"
    }


def summarize_imfine(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Summarize the scores by the protocol of `imfine`: "mean", "views" and "protocol", as in `summarize`."""
    values = {name: [row.get(imfine.PREFIX + name) for row in rows] for name in imfine.COLUMNS}
    return {
        "mean": {name: image_metrics.mean(each) for name, each in values.items()},
        "views": {name: sum(value is not None for value in each) for name, each in values.items()},
        "protocol": imfine.PROTOCOL,
    }


def summarize_leftovers(rows: list[dict[str, Any]], unavailable: str | None) -> dict[str, Any]:
    """Summarize how much of the removed object is still found in the views.

    Args:
        unavailable: why the network cannot be used; None if it can.

    Returns:
        "share": mean over the examined views, None without any; "found": number of views with a leftover; "views":
        number of examined views; "unavailable"; "protocol".
    """
    shares = [row[leftovers.COLUMN] for row in rows if row.get(leftovers.COLUMN) is not None]
    found = sum(share > 0 for share in shares)
    about = {"unavailable": unavailable, "protocol": leftovers.PROTOCOL}
    return {"share": image_metrics.mean(shares), "found": found, "views": len(shares), **about}


def to_csv(rows: list[dict[str, Any]]) -> str:
    """Format rows as CSV with a header and a line for each view.

    A missing value gives an empty cell. The PSNR of an identical image is written as inf.
    """
    text = StringIO()
    columns = dict.fromkeys(column for row in rows for column in row)
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def add_consistency(row: dict[str, Any], view: RenderedView, following: RenderedView) -> None:
    """Compare a view with the next view, and write the result into `CONSISTENCY_COLUMNS` of `row`, the first view's."""
    row |= dict(zip(CONSISTENCY_COLUMNS, consistency.reprojected_color_difference(view, following), strict=True))


def summarize_consistency(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Summarize the multi-view consistency over the pairs of consecutive views.

    Returns:
        "consistency", the color difference (0 = consistent), and "consistency_share", the share of the mask's pixels
        that were compared: means over the pairs that have a value, None if none has. "pairs": number of pairs that
        could be compared. "protocol": description of the measurement.
    """
    difference, share = ([row[name] for row in rows] for name in CONSISTENCY_COLUMNS)
    return {
        "consistency": image_metrics.mean(difference),
        "consistency_share": image_metrics.mean(share),
        "pairs": sum(value is not None for value in difference),
        "protocol": consistency.PROTOCOL,
    }


def library_versions() -> dict[str, str]:
    """Return the versions of reffusion and of the libraries that the scores depend on: name -> version."""
    import reffusion

    return {"reffusion": reffusion.__version__} | {name: version(name) for name in LIBRARIES}


def protocol(rows: list[dict[str, Any]], models: dict[str, Lpips]) -> dict[str, Any]:
    """Describe how the scores were measured: definitions, image sizes, digests of LPIPS weights, versions of libraries.

    Args:
        rows: the rows of `score_row`.
        models: name of the network ("alex" or "vgg") -> LPIPS network.
    """
    return {
        **image_metrics.PROTOCOL,
        "seen": training_coverage.PROTOCOL,
        "box_dilation": image_metrics.BOX_DILATION,
        "outside_margin": OUTSIDE_MARGIN,
        "resolution": sorted({f"{row['width']}x{row['height']}" for row in rows}),
        "lpips_weights": {name: digest for model in models.values() for name, digest in model.files.items()},
        "versions": library_versions(),
    }
