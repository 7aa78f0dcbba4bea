"""Propagates the object's mask from some views to all: Gaussians vote, and a segmentation network draws each mask.

The votes of the views so far label Gaussians. Their silhouette in the next view is the prompt: a box, and points inside
it. The network answers with the object's outline there, and that mask votes in turn. Views follow each other by their
distance, so that each shows most of what its neighbour shows. A second round asks all views with the votes of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from reffusion import trace
from reffusion.clicks.all_views import remove_rim
from reffusion.clicks.marks import UNKNOWN, Clicks
from reffusion.clicks.segmenter import Candidate, ImageFeatures, Prompt, Segmenter, predict_masks
from reffusion.clicks.single_view import refine_edges
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

MIN_WEIGHT = 2.0  # px of blending weight, over all views, from which votes label a Gaussian
MIN_PIXELS = 20  # px of a silhouette below which a view does not show the object
MIN_PART = 0.1  # of the largest connected part of a silhouette: smaller parts are no prompt
POINTS = 3  # points of a prompt
MIN_DEPTH = 0.3  # of the largest distance to the silhouette's border: points nearer to it are no prompt
MIN_DEPTH_PX = 1.5
WHOLE_BONUS = 0.03  # of IoU: the network's mask of the largest object is preferred, since votes know parts first
MIN_RECALL = 0.8  # share of the silhouette that a mask must contain to vote in the first round
MIN_SCORE = 0.85  # IoU that the network must expect of such a mask
SPILL_COST = 0.3  # of a mask's share outside the silhouette, which in the first round may be unseen parts
SPILL_PX = 6  # px around the silhouette that do not count as outside
MIN_AGREEMENT = 0.8  # IoU of silhouette and mask from which a mask votes in the second round


@dataclass(frozen=True)
class Projection:
    """What the labels so far show in a view.

    Attributes:
        silhouette: bool [H, W], the object's Gaussians alone, without what stands before them.
        visible: bool [H, W], where the object's Gaussians outweigh all others.
    """

    silhouette: np.ndarray
    visible: np.ndarray


@dataclass(frozen=True)
class ViewMask:
    """The object in a view, bool [H, W], and its agreement (IoU) with what the other views project there."""

    mask: np.ndarray
    agreement: float


def propagate_masks(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    image_of: Callable[[str], np.ndarray],
    features_of: Callable[[str], ImageFeatures],
    segmenter: Segmenter,
    masks: Mapping[str, np.ndarray],
) -> dict[str, ViewMask]:
    """The object's mask in every view without one.

    Args:
        cameras: all views.
        image_of: view -> uint8 [H, W, 3]; features_of: view -> its encoding by the segmenter.
        masks: view -> bool [H, W], at least one; they stay as they are.
    """
    votes = sum(count_votes(gaussians, cameras[name], mask) for name, mask in masks.items())
    order = order_by_distance(cameras, masks)
    voting: dict[str, np.ndarray] = {}
    for k in trace.progress(2 * len(order), "masks of all views"):
        name = order[k % len(order)]
        camera, own = cameras[name], voting.pop(name, None)
        if own is not None:
            votes = votes - count_votes(gaussians, camera, own)
        projection = project_labels(gaussians, camera, votes)
        if projection.silhouette.sum() < MIN_PIXELS:
            continue
        candidates = ask_network(segmenter, features_of(name), projection)
        best = select_first(candidates, projection) if k < len(order) else select_agreeing(candidates, projection)
        if best is not None:
            voting[name] = best.mask
            votes = votes + count_votes(gaussians, camera, best.mask)
    found = {}
    for name in order:
        camera = cameras[name]
        own = count_votes(gaussians, camera, voting[name]) if name in voting else 0.0
        projection = project_labels(gaussians, camera, votes - own)
        found[name] = combine(image_of(name), projection, voting.get(name))
    return found


@torch.no_grad()
def count_votes(gaussians: Gaussians, camera: Camera, mask: np.ndarray) -> np.ndarray:
    """[N, 2] px of blending weight, inside and outside a mask; pixels at its border do not vote."""
    ballots = torch.as_tensor(np.stack([remove_rim(mask), remove_rim(~mask)], -1), dtype=gaussians.means.dtype)
    return rasterizer.accumulate(gaussians, camera, ballots.to(gaussians.means.device)).cpu().numpy()


@torch.no_grad()
def project_labels(gaussians: Gaussians, camera: Camera, votes: np.ndarray) -> Projection:
    """Project what votes [N, 2] label as the object."""
    weight = votes.sum(1)
    share = np.where(weight > MIN_WEIGHT, votes[:, 0] / np.maximum(weight, 1e-9), 0.0)
    labels = torch.as_tensor(share > 0.5, device=gaussians.means.device)
    if not labels.any():
        return Projection(*np.zeros((2, camera.height, camera.width), bool))
    alone = rasterizer.render(gaussians.map(lambda p: p[labels]), camera, sh_degree=0).alpha
    values = torch.as_tensor(np.stack([share, (1 - share) * (weight > MIN_WEIGHT)], -1))
    values = values.to(gaussians.means)
    blended = rasterizer.render(gaussians, camera, sh_degree=0, features=values).features.cpu().numpy()
    return Projection((alone > 0.5).cpu().numpy(), blended[..., 0] > blended[..., 1])


def order_by_distance(cameras: Mapping[str, Camera], masks: Mapping[str, np.ndarray]) -> list[str]:
    """The views without masks; each is the nearest to those before it and to the views with masks."""
    centers = {name: camera.center for name, camera in cameras.items()}
    distance = lambda a, b: float(np.linalg.norm(centers[a] - centers[b]))
    remaining = {
        name: min((distance(name, other) for other in masks), default=0.0) for name in cameras if name not in masks
    }
    order = []
    while remaining:
        order.append(min(remaining, key=lambda name: (remaining[name], name)))
        del remaining[order[-1]]
        remaining = {name: min(far, distance(name, order[-1])) for name, far in remaining.items()}
    return order


def ask_network(segmenter: Segmenter, features: ImageFeatures, projection: Projection) -> list[Candidate]:
    """The network's masks for boxes around the silhouette and around its visible part, the largest objects first."""
    silhouette = _drop_small_parts(projection.silhouette)
    visible = _drop_small_parts(silhouette & projection.visible)
    if visible.sum() < MIN_PART * silhouette.sum():
        visible = silhouette
    inside = _deepest_points(visible)
    prompts = [
        Prompt(inside, _box(silhouette)),
        Prompt(inside, _box(visible)),
        Prompt(_deepest_points(silhouette), _box(silhouette)),
    ]
    return [each for prompt in prompts for each in reversed(predict_masks(segmenter, features, prompt)[1:])]


