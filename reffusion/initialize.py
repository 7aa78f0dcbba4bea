"""From a completed view to new Gaussians: depth behind the object, then a disk for each pixel of the reference."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage

from reffusion import bilateral, geometry, planes, splat, trace
from reffusion.depth import Plate, complete
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


@torch.no_grad()
def depth_behind(
    remaining: Gaussians,
    reference: Reference,
    hole: np.ndarray,
    hidden: np.ndarray,
    points: np.ndarray,
    how: Completion,
) -> tuple[np.ndarray, str]:
    """Depth [H, W] float64 of the scene without the object, made up in the hole, and how in words.

    Planes are found among the sparse points where there are enough (they are unbiased, while the expected depth of
    splats lies too near wherever haze hangs before a plain surface), else among the rendered depths.

    Args:
        remaining: the Gaussians left.
        reference: gives the view and the guide.
        hole: bool [H, W], the pixels to be filled.
        hidden: bool [H, W], C of that view: where the object stood.
        points: [P, 3] sparse points of the scene.
        how: parameters.

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
        source = "sparse points"
        if len(values) < ENOUGH_POINTS:
            rows, columns = np.nonzero(around & known)
            pixels, values, source = np.stack([columns, rows], 1) + 0.5, disparity[rows, columns], "rendered depth"
        draws = trace.generator(how.seed, "planes", camera.name)
        planar = planes.planar_model(pixels, values, hole.shape, draws, tolerance=how.planar_tolerance)
        said = f"{planar.planes} planes explain {planar.explained:.0%} of {len(values)} {source}"
        if planar.explained >= how.planar_share:
            solved = planar.disparity
        else:
            solved, said = _continued(disparity, known, reference.image, how), f"{said}: continued smoothly instead"
    except ValueError as error:
        raise ValueError(f"reference {camera.name}: {error}") from error
    # Beyond infinity there is nothing: twice the farthest known depth stands in.
    made_up = 1.0 / np.maximum(solved, 0.5 * disparity[known].min())
    return np.where(known, depth, made_up), said


def visible_points(
    points: np.ndarray, camera: Camera, pixels: np.ndarray, disparity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Image points [S, 2] and disparities [S] of the points that fall on `pixels`, not behind what is rendered."""
    uv, z = geometry.project(points, camera)
    chosen, inside = geometry.sample_nearest(pixels, uv)
    shown, _ = geometry.sample_nearest(disparity, uv)
    seen = chosen & inside & (z > 0) & (z * shown < BEHIND)
    return uv[seen], 1.0 / z[seen]


def _continued(disparity: np.ndarray, known: np.ndarray, guide: np.ndarray, how: Completion) -> np.ndarray:
    """The smooth completion; its misfit on known pixels is spread by the bilateral solver, so that rims meet."""
    plate = Plate(how.ring, how.stiffness, how.edge, how.unknowns)
    solver = bilateral.Solver(how.solver_smoothness, how.solver_spatial, how.solver_luma, how.solver_chroma)
    fitted = complete(disparity, known, guide, plate, keep=False)
    return bilateral.refine(fitted, disparity, known.astype(np.float64), guide, solver)


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
def share_of(gaussians: Gaussians, labels: torch.Tensor, camera: Camera) -> np.ndarray:
    """[H, W] in [0, 1): blended share of the labelled Gaussians."""
    features = labels[:, None].to(gaussians.means.dtype)
    return splat.render(gaussians, camera, features=features, sh_degree=0).features[..., 0].cpu().numpy()


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
