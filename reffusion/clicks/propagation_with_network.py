"""Propagation of the object's mask from some views to all views by votes of masks and a segmentation network.

The masks so far vote on the Gaussians: the vote of a mask is the blending weight of a Gaussian, summed over the pixels
inside the mask (for the object) or outside the mask (against the object). Votes label the Gaussians. The silhouette of
the object's Gaussians in the next view gives the prompt for the network: a box, and points inside the silhouette. The
network's mask votes in turn. The next view is the one whose camera is nearest to a view with a mask, so that both views
show mostly the same surfaces. At the end each view gets the network's mask or the projected labels, whichever agrees
better with all votes.

A brush stroke or a mask that is a few pixels too large covers a border of what lies behind or before the object. Pixels
of such a border, beyond a step in depth, do not vote. The network is not asked for thin things: its masks are too
coarse, and take in what the thing hides. After a correction, a view's former mask changes only where the
votes contradict it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage

from reffusion import trace
from reffusion.clicks.marks import UNKNOWN, Clicks
from reffusion.clicks.mask_borders import bounding_box, erode, refine_edges
from reffusion.clicks.pixel_grid import DEPTH_SLOPE
from reffusion.clicks.propagation_without_network import count_votes
from reffusion.clicks.segmenter import Candidate, Prompt
from reffusion.clicks.single_view import ViewEvidence
from reffusion.clicks.support_planes import find_support_gaussians
from reffusion.morphology import label_sizes, open_mask
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

# Votes label a Gaussian if their sum exceeds this share of the mean sum over the Gaussians that a view shows.
LEAST_WEIGHT = 0.5
SHOWN = 0.05  # px of blending weight (summed over pixels) above which a view shows a Gaussian
MIN_PIXELS = 20  # a view whose silhouette has fewer pixels does not show the object
MIN_PART = 0.1  # share of the largest connected part of a silhouette; smaller parts are not used for prompts
POINTS = 3  # largest number of points in a prompt
MIN_REST = 0.01  # share of the visible silhouette; the network gets a further prompt for larger parts that it left out
# Votes exclude a pixel whose `Projection.outside` is above MIN_AGAINST and whose `Projection.inside` is below MAX_FOR.
MIN_AGAINST, MAX_FOR = 0.5, 0.2
MIN_WIDTH = 0.004  # share of the image's width: radius of the narrowest part that votes take from a network's mask
BORDER = 0.015  # share of the larger image side: how far a mask may reach beyond a step in depth
THIN = 0.035  # share of the larger image side: a thing is thin if no disk with a larger radius fits into its masks
RIDGE = 0.7  # share of the largest distance from a mask's border nearby, from which on a pixel is in the mask's middle
# Points of a prompt are at least this far from the mask's border: as a share of the largest such distance, and in px.
MIN_DEPTH = 0.3
MIN_DEPTH_PX = 1.5
WHOLE_BONUS = 0.03  # added to the merit of the network's mask of the largest object: early votes cover only parts
MAX_OTHER_SHARE = 0.2  # a Gaussian with a smaller share of votes for the object is surely not the object
MIN_AGREEMENT = 0.8  # `agreement` with the votes so far that a network's mask must exceed to vote itself


@dataclass(frozen=True)
class Votes:
    """The votes of masks on N Gaussians.

    Attributes:
        counts: [N, 2], each Gaussian's blending weight summed over the pixels inside the masks (column 0, for the
            object) and outside the masks (column 1, against the object), in px.
        least: px; votes label a Gaussian if the sum of its two counts exceeds this value.
    """

    counts: np.ndarray
    least: float

    @property
    def has_label(self) -> np.ndarray:
        """bool [N], True for the Gaussians that the votes label."""
        return self.counts.sum(1) > self.least

    @property
    def shares(self) -> np.ndarray:
        """[N] in [0, 1], the share of each Gaussian's votes for the object; 0 for Gaussians without a label."""
        return np.where(self.has_label, self.counts[:, 0] / np.maximum(self.counts.sum(1), self.least), 0.0)


@dataclass(frozen=True)
class Projection:
    """The votes on Gaussians, rendered into a view.

    Attributes:
        silhouette: bool [H, W], True where the object's Gaussians cover the pixel if rendered alone, so that nothing
            occludes them.
        inside, outside: float [H, W] in [0, 1], each Gaussian's share of votes for and against the object, rendered
            with all Gaussians. Gaussians with too few votes add to neither, so the sum may be below the alpha.
    """

    silhouette: np.ndarray
    inside: np.ndarray
    outside: np.ndarray


