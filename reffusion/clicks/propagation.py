"""Propagates the object's mask from some views to all: Gaussians vote, and a segmentation network draws each mask.

The masks so far label Gaussians by their votes. The silhouette of these Gaussians in the next view is the prompt: a
box, and points inside it. The network's mask votes in turn. Views follow each other by the distance of their cameras,
so that each mostly shows what an earlier one shows. At the end each view gets the network's mask or the projected
labels, whichever agrees better with all votes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from reffusion import trace
from reffusion.clicks.all_views import remove_rim
from reffusion.clicks.marks import UNKNOWN, Clicks
from reffusion.clicks.segmenter import Candidate, Prompt
from reffusion.clicks.single_view import ViewEvidence, bounding_box, erode, refine_edges
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

LEAST_WEIGHT = 0.5  # of the mean blending weight of the Gaussians that a view shows, from which votes label one
SHOWN = 0.05  # px of blending weight from which a view shows a Gaussian
MIN_PIXELS = 20  # px of a silhouette below which a view does not show the object
MIN_PART = 0.1  # of the largest connected part of a silhouette: smaller parts are no prompt
POINTS = 3  # points of a prompt
MIN_REST = 0.01  # of the visible silhouette: larger parts that the network leaves out are asked for separately
# Votes exclude a pixel with more than this blending weight against the object, and less than this for it.
MIN_AGAINST, MAX_FOR = 0.5, 0.2
MIN_DEPTH = 0.3  # of the largest distance to the silhouette's border: points nearer to it are no prompt
MIN_DEPTH_PX = 1.5
WHOLE_BONUS = 0.03  # of agreement, for the network's mask of the largest object, since early votes cover only parts
MIN_AGREEMENT = 0.8  # of a network's mask with the labels so far, from which it votes


@dataclass(frozen=True)
class Votes:
    """What masks say of Gaussians.

    Attributes:
        counts: [N, 2] px of blending weight, inside and outside the masks.
        least: px of blending weight from which votes label a Gaussian.
    """

    counts: np.ndarray
    least: float

    def plus(self, counts: np.ndarray) -> Votes:
        """These votes and those of a further view."""
        return Votes(self.counts + counts, self.least)


@dataclass(frozen=True)
class Projection:
    """What votes show in a view.

    Attributes:
        silhouette: bool [H, W], the object's Gaussians alone, without what stands before them.
        inside, outside: float [H, W], blending weight of votes for and against the object; the rest is unknown.
    """

    silhouette: np.ndarray
    inside: np.ndarray
    outside: np.ndarray


def propagate_masks(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    evidence_of: Callable[[str], ViewEvidence],
    masks: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """The object's mask, bool [H, W], in every view.

    Args:
        cameras: all views.
        evidence_of: view -> its photograph; without a segmentation network a mask is the projection of the votes.
        masks: view -> bool [H, W], at least one; they stay as they are.
    """
    drawn, votes = dict(masks), count_all_votes(gaussians, cameras, masks)
    order = order_by_distance(cameras, masks)
    for k in trace.progress(len(order), "masks from view to view"):
        name = order[k]
        view, projection = evidence_of(name), project_votes(gaussians, cameras[name], votes)
        if view.ask is None or projection.silhouette.sum() < MIN_PIXELS:
            continue
        drawn[name] = mask = draw_mask(view, projection)
        if agreement(mask, projection) > MIN_AGREEMENT:
            votes = votes.plus(count_votes(gaussians, cameras[name], mask))
    return dict(masks) | {
        name: combine(evidence_of(name).image, project_votes(gaussians, cameras[name], votes), drawn.get(name))
        for name in order
    }


def count_all_votes(gaussians: Gaussians, cameras: Mapping[str, Camera], masks: Mapping[str, np.ndarray]) -> Votes:
    """Sum the votes of all masks, at least one."""
    counts = [count_votes(gaussians, cameras[name], mask) for name, mask in masks.items()]
    weights = np.concatenate([each.sum(1) for each in counts])
    shown = weights[weights > SHOWN]
    return Votes(np.sum(counts, 0), LEAST_WEIGHT * float(shown.mean()) if len(shown) else SHOWN)


@torch.no_grad()
def count_votes(gaussians: Gaussians, camera: Camera, mask: np.ndarray) -> np.ndarray:
    """[N, 2] px of blending weight, inside and outside a mask; pixels at its border do not vote."""
    ballots = torch.as_tensor(np.stack([remove_rim(mask), remove_rim(~mask)], -1), dtype=gaussians.means.dtype)
    return rasterizer.accumulate(gaussians, camera, ballots.to(gaussians.means.device)).cpu().numpy()


@torch.no_grad()
def project_votes(gaussians: Gaussians, camera: Camera, votes: Votes) -> Projection:
    """Project the labels of the Gaussians that enough votes know."""
    weight = votes.counts.sum(1)
    known = weight > votes.least
    share = np.where(known, votes.counts[:, 0] / np.maximum(weight, votes.least), 0.0)
    labels = torch.as_tensor(share > 0.5, device=gaussians.means.device)
    shares = torch.as_tensor(np.stack([share, (1 - share) * known], -1)).to(gaussians.means)
    blended = rasterizer.render(gaussians, camera, sh_degree=0, features=shares).features.cpu().numpy()
    silhouette = np.zeros(blended.shape[:2], bool)
    if labels.any():
        alone = rasterizer.render(gaussians.map(lambda p: p[labels]), camera, sh_degree=0).alpha
        silhouette = (alone > 0.5).cpu().numpy()
    return Projection(silhouette, blended[..., 0], blended[..., 1])


def order_by_distance(cameras: Mapping[str, Camera], masks: Mapping[str, np.ndarray]) -> list[str]:
    """The views without masks; each is the nearest, by its camera, to an earlier one or to a view with a mask."""
    distance = lambda a, b: float(np.linalg.norm(cameras[a].center - cameras[b].center))
    remaining = {
        name: min((distance(name, other) for other in masks), default=0.0) for name in cameras if name not in masks
    }
    order = []
    while remaining:
        order.append(min(remaining, key=lambda name: (remaining[name], name)))
        del remaining[order[-1]]
        remaining = {name: min(far, distance(name, order[-1])) for name, far in remaining.items()}
    return order


def draw_mask(view: ViewEvidence, projection: Projection) -> np.ndarray:
    """bool [H, W]: the network's mask of what votes show in a view.

    To the network, the object and what it stands on may be one thing, such as a statue and its plinth. So where its
    mask covers what votes exclude, it is asked again with points there. What is removed together may be several things,
    such as a table and what stands on it. So what the mask leaves out is asked for separately.
    """
    silhouette = _drop_small_parts(projection.silhouette)
    visible = _drop_small_parts(silhouette & (projection.inside > projection.outside))
    if visible.sum() < MIN_PART * silhouette.sum():
        visible = silhouette
    inside, box = _deepest_points(visible), bounding_box(silhouette)
    prompts = [
        Prompt(inside, box),
        Prompt(inside, bounding_box(visible)),
        Prompt(_deepest_points(silhouette), box),
    ]
    candidates = _ask(view, prompts)
    mask = _select(candidates, projection)
    excluded = mask & (projection.outside > MIN_AGAINST) & (projection.inside < MAX_FOR)
    if excluded.sum() > MIN_REST * silhouette.sum():
        others = _deepest_points(excluded)
        points = Clicks(
            np.concatenate([inside.points, others.points]), np.concatenate([inside.positive, ~others.positive])
        )
        candidates += _ask(view, [Prompt(points, box), Prompt(points)], parts=True)
        mask = _select(candidates, projection)
    for part in _large_parts(erode(visible & ~mask, 1), MIN_REST * visible.sum()):
        both = mask | _select(_ask(view, [Prompt(_deepest_points(part), bounding_box(part))]), projection, mask)
        if agreement(both, projection) > agreement(mask, projection):
            mask = both
    return mask


def _ask(view: ViewEvidence, prompts: Sequence[Prompt], parts: bool = False) -> list[tuple[Candidate, float]]:
    """The network's masks of an object and of the largest object, or of a part too, each with its bonus."""
    assert view.ask is not None
    answers = [view.ask(prompt)[-3 if parts else -2 :] for prompt in prompts]
    return [(each, WHOLE_BONUS * (each is masks[-1])) for masks in answers for each in masks]


