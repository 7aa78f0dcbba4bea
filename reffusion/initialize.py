"""From a completed view to new Gaussians: depth behind the object, then a disk for each pixel of the reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage

from reffusion import bilateral, geometry, planes, splat, trace
from reffusion.depth import Plate, complete
from reffusion.solverlog import SolverLog
from reffusion.types import Camera, Gaussians, Reference

ENOUGH_POINTS = 50  # fewer sparse points around the hole, and the rendered depth is asked instead
BEHIND = 1.03  # relative depth from which a sparse point is hidden by what is rendered


@dataclass(frozen=True)
class Completion:
    """How depth is continued behind the object; the fields are stages/initialize.py's parameters.

    PAPER leaves open: the depth model. Without one the surroundings are continued, by two hypotheses: planes that meet
    (rooms), taken where they explain the surroundings, else the smooth completion.

    Attributes:
        explained: alpha from which the rendered depth is known.
        margin: known pixels nearer to the hole are left out, / image width: their depth is half the object's.
        ring: surroundings that are continued, / image width.
        planar_share: share of the surroundings that planes must explain to be taken; above 1 they never are.
        planar_tolerance: relative disparity within which they do.
        stiffness, edge, unknowns: see `depth.Plate`.
        solver_smoothness, solver_spatial, solver_luma, solver_chroma: see `bilateral.Solver`.
        seed: of the draws that find planes.
    """

    explained: float
    margin: float
    ring: float
    planar_share: float
    planar_tolerance: float
    stiffness: float
    edge: float
    unknowns: int
    solver_smoothness: float
    solver_spatial: float
    solver_luma: float
    solver_chroma: float
    seed: int


@dataclass(frozen=True)
class Sheets:
    """How new Gaussians lie on a surface: a sheet of thin ones, and a second, opaque one behind it.

    Opaque Gaussians next to each other cannot show a sharp picture from all sides: the nearer one hides part of the
    next, so that each is seen on its far side only. What is painted on them seems to slide away from the camera by a
    third of their distance, and so twice that between opposite views. The fainter they are, the less; the second sheet
    keeps the surface closed. docs/initialization.md has figures.

    PAPER leaves open: scale and opacity of the initial Gaussians.

    Attributes:
        spread, thickness, grazing: see `geometry.surface_gaussians`.
        opacity: of the first sheet.
        sunk, under_opacity: how far behind it the second lies, in pixels (0: there is none), and its opacity.
        color_steps: corrections of the colours, see `match_colors`.
    """

    spread: float
    thickness: float
    grazing: float
    opacity: float
    sunk: float
    under_opacity: float
    color_steps: int


@torch.no_grad()
def depth_behind(
    remaining: Gaussians,
    reference: Reference,
    hole: np.ndarray,
    hidden: np.ndarray,
    points: np.ndarray,
    how: Completion,
    log: trace.Trace | None = None,
) -> tuple[np.ndarray, np.ndarray, str]:
    """The scene without the object in one view: depth [H, W] float64, as rendered where that is known, else made up;
    the same made up everywhere; and how in words.

    Planes are found among the sparse points where there are enough (they are unbiased, while the expected depth of
    splats lies too near wherever haze hangs before a plain surface), else among the rendered depths.

    Args:
        remaining: the Gaussians left.
        reference: gives the view and the guide.
        hole: bool [H, W], the pixels to be filled.
        hidden: bool [H, W], C of that view: where the object stood.
        points: [P, 3] sparse points of the scene.
        how: parameters.
        log: gets a series for each solver (docs/traces.md).

    Raises:
        ValueError: naming the view, where too little is known around the hole.
    """
    camera = reference.camera
    drawn = splat.render(remaining, camera, sh_degree=0)
    depth, alpha = drawn.depth.double().cpu().numpy(), drawn.alpha.cpu().numpy()
    known = (alpha > how.explained) & (depth > 0) & ~grown(hole, how.margin)
    disparity = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    around = grown(hidden | hole, how.ring) & ~(hidden | hole)
    try:
        pixels, values = visible_points(points, camera, around, disparity)
        source, sparse = "sparse points", (pixels, values)
        if len(values) < ENOUGH_POINTS:
            rows, columns = np.nonzero(around & known)
            pixels, values, source = np.stack([columns, rows], 1) + 0.5, disparity[rows, columns], "rendered depth"
        draws = trace.generator(how.seed, "planes", camera.name)
        planar = planes.planar_model(pixels, values, hole.shape, draws, tolerance=how.planar_tolerance)
        solvers = SolverLog(log, camera.name, *sparse)
        solvers.solved("planes", planar.disparity)
        said = f"{planar.planes} planes explain {planar.explained:.0%} of {len(values)} {source}"
        if planar.explained >= how.planar_share:
            solved = planar.disparity
        else:
            said = f"{said}: continued smoothly instead"
            solved = _continued(disparity, known, reference.image, how, solvers)
    except ValueError as error:
        raise ValueError(f"reference {camera.name}: {error}") from error
    # Beyond infinity there is nothing: twice the farthest known depth stands in.
    made_up = 1.0 / np.maximum(solved, 0.5 * disparity[known].min())
    return np.where(known, depth, made_up), made_up, said


def visible_points(
    points: np.ndarray, camera: Camera, pixels: np.ndarray, disparity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Image points [S, 2] and disparities [S] of the points that fall on `pixels`, not behind what is rendered."""
    uv, z = geometry.project(points, camera)
    chosen, inside = geometry.sample_nearest(pixels, uv)
    shown, _ = geometry.sample_nearest(disparity, uv)
    seen = chosen & inside & (z > 0) & (z * shown < BEHIND)
    return uv[seen], 1.0 / z[seen]


