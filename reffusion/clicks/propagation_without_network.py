"""Propagation of the object's masks from a few views to all views, without a segmentation network.

The masks vote on the Gaussians: the vote of a mask is the blending weight of a Gaussian, summed over the pixels inside
the mask (for the object) or outside the mask (against the object). A minimum cut between neighboring Gaussians labels
the Gaussians that have no votes. In each view the silhouette of the labeled Gaussians is moved to the edges of the
photograph.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from reffusion.clicks import color_evidence
from reffusion.clicks.geodesic_cut import keep_connected, relative_distance
from reffusion.clicks.marks import UNKNOWN
from reffusion.clicks.mask_borders import erode, refine_edges
from reffusion.gaussians.neighbors import NeighborGraph
from reffusion.graph_cut import min_cut
from reffusion.masks import voting
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

LARGEST_VOTE = 5.0  # px, upper limit of the votes for one Gaussian (blending weight summed over pixels)
LEAST_VOTE = 1.0  # px of blending weight that votes must exceed to determine the label of a Gaussian
RIM = 0.006  # share of the larger image side: pixels this near to a mask's border do not vote
RING = 0.05  # share of the larger image side: width of the ring around a mask in which `is_visible` compares colors
# A photograph does not show the object if the color difference (1 = white against black) between photograph and
# rendering inside the mask is at least ABSENT times the difference in the ring, plus LEVEL.
ABSENT, LEVEL = 3.0, 0.02
ROUNDS = 3  # largest number of cuts; each takes the object's colors from the labels of the cut before
COLOR = 1.0  # votes per px of blending weight that a Gaussian has in the mean of the views without masks
NEARER = 3.0  # weight of the relative distance to object and background, where the log ratio of colors has weight 1
COVERED = 0.5  # rendered label (1 = object) above which a pixel shows the object


@torch.no_grad()
def surface_relief(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Return float64 [H, W] in pixels: the natural logarithm of the rendered depth, times the focal length.

    The slope of this relief in px per px depends on the tilt of a surface, but not on the distance of the surface.
    Pixels without Gaussians get the largest depth of the view. The relief is 0 everywhere if the view shows nothing.
    """
    depth = rasterizer.render(gaussians, camera, sh_degree=0).depth.double().cpu().numpy()
    if not (depth > 0).any():
        return np.zeros_like(depth)
    return np.log(np.where(depth > 0, depth, depth.max())) * camera.fx


def label_gaussians(
    gaussians: Gaussians,
    near: NeighborGraph,
    cameras: Mapping[str, Camera],
    masks: Mapping[str, np.ndarray],
    image_of: Callable[[str], np.ndarray],
    rim: float = RIM,
) -> Tensor:
    """Return bool [N], True = the Gaussian belongs to the object.

    Votes of the masks label the Gaussians that the views with masks show. Gaussians whose centers project beside a mask
    count as background, unless the masks vote for them. A minimum cut labels all other Gaussians. The cut uses the
    distances to labeled Gaussians, the colors of the photographs without masks, and the similarity of neighbors. The
    result contains only Gaussians that a chain of object neighbors connects with a Gaussian that votes label as the
    object.

    Args:
        near: the graph of neighboring Gaussians, from `find_neighbors`.
        cameras: view -> Camera, all views.
        masks: view -> bool [H, W], True = the object; at least one view.
        image_of: view -> photograph, uint8 [H, W, 3].
        rim: share of the larger image side; pixels this near to a mask's border do not vote.
    """
    sure = np.zeros((len(gaussians), 2))
    for name, mask in masks.items():
        sure += count_votes(gaussians, cameras[name], mask, rim=rim)
    inside, outside = sure.T
    margin = max(1, round(rim * max(next(iter(masks.values())).shape)))
    outside_mask = color_evidence.find_outside(gaussians, cameras, masks, margin) & (inside < LEAST_VOTE)
    inside, outside = (
        np.minimum(inside, LARGEST_VOTE),
        np.where(outside_mask, LARGEST_VOTE, np.minimum(outside, LARGEST_VOTE)),
    )
    others = {name: camera for name, camera in cameras.items() if name not in masks}
    is_object, is_other = inside > np.maximum(LEAST_VOTE, outside), outside > np.maximum(LEAST_VOTE, inside)
    side, labels = relative_distance(near.pairs, near.way, is_object, is_other), is_object
    for _ in range(ROUNDS):
        log_ratio, coverage = color_evidence.color_votes(gaussians, labels, is_other, others, image_of).T
        gain = np.minimum(COLOR * coverage, LARGEST_VOTE) * (log_ratio + NEARER * side) * ~(is_object | is_other)
        before, against, for_it = labels, outside + np.maximum(-gain, 0), inside + np.maximum(gain, 0)
        labels = keep_connected(min_cut(against, for_it, near.pairs, near.likeness), near.pairs, is_object)
        if (labels == before).all():
            break
    return torch.as_tensor(labels, device=gaussians.means.device)


