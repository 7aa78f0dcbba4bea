"""From a completed view to new Gaussians: depth behind the object, then a disk for each pixel of the reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from reffusion import geometry, trace
from reffusion.background import continuation
from reffusion.background.mirrors import Mirror
from reffusion.background.plane import Plane, without_pits
from reffusion.background.visibility import Witness, votes, widened, with_photographed_depth
from reffusion.depth import background_depth, estimates
from reffusion.depth.background_depth import NO_HINTS, Completion, Hints
from reffusion.depth.solverlog import SolverLog
from reffusion.gaussians.sheets import Sheets, surface
from reffusion.initialize import sweep, view_dependent_color
from reffusion.inpaint.exemplar import Around
from reffusion.splat import rasterizer
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians, Reference

AROUND, BEYOND = 2, 0.1  # px around, and how far beyond the colours there, in [0, 1], a Gaussian's may lie
SWEPT = 0.1  # of the image's width: how far around a hole depth is found by comparing photographs


@torch.no_grad()
def depth_behind(
    remaining: Gaussians,
    reference: Reference,
    hole: np.ndarray,
    hidden: np.ndarray,
    points: np.ndarray,
    how: Completion,
    estimate: np.ndarray | None = None,
    log: trace.Trace | None = None,
    hints: Hints = NO_HINTS,
    farthest: bool = False,
) -> tuple[np.ndarray, np.ndarray, str]:
    """The scene without the object in one view: depth [H, W] float64, as rendered where that is known, else made up;
    the same made up everywhere; and how in words.

    By the reference's own depth map where it brings one; with an estimate, the paper's way (`estimates`); else
    the surroundings are continued.

    Args:
        remaining: the Gaussians left.
        reference: gives the view and the guide.
        hole: bool [H, W], the pixels to be filled.
        hidden: bool [H, W], C of that view: where the object stood.
        points: [P, 3] sparse points of the scene.
        how: parameters.
        estimate: [H, W] a depth model's answer to the reference, disparity up to scale and offset; None: there is none.
        log: gets a series for each solver (docs/traces.md).
        hints: what else is known of its depth. farthest: see `behind.continued`.

    Raises:
        ValueError: naming the view, where too little is known around the hole, or the estimate does not fit.
    """
    drawn = rasterizer.render(remaining, reference.camera, sh_degree=0)
    view = background_depth.seen(drawn, reference.camera, hole, hidden, how, hints)
    solvers = SolverLog(log, reference.camera.name, *background_depth.points_around(view, points, how))
    try:
        if reference.depth is not None:
            solved, said = estimates.brought(view, reference.image, reference.depth, points, how, solvers)
        elif estimate is None:
            solved, said = background_depth.continued(view, reference.image, points, how, solvers, farthest)
        else:
            solved, said = estimates.estimated(view, reference.image, estimate, how, solvers)
        # Beyond infinity there is nothing: the farthest depth that can be told stands in.
        made_up = 1.0 / np.maximum(solved, view.least_disparity)
    except ValueError as error:
        raise ValueError(f"reference {reference.camera.name}: {error}") from error
    return np.where(view.known, view.depth, made_up), made_up, said


@torch.no_grad()
def to_fill(
    gaussians: Gaussians, new: torch.Tensor, reference: Reference, hidden: np.ndarray, covered: float
) -> np.ndarray:
    """bool [H, W]: what the reference has to fill: of its mask, what no earlier reference filled; of C (`hidden`, bool
    [H, W]) also what the Gaussians cover by less than `covered`, e.g. where haze was taken away.
    """
    drawn = rasterizer.render(gaussians, reference.camera, features=new[:, None].to(gaussians.means.dtype), sh_degree=0)
    thin, filled = drawn.alpha.cpu().numpy() < covered, drawn.features[..., 0].cpu().numpy() > 0.5
    return (reference.mask & ~filled) | (hidden & thin)


@torch.no_grad()
def seen_through(
    gaussians: Gaussians,
    reference: Camera,
    depth: np.ndarray,
    pixels: np.ndarray,
    views: Sequence[tuple[Camera, np.ndarray]],
    covered: float,
) -> np.ndarray:
    """bool [H, W]: those of `pixels` whose surface another view sees through, into nothing.

    Beside the hole, behind the object, stand Gaussians that few views ever looked at from about one side: from there
    they cover the ground, from the other side they do not, and leave a black gap between it and the new surface.

    Args:
        reference: the view; depth: [H, W] of its surface; pixels: bool [H, W].
        views: other cameras, and C in them, bool; only there a gap is looked for.
        covered: alpha under which there is nothing.
    """
    rows, columns = np.nonzero(pixels)
    points, gap = geometry.unproject(depth, reference)[rows, columns], np.zeros(len(rows), bool)
    for camera, hidden in views:
        alpha = rasterizer.render(gaussians, camera, sh_degree=0).alpha.cpu().numpy()
        uv, z = geometry.project(points, camera)
        empty, inside = geometry.sample_nearest(hidden & (alpha < covered), uv)
        gap |= empty & inside & (z > 0)
    found = np.zeros_like(pixels)
    found[rows[gap], columns[gap]] = True
    return found


@dataclass(frozen=True)
class Surroundings:
    """What is known around the object.

    Attributes:
        cameras: the training views.
        hidden: view name -> bool [H, W], C. photos: view name -> uint8 [H, W, 3], exposed as the Gaussians are.
        views: the training views as witnesses. planes: those that go on into what nobody saw.
        points: [P, 3] sparse points of the scene.
        centre: [3], the object's middle. radius: of most of it; infinite where there is none.
        mirrors: of things around the object. undecided: view name -> bool [H, W], what of C no photograph shows.
        blank: names of the cameras without a photograph.
    """

    cameras: Sequence[Camera]
    hidden: Mapping[str, np.ndarray]
    photos: Mapping[str, np.ndarray]
    views: Sequence[Witness]
    planes: Sequence[Plane]
    points: np.ndarray
    centre: np.ndarray
    radius: float
    mirrors: Sequence[Mirror]
    undecided: Mapping[str, np.ndarray]
    blank: frozenset[str]

    def looked(self) -> Around:
        """What of this pictures are completed by."""
        return Around(self.views, self.planes, self.photos, self.centre, self.radius, mirrors=self.mirrors)

    def photographed(self, camera: Camera) -> np.ndarray:
        """[H, W] depth that a training view shows beside its mask, of a mirror its plane's; 0 elsewhere."""
        nothing = np.zeros((camera.height, camera.width))
        shown = with_photographed_depth(nothing, camera, self.views)
        return without_pits(shown, camera, self.planes)

    def looked_past(self, camera: Camera, depth: np.ndarray) -> np.ndarray:
        """bool [H, W], where other views look past a surface at this depth of a view, and few show it."""
        return votes(geometry.unproject(depth, camera).reshape(-1, 3), self.views).empty.reshape(depth.shape)

    def compared(self, camera: Camera, hole: np.ndarray) -> tuple[Surroundings, np.ndarray]:
        """The same, but around a hole of a training view depth and planes are where the photographs agree best; and
        bool [H, W], where they tell."""
        depth = self.photographed(camera)
        ring = widened(hole | self.hidden[camera.name], SWEPT) & ~hole & (depth > 0)
        swept = sweep.swept(self.photos[camera.name], depth, ring, camera, self.views, self.photos)
        told = swept > 0
        better = lambda view: replace(view, depth=np.where(told, swept, view.depth).astype(view.depth.dtype))
        views = [better(view) if view.camera.name == camera.name else view for view in self.views]
        planes = [continuation.aligned(plane, swept, camera, hole) for plane in self.planes]
        return replace(self, views=views, planes=planes), told


