"""View-dependent color of new Gaussians, estimated from the surface around the hole.

A reference shows the new surface from one side only. A wet table, or a leaf in the sun, is brighter from another side,
where new Gaussians of constant color would stand out as a patch. But the photographs show the surface around the hole
from all sides. So its change of color from view to view is measured, and given to new Gaussians of similar color.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree

from reffusion import geometry, morphology
from reffusion.background.visibility import DepthView, is_seen
from reffusion.splat.conventions import SH0
from reffusion.splat.pure_torch import harmonics
from reffusion.types import Camera, Gaussians

RING = 0.1  # of the image's width: width of the ring around the hole in which the surface is sampled
MARGIN = 0.006  # of the image's width: distance that samples keep from the object's blurred rim
BLUR = 0.015  # of the image's width: standard deviation of the blur before colors are compared between views
# Of the image's width: standard deviation of the blur before materials are compared. After the weaker blur `BLUR`, dark
# spots would seem to brighten.
COLOR_BLUR = 0.03
MAX_SAMPLES = 3000  # sampled points at most
NEIGHBORS = 200  # nearest samples, from which each new Gaussian takes its change of color
BATCH = 20_000  # new Gaussians that are handled at a time: for 200 views their neighbors take a GB
COLOR_SIGMA = 0.08  # colors in [0, 1]: difference at which a sample's weight is 0.6; wood and steel shine differently
NOISE = 0.012  # colors in [0, 1]: a mean change up to this is noise, and the surface matte
MIN_SHARE = 0.05  # a view's change of color is known where it shows this share of the neighboring samples, by weight
GUESS_WEIGHT = 0.3  # weight of a view whose change of color is unknown and guessed; known ones have weight 1
RIDGE = 0.002  # weight of the ridge penalty, per view: it keeps harmonics small where few views determine them


@dataclass(frozen=True)
class ColorChange:
    """The change of color of the surface around a hole, from a completed view to each of V views.

    Attributes:
        material: [H, W, 3] float32 in [0, 1], the completed view inside the hole and its photograph outside, after a
            strong blur (`COLOR_BLUR`). It tells materials apart.
        points: [R, 3], R samples of the surface, in the world.
        colors: [R, 3], `material` at the samples.
        change: [R, V, 3], a sample's color in the photograph of each view minus its color in the photograph of the
            completed view, both in [0, 1] and blurred by `BLUR`; 0 where the view does not show the sample.
        visible: bool [R, V], True where a view shows a sample.
    """

    material: np.ndarray
    points: np.ndarray
    colors: np.ndarray
    change: np.ndarray
    visible: np.ndarray


def measure_change(
    picture: np.ndarray,
    depth: np.ndarray,
    hole: np.ndarray,
    camera: Camera,
    views: Sequence[DepthView],
    photos: Mapping[str, np.ndarray],
) -> ColorChange:
    """Measure how the color of the surface around a hole changes from a completed view to each of V views.

    Photographs are compared with photographs, because a completed view may lack the object's shadow.

    Args:
        picture: [H, W, 3] uint8, the completed view.
        depth: [H, W], camera z of the surfaces in the completed view; 0 where unknown.
        hole: bool [H, W], the pixels that were completed, and C (the object's pixels). The surface is sampled around
            them.
        camera: the camera of the completed view, which must have a photograph too.
        views: the V depth views of the scene.
        photos: view name -> uint8 [H, W, 3], the photographs of these views, in one common exposure.
    """
    # Outside the hole photographs are compared with photographs. A reference may have removed the object's shadow,
    # which the photographs show.
    picture = np.where(hole[..., None], picture, photos[camera.name])
    ring = morphology.dilate(hole, RING) & ~morphology.dilate(hole, MARGIN) & (depth > 0)
    rows, columns = np.nonzero(ring)
    kept = np.linspace(0, len(rows) - 1, min(MAX_SAMPLES, len(rows))).round().astype(int)
    rows, columns = rows[kept], columns[kept]
    points = geometry.unproject(np.where(depth > 0, depth, 1.0), camera)[rows, columns]
    here, material = _blur(picture, ~hole, BLUR)[rows, columns], _blur(picture, np.ones_like(hole), COLOR_BLUR)
    change, visible = np.zeros((len(points), len(views), 3)), np.zeros((len(points), len(views)), bool)
    for number, view in enumerate(views):
        uv, _ = geometry.project(points, view.camera)
        visible[:, number] = is_seen(replace(view, masked=morphology.dilate(view.masked, MARGIN)), points)
        color, _ = geometry.sample_nearest(_blur(photos[view.camera.name], ~view.masked, BLUR), uv)
        change[:, number] = np.where(visible[:, number, None], color - here, 0.0)
    return ColorChange(material, points, material[rows, columns], change, visible)


def _blur(image: np.ndarray, known: np.ndarray, blur: float) -> np.ndarray:
    """Return the uint8 image in [0, 1], blurred over `known` pixels; `blur` is sigma as a fraction of the width."""
    return morphology.masked_blur(image.astype(np.float32) / 255, known, morphology.to_pixels(blur, known.shape[1]))


@torch.no_grad()
def transfer_sh(
    gaussians: Gaussians, is_new: torch.Tensor, camera: Camera, change: ColorChange, views: Sequence[DepthView]
) -> Gaussians:
    """Return all Gaussians, the new ones with harmonics whose color changes as that of the surface around them does.

    For every view, each new Gaussian takes the mean change of color of the neighboring samples, weighted by distance
    and similarity of color, and shrunk toward 0 where the samples disagree. Its harmonics are a least squares fit to
    these changes. Seen from `camera`, the Gaussian keeps its color.

    Args:
        gaussians: all N Gaussians of the scene.
        is_new: bool [N], True for the Gaussians to change.
        camera: the completed view, from which the new Gaussians were made.
        change: the changes of color around the hole.
        views: the V views of `change`.

    Returns:
        All N Gaussians. They are unchanged if their harmonics are of degree 0, or if `change` has fewer than
        `NEIGHBORS` samples.
    """
    indices = torch.nonzero(is_new)[:, 0]
    if gaussians.sh_degree == 0 or not len(indices) or len(change.points) < NEIGHBORS:
        return gaussians
    sh = gaussians.sh.clone()
    for part in indices.split(BATCH):
        batch = gaussians.map(lambda p, part=part: p[part].cpu())
        sh[part] = _fit_harmonics(batch, camera, change, views).to(sh.device)
    return replace(gaussians, sh=sh)


def _fit_harmonics(batch: Gaussians, camera: Camera, change: ColorChange, views: Sequence[DepthView]) -> torch.Tensor:
    """Return [N, K, 3], the spherical harmonics of N new Gaussians; arguments as of `transfer_sh`."""
    degree, means, constant = batch.sh_degree, batch.means.double(), batch.sh[:, 0].double()
    own, _ = geometry.sample_nearest(change.material, geometry.project(means.numpy(), camera)[0])
    mean, known = _neighbor_change(means.numpy(), own, change)
    target, weight = _fill_unknown_views(mean, known, change.points.mean(0), views)
    base = harmonics(means - torch.from_numpy(camera.center), degree)[..., 1:]
    size = base.shape[-1]
    normal = RIDGE * len(views) * torch.eye(size, dtype=torch.float64).expand(len(means), size, size).clone()
    right = torch.zeros(len(means), size, 3, dtype=torch.float64)
    for number, view in enumerate(views):
        row = harmonics(means - torch.from_numpy(view.camera.center), degree)[..., 1:] - base
        weighted = row * weight[:, number, None]
        normal += weighted[:, :, None] * row[:, None]
        right += weighted[:, :, None] * target[:, number, None]
    # These non-constant harmonics c_k minimize the sum of squares in docs/method.md#initialization (view-dependent
    # color).
    rest = torch.linalg.solve(normal, right)
    constant = constant - (base[..., None] * rest).sum(1) / SH0
    return torch.cat([constant[:, None], rest], 1).to(batch.sh.dtype)


def _neighbor_change(means: np.ndarray, own: np.ndarray, change: ColorChange) -> tuple[np.ndarray, np.ndarray]:
    """Return [N, V, 3], mean changes of color around Gaussians of colors `own` [N, 3], and [N, V], which are known."""
    # `own` are the colors of the Gaussians in `change.material`.
    distance, index = cKDTree(change.points).query(means, k=NEIGHBORS)
    near = np.exp(-0.5 * (distance / np.maximum(distance[:, -1:] / 2, 1e-12)) ** 2)
    alike = np.exp(-0.5 * ((own[:, None] - change.colors[index]) ** 2).sum(-1) / COLOR_SIGMA**2)
    weight = near * (alike + 1e-3)
    weight /= weight.sum(1, keepdims=True)
    starts = np.arange(len(means) + 1) * NEIGHBORS
    weights = sparse.csr_matrix((weight.ravel(), index.ravel(), starts), (len(means), len(change.points)))
    share = weights @ change.visible.astype(np.float64)
    flat = change.change.reshape(len(change.points), -1)
    average = lambda values: (weights @ values).reshape(len(means), -1, 3) / np.maximum(share, 1e-12)[..., None]
    mean, square = average(flat), average(flat**2)
    # On a mirror the change differs from point to point, and a mean of it is wrong: disagreement shrinks the mean.
    size = (mean**2).sum(-1)
    agreement = size / np.maximum(square.sum(-1), 1e-12) * np.maximum(1 - 3 * NOISE**2 / np.maximum(size, 1e-12), 0)
    # The mean change is known where a view shows enough of the neighbors.
    return mean * agreement[..., None], share > MIN_SHARE


def _fill_unknown_views(
    change: np.ndarray, known: np.ndarray, middle: np.ndarray, views: Sequence[DepthView]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Guess unknown changes of color from the view with the nearest direction; return changes and weights [N, V]."""
    # Without the guesses, harmonics that are constrained in a few directions would take extreme values in all others.
    # Directions to the cameras are compared from `middle` [3].
    directions = np.stack([view.camera.center for view in views]) - middle
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance, any_known = 1 - directions @ directions.T, known.any(1)
    filled = change.copy()
    for number in range(len(views)):
        missing = np.flatnonzero(any_known & ~known[:, number])
        nearest = np.where(known[missing], distance[number], np.inf).argmin(1)
        filled[missing, number] = change[missing, nearest]
    # The weight is 0 for a Gaussian whose change is known in no view.
    weight = np.where(known, 1.0, GUESS_WEIGHT) * any_known[:, None]
    return torch.from_numpy(filled), torch.from_numpy(weight)