@torch.no_grad()
def count_votes(
    gaussians: Gaussians, camera: Camera, mask: np.ndarray, allowed: np.ndarray | None = None, rim: float = RIM
) -> np.ndarray:
    """Return [N, 2], each Gaussian's blending weight summed over the pixels inside and outside a mask, in px.

    Pixels at the mask's border do not count.

    Args:
        mask: bool [H, W], True = the object.
        allowed: bool [H, W], the pixels inside the mask that may vote; None for all.
        rim: as in `remove_rim`.
    """
    inside = remove_rim(mask, rim) if allowed is None else remove_rim(mask, rim) & allowed
    ballots = torch.as_tensor(np.stack([inside, remove_rim(~mask, rim)], -1), dtype=gaussians.means.dtype)
    return rasterizer.accumulate(gaussians, camera, ballots.to(gaussians.means.device)).cpu().numpy()


def object_mask(gaussians: Gaussians, labels: Tensor, camera: Camera, image: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the object's mask in a view.

    This is the silhouette of the object's Gaussians, with the border moved to the edges of the photograph.

    Args:
        labels: bool [N], True = the object.
        image: uint8 [H, W, 3], the photograph.
    """
    mask = voting.render_labels(gaussians, labels, camera) > COVERED
    return refine_edges(image, mask, np.full(mask.shape, UNKNOWN, np.int8))


def is_visible(gaussians: Gaussians, camera: Camera, image: np.ndarray, mask: np.ndarray) -> bool:
    """Return True if a photograph shows the object inside its mask, False if the photograph was taken without it.

    The photograph is compared with the rendering of the Gaussians, which contain the object. The object is visible if
    the mean color difference inside the mask is not much larger than in a ring around the mask.

    Args:
        image: uint8 [H, W, 3], the photograph.
        mask: bool [H, W], the object. The result is False if the mask is empty, and True if it leaves no ring.
    """
    around = ~erode(~mask, max(2, round(RING * max(mask.shape)))) & ~mask
    if not mask.any() or not around.any():
        return bool(mask.any())
    with torch.no_grad():
        drawn = rasterizer.render(gaussians, camera).color.clamp(0, 1).cpu().numpy()
    off = np.abs(drawn - image / 255.0).mean(-1)
    return float(off[mask].mean()) < ABSENT * float(off[around].mean()) + LEVEL


def remove_rim(mask: np.ndarray, rim: float = RIM) -> np.ndarray:
    """Return the mask, bool [H, W], without the pixels next to its border, whose labels are uncertain.

    The mask is returned unchanged if at most a quarter of its pixels would remain.

    Args:
        rim: width of the removed rim as a share of the larger image side.
    """
    inner = erode(mask, max(1, round(rim * max(mask.shape))))
    return inner if inner.sum() > 0.25 * mask.sum() else mask