def propagate_masks(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    evidence_of: Callable[[str], ViewEvidence],
    masks: Mapping[str, np.ndarray],
    network_views: Collection[str],
    former: Mapping[str, np.ndarray] | None = None,
) -> dict[str, np.ndarray]:
    """Return the object's mask in every view, view -> bool [H, W].

    Args:
        cameras: view -> Camera, all views.
        evidence_of: function from a view's name to its photograph, relief and segmentation network.
        masks: view -> bool [H, W], the known masks, at least one, which are returned unchanged.
        network_views: the views in which the network is asked. In other views, in those without a network (`ask` is
            None), and in all views if all masks show a thin thing, the mask is the projection of the votes.
        former: view -> bool [H, W], the masks of all views before a correction; None if there are none. These
            masks change only where the votes contradict them.
    """
    ballots = {name: find_voting_pixels(mask, evidence_of(name).relief) for name, mask in masks.items()}
    drawn, votes = dict(masks), count_all_votes(gaussians, cameras, masks, ballots)
    order, thin = order_by_distance(cameras, masks), all(is_thin(mask) for mask in masks.values())
    for k in trace.progress(len(order), "masks from view to view"):
        name = order[k]
        view, projection = evidence_of(name), project_votes(gaussians, cameras[name], assume_supports(gaussians, votes))
        if thin or name not in network_views or view.ask is None or projection.silhouette.sum() < MIN_PIXELS:
            continue
        drawn[name] = mask = draw_mask(view, projection)
        if agreement(mask, projection) > MIN_AGREEMENT:
            counts = count_votes(gaussians, cameras[name], mask, find_voting_pixels(mask, view.relief))
            votes = replace(votes, counts=votes.counts + counts)
    votes, found = assume_supports(gaussians, votes), dict(masks)
    for name in order:
        projection = project_votes(gaussians, cameras[name], votes)
        found[name] = combine(evidence_of(name).image, projection, drawn.get(name))
        if former is not None:
            found[name] = change_where_votes_agree(former[name], found[name], projection)
    return found


def is_thin(mask: np.ndarray) -> bool:
    """Return True if each disk inside a mask, bool [H, W], has a radius below the share `THIN` of the larger side."""
    return bool(ndimage.distance_transform_edt(mask).max() < THIN * max(mask.shape))


def find_voting_pixels(mask: np.ndarray, relief: np.ndarray | None) -> np.ndarray:
    """Return bool [H, W], the pixels of a mask that vote: those on the surfaces that the middle of the mask shows.

    Pixels at most the share `BORDER` of the larger side from the mask's border vote only if no step in depth separates
    them from the middle of the mask, or from the middle of a thin part. Small pieces between steps do not vote.

    Args:
        mask: bool [H, W], True = the object.
        relief: float [H, W] as in `ViewEvidence`; None if depth is unknown, so that the whole mask votes.
    """
    if relief is None or not mask.any():
        return mask
    width, around = max(2, round(BORDER * max(mask.shape))), np.ones((3, 3))
    distance = ndimage.distance_transform_edt(mask)
    middle = mask & (distance >= np.minimum(width, RIDGE * ndimage.maximum_filter(distance, 2 * width + 1)))
    smooth = ndimage.median_filter(relief, 3)
    level = mask & (np.hypot(ndimage.sobel(smooth, 0), ndimage.sobel(smooth, 1)) / 8 < DEPTH_SLOPE[0])
    reached = ndimage.binary_dilation(middle & level, around, round(1.5 * width), mask=level)
    parts, sizes = label_sizes(reached, around)
    voting = reached & (sizes >= min(4 * width**2, MIN_PART * sizes.max()))[parts]
    if not voting.any():
        return mask
    # The slope is also large at the last pixels before a step, which are as near as the pixels beside them.
    far, at = ndimage.distance_transform_edt(~voting, return_indices=True)
    return voting | (mask & (far <= 2) & (np.abs(smooth - smooth[tuple(at)]) < DEPTH_SLOPE[0] * far))


def change_where_votes_agree(former: np.ndarray, new: np.ndarray, projection: Projection) -> np.ndarray:
    """Return bool [H, W], the former mask of a view, with those connected changes that the votes support.

    Args:
        former, new: bool [H, W], the masks before and after a correction.
        projection: the votes after the correction.
    """
    regions, count = ndimage.label(former ^ new, np.ones((3, 3)))
    gain = np.where(new, 1, -1) * (projection.inside - projection.outside)
    sums = ndimage.sum_labels(gain, regions, np.arange(count + 1))
    return former ^ ((regions > 0) & (sums > 0)[regions])


