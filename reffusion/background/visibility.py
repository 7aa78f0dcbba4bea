"""Seen, free or unknown: what the photographs say of points in space, outside the masks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
import torch

from reffusion import geometry, morphology
from reffusion.background.visibility_kernel import SEEN, SHARES, ask
from reffusion.gaussians.surfels import surface_normals
from reffusion.splat import rasterizer
from reffusion.splat.reference import colors
from reffusion.types import Camera, Gaussians

OPAQUE = 0.9  # alpha from which a pixel shows a surface
SURFACE = 0.02  # relative depth, to either side, within which a point lies on the surface that a view shows
FREE = 0.03  # relative depth by which a view must look past a point to say that nothing is there
ROUGH = 0.006  # of the image's width: how far around a pixel the range of a view's depth is taken
TONE = 10.0  # levels of 255 beyond those that a view shows around a point, from which a Gaussian has another colour
UNEVEN = 1.05  # farthest over nearest depth around a point from which a surface is rough
UNLIKE = 0.5  # share of the views that show a surface there, in which it must, to be debris
TRUSTED = 0.25  # share of the views that look its way in which a surface must be seen, not stand behind another
TINY = 1e-30  # of depth, so that none is no division by zero
MARGIN = 0.004  # of the image's width: a view says nothing so near to its mask, where object and background mix


@dataclass(frozen=True)
class Witness:
    """A training view as a witness of where surfaces are.

    Attributes:
        camera: the view.
        depth: [H, W] float32 of the surface shown, 0 where the view shows nothing opaque.
        closer, farther: [H, W] uint16, `surface_range` in shares that need half of its memory, of hundreds of views the
            most there is: the nearest depth around over `depth`, and `depth` over the farthest, in `asked.SHARES`.
        hidden: bool [H, W], where it shows the object, and a margin around.
    """

    camera: Camera
    depth: np.ndarray
    closer: np.ndarray
    farther: np.ndarray
    hidden: np.ndarray

    @classmethod
    def of(cls, camera: Camera, depth: np.ndarray, surface: tuple[np.ndarray, np.ndarray], hidden: np.ndarray) -> Self:
        """The view as a witness, of the nearest and the farthest depth around each pixel, [H, W]."""
        nearest, farthest = surface
        known = np.maximum(depth, TINY)
        closer = np.rint(SHARES * np.minimum(nearest / known, 1))
        farther = np.rint(SHARES * np.minimum(known / np.maximum(farthest, TINY), 1))
        return cls(camera, depth.astype(np.float32), closer.astype(np.uint16), farther.astype(np.uint16), hidden)

    @property
    def nearest(self) -> np.ndarray:
        """[H, W] float32, the nearest depth around each pixel, 0 where nothing is shown."""
        return self.depth * (self.closer / np.float32(SHARES))

    @property
    def farthest(self) -> np.ndarray:
        """[H, W] float32, the farthest depth around each pixel, 0 where nothing is shown."""
        return self.depth * (SHARES / np.maximum(self.farther, 1).astype(np.float32))


@torch.no_grad()
def witnesses(
    gaussians: Gaussians, cameras: Sequence[Camera], hidden: Mapping[str, np.ndarray], margin: float = MARGIN
) -> list[Witness]:
    """The views as witnesses.

    Args:
        gaussians: the whole scene, the object included: what the photographs show.
        hidden: view name -> bool [H, W], where the object is shown (all False in a clean view).
        margin: pixels so near to it say nothing either, / image width.
    """
    found = []
    for camera in cameras:
        drawn = rasterizer.render(gaussians, camera, sh_degree=0)
        depth = torch.where(drawn.alpha > OPAQUE, drawn.depth, 0).cpu().numpy().astype(np.float32)
        wide = widened(hidden[camera.name], margin)
        found.append(Witness.of(camera, depth, surface_range(depth), wide))
    return found


def surface_range(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest and the farthest depth around each pixel of depth [H, W], 0 where unknown: about the same on a smooth
    surface, wide at depth edges and where the surface is rough, like grass."""
    around = np.ones((2 * pixels(ROUGH, depth.shape[1]) + 1,) * 2, np.uint8)
    nearest = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), around)
    return np.where(depth > 0, nearest, 0), cv2.dilate(depth.astype(np.float32), around)


def with_photographed_depth(depth: np.ndarray, camera: Camera, views: Sequence[Witness]) -> np.ndarray:
    """[H, W] float64: `depth`, rendered without the object, but outside the mask what the view shows with it.

    There the photograph had its say; without the object's blurred rim the same pixels show what lies behind them.
    """
    for view in views:
        if view.camera.name == camera.name:
            return np.where(~view.hidden & (view.depth > 0), view.depth, depth).astype(np.float64)
    return depth


def pixels(fraction: float, width: int) -> int:
    """A share of the image's width in pixels, at least 1."""
    return max(1, round(fraction * width))


def widened(mask: np.ndarray, fraction: float) -> np.ndarray:
    """The mask, bool [H, W], and all pixels within `fraction` of the image's width, at least the next."""
    return morphology.widened(mask, pixels(fraction, mask.shape[1]) / mask.shape[1])


@dataclass(frozen=True)
class Votes:
    """How many views say what of each of P points.

    Attributes:
        seen: [P], views that show a surface there. With normals: a surface that faces them.
        free: [P], views that look past the point onto something farther.
        behind: [P], views in which something stands before the point. With normals: of those that the surface faces.
        hidden: [P], views that see the object in the point's direction.
    """

    seen: np.ndarray
    free: np.ndarray
    behind: np.ndarray
    hidden: np.ndarray

    @property
    def trusted(self) -> np.ndarray:
        """[P], how many views must show a surface there: what lies beneath another in nearly all is not believed."""
        return TRUSTED * (self.seen + self.behind)

    @property
    def shown(self) -> np.ndarray:
        """bool [P]: enough views show a surface there."""
        return self.seen >= np.maximum(1, self.trusted)

    @property
    def empty(self) -> np.ndarray:
        """bool [P]: views look past it, more than show it."""
        return (self.free >= 2) & (self.free > self.seen)