def _continued(
    disparity: np.ndarray, known: np.ndarray, guide: np.ndarray, how: Completion, solvers: SolverLog
) -> np.ndarray:
    """The smooth completion; its misfit on known pixels is spread by the bilateral solver, so that rims meet."""
    plate = Plate(how.ring, how.stiffness, how.edge, how.unknowns)
    solver = bilateral.Solver(how.solver_smoothness, how.solver_spatial, how.solver_luma, how.solver_chroma)
    fitted = complete(disparity, known, guide, plate, keep=False)
    solvers.solved("completion", fitted)
    refined = bilateral.refine(fitted, disparity, known.astype(np.float64), guide, solver, solvers.iterated)
    solvers.solved("bilateral", refined, solvers.iterations)
    return refined


def grown(mask: np.ndarray, fraction: float) -> np.ndarray:
    """`mask` and all pixels within `fraction` of the image's width of it."""
    if not mask.any():
        return mask
    return ndimage.distance_transform_edt(~mask) <= fraction * mask.shape[1]


@torch.no_grad()
def to_fill(
    gaussians: Gaussians, new: torch.Tensor, reference: Reference, hidden: np.ndarray, covered: float
) -> np.ndarray:
    """bool [H, W]: what the reference has to fill: of its mask, what no earlier reference filled; of C (`hidden`, bool
    [H, W]) also what the Gaussians cover by less than `covered`, e.g. where haze was taken away.
    """
    drawn = splat.render(gaussians, reference.camera, features=new[:, None].to(gaussians.means.dtype), sh_degree=0)
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
        alpha = splat.render(gaussians, camera, sh_degree=0).alpha.cpu().numpy()
        uv, z = geometry.project(points, camera)
        empty, inside = geometry.sample_nearest(hidden & (alpha < covered), uv)
        gap |= empty & inside & (z > 0)
    found = np.zeros_like(pixels)
    found[rows[gap], columns[gap]] = True
    return found


@torch.no_grad()
def share_of(gaussians: Gaussians, labels: torch.Tensor, camera: Camera) -> np.ndarray:
    """[H, W] in [0, 1): blended share of the labelled Gaussians."""
    features = labels[:, None].to(gaussians.means.dtype)
    return splat.render(gaussians, camera, features=features, sh_degree=0).features[..., 0].cpu().numpy()


def surface(
    image: np.ndarray, depth: np.ndarray, pixels: np.ndarray, camera: Camera, sh_count: int, how: Sheets
) -> Gaussians:
    """Both sheets, see `geometry.surface_gaussians`."""
    shown, shape = (image, depth, pixels, camera), {"sh_count": sh_count, "spread": how.spread}
    shape |= {"thickness": how.thickness, "grazing": how.grazing}
    sheet = geometry.surface_gaussians(*shown, **shape, opacity=how.opacity)
    if not how.sunk:
        return sheet
    under = geometry.surface_gaussians(*shown, **shape, opacity=how.under_opacity, sunk=how.sunk)
    return sheet.zipped(under, lambda a, b: torch.cat([a, b]))


def placed(
    gaussians: Gaussians, new: torch.Tensor, reference: Reference, depth: np.ndarray, pixels: np.ndarray, how: Sheets
) -> tuple[Gaussians, torch.Tensor]:
    """The Gaussians with a surface that shows these pixels of the reference, bool [H, W], and the labels of the new."""
    added = surface(reference.image, depth, pixels, reference.camera, gaussians.sh.shape[1], how)
    together = gaussians.zipped(added, lambda a, b: torch.cat([a, b]))
    fresh = torch.arange(len(together)) >= len(gaussians)
    together = match_colors(together, fresh, reference.image, pixels, reference.camera, how.color_steps)
    return together, torch.cat([new, fresh[len(new) :]])


@torch.no_grad()
def match_colors(
    gaussians: Gaussians, labels: torch.Tensor, image: np.ndarray, pixels: np.ndarray, camera: Camera, steps: int
) -> Gaussians:
    """The labelled Gaussians' constant colours, corrected until the view shows `image` on `pixels`.

    Each step gives a Gaussian the mean residual of the pixels it is blended into, by weight: this undoes the blur that
    the footprints lay over the picture.

    Args:
        image: [H, W, 3] uint8; pixels: bool [H, W]; labels: bool [N]; steps: corrections.
    """
    target = torch.from_numpy(image).float() / 255
    chosen = torch.from_numpy(pixels)[..., None].float()
    for _ in range(steps):
        residual = (target - splat.render(gaussians, camera).color) * chosen
        gathered = splat.accumulate(gaussians, camera, torch.cat([residual, chosen], -1))
        seen = labels & (gathered[:, 3] > 1e-3)
        sh = gaussians.sh.clone()
        sh[seen, 0] += gathered[seen, :3] / gathered[seen, 3:] / geometry.SH_0
        sh[seen, 0] = sh[seen, 0].clamp(-0.5 / geometry.SH_0, 0.5 / geometry.SH_0)
        gaussians = replace(gaussians, sh=sh)
    return gaussians
