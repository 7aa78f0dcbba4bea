"""What views without clicks say of the object: where the views with clicks could not see, by each photograph's colours.

A view with a mask shows nothing of the object's far side. There its Gaussians are unknown: they may be the object's
back, its top, or what stands behind it. The other photographs tell, each by the colours that what is known has in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from reffusion import geometry
from reffusion.clicks.geodesic_cut import frequency
from reffusion.clicks.single_view import shrunk
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

LONGEST = 256  # px, the larger side at which photographs are asked
VIEWS = 24  # at most so many are
SURE = 0.6  # of a pixel: what is known of it is taken for its colour
AROUND = 0.12  # of the picture's larger side: how far around the object another colour may lie
FRONT = 5  # percent of the object's pixels, that are nearer than its front
BEFORE = 0.98  # of the front's depth: what is nearer than this may hide the object
MOST = 3.0  # that colour may tell, natural logarithm of a ratio


@dataclass(frozen=True)
class Known:
    """What the masks of some views say: [N] bool each; neither: they do not tell."""

    inside: np.ndarray
    outside: np.ndarray


def beside(
    gaussians: Gaussians, cameras: Mapping[str, Camera], masks: Mapping[str, np.ndarray], margin: int
) -> np.ndarray:
    """bool [N]: centres that a view with a mask sees beside the object, or behind what it sees there, unless that
    stands before the object and may hide it.

    Args:
        masks: view -> bool [H, W]; margin: px around one that say nothing.
    """
    points, found = gaussians.means.detach().cpu().double().numpy(), np.zeros(len(gaussians), bool)
    for name, mask in masks.items():
        with torch.no_grad():
            depth = rasterizer.render(gaussians, cameras[name], sh_degree=0).depth.cpu().numpy()
        if not (mask & (depth > 0)).any():
            continue
        front = np.percentile(depth[mask & (depth > 0)], FRONT)
        clear = shrunk(~mask, margin) & ((depth > BEFORE * front) | (depth == 0))
        uv, z = geometry.project(points, cameras[name])
        hit, within = geometry.sample_nearest(clear, uv)
        found |= hit & within & (z > 0)
    return found


def told(
    gaussians: Gaussians, known: Known, cameras: Mapping[str, Camera], image_of: Callable[[str], np.ndarray]
) -> np.ndarray:
    """[N, 2]: what the views' colours say of each Gaussian, natural logarithm of a ratio in [-MOST, MOST], positive for
    the object; and how much of a pixel it is in the mean view, px.

    Args:
        image_of: view -> uint8 [H, W, 3].
    """
    names = sorted(cameras)
    sums, own = np.zeros((len(gaussians), 2)), gaussians.means
    features = torch.as_tensor(np.stack([known.inside, known.outside], 1)).to(own)
    some = [names[i] for i in np.unique(np.linspace(0, len(names) - 1, min(VIEWS, len(names))).round().astype(int))]
    for name in some:
        width, height = cameras[name].width, cameras[name].height
        factor = min(1.0, LONGEST / max(width, height))
        camera = cameras[name].resized(max(1, round(width * factor)), max(1, round(height * factor)))
        with torch.no_grad():
            drawn = rasterizer.render(gaussians, camera, features=features, sh_degree=0).features.cpu().numpy()
        image = cv2.resize(image_of(name), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        says = colours_say(image, drawn[..., 0] > SURE, drawn[..., 1] > SURE)
        if says is not None:
            values = torch.as_tensor(np.stack([says, np.ones_like(says)], -1)).to(own)
            sums += rasterizer.accumulate(gaussians, camera, values).cpu().numpy()
    return np.stack([sums[:, 0] / np.maximum(sums[:, 1], 1e-9), sums[:, 1] / max(len(some), 1)], 1)


def colours_say(image: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> np.ndarray | None:
    """float [H, W]: how much rather each pixel's colour is the object's, logarithm of a ratio in [-MOST, MOST]; None
    where the picture shows too little of it."""
    if inside.sum() < 10:
        return None
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).reshape(-1, 3).astype(float)
    reach = max(2, round(AROUND * max(inside.shape)))
    ring = ~shrunk(~(shrunk(~outside, 1) | inside), reach) & outside
    like = frequency(lab, inside.ravel().astype(float))
    other = frequency(lab, ring.ravel().astype(float))
    return np.log(like / other).clip(-MOST, MOST).reshape(inside.shape)
