"""How the depth term finds the depth of a view: with a depth network, or by continuing the scene's own depth."""

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
    """Estimates the depth of a view.

    Attributes:
        how: which rendered depth counts as known.
        disparity: (what the view shows of the scene's depth, a function that returns the view with its hole repainted)
            -> disparity [H, W] in the scene's units. The image, [H, W, 3] in [0, 1], is painted only if the function
            is called. Raises Degenerate where the disparity is undetermined.
    """

    how: CompletionSettings
    disparity: Callable[[ViewDepth, Callable[[], np.ndarray]], np.ndarray]


def build_estimator(params: Params, points: np.ndarray) -> DepthEstimator:
    """The depth term's estimator: with a network if one is named, else the scene's own depth continued.

    Args:
        points: [P, 3] sparse points of the scene.
    """
    # PAPER leaves open: whether an estimate is aligned by least squares or robustly on known pixels; least squares.
    how = CompletionSettings(robust=False, seed=params.seed)
    if not params.depth.model:
        return continuation_estimator(points, how)
    network = monocular.load_network(params.depth.model, params.device)
    return network_estimator(partial(monocular.predict_disparity, network), how)


def continuation_estimator(points: np.ndarray, how: CompletionSettings) -> DepthEstimator:
    """An estimator without a depth network: it continues the scene's own depth around the hole through it.

    Args:
        points: [P, 3] sparse points of the scene.
    """
    return DepthEstimator(how, lambda view, picture: background_depth.continue_depth(view, picture, points, how)[0])


def network_estimator(network: Callable[[Tensor], Tensor], how: CompletionSettings) -> DepthEstimator:
    """The paper's estimator: a network's depth of the repainted view, aligned and passed through the bilateral solver.

    Args:
        network: [3, H, W] in [0, 1] -> [H, W] disparity up to scale and offset.
    """

    def disparity(view: ViewDepth, picture: Callable[[], np.ndarray]) -> np.ndarray:
        painted = picture()
        estimate = network(torch.from_numpy(painted).float().permute(2, 0, 1)).double().cpu().numpy()
        return estimates.align_estimate(view, painted, estimate, how)[0]

    return DepthEstimator(how, disparity)
