"""2D masks -> votes -> labelled Gaussians -> consistent masks -> the view to complete (paper, mask consolidation)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from reffusion import geometry
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

VoteMode = Literal["count", "weight"]


@dataclass(frozen=True)
class Votes:
    """What each Gaussian contributed to the masked and to the unmasked pixels of all voting views.

    Attributes:
        masked, unmasked: [N], numbers of contributions (mode `count`) or sums of blending weights (`weight`), >= 0.
    """

    masked: Tensor
    unmasked: Tensor


def cast_votes(
    gaussians: Gaussians, cameras: Sequence[Camera], masks: Mapping[str, np.ndarray], *, mode: VoteMode = "weight"
) -> Votes:
    """The votes of every view that has a mask; the others do not vote.

    PAPER leaves open: whether a contribution counts as one or by its blending weight. `weight` is the default: behind
    the object a Gaussian is still blended, faintly, into many masked pixels, and by `count` these outvote the pixels
    in which it is plainly seen, so that background is removed which photographs show.

    Args:
        gaussians: N of them.
        cameras: the training views.
        masks: view name -> bool [H, W], True = the object; an empty mask is a vote, a missing one is not.

    Raises:
        ValueError: no view has a mask, or a mask is not of its view's size.
    """
    voters = [camera for camera in cameras if camera.name in masks]
    if not voters:
        raise ValueError("none of the training views has a mask: nothing says what is to be removed")
    for camera in voters:
        if masks[camera.name].shape != (camera.height, camera.width):
            raise ValueError(
                f"mask of view {camera.name} is {masks[camera.name].shape}, the view {(camera.height, camera.width)}"
            )
    total = torch.zeros(len(gaussians), 2, dtype=gaussians.means.dtype, device=gaussians.means.device)
    for camera in voters:
        mask = torch.as_tensor(masks[camera.name], device=total.device)
        ballots = torch.stack([mask, ~mask], -1).to(total.dtype)
        total += rasterizer.accumulate(gaussians, camera, ballots, count=mode == "count")
    return Votes(total[:, 0], total[:, 1])


def label_gaussians(votes: Votes, tau: float = 1.0) -> Tensor:
    """bool [N], True = masked: the ratio of masked to unmasked contributions exceeds tau.

    A Gaussian without any contribution (0 / 0) stays unmasked; see `hidden_inside`.
    """
    return votes.masked > tau * votes.unmasked


def leaking(
    remaining: Gaussians, cameras: Sequence[Camera], undecided: Mapping[str, np.ndarray], tau: float = 1.0
) -> Tensor:
    """bool [M]: haze, the Gaussians that with the object gone show mostly in undecided pixels.

    The fit had no say in what they show there: footprints that reached far into or behind the object while it hid
    them. The same ratio that labels the object decides, counted without the object.

    Args:
        remaining: M Gaussians, the masked ones gone.
        undecided: view name -> bool [H, W].
        tau: ratio of contributions in undecided pixels to those in all others.
    """
    return label_gaussians(cast_votes(remaining, cameras, undecided, mode="weight"), tau)


def hidden_inside(
    gaussians: Gaussians, cameras: Sequence[Camera], masks: Mapping[str, np.ndarray], share: float = 0.5
) -> Tensor:
    """bool [N]: the centre falls into the mask in more than `share` of the voting views that have it in their frame.

    The vote for Gaussians no view sees: those buried in the object would come to light with its removal.
    """
    means = gaussians.means.detach().cpu().double().numpy()
    return torch.as_tensor(points_inside(means, cameras, masks, share), device=gaussians.means.device)


def points_inside(
    points: np.ndarray, cameras: Sequence[Camera], masks: Mapping[str, np.ndarray], share: float = 0.5
) -> np.ndarray:
    """bool [P]: points [P, 3] inside the mask of more than `share` of the views with a mask that frame them."""
    inside, framed = np.zeros(len(points)), np.zeros(len(points))
    for camera in cameras:
        if camera.name in masks:
            hit, within = geometry.sample_nearest(masks[camera.name], geometry.project(points, camera)[0])
            inside += hit & within
            framed += within
    return inside > share * framed


@torch.no_grad()
def label_view(gaussians: Gaussians, labels: Tensor, camera: Camera) -> np.ndarray:
    """What one view shows of the labels, [H, W] in [0, 1).

    C is where it exceeds tau'. PAPER leaves open: whether it is divided by alpha first. Not here: where alpha is small
    nothing hides the background, whatever the label of the haze.
    """
    drawn = rasterizer.render(gaussians, camera, features=labels[:, None].to(gaussians.means.dtype), sh_degree=0)
    return drawn.features[..., 0].cpu().numpy()


def extent(means: Tensor) -> tuple[np.ndarray, float]:
    """Middle [3] and radius, float64, of what most of the points [N, 3] stand on, N at least 1.

    From medians: a tenth of the labels may be wrong, and lie as far away as the sky.
    """
    points = means.detach().double().cpu().numpy()
    centre = np.median(points, 0)
    return centre, 1.5 * float(np.median(np.linalg.norm(points - centre, axis=1)))


def tidy(mask: np.ndarray, speck: float, gap: float) -> np.ndarray:
    """`mask` without islands of less than `speck` and holes of less than `gap`, both diameters in pixels."""
    kept = mask & ~_small_parts(mask, speck)
    return kept | _small_parts(~kept, gap)


def _small_parts(mask: np.ndarray, diameter: float) -> np.ndarray:
    parts, count = ndimage.label(mask)
    area = np.bincount(parts.ravel(), minlength=count + 1)
    small = area < np.pi / 4 * diameter**2
    small[0] = False
    return small[parts]


def best_view(invent: Mapping[str, np.ndarray], names: Sequence[str]) -> str | None:
    """The view to complete: of those whose invent mask keeps clear of the border (if any does), the largest mask.

    PAPER leaves open: which view is the reference. The largest, because what another view shows of the hole beyond
    it would be left empty; clear of the border, because a mask cut off by it hides a part of the hole.
    None where no view has anything to invent.
    """
    sizes = {name: int(invent[name].sum()) for name in names if invent[name].any()}
    whole = {name: size for name, size in sizes.items() if not _touches_border(invent[name])}
    candidates = whole or sizes
    return max(sorted(candidates), key=candidates.__getitem__) if candidates else None


def _touches_border(mask: np.ndarray) -> bool:
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())