def count_all_votes(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    masks: Mapping[str, np.ndarray],
    voting: Mapping[str, np.ndarray] | None = None,
) -> Votes:
    """Sum the votes of all masks on the N Gaussians.

    Args:
        masks: view -> bool [H, W], True = the object; at least one view.
        voting: view -> bool [H, W], the pixels inside each mask that vote; None for all.
    """
    voters = lambda name: voting[name] if voting else None
    counts = [count_votes(gaussians, cameras[name], mask, voters(name)) for name, mask in masks.items()]
    weights = np.concatenate([each.sum(1) for each in counts])
    shown = weights[weights > SHOWN]
    return Votes(np.sum(counts, 0), LEAST_WEIGHT * float(shown.mean()) if len(shown) else SHOWN)


def assume_supports(gaussians: Gaussians, votes: Votes) -> Votes:
    """Return the votes, with votes against the object for unlabeled Gaussians on supports (`support_planes`)."""
    known, share = votes.has_label, votes.shares
    means = gaussians.means.detach().double().cpu().numpy()
    assumed = find_support_gaussians(means, share > 0.5, known & (share < MAX_OTHER_SHARE)) & ~known
    return Votes(np.where(assumed[:, None], (0.0, 1.01 * votes.least), votes.counts), votes.least)


@torch.no_grad()
def project_votes(gaussians: Gaussians, camera: Camera, votes: Votes) -> Projection:
    """Render the votes on Gaussians into a view. Gaussians without a label (`Votes.has_label`) add nothing.

    A Gaussian belongs to the object's silhouette if it has a label, and more than half of its votes are for the object.
    """
    share = votes.shares
    labels = torch.as_tensor(share > 0.5, device=gaussians.means.device)
    shares = torch.as_tensor(np.stack([share, (1 - share) * votes.has_label], -1)).to(gaussians.means)
    blended = rasterizer.render(gaussians, camera, sh_degree=0, features=shares).features.cpu().numpy()
    silhouette = np.zeros(blended.shape[:2], bool)
    if labels.any():
        alone = rasterizer.render(gaussians.map(lambda p: p[labels]), camera, sh_degree=0).alpha
        silhouette = (alone > 0.5).cpu().numpy()
    return Projection(silhouette, blended[..., 0], blended[..., 1])


def order_by_distance(cameras: Mapping[str, Camera], masks: Mapping[str, np.ndarray]) -> list[str]:
    """Return the names of the views without masks, in the order in which masks are propagated.

    The next view is always the one whose camera center is nearest to any view with a mask or earlier in this order.

    Args:
        cameras: view -> Camera, all views.
        masks: the views with masks.
    """
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
    """Return bool [H, W], the segmentation network's mask of the object in a view, prompted by projected votes.

    The network may take the object and its support for one thing, such as a statue and its plinth. So if the network's
    mask covers pixels that votes exclude, the network is prompted again with negative points at these pixels. What the
    mask still covers of them, outside the silhouette, is removed. The object to remove may consist of several things,
    such as a table and the dishes on the table. So for each large part of the visible silhouette that the mask leaves
    out, the network is prompted separately, and its answer is added if this raises the agreement with the votes.

    Args:
        view: a view with a network (`ask` is not None).
        projection: the projected votes; the silhouette is not empty.
    """
    silhouette = _drop_small_parts(projection.silhouette)
    visible = _drop_small_parts(silhouette & (projection.inside > projection.outside))
    if visible.sum() < MIN_PART * silhouette.sum():
        visible = silhouette
    inside, box = deepest_points(visible), bounding_box(silhouette)
    prompts = [
        Prompt(inside, box),
        Prompt(inside, bounding_box(visible)),
        Prompt(deepest_points(silhouette), box),
    ]
    candidates = _ask(view, prompts)
    mask = _select(candidates, projection)
    excluded = mask & _find_excluded(projection)
    if excluded.sum() > MIN_REST * silhouette.sum():
        others = deepest_points(excluded)
        points = Clicks(
            np.concatenate([inside.points, others.points]), np.concatenate([inside.positive, ~others.positive])
        )
        candidates += _ask(view, [Prompt(points, box), Prompt(points)], parts=True)
        mask = _select(candidates, projection)
    for part in _large_parts(erode(visible & ~mask, 1), MIN_REST * visible.sum()):
        both = mask | _select(_ask(view, [Prompt(deepest_points(part), bounding_box(part))]), projection, mask)
        if agreement(both, projection) > agreement(mask, projection):
            mask = both
    return mask & ~open_mask(mask & _find_excluded(projection) & ~projection.silhouette, MIN_WIDTH)


