"""Mask consolidation (paper): 2D masks vote on which Gaussians are the object, and the labels are rendered to masks.

The rendered masks, the *consistent masks* C, agree with each other in 3D.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from reffusion import geometry, morphology
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Rendering

VoteMode = Literal["count", "weight"]


@dataclass(frozen=True)
class Votes:
    """The contributions of N Gaussians to the masked and to the unmasked pixels of all voting views.

    Attributes:
        masked: [N] >= 0, contributions to masked pixels. These are numbers of pixels in the mode `count`, and sums of
            blending weights in the mode `weight`.
        unmasked: [N] >= 0, contributions to all other pixels, in the same unit.
    """

    masked: Tensor
    unmasked: Tensor


def cast_votes(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    masks: Mapping[str, np.ndarray],
    *,
    mode: VoteMode = "weight",
    ignored: Mapping[str, np.ndarray] = MappingProxyType({}),
) -> Votes:
    """Sum the votes of all views that have a mask.

    PAPER leaves open: whether a contribution counts as one or by its blending weight. `weight` is the default, because
    a Gaussian behind the object is blended faintly into many masked pixels. By `count` these pixels would outvote the
    unmasked pixels that show the Gaussian clearly, and visible background would be removed.

    Args:
        gaussians: N Gaussians.
        cameras: the training views.
        masks: view name -> bool [H, W], True at pixels of the object. A view with an empty mask votes, too: all its
            pixels are unmasked. A view without an entry does not vote.
        mode: value of one contribution: "count" for 1, "weight" for its blending weight.
        ignored: view name -> bool [H, W], pixels that do not vote; a view without an entry has none.

    Raises:
        ValueError: none of `cameras` has a mask, or a mask does not have the size of its view.
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
        votes = torch.as_tensor(~ignored.get(camera.name, np.zeros(mask.shape, bool)), device=total.device)
        ballots = torch.stack([mask & votes, ~mask & votes], -1).to(total.dtype)
        total += rasterizer.accumulate(gaussians, camera, ballots, count=mode == "count")
    return Votes(total[:, 0], total[:, 1])


def label_gaussians(votes: Votes, tau: float = 1.0) -> Tensor:
    """Return bool [N], True (masked) where the ratio of masked to unmasked contributions exceeds tau.

    A Gaussian without any contribution (0 / 0) is False; `hidden_inside` labels such Gaussians.
    """
    return votes.masked > tau * votes.unmasked


def find_floaters(remaining: Gaussians, cameras: Sequence[Camera], unobserved: Mapping[str, np.ndarray]) -> Tensor:
    """Find floaters: Gaussians that contribute mostly to unobserved pixels once the object is removed.

    Too few other photographs show the place behind an unobserved pixel. Hardly anything supervised the fit there, so
    Gaussians may extend far into or behind the object. Floaters are found by the same vote as the object,
    with the unobserved pixels as masks, and without the object's Gaussians.

    Args:
        remaining: the M Gaussians of the scene without the removed ones.
        cameras: the training views.
        unobserved: view name -> bool [H, W], True at unobserved pixels. A view without an entry does not vote.

    Returns:
        bool [M], True for floaters; all False if no pixel is unobserved.

    Raises:
        ValueError: as `cast_votes`, unless no pixel is unobserved.
    """
    if not any(mask.any() for mask in unobserved.values()):
        return torch.zeros(len(remaining), dtype=torch.bool, device=remaining.means.device)
    return label_gaussians(cast_votes(remaining, cameras, unobserved, mode="weight"))


def hidden_inside(
    gaussians: Gaussians, cameras: Sequence[Camera], masks: Mapping[str, np.ndarray], share: float = 0.5
) -> Tensor:
    """Return bool [N], the Gaussians whose means project into the masks in more than `share` of the views.

    All Gaussians are tested, whether views see them or not. So Gaussians inside the object are found, which votes by
    blending weight cannot label if no view sees them, and which would become visible once the object is removed. The
    other arguments are those of `points_inside`.
    """
    means = gaussians.means.detach().cpu().double().numpy()
    return torch.as_tensor(points_inside(means, cameras, masks, share), device=gaussians.means.device)


def points_inside(
    points: np.ndarray, cameras: Sequence[Camera], masks: Mapping[str, np.ndarray], share: float = 0.5
) -> np.ndarray:
    """Return bool [P], the points that project into the mask in more than `share` of the views.

    Only views that have a mask, and into whose image the point projects, count. A point without such a view is False.
    Occlusion plays no role.

    Args:
        points: [P, 3], world coordinates.
        masks: view name -> bool [H, W], True at pixels of the object.
        share: in [0, 1].
    """
    inside, framed = np.zeros(len(points)), np.zeros(len(points))
    for camera in cameras:
        if camera.name in masks:
            hit, within = geometry.sample_nearest(masks[camera.name], geometry.project(points, camera)[0])
            inside += hit & within
            framed += within
    return inside > share * framed


@torch.no_grad()
def render_labels(gaussians: Gaussians, labels: Tensor, camera: Camera) -> np.ndarray:
    """Render labels into one view: [H, W] in [0, 1), the total blending weight of the labeled Gaussians at each pixel.

    The consistent mask C consists of the pixels where the result exceeds tau'. PAPER leaves open: whether the result is
    divided by alpha first. Here it is not: where alpha is small, nothing hides the background, so faint labeled
    Gaussians should not mask the pixel.

    Args:
        labels: bool [N], True for labeled Gaussians.
    """
    return render_with_labels(gaussians, labels, camera).features[..., 0].cpu().numpy()


@torch.no_grad()
def render_with_labels(gaussians: Gaussians, labels: Tensor, camera: Camera) -> Rendering:
    """Render one view with the labels, bool [N], as its only feature; the colors are those of degree 0."""
    return rasterizer.render(gaussians, camera, features=labels[:, None].to(gaussians.means.dtype), sh_degree=0)


def best_view(invent: Mapping[str, np.ndarray], names: Sequence[str]) -> str | None:
    """Return the name of the view to complete in 2D, which becomes the reference.

    This is the view with the largest invent mask among the views whose invent mask does not touch the image's border.
    If all masks touch the border, it is the view with the largest mask.

    PAPER leaves open: which view is the reference. The mask should be large, because the parts of the hole that the
    reference does not show would stay empty. It should not touch the border, because the border then cuts off a part of
    the hole.

    Args:
        invent: view name -> bool [H, W], the pixels to invent.
        names: the views to choose from.

    Returns:
        The name; None if no view has pixels to invent.
    """
    sizes = {name: int(invent[name].sum()) for name in names if invent[name].any()}
    whole = {name: size for name, size in sizes.items() if not morphology.touches_border(invent[name])}
    candidates = whole or sizes
    return max(sorted(candidates), key=candidates.__getitem__) if candidates else None
