"""From masks of a few views to masks of all, by the Gaussians: votes, a cut among neighbours, each view's own edges."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from reffusion.clicks import color_evidence
from reffusion.clicks.geodesic_cut import attached, nearer
from reffusion.clicks.marks import Clicks, marked
from reffusion.clicks.single_view import corrected, refined, shrunk, view_mask
from reffusion.graph_cut import least_cut
from reffusion.masks import voting
from reffusion.splat import rasterizer
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians

NEIGHBOURS = 8
MOST = 5.0  # px of blending weight, beyond which a vote counts no more
SEEN = 1.0  # px of blending weight from which a Gaussian is shown to be the object
UNSURE = 0.006  # of the picture's larger side: pixels this near to a mask's rim do not vote
AROUND = 0.05  # of the picture's larger side: the ring around a mask that a test photograph is judged by
ABSENT, LEVEL = 3.0, 0.02  # times as far off as in that ring, beside a part of white: the object is not there
ROUNDS = 3  # at most, of colours, each by the labels of the one before
COLOR = 1.0  # of a pixel in the mean view: what the colours of other views weigh
UNLIKE = 1.0  # how much longer a way is where colours differ as neighbours do on average
NEARER = 3.0  # what the way to the object, or to what it is not, may tell, beside what colours do
SHOWN = 0.5  # of a pixel: the object covers it


@dataclass(frozen=True)
class Neighbours:
    """Which Gaussians lie next to each other, and how alike they look.

    Attributes:
        pairs: [E, 2] int, each pair once.
        likeness: [E] in (0, 1].
        way: [E] > 0, how far it is from one to the other: their distance, longer where their colours differ.
    """

    pairs: np.ndarray
    likeness: np.ndarray
    way: np.ndarray


@dataclass(frozen=True)
class Solved:
    """What clicks say of the scene.

    Attributes:
        labels: bool [N], the Gaussians that are the object.
        masks: view -> bool [H, W], of the views with clicks, or with a mask that was given.
    """

    labels: Tensor
    masks: dict[str, np.ndarray]


def neighbours(gaussians: Gaussians) -> Neighbours:
    """Those next to each other in space; likeness by colour, against what neighbours differ by on average."""
    means, color = (each.detach().cpu().double().numpy() for each in (gaussians.means, gaussians.sh[:, 0] * SH0))
    near = cKDTree(means).query(means, min(NEIGHBOURS + 1, len(means)))[1].reshape(len(means), -1)[:, 1:]
    own = np.repeat(np.arange(len(means)), near.shape[1])
    pairs = np.unique(np.sort(np.stack([own, near.ravel()], 1), 1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    square = ((color[pairs[:, 0]] - color[pairs[:, 1]]) ** 2).sum(1)
    unlike = square / (square.sum() / max(len(square), 1) + 1e-12)
    apart = np.linalg.norm(means[pairs[:, 0]] - means[pairs[:, 1]], axis=1)
    return Neighbours(pairs, np.exp(-unlike / 2), apart * (1 + UNLIKE * np.sqrt(unlike)) + 1e-12)


def solved(
    gaussians: Gaussians,
    near: Neighbours,
    cameras: Mapping[str, Camera],
    image_of: Callable[[str], np.ndarray],
    clicks: Mapping[str, Clicks],
    given: Mapping[str, np.ndarray],
) -> Solved:
    """The object by clicks, and by masks of some views.

    The view with most clicks on the object is cut by its photograph alone; in each of the others clicks correct what
    the Gaussians so far show there.

    Args:
        near: `neighbours` of the Gaussians.
        cameras: of the views whose photographs show the object.
        image_of: view -> uint8 [H, W, 3].
        clicks: view -> clicks in its undistorted pixels.
        given: view -> bool [H, W], taken as they are.
    """
    masks, labels = dict(given), torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    if masks:
        labels = labelled(gaussians, near, cameras, masks, image_of)
    for name in in_order(clicks):
        if labels.any():
            before = voting.render_labels(gaussians, labels, cameras[name]) > SHOWN
            masks[name] = corrected(image_of(name), before, clicks[name], relief(gaussians, cameras[name]))
        else:
            masks[name] = view_mask(image_of(name), clicks[name], relief(gaussians, cameras[name]))
        labels = labelled(gaussians, near, cameras, masks, image_of)
    return Solved(labels, masks)


@torch.no_grad()
def relief(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """float64 [H, W], logarithm of the depth times the focal length, px: its slope is that of surfaces, whatever their
    distance. Where nothing is drawn it is as far as the farthest."""
    depth = rasterizer.render(gaussians, camera, sh_degree=0).depth.double().cpu().numpy()
    if not (depth > 0).any():
        return np.zeros_like(depth)
    return np.log(np.where(depth > 0, depth, depth.max())) * camera.fx


def in_order(clicks: Mapping[str, Clicks]) -> list[str]:
    """The views, those first with most clicks on the object."""
    return sorted(clicks, key=lambda name: (-int(clicks[name].positive.sum()), name))


def labelled(
    gaussians: Gaussians,
    near: Neighbours,
    cameras: Mapping[str, Camera],
    masks: Mapping[str, np.ndarray],
    image_of: Callable[[str], np.ndarray],
) -> Tensor:
    """bool [N]: the object, where the views with masks show the Gaussians by their votes, elsewhere by neighbours and
    by the colours of the other photographs."""
    sure = np.zeros((len(gaussians), 2))
    for name, mask in masks.items():
        ballots = torch.as_tensor(np.stack([_sure(mask), _sure(~mask)], -1), device=gaussians.means.device)
        sure += rasterizer.accumulate(gaussians, cameras[name], ballots.to(gaussians.means.dtype)).cpu().numpy()
    inside, outside = sure.T
    margin = max(1, round(UNSURE * max(next(iter(masks.values())).shape)))
    never = color_evidence.beside(gaussians, cameras, masks, margin) & (inside < SEEN)
    inside, outside = np.minimum(inside, MOST), np.where(never, MOST, np.minimum(outside, MOST))
    others = {name: camera for name, camera in cameras.items() if name not in masks}
    known = color_evidence.Known(inside > np.maximum(SEEN, outside), outside > np.maximum(SEEN, inside))
    side, labels = nearer(near.pairs, near.way, known.inside, known.outside), known.inside
    for _ in range(ROUNDS):
        says, much = color_evidence.told(gaussians, color_evidence.Known(labels, known.outside), others, image_of).T
        gain = np.minimum(COLOR * much, MOST) * (says + NEARER * side) * ~(known.inside | known.outside)
        before, against, for_it = labels, outside + np.maximum(-gain, 0), inside + np.maximum(gain, 0)
        labels = attached(least_cut(against, for_it, near.pairs, near.likeness), near.pairs, known.inside)
        if (labels == before).all():
            break
    return torch.as_tensor(labels, device=gaussians.means.device)


def shown(
    gaussians: Gaussians, labels: Tensor, camera: Camera, image: np.ndarray, clicks: Clicks | None = None
) -> np.ndarray:
    """bool [H, W]: where a view shows the labelled Gaussians, up to its photograph's own edges."""
    mask = voting.render_labels(gaussians, labels, camera) > SHOWN
    nothing = Clicks(np.zeros((0, 2)), np.zeros(0, bool))
    return refined(image, mask, marked(clicks or nothing, mask.shape))


def there(gaussians: Gaussians, camera: Camera, image: np.ndarray, mask: np.ndarray) -> bool:
    """Does the photograph show the object where its mask [H, W] is, as the Gaussians do, or was it taken without?"""
    around = ~shrunk(~mask, max(2, round(AROUND * max(mask.shape)))) & ~mask
    if not mask.any() or not around.any():
        return bool(mask.any())
    with torch.no_grad():
        drawn = rasterizer.render(gaussians, camera).color.clamp(0, 1).cpu().numpy()
    off = np.abs(drawn - image / 255.0).mean(-1)
    return float(off[mask].mean()) < ABSENT * float(off[around].mean()) + LEVEL


def _sure(mask: np.ndarray) -> np.ndarray:
    """The mask without its rim, where one this thin is not all rim."""
    inner = shrunk(mask, max(1, round(UNSURE * max(mask.shape))))
    return inner if inner.sum() > 0.25 * mask.sum() else mask