def select_first(candidates: list[Candidate], projection: Projection) -> Candidate | None:
    """The mask of the first round: it contains the silhouette, which may lack parts that no view has shown yet."""
    silhouette = projection.silhouette
    near = ndimage.binary_dilation(silhouette, iterations=SPILL_PX)

    def merit(candidate: Candidate) -> float:
        spill = (candidate.mask & ~near).sum() / max(candidate.mask.sum(), 1)
        return _recall(candidate.mask, silhouette) * candidate.score - SPILL_COST * spill

    best = max(candidates[::2], key=merit)  # of each prompt the mask of the largest object
    return best if _recall(best.mask, silhouette) > MIN_RECALL and best.score > MIN_SCORE else None


def select_agreeing(candidates: list[Candidate], projection: Projection) -> Candidate | None:
    """The mask of the second round: the one that agrees best with the silhouette of what the other views label."""
    agreement = [iou(each.mask, projection.silhouette) for each in candidates]
    bonus = WHOLE_BONUS * (np.arange(len(candidates)) % 2 == 0)
    best = int(np.argmax(agreement + bonus))
    return candidates[best] if agreement[best] > MIN_AGREEMENT else None


def combine(image: np.ndarray, projection: Projection, drawn: np.ndarray | None) -> ViewMask:
    """The mask of a view: the projection with its border on the photograph's edges, or the network's mask; whichever
    agrees better with the silhouette. The projection fails where Gaussians that few views show stand before the object;
    the network where a part of the object looks like an object of its own."""
    silhouette = projection.silhouette
    refined = refine_edges(image, projection.visible, np.full(silhouette.shape, UNKNOWN, np.int8))
    masks = [refined] if drawn is None else [refined, drawn]
    best = max(masks, key=lambda mask: iou(mask, silhouette))
    return ViewMask(best, iou(best, silhouette))


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of bool [H, W] masks; 1 if both are empty."""
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else 1.0


def _recall(mask: np.ndarray, silhouette: np.ndarray) -> float:
    return float((mask & silhouette).sum() / max(silhouette.sum(), 1))


def _drop_small_parts(mask: np.ndarray) -> np.ndarray:
    """The mask without connected parts below `MIN_PART` of the largest one."""
    parts, count = ndimage.label(mask)
    if count < 2:
        return mask
    sizes = np.bincount(parts.ravel())[1:]
    return np.isin(parts, 1 + np.flatnonzero(sizes >= MIN_PART * sizes.max()))


def _box(mask: np.ndarray) -> tuple[float, float, float, float]:
    rows, columns = np.nonzero(mask)
    return float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1)


def _deepest_points(mask: np.ndarray) -> Clicks:
    """Up to `POINTS` positive points deep inside a mask, apart from each other."""
    depth = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    least, points = max(MIN_DEPTH * depth.max(), MIN_DEPTH_PX), []
    rows, columns = np.ogrid[: mask.shape[0], : mask.shape[1]]
    while len(points) < POINTS and (depth.max() >= least or not points):
        row, column = np.unravel_index(depth.argmax(), depth.shape)
        points.append((column + 0.5, row + 0.5))
        depth = np.where((rows - row) ** 2 + (columns - column) ** 2 > (3 * depth[row, column]) ** 2, depth, 0.0)
    return Clicks(np.array(points), np.ones(len(points), bool))
