"""Estimators of a view's depth for the depth term: a depth network, or the continuation of the scene's own depth."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from reffusion.depth import background_depth, estimates, monocular
from reffusion.depth.background_depth import CompletionSettings, ViewDepth
from reffusion.params.distill import Params


class DepthEstimator(NamedTuple):
    """An estimator of the depth of a view.

    Attributes:
        how: Settings of the estimate, which also determine at which pixels the rendered depth counts as known.
        disparity: Function of a `ViewDepth` and of a function without arguments. It returns the disparity [H, W], 1 /
            camera z in the normalized frame. The second argument returns the view with its hole repainted, [H, W, 3] in
            [0, 1]. It runs the diffusion prior, so the estimator calls it only if the picture is needed. The estimator
            raises Degenerate if the view does not determine the disparity.
    """

    how: CompletionSettings
    disparity: Callable[[ViewDepth, Callable[[], np.ndarray]], np.ndarray]


def build_estimator(params: Params, points: np.ndarray) -> DepthEstimator:
    """Return the estimator of the depth term: with a depth network if the parameters name one, else without.

    Args:
        params: Parameters of the stage `distill`.
        points: [P, 3] sparse points of the scene.

    Raises:
        ValueError: The network cannot be loaded (see `monocular.load_network`).
    """
    # PAPER leaves open: whether an estimate is aligned by least squares or robustly. Here it is least squares.
    how = CompletionSettings(seed=params.seed)
    if not params.depth.model:
        return continuation_estimator(points, how)
    network = monocular.load_network(params.depth.model, params.device)
    return network_estimator(partial(monocular.predict_disparity, network), how)


def continuation_estimator(points: np.ndarray, how: CompletionSettings) -> DepthEstimator:
    """Return an estimator without a depth network, which continues the scene's own depth into the hole.

    Args:
        points: [P, 3] sparse points of the scene.
        how: Settings of the continuation.
    """
    return DepthEstimator(how, lambda view, picture: background_depth.continue_depth(view, picture, points, how)[0])


def network_estimator(network: Callable[[Tensor], Tensor], how: CompletionSettings) -> DepthEstimator:
    """Return the paper's estimator, which takes a network's depth of the repainted view.

    The depth is aligned with the scene and corrected by the bilateral solver (`estimates.align_estimate`).

    Args:
        network: Function of a picture [3, H, W] in [0, 1] that returns disparity [H, W] up to scale and offset.
        how: Settings of the alignment.
    """

    def disparity(view: ViewDepth, picture: Callable[[], np.ndarray]) -> np.ndarray:
        painted = picture()
        estimate = network(torch.from_numpy(painted).float().permute(2, 0, 1)).double().cpu().numpy()
        return estimates.align_estimate(view, painted, estimate)[0]

    return DepthEstimator(how, disparity)
