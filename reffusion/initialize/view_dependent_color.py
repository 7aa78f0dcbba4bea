"""View-dependent colour of new Gaussians: it follows the surface around them, from photograph to photograph.

One picture shows a surface from one side. A wet table, or a leaf in the sun, is brighter from another side, and new
Gaussians of constant colour would stand out as a patch. The photographs show the surface around the hole from all
sides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree

from reffusion import geometry, morphology
from reffusion.background.visibility import DepthView, is_seen
from reffusion.splat.conventions import SH0
from reffusion.splat.pure_torch import harmonics
from reffusion.types import Camera, Gaussians

RING = 0.1  # of the image's width: how far around the hole the surface is sampled
MARGIN = 0.006  # of the image's width: distance from the object's blurred rim
BLUR = 0.015  # of the image's width: standard deviation at which brightness is compared
COLOR_BLUR = 0.03  # of the image's width: at which materials are compared; at `BLUR` dark spots would seem to brighten
MAX_SAMPLES = 3000  # points that are kept
NEIGHBORS = 200  # samples that each new Gaussian takes its colour change from
BATCH = 20_000  # new Gaussians at a time: their neighbours in all views take a GB at 200 views
COLOR_SIGMA = 0.08  # of [0, 1]: difference at which a sample's weight is 0.6; wood and steel shine differently
NOISE = 0.012  # of [0, 1]: mean change up to which a surface is matte
MIN_SHARE = 0.05  # of the samples, by weight, that a view must show to tell of the change
GUESS_WEIGHT = 0.3  # of a view that does not tell, against 1 for one that does
RIDGE = 0.002  # weight of no change against one view: where few views tell, little is made up


@dataclass(frozen=True)
class ColorChange:
    """How the surface around a hole changes from a completed view to V other views.

    Attributes:
        material: [H, W, 3] float32, the completed view, strongly blurred, in [0, 1].
        points: [R, 3], R samples of the surface. colors: [R, 3], `material` at them.
        change: [R, V, 3], colour in each view minus colour in the completed view, both blurred by `BLUR`; 0 where the
            view does not show the sample.
        visible: bool [R, V], whether a view shows a sample.
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
    """The change of colour around a hole, from its completed view to all views.

    Args:
        picture: [H, W, 3] uint8, the completed view; depth: [H, W] of the surfaces it shows, 0 where unknown.
        hole: bool [H, W]. camera: the completed view, one of those with a photograph.
        views: V of them. photos: their pictures, uint8, in one exposure.
    """
    # Outside the hole photographs are compared: a reference may show in the light what they show in the object's
    # shadow.
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
    """[H, W, 3] float32 in [0, 1], blurred over known pixels only."""
    sigma, weight = morphology.to_pixels(blur, known.shape[1]), known.astype(np.float32)
    total = cv2.GaussianBlur(weight, (0, 0), sigma)
    blurred = cv2.GaussianBlur(image.astype(np.float32) / 255 * weight[..., None], (0, 0), sigma)
    return blurred / np.maximum(total, 1e-3)[..., None]


@torch.no_grad()
def transfer_sh(
    gaussians: Gaussians, is_new: torch.Tensor, camera: Camera, change: ColorChange, views: Sequence[DepthView]
) -> Gaussians:
    """The new Gaussians, bool [N], with spherical harmonics that change as the surface around them does.

    Each takes the mean change of its neighbours in every view, weighted by distance and similarity of colour; the
    harmonics are a least squares fit to these. Towards `camera`, in which the Gaussians were made, they keep their
    colour.
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
    """[N, K, 3], the harmonics of `transfer_sh`."""
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
    rest = torch.linalg.solve(normal, right)
    constant = constant - (base[..., None] * rest).sum(1) / SH0
    return torch.cat([constant[:, None], rest], 1).to(batch.sh.dtype)


def _neighbor_change(means: np.ndarray, own: np.ndarray, change: ColorChange) -> tuple[np.ndarray, np.ndarray]:
    """The mean change [N, V, 3] of the neighbours of means [N, 3], whose colours are `own`, [N, 3]; and bool [N, V],
    whether enough of them are visible."""
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
    # A mirror shows something else at every point: where neighbours disagree, their mean is shrunk.
    size = (mean**2).sum(-1)
    agreement = size / np.maximum(square.sum(-1), 1e-12) * np.maximum(1 - 3 * NOISE**2 / np.maximum(size, 1e-12), 0)
    return mean * agreement[..., None], share > MIN_SHARE


def _fill_unknown_views(
    change: np.ndarray, known: np.ndarray, middle: np.ndarray, views: Sequence[DepthView]
) -> tuple[torch.Tensor, torch.Tensor]:
    """The change [N, V, 3], where a view is unknown that of the nearest known one; and the views' weights [N, V].

    Harmonics that are constrained in a few directions only run away in the others.
    """
    directions = np.stack([view.camera.center for view in views]) - middle
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance, any_known = 1 - directions @ directions.T, known.any(1)
    filled = change.copy()
    for number in range(len(views)):
        missing = np.flatnonzero(any_known & ~known[:, number])
        nearest = np.where(known[missing], distance[number], np.inf).argmin(1)
        filled[missing, number] = change[missing, nearest]
    weight = np.where(known, 1.0, GUESS_WEIGHT) * any_known[:, None]
    return torch.from_numpy(filled), torch.from_numpy(weight)