@torch.no_grad()
def uncovered(gaussians: Gaussians, camera: Camera, hidden: np.ndarray, covered: float = 0.9) -> float:
    """Share in [0, 1] of C (`hidden`, bool [H, W]) whose alpha is below `covered`."""
    alpha = rasterizer.render(gaussians, camera, sh_degree=0).alpha.cpu().numpy()
    return float((alpha[hidden] < covered).mean()) if hidden.any() else 0.0


def placed(
    gaussians: Gaussians,
    new: torch.Tensor,
    reference: Reference,
    depth: np.ndarray,
    pixels: np.ndarray,
    around: Surroundings,
    how: Sheets,
) -> tuple[Gaussians, torch.Tensor]:
    """The Gaussians with a surface that shows these pixels of the reference, bool [H, W], and the labels of the new."""
    added = surface(reference.image, depth, pixels, reference.camera, gaussians.sh.shape[1], how)
    added = added.map(lambda p: p.to(gaussians.means))
    together = gaussians.zipped(added, lambda a, b: torch.cat([a, b]))
    fresh = torch.arange(len(together), device=new.device) >= len(gaussians)
    if how.gloss:
        camera, known = reference.camera, around.photographed(reference.camera)
        hole = pixels | around.hidden[camera.name]
        change = view_dependent_color.change_around(reference.image, known, hole, camera, around.views, around.photos)
        together = view_dependent_color.lent(together, fresh, camera, change, around.views)
    together = match_colors(together, fresh, reference.image, pixels, reference.camera, how.color_steps)
    return together, torch.cat([new, fresh[len(new) :]])


def _range_around(gaussians: Gaussians, image: np.ndarray, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """[N, 3] twice: between which constant colours may lie, that of the picture around each Gaussian and a bit more."""
    window = np.ones((2 * AROUND + 1,) * 2, np.uint8)
    uv, _ = geometry.project(gaussians.means.double().cpu().numpy(), camera)
    bounds = []
    for of, beyond in ((cv2.erode, -BEYOND), (cv2.dilate, BEYOND)):
        told, _ = geometry.sample_nearest(of(image, window), uv)
        bounds.append(torch.from_numpy((told / 255 + beyond).clip(0, 1) - 0.5).to(gaussians.sh) / SH0)
    return bounds[0], bounds[1]


@torch.no_grad()
def match_colors(
    gaussians: Gaussians, labels: torch.Tensor, image: np.ndarray, pixels: np.ndarray, camera: Camera, steps: int
) -> Gaussians:
    """The labelled Gaussians' constant colours, corrected until the view shows `image` on `pixels`.

    Each step gives a Gaussian the mean residual of the pixels it is blended into, by weight: this undoes the blur that
    the footprints lay over the picture. One that is hidden by others cannot show the picture whatever its colour: what
    is around in the picture bounds it, or it would stand out as a speck from elsewhere.

    Args:
        image: [H, W, 3] uint8; pixels: bool [H, W]; labels: bool [N]; steps: corrections.
    """
    target = torch.from_numpy(image).to(gaussians.means) / 255
    chosen = torch.from_numpy(pixels)[..., None].to(gaussians.means)
    low, high = _range_around(gaussians, image, camera)
    for _ in range(steps):
        residual = (target - rasterizer.render(gaussians, camera).color) * chosen
        gathered = rasterizer.accumulate(gaussians, camera, torch.cat([residual, chosen], -1))
        seen = labels & (gathered[:, 3] > 1e-3)
        sh = gaussians.sh.clone()
        sh[seen, 0] += gathered[seen, :3] / gathered[seen, 3:] / SH0
        sh[seen, 0] = sh[seen, 0].clamp(low[seen], high[seen])
        gaussians = replace(gaussians, sh=sh)
    return gaussians
