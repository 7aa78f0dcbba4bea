"""2D masks -> votes -> labelled Gaussians -> consistent masks -> never-seen pixels (paper, mask consolidation)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from reffusion import geometry, splat
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
        total += splat.accumulate(gaussians, camera, ballots, count=mode == "count")
    return Votes(total[:, 0], total[:, 1])


def label_gaussians(votes: Votes, tau: float = 1.0) -> Tensor:
    """bool [N], True = masked: the ratio of masked to unmasked contributions exceeds tau.

    A Gaussian without any contribution (0 / 0) stays unmasked; see `hidden_inside`.
    """
    return votes.masked > tau * votes.unmasked


def leaking(
    remaining: Gaussians, cameras: Sequence[Camera], never_seen: Mapping[str, np.ndarray], tau: float = 1.0
) -> Tensor:
    """bool [M]: haze, the Gaussians that with the object gone show mostly in never-seen pixels.

    The fit had no say in what they show there: footprints that reached far into or behind the object while it hid
    them. The same ratio that labels the object decides, counted without the object.

    Args:
        remaining: M Gaussians, the masked ones gone.
        never_seen: view name -> bool [H, W].
        tau: ratio of contributions in never-seen pixels to those in all others.
    """
    return label_gaussians(cast_votes(remaining, cameras, never_seen, mode="weight"), tau)


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
def label_view(gaussians: Gaussians, labels: Tensor, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """What one view shows of the labels: (blended label [H, W] in [0, 1), disparity [H, W], 0 where nothing is).

    C is where the blended label exceeds tau'. PAPER leaves open: whether it is divided by alpha first. Not here: where
    alpha is small nothing hides the background, whatever the label of the haze.
    """
    drawn = splat.render(gaussians, camera, features=labels[:, None].to(gaussians.means.dtype), sh_degree=0)
    return drawn.features[..., 0].cpu().numpy(), _inverse(drawn.depth)


def _inverse(depth: Tensor) -> np.ndarray:
    values = depth.double().cpu().numpy()
    return np.divide(1.0, values, out=np.zeros_like(values), where=values > 0)


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


def evidence(votes: Votes, enough: float) -> Tensor:
    """[N] in [0, 1]: how far a Gaussian was observed outside the masks, 1 from `enough` (in the unit of the votes)."""
    return (votes.unmasked / enough).clamp(0, 1)


@torch.no_grad()
def remaining_view(remaining: Gaussians, observed: Tensor, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """What one view shows with the object gone: (disparity [H, W], 0 where nothing is; explained [H, W] in [0, 1)).

    `explained` is the evidence of the M remaining Gaussians, `observed` [M], blended like a colour: tails and haze that
    no photograph showed do not explain a pixel, however opaque.
    """
    drawn = splat.render(remaining, camera, features=observed[:, None].to(remaining.means.dtype), sh_degree=0)
    return _inverse(drawn.depth), drawn.features[..., 0].cpu().numpy()


def seen_elsewhere(
    disparity: np.ndarray,
    pixels: np.ndarray,
    camera: Camera,
    witnesses: Sequence[Camera],
    hidden: Mapping[str, np.ndarray],
    surfaces: Mapping[str, np.ndarray],
    *,
    tolerance: float = 0.02,
) -> np.ndarray:
    """int [H, W]: in how many training views the background point behind each of `pixels` is plainly visible.

    A witness sees a point that falls into its frame, outside its C, and not behind the surface it shows.

    Args:
        disparity: [H, W] of the scene without the object, in `camera`.
        pixels: bool [H, W], those asked for; others get 0.
        witnesses: the training views.
        hidden: view name -> bool [H, W], where that view shows the object (its C; all False in a clean view).
        surfaces: view name -> [H, W] disparity of what that view shows outside C.
        tolerance: relative depth by which a point may lie behind that surface.
    """
    count = np.zeros(pixels.shape, np.int64)
    rows, columns = np.nonzero(pixels & (disparity > 0))
    rays = geometry.pixel_rays(camera)[rows, columns]
    pose = camera.world_to_camera
    points = (rays / disparity[rows, columns, None] - pose[:3, 3]) @ pose[:3, :3]
    for witness in witnesses:
        uv, z = geometry.project(points, witness)
        covered, framed = geometry.sample_nearest(hidden[witness.name], uv)
        shown, _ = geometry.sample_nearest(surfaces[witness.name], uv)
        with np.errstate(invalid="ignore"):
            count[rows, columns] += framed & ~covered & (z * shown < 1 + tolerance)
    return count


def box_silhouette(center: np.ndarray, size: np.ndarray, camera: Camera, disparity: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels whose ray meets an axis-aligned box before the surface of the given disparity [H, W]."""
    rays = geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = (np.asarray(center) + np.multiply.outer((-0.5, 0.5), size) - camera.center)[:, None, None] / rays
    near, far = np.fmin(*bounds).max(-1), np.fmax(*bounds).min(-1)  # in units of camera z
    return (far > np.maximum(near, 0.0)) & (np.maximum(near, 0.0) * disparity < 1.0)


def inside_box(gaussians: Gaussians, center: np.ndarray, size: np.ndarray) -> Tensor:
    """bool [N]: centres within an axis-aligned box."""
    offset = gaussians.means - torch.as_tensor(center, dtype=gaussians.means.dtype)
    return (offset.abs() <= torch.as_tensor(size, dtype=gaussians.means.dtype) / 2).all(-1)


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