def _find_excluded(projection: Projection) -> np.ndarray:
    """Return bool [H, W], the pixels that votes exclude from the object."""
    return (projection.outside > MIN_AGAINST) & (projection.inside < MAX_FOR)


def _ask(view: ViewEvidence, prompts: Sequence[Prompt], parts: bool = False) -> list[tuple[Candidate, float]]:
    """Return the network's last two masks for each prompt (`parts`: three), each with the bonus to its merit."""
    assert view.ask is not None
    # masks go from part to whole; the last one, that of the largest object, gets the bonus
    answers = [view.ask(prompt)[-3 if parts else -2 :] for prompt in prompts]
    return [(each, WHOLE_BONUS * (each is masks[-1])) for masks in answers for each in masks]


def _select(
    candidates: Sequence[tuple[Candidate, float]], projection: Projection, known: np.ndarray | None = None
) -> np.ndarray:
    """Return the mask with the largest merit; `known` is united with each candidate to compute its agreement only."""
    joined = lambda mask: mask if known is None else mask | known
    # agreement with the votes, times the IoU that the network expects of its mask, plus the bonus
    merit = lambda pair: agreement(joined(pair[0].mask), projection) * pair[0].score + pair[1]
    return max(candidates, key=merit)[0].mask


def draw_view(view: ViewEvidence, projection: Projection) -> np.ndarray:
    """Return bool [H, W], the object's mask in a view whose masks did not vote, such as a test view.

    The mask is all False if the votes project to fewer than `MIN_PIXELS` pixels of the object.
    """
    if projection.silhouette.sum() < MIN_PIXELS:
        return np.zeros_like(projection.silhouette)
    return combine(view.image, projection, draw_mask(view, projection) if view.ask else None)


def agreement(mask: np.ndarray, projection: Projection) -> float:
    """Return the agreement of a mask, bool [H, W], with the projected votes, in [0, 1].

    This is the larger of two IoUs. The first compares the mask with the projected votes for and against the object,
    without the pixels that have no votes. The second compares the mask with the object's silhouette. The second one is
    needed where Gaussians without votes, which only this view shows, occlude the object.
    """
    for_it, against = projection.inside, projection.outside
    shown = float((mask * for_it).sum() / max(for_it.sum() + (mask * against).sum(), 1e-9))
    return max(shown, iou(mask, projection.silhouette))


def combine(image: np.ndarray, projection: Projection, drawn: np.ndarray | None) -> np.ndarray:
    """Return bool [H, W], the projected labels or the network's mask, whichever agrees better with the votes.

    The border of the projected labels is moved to the photograph's edges first.

    Args:
        image: uint8 [H, W, 3], the photograph.
        drawn: bool [H, W], the network's mask; None if there is none.
    """
    labelled = projection.inside > projection.outside
    masks = [refine_edges(image, labelled, np.full(labelled.shape, UNKNOWN, np.int8))]
    if drawn is not None:
        masks.append(drawn)
    return max(masks, key=lambda mask: agreement(mask, projection))


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Return the intersection over union of two masks, bool [H, W]; 1 if both are empty."""
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else 1.0


def _large_parts(mask: np.ndarray, least: float) -> list[np.ndarray]:
    """Return the connected parts of a mask that have at least `least` pixels, bool [H, W] each, the largest first."""
    parts, sizes = label_sizes(mask)
    return [parts == k for k in np.argsort(-sizes, kind="stable") if sizes[k] >= max(least, 1)]


def _drop_small_parts(mask: np.ndarray) -> np.ndarray:
    """Return the mask without connected parts that are smaller than the share `MIN_PART` of the largest part."""
    parts, sizes = label_sizes(mask)
    return mask & (sizes >= MIN_PART * sizes.max())[parts]


def deepest_points(mask: np.ndarray) -> Clicks:
    """Return 1 to `POINTS` positive clicks inside a mask that is not empty, far from its border and each other."""
    depth = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    least, points = max(MIN_DEPTH * depth.max(), MIN_DEPTH_PX), []
    rows, columns = np.ogrid[: mask.shape[0], : mask.shape[1]]
    while len(points) < POINTS and (depth.max() >= least or not points):
        row, column = np.unravel_index(depth.argmax(), depth.shape)
        points.append((column + 0.5, row + 0.5))
        depth = np.where((rows - row) ** 2 + (columns - column) ** 2 > (3 * depth[row, column]) ** 2, depth, 0.0)
    return Clicks(np.array(points), np.ones(len(points), bool))
