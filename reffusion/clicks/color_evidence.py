"""Colors as evidence for the labels of Gaussians that the views with masks do not see.

A view with a mask shows nothing of the object's far side. The labels of Gaussians on the far side are unknown: they may
be the object's back or top, or the background behind the object. In each photograph without a mask the pixels of
Gaussians with known labels give the colors of object and background. These colors are compared with the colors at
the unknown Gaussians.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
import torch

from reffusion import geometry
from reffusion.clicks.geodesic_cut import color_frequency
from reffusion.clicks.mask_borders import erode
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

LONGEST = 256  # px, the larger side at which photographs are compared
VIEWS = 24  # largest number of photographs that are compared
LEAST_COVERAGE = 0.6  # blending weight that Gaussians of one label must exceed at a pixel for its color to count
RING = 0.12  # share of the larger side: how far around the object background colors are collected
FRONT_PERCENTILE = 5  # percentile of the depths in a mask that is taken as the depth of the object's front
OCCLUDER_DEPTH = 0.98  # share of the front's depth: a surface nearer than this may hide the object
LARGEST_LOG_RATIO = 3.0  # bound of the natural logarithm of a ratio of likelihoods


def find_outside(
    gaussians: Gaussians, cameras: Mapping[str, Camera], masks: Mapping[str, np.ndarray], margin: int
) -> np.ndarray:
    """Return bool [N], True = the Gaussian's center projects beside the mask in at least one view, at any depth.

    Such a Gaussian cannot be part of the object, because a mask covers the whole visible object. Pixels whose rendered
    depth is nearer than the object's front are not used: the surface there may hide a part of the object. Views in
    which no depth is rendered inside the mask are skipped.

    Args:
        masks: view -> bool [H, W], True = the object.
        margin: px; pixels this near to a mask are not used.
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
    gaussians: Gaussians,
    inside: np.ndarray,
    outside: np.ndarray,
    cameras: Mapping[str, Camera],
    image_of: Callable[[str], np.ndarray],
) -> np.ndarray:
    """Return float [N, 2]: for each Gaussian how much its colors resemble the object, and how well views show it.

    Up to `VIEWS` views, evenly spaced in the order of their names, are compared at a larger side of at most `LONGEST`.

    Args:
        inside, outside: bool [N], True = belongs, or does not belong, to the object. The pixels of these Gaussians give
            the colors of object and background. A Gaussian in neither array has no known label.
        cameras: view -> Camera, the views without masks.
        image_of: view -> photograph, uint8 [H, W, 3].

    Returns:
        Column 0: the mean of `color_log_ratio` over the pixels of all compared views, weighted by the Gaussian's
        blending weights, within +-`LARGEST_LOG_RATIO`; positive = like the object, 0 if no view shows the Gaussian.
        Column 1: blending weight summed over the pixels (px), mean over the compared views; a view that shows too
        little of the object counts as 0.
    """
    names = sorted(cameras)
    sums, means = np.zeros((len(gaussians), 2)), gaussians.means
    features = torch.as_tensor(np.stack([inside, outside], 1)).to(means)
    chosen = sample_evenly(names, VIEWS)
    for name in chosen:
        camera = cameras[name].shrunk(LONGEST)
        with torch.no_grad():
            drawn = rasterizer.render(gaussians, camera, features=features, sh_degree=0).features.cpu().numpy()
        image = cv2.resize(image_of(name), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        log_ratio = color_log_ratio(image, drawn[..., 0] > LEAST_COVERAGE, drawn[..., 1] > LEAST_COVERAGE)
        if log_ratio is not None:
            values = torch.as_tensor(np.stack([log_ratio, np.ones_like(log_ratio)], -1)).to(means)
            sums += rasterizer.accumulate(gaussians, camera, values).cpu().numpy()
    return np.stack([sums[:, 0] / np.maximum(sums[:, 1], 1e-9), sums[:, 1] / max(len(chosen), 1)], 1)


def color_log_ratio(image: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> np.ndarray | None:
    """Return float [H, W], how much each pixel's color speaks for the object (> 0) or against the object (< 0).

    This is the natural logarithm of a ratio: the frequency of the color among the object's pixels, divided by that
    among the pixels around the object.

    Args:
        image: uint8 [H, W, 3].
        inside: bool [H, W], pixels that are known to show the object.
        outside: bool [H, W], pixels that are known not to show the object. Only those within `RING` of the object, or
            of pixels of unknown label, are used.

    Returns:
        Values within +-`LARGEST_LOG_RATIO`, or None if the picture shows fewer than 10 pixels of the object.
    """
    if inside.sum() < 10:
        return None
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).reshape(-1, 3).astype(float)
    reach = max(2, round(RING * max(inside.shape)))
    ring = ~erode(~(erode(~outside, 1) | inside), reach) & outside
    like = color_frequency(lab, inside.ravel().astype(float))
    other = color_frequency(lab, ring.ravel().astype(float))
    return np.log(like / other).clip(-LARGEST_LOG_RATIO, LARGEST_LOG_RATIO).reshape(inside.shape)


def sample_evenly(names: Sequence[str], most: int) -> list[str]:
    """Return at most `most` of the names, at about equal steps from the first to the last, in their order."""
    return [names[k] for k in np.unique(np.linspace(0, len(names) - 1, min(most, len(names))).round().astype(int))]