def _select(
    candidates: Sequence[tuple[Candidate, float]], projection: Projection, known: np.ndarray | None = None
) -> np.ndarray:
    """bool [H, W]: the mask of largest agreement times expected IoU, plus bonus, judged joined with
    `known`, bool [H, W]."""
    joined = lambda mask: mask if known is None else mask | known
    merit = lambda pair: agreement(joined(pair[0].mask), projection) * pair[0].score + pair[1]
    return max(candidates, key=merit)[0].mask


def draw_view(view: ViewEvidence, projection: Projection) -> np.ndarray:
    """bool [H, W]: the mask of a view that did not vote; empty where votes show too little of the object."""
    if projection.silhouette.sum() < MIN_PIXELS:
        return np.zeros_like(projection.silhouette)
    return combine(view.image, projection, draw_mask(view, projection) if view.ask else None)


def agreement(mask: np.ndarray, projection: Projection) -> float:
    """In [0, 1]: the larger of the IoU with what votes show of the object, pixels without votes aside, and the IoU with
    its silhouette. The latter counts where Gaussians that only this view shows stand before the object."""
    for_it, against = projection.inside, projection.outside
    shown = float((mask * for_it).sum() / max(for_it.sum() + (mask * against).sum(), 1e-9))
    return max(shown, iou(mask, projection.silhouette))


def combine(image: np.ndarray, projection: Projection, drawn: np.ndarray | None) -> np.ndarray:
    """bool [H, W]: the projected labels with their border on the photograph's edges, or the network's mask."""
    labelled = projection.inside > projection.outside
    masks = [refine_edges(image, labelled, np.full(labelled.shape, UNKNOWN, np.int8))]
    if drawn is not None:
        masks.append(drawn)
    return max(masks, key=lambda mask: agreement(mask, projection))


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of bool [H, W] masks; 1 if both are empty."""
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else 1.0


def _large_parts(mask: np.ndarray, least: float) -> list[np.ndarray]:
    """The connected parts of a mask that have at least so many pixels, the largest first."""
    parts, _ = ndimage.label(mask)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return [parts == k for k in np.argsort(-sizes, kind="stable") if sizes[k] >= max(least, 1)]


def _drop_small_parts(mask: np.ndarray) -> np.ndarray:
    """The mask without connected parts below `MIN_PART` of the largest one."""
    parts, _ = ndimage.label(mask)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return mask & (sizes >= MIN_PART * sizes.max())[parts]


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
