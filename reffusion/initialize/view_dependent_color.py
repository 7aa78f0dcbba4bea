"""How a completed surface changes with the direction: as the surface around it does, from photograph to photograph.

One picture tells how a surface looks from one side. A wet table or a leaf in the sun is brighter from another, and what
is new would stand out there as a patch. The photographs show what stands around it from all sides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree

from reffusion import geometry
from reffusion.background.visibility import Witness, pixels, seen_by, widened
from reffusion.splat.conventions import SH0
from reffusion.splat.reference import harmonics
from reffusion.types import Camera, Gaussians

RING = 0.1  # of the image's width: how far around the hole the surface is looked at
AWAY = 0.006  # of it: and how far from the object's blurred rim
SOFT = 0.015  # of it: blur under which brightness is compared
BROAD = 0.03  # of it: blur under which two places are of one stuff; not the same, or the dark would seem to brighten
MOST = 3000  # points around that are kept
NEIGHBOURS = 200  # of a new Gaussian, among them
AT_ONCE = 20_000  # new Gaussians: their neighbours, in all views, take a GB at 200 views
ALIKE = 0.08  # difference of colour, in [0, 1], at which a neighbour counts by 0.6: wood and steel shine unlike
FAINT = 0.012  # of [0, 1]: a mean change up to which a surface is matte
ENOUGH = 0.05  # share of the neighbours, by weight, that a view must show to tell of the change
GUESSED = 0.3  # weight of a view that does not tell, against one that does
STIFF = 0.002  # weight of no change against a view: where few views tell, little is made up


@dataclass(frozen=True)
class Change:
    """How surfaces around a hole change from a completed view to V others.

    Attributes:
        broad: [H, W, 3] float32, the completed view, blurred, in [0, 1].
        points: [R, 3] on these surfaces. colors: [R, 3], of broad.
        brighter: [R, V, 3], what each view adds to these, as shine is added; 0 where it does not show them.
        shown: bool [R, V], where it does.
    """

    broad: np.ndarray
    points: np.ndarray
    colors: np.ndarray
    brighter: np.ndarray
    shown: np.ndarray


def change_around(
    picture: np.ndarray,
    depth: np.ndarray,
    hole: np.ndarray,
    camera: Camera,
    views: Sequence[Witness],
    photos: Mapping[str, np.ndarray],
) -> Change:
    """The change around a hole, from its completed view to all views.

    Args:
        picture: [H, W, 3] uint8, the completed view; depth: [H, W] of the surfaces it shows, 0 where unknown.
        hole: bool [H, W]. camera: the view, one of the photographed. views: V witnesses. photos: their pictures, uint8,
            exposed alike.
    """
    # Around the hole photographs are compared: a reference may show in the light what they show in the object's shadow.
    picture = np.where(hole[..., None], picture, photos[camera.name])
    ring = widened(hole, RING) & ~widened(hole, AWAY) & (depth > 0)
    rows, columns = np.nonzero(ring)
    kept = np.linspace(0, len(rows) - 1, min(MOST, len(rows))).round().astype(int)
    rows, columns = rows[kept], columns[kept]
    points = geometry.unproject(np.where(depth > 0, depth, 1.0), camera)[rows, columns]
    here, broad = _soft(picture, ~hole, SOFT)[rows, columns], _soft(picture, np.ones_like(hole), BROAD)
    brighter, shown = np.zeros((len(points), len(views), 3)), np.zeros((len(points), len(views)), bool)
    for number, view in enumerate(views):
        uv, _ = geometry.project(points, view.camera)
        shown[:, number] = seen_by(replace(view, hidden=widened(view.hidden, AWAY)), points)
        there, _ = geometry.sample_nearest(_soft(photos[view.camera.name], ~view.hidden, SOFT), uv)
        change = there - here
        brighter[:, number] = np.where(shown[:, number, None], change, 0.0)
    return Change(broad, points, broad[rows, columns], brighter, shown)


def _soft(image: np.ndarray, known: np.ndarray, blur: float) -> np.ndarray:
    """[H, W, 3] float32 in [0, 1], blurred, of known pixels only."""
    sigma, weight = pixels(blur, known.shape[1]), known.astype(np.float32)
    total = cv2.GaussianBlur(weight, (0, 0), sigma)
    blurred = cv2.GaussianBlur(image.astype(np.float32) / 255 * weight[..., None], (0, 0), sigma)
    return blurred / np.maximum(total, 1e-3)[..., None]


@torch.no_grad()
def lent(
    gaussians: Gaussians, fresh: torch.Tensor, camera: Camera, around: Change, views: Sequence[Witness]
) -> Gaussians:
    """The fresh Gaussians, bool [N], with spherical harmonics that follow what the surface around them does.

    Each takes the mean change of its neighbours in every view, near and alike in colour; the harmonics are least
    squares to them. Towards `camera`, from which the new were made, they keep their colour.
    """
    chosen = torch.nonzero(fresh)[:, 0]
    if gaussians.sh_degree == 0 or not len(chosen) or len(around.points) < NEIGHBOURS:
        return gaussians
    sh = gaussians.sh.clone()
    for part in chosen.split(AT_ONCE):
        theirs = gaussians.map(lambda p, part=part: p[part].cpu())
        sh[part] = _harmonics_of(theirs, camera, around, views).to(sh.device)
    return replace(gaussians, sh=sh)


def _harmonics_of(fresh: Gaussians, camera: Camera, around: Change, views: Sequence[Witness]) -> torch.Tensor:
    """[N, K, 3], those of `lent`."""
    degree, means, base = fresh.sh_degree, fresh.means.double(), fresh.sh[:, 0].double()
    own, _ = geometry.sample_nearest(around.broad, geometry.project(means.numpy(), camera)[0])
    brighter, known = _carried(means.numpy(), own, around)
    brighter, weight = _told_by_the_nearest(brighter, known, around.points.mean(0), views)
    ahead = harmonics(means - torch.from_numpy(camera.center), degree)[..., 1:]
    size = ahead.shape[-1]
    normal = STIFF * len(views) * torch.eye(size, dtype=torch.float64).expand(len(means), size, size).clone()
    right = torch.zeros(len(means), size, 3, dtype=torch.float64)
    for number, view in enumerate(views):
        apart = harmonics(means - torch.from_numpy(view.camera.center), degree)[..., 1:] - ahead
        weighted = apart * weight[:, number, None]
        normal += weighted[:, :, None] * apart[:, None]
        right += weighted[:, :, None] * brighter[:, number, None]
    rest = torch.linalg.solve(normal, right)
    constant = base - (ahead[..., None] * rest).sum(1) / SH0
    return torch.cat([constant[:, None], rest], 1).to(fresh.sh.dtype)


def _carried(means: np.ndarray, own: np.ndarray, around: Change) -> tuple[np.ndarray, np.ndarray]:
    """The mean change [N, V, 3] of the neighbours of means [N, 3], whose colours are own [N, 3]; and bool
    [N, V]: enough of these are shown."""
    distance, index = cKDTree(around.points).query(means, k=NEIGHBOURS)
    near = np.exp(-0.5 * (distance / np.maximum(distance[:, -1:] / 2, 1e-12)) ** 2)
    alike = np.exp(-0.5 * ((own[:, None] - around.colors[index]) ** 2).sum(-1) / ALIKE**2)
    weight = near * (alike + 1e-3)
    weight /= weight.sum(1, keepdims=True)
    starts = np.arange(len(means) + 1) * NEIGHBOURS
    weights = sparse.csr_matrix((weight.ravel(), index.ravel(), starts), (len(means), len(around.points)))
    share = weights @ around.shown.astype(np.float64)
    flat = around.brighter.reshape(len(around.points), -1)
    of_all = lambda values: (weights @ values).reshape(len(means), -1, 3) / np.maximum(share, 1e-12)[..., None]
    mean, square = of_all(flat), of_all(flat**2)
    # A mirror shows something else at every point: where neighbours differ, little is to be learnt of them.
    size = (mean**2).sum(-1)
    agreed = size / np.maximum(square.sum(-1), 1e-12) * np.maximum(1 - 3 * FAINT**2 / np.maximum(size, 1e-12), 0)
    return mean * agreed[..., None], share > ENOUGH


def _told_by_the_nearest(
    brighter: np.ndarray, known: np.ndarray, middle: np.ndarray, views: Sequence[Witness]
) -> tuple[torch.Tensor, torch.Tensor]:
    """The change [N, V, 3], that of the nearest view that tells where a view does not; and the views' weights [N, V]:
    harmonics that are bound in a few directions only run away in the others."""
    ways = np.stack([view.camera.center for view in views]) - middle
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    apart, some = 1 - ways @ ways.T, known.any(1)
    filled = brighter.copy()
    for number in range(len(views)):
        missing = np.flatnonzero(some & ~known[:, number])
        nearest = np.where(known[missing], apart[number], np.inf).argmin(1)
        filled[missing, number] = brighter[missing, nearest]
    weight = np.where(known, 1.0, GUESSED) * some[:, None]
    return torch.from_numpy(filled), torch.from_numpy(weight)
