"""Mask consolidation (paper): 2D masks vote for Gaussians, and labelled Gaussians are rendered to consistent masks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
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
    """Sum the votes of all views that have a mask.

    PAPER leaves open: whether a contribution counts as one or by its blending weight. `weight` is the default: a
    Gaussian behind the object is blended faintly into many masked pixels, and by `count` these outvote the pixels that
    show it plainly, so that visible background is removed.

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


def find_floaters(
    remaining: Gaussians, cameras: Sequence[Camera], unobserved: Mapping[str, np.ndarray], tau: float = 1.0
) -> Tensor:
    """bool [M]: floaters, the Gaussians that contribute mostly to unobserved pixels once the object is removed.

    The fit was not supervised there: their footprints reached far into or behind the object while it hid them. The
    ratio is the one that labels the object, counted without the object.

    Args:
        remaining: M Gaussians, without those to remove.
        unobserved: view name -> bool [H, W].
        tau: ratio of contributions to unobserved pixels over those to all others, above which it is a floater.
    """
    return label_gaussians(cast_votes(remaining, cameras, unobserved, mode="weight"), tau)


def hidden_inside(
    gaussians: Gaussians, cameras: Sequence[Camera], masks: Mapping[str, np.ndarray], share: float = 0.5
) -> Tensor:
    """bool [N]: the centre lies inside the mask in more than `share` of the voting views whose frame contains it.

    This is the vote for Gaussians that no view sees: those inside the object would come to light when it is removed.
    """
    means = gaussians.means.detach().cpu().double().numpy()
    return torch.as_tensor(points_inside(means, cameras, masks, share), device=gaussians.means.device)


def points_inside(
    points: np.ndarray, cameras: Sequence[Camera], masks: Mapping[str, np.ndarray], share: float = 0.5
) -> np.ndarray:
    """bool [P]: points [P, 3] that lie inside the mask in more than `share` of the masked views that frame them."""
    inside, framed = np.zeros(len(points)), np.zeros(len(points))
    for camera in cameras:
        if camera.name in masks:
            hit, within = geometry.sample_nearest(masks[camera.name], geometry.project(points, camera)[0])
            inside += hit & within
            framed += within
    return inside > share * framed


@torch.no_grad()
def render_labels(gaussians: Gaussians, labels: Tensor, camera: Camera) -> np.ndarray:
    """The labels rendered into one view, [H, W] in [0, 1).

    C is where they exceed tau'. PAPER leaves open: whether they are divided by alpha first. Here they are not: where
    alpha is small nothing hides the background, whatever the labels of faint Gaussians.
    """
    rendering = rasterizer.render(gaussians, camera, features=labels[:, None].to(gaussians.means.dtype), sh_degree=0)
    return rendering.features[..., 0].cpu().numpy()


def best_view(invent: Mapping[str, np.ndarray], names: Sequence[str]) -> str | None:
    """The view to complete: the one with the largest invent mask, of those whose mask does not touch the border if
    there are any; None where no view has anything to invent.

    PAPER leaves open: which view is the reference. The largest mask, because parts of the hole that it does not show
    would stay empty; away from the border, because a border that cuts the mask hides a part of the hole.
    """
    sizes = {name: int(invent[name].sum()) for name in names if invent[name].any()}
    whole = {name: size for name, size in sizes.items() if not _touches_border(invent[name])}
    candidates = whole or sizes
    return max(sorted(candidates), key=candidates.__getitem__) if candidates else None


def _touches_border(mask: np.ndarray) -> bool:
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())
