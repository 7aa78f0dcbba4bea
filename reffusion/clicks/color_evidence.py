"""Evidence from views without clicks, for Gaussians that the views with clicks do not see: the colours of each
photograph.

A view with a mask shows nothing of the object's far side. Gaussians there are unknown: they may be the object's back,
its top, or what stands behind it. The other photographs tell, by the colours that the known Gaussians have in them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from reffusion import geometry
from reffusion.clicks.geodesic_cut import color_frequency
from reffusion.clicks.single_view import erode
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

LONGEST = 256  # px, the larger side at which photographs are compared
VIEWS = 24  # at most, that are compared
LEAST_COVERAGE = 0.6  # share of a pixel that known Gaussians must cover for its colour to count
RING = 0.12  # of the larger side: how far around the object background colours are collected
FRONT_PERCENTILE = 5  # percentile of the depth of the object's pixels that stands for its front
OCCLUDER_DEPTH = 0.98  # times the front's depth: what is nearer may hide the object
LARGEST_LOG_RATIO = 3.0  # bound of the natural logarithm of a ratio of likelihoods


@dataclass(frozen=True)
class KnownLabels:
    """Labels that masks of some views determine: bool [N] each; neither where they do not."""

    inside: np.ndarray
    outside: np.ndarray


def find_outside(
    gaussians: Gaussians, cameras: Mapping[str, Camera], masks: Mapping[str, np.ndarray], margin: int
) -> np.ndarray:
    """bool [N]: Gaussians whose centres a view with a mask sees beside the object, or behind what it sees there, unless
    that is nearer than the object and may hide it.

    Args:
        masks: view -> bool [H, W]; margin: px around a mask that are ignored.
    """
    points, found = gaussians.means.detach().cpu().double().numpy(), np.zeros(len(gaussians), bool)
    for name, mask in masks.items():
        with torch.no_grad():
            depth = rasterizer.render(gaussians, cameras[name], sh_degree=0).depth.cpu().numpy()
        if not (mask & (depth > 0)).any():
            continue
        front = np.percentile(depth[mask & (depth > 0)], FRONT_PERCENTILE)
        clear = erode(~mask, margin) & ((depth > OCCLUDER_DEPTH * front) | (depth == 0))
        uv, z = geometry.project(points, cameras[name])
        hit, within = geometry.sample_nearest(clear, uv)
        found |= hit & within & (z > 0)
    return found


def color_votes(
    gaussians: Gaussians, known: KnownLabels, cameras: Mapping[str, Camera], image_of: Callable[[str], np.ndarray]
) -> np.ndarray:
    """[N, 2]: the mean log ratio of the likelihoods that each Gaussian's colours are the object's, in [-MOST, MOST];
    and its blending weight in the mean view, px.

    Args:
        image_of: view -> uint8 [H, W, 3].
    """
    names = sorted(cameras)
    sums, means = np.zeros((len(gaussians), 2)), gaussians.means
    features = torch.as_tensor(np.stack([known.inside, known.outside], 1)).to(means)
    chosen = [names[i] for i in np.unique(np.linspace(0, len(names) - 1, min(VIEWS, len(names))).round().astype(int))]
    for name in chosen:
        width, height = cameras[name].width, cameras[name].height
        factor = min(1.0, LONGEST / max(width, height))
        camera = cameras[name].resized(max(1, round(width * factor)), max(1, round(height * factor)))
        with torch.no_grad():
            drawn = rasterizer.render(gaussians, camera, features=features, sh_degree=0).features.cpu().numpy()
        image = cv2.resize(image_of(name), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        log_ratio = color_log_ratio(image, drawn[..., 0] > LEAST_COVERAGE, drawn[..., 1] > LEAST_COVERAGE)
        if log_ratio is not None:
            values = torch.as_tensor(np.stack([log_ratio, np.ones_like(log_ratio)], -1)).to(means)
            sums += rasterizer.accumulate(gaussians, camera, values).cpu().numpy()
    return np.stack([sums[:, 0] / np.maximum(sums[:, 1], 1e-9), sums[:, 1] / max(len(chosen), 1)], 1)


def color_log_ratio(image: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> np.ndarray | None:
    """float [H, W]: natural logarithm of how much more frequent each pixel's colour is in the object than around it, in
    [-MOST, MOST]; None where the picture shows too little of the object."""
    if inside.sum() < 10:
        return None
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).reshape(-1, 3).astype(float)
    reach = max(2, round(RING * max(inside.shape)))
    ring = ~erode(~(erode(~outside, 1) | inside), reach) & outside
    like = color_frequency(lab, inside.ravel().astype(float))
    other = color_frequency(lab, ring.ravel().astype(float))
    return np.log(like / other).clip(-LARGEST_LOG_RATIO, LARGEST_LOG_RATIO).reshape(inside.shape)
