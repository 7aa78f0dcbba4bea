"""Propagates masks of a few views to all views without a segmentation network: votes of Gaussians, a cut between
neighbours, edges of each photograph."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from reffusion.clicks import color_evidence
from reffusion.clicks.geodesic_cut import keep_connected, relative_distance
from reffusion.clicks.marks import UNKNOWN
from reffusion.clicks.single_view import erode, refine_edges
from reffusion.gaussians.neighbours import NeighbourGraph
from reffusion.graph_cut import min_cut
from reffusion.masks import voting
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

LARGEST_VOTE = 5.0  # px of blending weight at which votes saturate
LEAST_VOTE = 1.0  # px of blending weight from which masks determine the label of a Gaussian
RIM = 0.006  # of the larger side: pixels this near to a mask's border do not vote
RING = 0.05  # of the larger side: width of the ring around a mask that a test photograph is compared in
# times the difference in that ring, plus a share of white: the object is not in the photograph
ABSENT, LEVEL = 3.0, 0.02
ROUNDS = 3  # at most, of colours, each with the labels of the one before
COLOR = 1.0  # weight of the colours of other views, px of blending weight in the mean view
NEARER = 3.0  # weight of the distances to object and background, compared with that of colours
COVERED = 0.5  # alpha from which the object covers a pixel


@torch.no_grad()
def surface_relief(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """float64 [H, W] px, logarithm of the depth times the focal length, so that its slope does not depend on the
    distance of a surface. Empty pixels get the largest depth."""
    depth = rasterizer.render(gaussians, camera, sh_degree=0).depth.double().cpu().numpy()
    if not (depth > 0).any():
        return np.zeros_like(depth)
    return np.log(np.where(depth > 0, depth, depth.max())) * camera.fx


def label_gaussians(
    gaussians: Gaussians,
    near: NeighbourGraph,
    cameras: Mapping[str, Camera],
    masks: Mapping[str, np.ndarray],
    image_of: Callable[[str], np.ndarray],
    rim: float = RIM,
) -> Tensor:
    """bool [N], the object: where the views with masks show the Gaussians by their votes, elsewhere by neighbours and
    by the colours of the other photographs.

    Args:
        rim: of the larger side: pixels this near to a mask's border do not vote.
    """
    sure = np.zeros((len(gaussians), 2))
    for name, mask in masks.items():
        ballots = torch.as_tensor(
            np.stack([remove_rim(mask, rim), remove_rim(~mask, rim)], -1), device=gaussians.means.device
        )
        sure += rasterizer.accumulate(gaussians, cameras[name], ballots.to(gaussians.means.dtype)).cpu().numpy()
    inside, outside = sure.T
    margin = max(1, round(rim * max(next(iter(masks.values())).shape)))
    outside_mask = color_evidence.find_outside(gaussians, cameras, masks, margin) & (inside < LEAST_VOTE)
    inside, outside = (
        np.minimum(inside, LARGEST_VOTE),
        np.where(outside_mask, LARGEST_VOTE, np.minimum(outside, LARGEST_VOTE)),
    )
    others = {name: camera for name, camera in cameras.items() if name not in masks}
    known = color_evidence.KnownLabels(
        inside > np.maximum(LEAST_VOTE, outside), outside > np.maximum(LEAST_VOTE, inside)
    )
    side, labels = relative_distance(near.pairs, near.way, known.inside, known.outside), known.inside
    for _ in range(ROUNDS):
        log_ratio, coverage = color_evidence.color_votes(
            gaussians, color_evidence.KnownLabels(labels, known.outside), others, image_of
        ).T
        gain = (
            np.minimum(COLOR * coverage, LARGEST_VOTE) * (log_ratio + NEARER * side) * ~(known.inside | known.outside)
        )
        before, against, for_it = labels, outside + np.maximum(-gain, 0), inside + np.maximum(gain, 0)
        labels = keep_connected(min_cut(against, for_it, near.pairs, near.likeness), near.pairs, known.inside)
        if (labels == before).all():
            break
    return torch.as_tensor(labels, device=gaussians.means.device)


def object_mask(gaussians: Gaussians, labels: Tensor, camera: Camera, image: np.ndarray) -> np.ndarray:
    """bool [H, W]: the labelled Gaussians in a view, with the border moved to the edges of its photograph."""
    mask = voting.render_labels(gaussians, labels, camera) > COVERED
    return refine_edges(image, mask, np.full(mask.shape, UNKNOWN, np.int8))


def is_visible(gaussians: Gaussians, camera: Camera, image: np.ndarray, mask: np.ndarray) -> bool:
    """Does the photograph show the object inside its mask [H, W], as the Gaussians do, or was it taken without the
    object?"""
    around = ~erode(~mask, max(2, round(RING * max(mask.shape)))) & ~mask
    if not mask.any() or not around.any():
        return bool(mask.any())
    with torch.no_grad():
        drawn = rasterizer.render(gaussians, camera).color.clamp(0, 1).cpu().numpy()
    off = np.abs(drawn - image / 255.0).mean(-1)
    return float(off[mask].mean()) < ABSENT * float(off[around].mean()) + LEVEL


def remove_rim(mask: np.ndarray, rim: float = RIM) -> np.ndarray:
    """The mask without its rim, unless that is most of it."""
    inner = erode(mask, max(1, round(rim * max(mask.shape))))
    return inner if inner.sum() > 0.25 * mask.sum() else mask