def votes(points: np.ndarray, views: Sequence[Witness], normals: np.ndarray | None = None) -> Votes:
    """What the views say of points [P, 3].

    Two-sided: a point that lies before or behind what a view shows is not seen there.

    Args:
        normals: [P, 3], of the surface that the points lie on, towards the side asked about; a view from the other
            side does not count, so that the underside of a table is no witness of its top, nor does a vase that hides
            its own far side speak against it.
    """
    counts = np.zeros((4, len(points)), np.int64)
    for view in views:
        _ask(view, points, normals, counts)
    return Votes(*counts)


def seen_by(view: Witness, points: np.ndarray) -> np.ndarray:
    """bool [P]: the view shows a surface at the points [P, 3], not before and not behind them."""
    counts = np.zeros((4, len(points)), np.int64)
    _ask(view, points, None, counts)
    return counts[SEEN] > 0


def _ask(view: Witness, points: np.ndarray, normals: np.ndarray | None, counts: np.ndarray) -> None:
    shown = view.depth, view.closer, view.farther, view.hidden
    ask(points, normals, view.camera, shown, (SURFACE, FREE), counts)


def smoothed_surface(depth: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """World points and unit normals towards the camera, [H, W, 3] both, of a rendered depth map [H, W], without the
    splats' own roughness."""
    smooth = cv2.medianBlur(depth.astype(np.float32), 5).astype(np.float64)
    return geometry.unproject(smooth, camera), surface_normals(smooth, camera)


@torch.no_grad()
def debris(
    gaussians: Gaussians,
    labels: torch.Tensor,
    views: Sequence[Witness],
    hidden: Mapping[str, np.ndarray],
    photos: Mapping[str, np.ndarray],
) -> torch.Tensor:
    """bool [N]: Gaussians that the masks' removal brings to light and no photograph supports.

    They stand within the object or in its shadow, where the fit had no say: without the object they show more inside
    the masks than they ever did outside; and where other views look, there is no surface, or a free sight, or one of
    other colours.

    Args:
        gaussians: N of them, the object included. labels: [N] bool, the object's.
        hidden: view name -> bool [H, W], C. photos: view name -> uint8 [H, W, 3], exposed as the Gaussians are.
    """
    remaining = gaussians.map(lambda p: p[~labels])
    uncovered, outside = torch.zeros(len(remaining)), torch.zeros(len(remaining))
    for view in views:
        inside = torch.from_numpy(hidden[view.camera.name])[..., None].to(gaussians.means)
        uncovered += rasterizer.accumulate(remaining, view.camera, inside)[:, 0].cpu()
        photographed = torch.from_numpy(~view.hidden)[..., None].to(gaussians.means)
        outside += rasterizer.accumulate(gaussians, view.camera, photographed)[:, 0].cpu()[~labels.cpu()]
    suspects = torch.nonzero((uncovered > 0.5) & (uncovered > outside))[:, 0]
    asked = remaining.map(lambda p: p[suspects.to(p.device)])
    said = votes(asked.means.double().cpu().numpy(), views)
    unsupported = (said.seen <= said.free) | (unlike(asked, views, photos) > UNLIKE * said.seen)
    found, rest = torch.zeros_like(labels), torch.nonzero(~labels)[:, 0]
    found[rest[suspects[torch.from_numpy(unsupported)].to(rest.device)]] = True
    return found


def unlike(gaussians: Gaussians, views: Sequence[Witness], photos: Mapping[str, np.ndarray]) -> np.ndarray:
    """[N], how many of the views that show a surface at a Gaussian show other colours there than its own.

    Only rough surfaces are asked: on a smooth one its place tells enough, and its colour changes with the direction.
    """
    points, found = gaussians.means.double().cpu().numpy(), np.zeros(len(gaussians), np.int64)
    for view in views:
        own = colors(gaussians, view.camera, gaussians.sh_degree).cpu().numpy() * 255
        photo = photos[view.camera.name]
        around = np.ones((2 * pixels(ROUGH, view.camera.width) + 1,) * 2, np.uint8)
        uv, _ = geometry.project(points, view.camera)
        darkest, lightest = (geometry.sample_nearest(of(photo, around), uv)[0] for of in (cv2.erode, cv2.dilate))
        other = ((own < darkest - TONE) | (own > lightest.astype(float) + TONE)).any(-1)
        nearest, farthest = (geometry.sample_nearest(of, uv)[0] for of in (view.nearest, view.farthest))
        found += other & seen_by(view, points) & (farthest > nearest * UNEVEN)
    return found


def without_slivers(mask: np.ndarray, fraction: float = MARGIN) -> np.ndarray:
    """The mask, bool [H, W], evened out by what most of its neighbours say, and without what is narrower than twice
    `fraction` of the image's width: depth edges."""
    reach = pixels(fraction, mask.shape[1])
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    most = cv2.blur(mask.astype(np.float32), disk.shape, borderType=cv2.BORDER_REPLICATE) > 0.5
    padded = np.pad(most.astype(np.uint8), reach, mode="edge")
    return cv2.morphologyEx(padded, cv2.MORPH_OPEN, disk)[reach:-reach, reach:-reach] > 0
