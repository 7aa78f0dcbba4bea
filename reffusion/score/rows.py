"""The scores of a test run: a line for each view, and what all the numbers depend on."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from reffusion.paint.margin import widened
from reffusion.score import consistency, metrics, sight
from reffusion.score.consistency import Shown
from reffusion.score.lpips import Lpips

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


def row_of(shown: Shown, initial: np.ndarray | None, truth: Truth, models: dict[str, Lpips]) -> dict[str, Any]:
    """A view's line of per_view.csv: its box, and its scores and those of the initialization, uint8 [H, W, 3], where
    there is a truth."""
    camera, box = shown.camera, metrics.mask_box(shown.mask)
    row = {"view": camera.name, "width": camera.width, "height": camera.height} | dict.fromkeys(CONSISTENCY)
    row |= dict(zip(("left", "top", "right", "bottom"), box or (None,) * 4, strict=True))
    if truth.picture is not None:
        margin = widened(shown.mask, OUTSIDE_MARGIN)
        scored = box is not None and not truth.shows_object
        targets = metrics.lpips_targets(box.crop(truth.picture), models) if scored else {}
        given = truth.picture, box, targets, margin, truth.shows_object, truth.unseen
        row |= metrics.score_view(shown.picture, *given)
        if initial is not None:
            scores = metrics.score_view(initial, *given)
            row |= {f"initialize_{column}": value for column, value in scores.items()}
    return row


def add_consistency(row: dict[str, Any], shown: Shown, following: Shown) -> None:
    """Into the line of a view, how far it agrees with the next."""
    row |= dict(zip(CONSISTENCY, consistency.difference(shown, following), strict=True))


def consistency_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """{"consistency", "consistency_share"}: means over the pairs of neighbours; {"pairs"}: how many could be compared;
    {"protocol"}."""
    difference, share = ([row[name] for row in rows] for name in CONSISTENCY)
    return {
        "consistency": metrics.mean(difference),
        "consistency_share": metrics.mean(share),
        "pairs": sum(value is not None for value in difference),
        "protocol": consistency.PROTOCOL,
    }


def protocol(rows: list[dict[str, Any]], models: dict[str, Lpips]) -> dict[str, Any]:
    """All that the numbers depend on, in words and versions."""
    return {
        **metrics.PROTOCOL,
        "seen": sight.PROTOCOL,
        "box_dilation": metrics.BOX_DILATION,
        "outside_margin": OUTSIDE_MARGIN,
        "resolution": sorted({f"{row['width']}x{row['height']}" for row in rows}),
        "lpips_weights": {name: digest for model in models.values() for name, digest in model.files.items()},
        "versions": metrics.versions(),
    }
