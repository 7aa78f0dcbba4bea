"""Evaluation of a scene: which views are rendered, what training views cannot show of them, and the scores of each."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np

from reffusion import trace
from reffusion.background import training_coverage
from reffusion.kernels.compiled import map_in_threads, views_at_once
from reffusion.metrics import leftovers, rows
from reffusion.metrics.consistency import RenderedView
from reffusion.metrics.view_renders import ViewRenders
from reffusion.types import Gaussians, Scene

MAX_UNSCORED = 64  # most training views that are rendered where there are no test views


def views_to_render(scene: Scene) -> tuple[tuple[str, ...], str]:
    """Return the names of the views to render, and their kind, e.g. "test", "training" or "training (one in 2)".

    The views are the test views; without test views all training views, or every n-th one if there are more than
    `MAX_UNSCORED`.
    """
    if scene.test:
        return scene.test, "test"
    step = -(-len(scene.train) // MAX_UNSCORED)
    return scene.train[::step], "training" + (f" (one in {step})" if step > 1 else "")


def unseen_by_training(
    scene: Scene, gaussians: Gaussians, object_masks: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Find the pixels of the test views that show surfaces which no training view saw.

    Args:
        scene: the scene.
        gaussians: those of the stage `fit`.
        object_masks: training view -> bool [H, W], the pixels of the object.

    Returns:
        Test view -> bool [H, W], True = unseen; empty without test views.
    """
    if not scene.test:
        return {}
    views = training_coverage.render_coverage_views(gaussians, [scene.cameras[n] for n in scene.train], object_masks)
    return {name: training_coverage.unseen_pixels(gaussians, scene.cameras[name], views) for name in scene.test}


@dataclass(frozen=True)
class ViewScorer:
    """What scores the renders of a view.

    Attributes:
        models: name -> LPIPS network.
        longest: larger side in px of the reduced pictures that are scored as well; 0 for none.
        segmenter: network that looks for leftovers of the object; None if it is not on this machine.
        examined: names of the views in which the network looks for leftovers.
    """

    models: Mapping[str, Any]
    longest: int
    segmenter: Any
    examined: Collection[str]

    def score(self, renders: ViewRenders, truth: rows.GroundTruth) -> dict[str, Any]:
        """Return the row of per_view.csv for a view: `rows.score_row`, and leftovers if the view is examined."""
        result, fit = renders.result, renders.by_stage["fit"]
        row = rows.score_row(result, renders.by_stage.get("initialize"), truth, dict(self.models), self.longest)
        if self.segmenter and result.camera.name in self.examined and result.mask.any():
            row[leftovers.COLUMN] = leftovers.measure_share(self.segmenter, fit, result.picture, result.mask)
        return row


def score_in_order(
    evaluate_view: Callable[[str], tuple[RenderedView, dict[str, Any]]], names: Sequence[str], device: str
) -> list[dict[str, Any]]:
    """Return the rows of all views, in their order, each with the consistency between the view and the next one.

    The consistency of the last view is None. Progress is printed.

    Args:
        evaluate_view: returns the result of a view and its row; it is called for several views at once.
        names: the views, in the order of the camera's path.
        device: where the views are rendered.
    """
    scored: list[dict[str, Any]] = []
    previous = None
    with closing(map_in_threads(evaluate_view, names, views_at_once(device))) as views:
        for _ in trace.progress(len(names), "evaluate"):
            view, row = next(views)
            if previous:
                rows.add_consistency(scored[-1], previous, view)
            previous = view
            scored.append(row)
    return scored
