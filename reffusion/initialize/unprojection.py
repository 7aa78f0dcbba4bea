"""Unprojection of a completed view into 3D: the depth behind the object is estimated, and pixels become Gaussians.

The Gaussians are thin disks on the surface, in two sheets (`reffusion.gaussians.sheets`). The draft is the scene that
is being filled: the remaining Gaussians (the scene without the object) and the new ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch

from reffusion import geometry, trace
from reffusion.background.model import Background
from reffusion.depth import background_depth, estimates
from reffusion.depth.background_depth import NO_HINTS, CompletionSettings, Hints
from reffusion.depth.solverlog import SolverLog
from reffusion.gaussians.sheets import sheet_gaussians
from reffusion.initialize.draft import REFERENCE, Draft
from reffusion.initialize.view_dependent_color import measure_change, transfer_sh
from reffusion.morphology import square
from reffusion.splat import rasterizer
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians, Reference, Rendering

COLOR_STEPS = 5  # number of corrections of the colors
COLOR_WINDOW_PX = 2  # px: radius of the window whose darkest and brightest colors bound a Gaussian's color
COLOR_MARGIN = 0.1  # colors in [0, 1]: how far beyond these bounds a Gaussian's color may lie


@torch.no_grad()
def estimate_depth(
    rendering: Rendering,
    reference: Reference,
    hole: np.ndarray,
    mask: np.ndarray,
    points: np.ndarray,
    completion: CompletionSettings,
    disparity: np.ndarray | None = None,
    log: trace.Trace | None = None,
    hints: Hints = NO_HINTS,
    farthest: bool = False,
) -> tuple[np.ndarray, np.ndarray, str]:
    """Estimate the depth of the scene without the object in one view.

    If the reference has its own depth map, this map is aligned to the scene. Else, if there is a depth model, the
    model's output is aligned as in the paper (`depth.estimates`). Else the depth of the surroundings is continued into
    the hole.

    Args:
        rendering: the view of the scene without the object, whose depth is continued.
        reference: the completed view.
        hole: bool [H, W], the pixels to fill.
        mask: bool [H, W], C of the view (the object's pixels).
        points: [P, 3], sparse points of the scene.
        completion: settings of the depth completion.
        disparity: [H, W], the depth model's output for the reference, up to scale and offset; None without a model.
        log: receives a series of values for each solver (docs/development.md#traces).
        hints: further knowledge of the view's depth.
        farthest: as of `background_depth.continue_depth`; read only without a depth map and without a model.

    Returns:
        A tuple of three results:

        - depth, [H, W] float64 camera z: where the scene's depth is known, the rendered depth or the better one of
          `hints` (see `background_depth.extract_depth`), and the estimate elsewhere;
        - the estimate at all pixels, [H, W] float64 camera z;
        - a description of the method, in words.

    Raises:
        ValueError: too little depth is known around the hole, or the depth map or the model's output does not fit the
            scene. The message names the view.
    """
    view = background_depth.extract_depth(rendering, reference.camera, hole, mask, completion, hints)
    solvers = SolverLog(log, reference.camera.name, *background_depth.points_around(view, points, completion))
    try:
        if reference.depth is not None:
            solved, words = estimates.align_depth_map(
                view, reference.image, reference.depth, points, completion, solvers
            )
        elif disparity is None:
            solved, words = background_depth.continue_depth(
                view, reference.image, points, completion, solvers, farthest
            )
        else:
            solved, words = estimates.align_estimate(view, reference.image, disparity, solvers)
        # A continued disparity may fall to 0 and below, where depth is infinite; so it is limited from below.
        estimate = 1.0 / np.maximum(solved, view.least_disparity)
    except ValueError as error:
        raise ValueError(f"reference {reference.camera.name}: {error}") from error
    return np.where(view.known, view.depth, estimate), estimate, words


@torch.no_grad()
def find_hole(draft: Draft, reference: Reference, mask: np.ndarray, min_alpha: float) -> np.ndarray:
    """Return bool [H, W], the pixels that a reference has to fill.

    These are the pixels of the reference's mask that no earlier reference filled, and all pixels of C whose rendered
    alpha is below `min_alpha`, for example because floaters were removed.

    Args:
        draft: the scene that is being filled.
        reference: the completed view.
        mask: bool [H, W], C of the view (the object's pixels).
        min_alpha: in [0, 1].
    """
    features = draft.is_new[:, None].to(draft.gaussians.means.dtype)
    rendering = rasterizer.render(draft.gaussians, reference.camera, features=features, sh_degree=0)
    thin, filled = rendering.alpha.cpu().numpy() < min_alpha, rendering.features[..., 0].cpu().numpy() > 0.5
    return (reference.mask & ~filled) | (mask & thin)


@torch.no_grad()
def find_gaps(
    gaussians: Gaussians,
    camera: Camera,
    depth: np.ndarray,
    pixels: np.ndarray,
    views: Sequence[tuple[Camera, np.ndarray]],
    min_alpha: float,
) -> np.ndarray:
    """Return bool [H, W], the pixels of a view whose surface is missing in another view, which shows a gap instead.

    Only few views, all from about the same side, see the ground beside the hole and behind the object. The Gaussians
    that were fitted there cover the ground from this side. From the other side a black gap shows between these
    Gaussians and the new surface.

    Args:
        gaussians: of the filled scene.
        camera: the view.
        depth: [H, W], camera z of the view's surface.
        pixels: bool [H, W], the pixels of the view to test.
        views: other cameras, each with its C (the object's pixels), bool [H, W]. Gaps are sought in C only.
        min_alpha: a pixel of another view shows a gap if its rendered alpha is below this.
    """
    rows, columns = np.nonzero(pixels)
    points, is_gap = geometry.unproject(depth, camera)[rows, columns], np.zeros(len(rows), bool)
    for other, mask in views:
        alpha = rasterizer.render(gaussians, other, sh_degree=0).alpha.cpu().numpy()
        uv, z = geometry.project(points, other)
        empty, inside = geometry.sample_nearest(mask & (alpha < min_alpha), uv)
        is_gap |= empty & inside & (z > 0)
    found = np.zeros_like(pixels)
    found[rows[is_gap], columns[is_gap]] = True
    return found


def add_surface(
    draft: Draft,
    reference: Reference,
    depth: np.ndarray,
    pixels: np.ndarray,
    background: Background,
    view_dependent: bool,
    origin: int = REFERENCE,
) -> Draft:
    """Return the draft with pixels of a reference added, as a surface of new Gaussians.

    The colors of these Gaussians are corrected so that the rendered view shows the reference (`match_colors`).

    Args:
        draft: the scene that is being filled.
        reference: the completed view, from which the colors are taken.
        depth: [H, W], camera z of the surface; positive at `pixels`.
        pixels: bool [H, W], the pixels to add.
        background: the photographs, from which view-dependent color is estimated.
        view_dependent: whether the colors change with the viewing direction, as those of the surface around the hole do
            (`reffusion.initialize.view_dependent_color`).
        origin: origin of the new Gaussians, see `draft.Draft`.
    """
    camera = reference.camera
    added = sheet_gaussians(reference.image, depth, pixels, camera, draft.gaussians.sh.shape[1])
    old_count, draft = len(draft.gaussians), draft.add(added.map(lambda p: p.to(draft.gaussians.means)), origin)
    gaussians = draft.gaussians
    is_added = torch.arange(len(gaussians), device=draft.is_new.device) >= old_count
    if view_dependent:
        known = background.photographed_depth(camera)
        hole = pixels | background.masks[camera.name]
        change = measure_change(reference.image, known, hole, camera, background.views, background.photos)
        gaussians = transfer_sh(gaussians, is_added, camera, change, background.views)
    gaussians = match_colors(gaussians, is_added, reference.image, pixels, camera)
    return Draft(gaussians, draft.origin)


@torch.no_grad()
def match_colors(
    gaussians: Gaussians, labels: torch.Tensor, image: np.ndarray, pixels: np.ndarray, camera: Camera
) -> Gaussians:
    """Return all Gaussians, the colors of the labeled ones corrected so that a rendered view shows a given picture.

    Only the constant spherical harmonic changes. Each step adds to the color of a Gaussian the mean residual of the
    pixels that it is blended into, weighted by its blending weights. This undoes the blur of the footprints. A Gaussian
    that others occlude cannot show the picture, whatever its color is. Therefore colors are bounded by those of the
    picture around the Gaussian. Otherwise an occluded Gaussian would stand out as a speck in other views.

    Args:
        gaussians: all N Gaussians of the scene.
        labels: bool [N], True for the Gaussians whose colors are corrected.
        image: uint8 [H, W, 3], the picture that the view should show.
        pixels: bool [H, W], the pixels at which the picture is compared.
        camera: the view.
    """
    target = torch.from_numpy(image).to(gaussians.means) / 255
    chosen = torch.from_numpy(pixels)[..., None].to(gaussians.means)
    low, high = _color_bounds(gaussians, image, camera)
    for _ in range(COLOR_STEPS):
        residual = (target - rasterizer.render(gaussians, camera).color) * chosen
        gathered = rasterizer.accumulate(gaussians, camera, torch.cat([residual, chosen], -1))
        visible = labels & (gathered[:, 3] > 1e-3)
        sh = gaussians.sh.clone()
        sh[visible, 0] += gathered[visible, :3] / gathered[visible, 3:] / SH0
        sh[visible, 0] = sh[visible, 0].clamp(low[visible], high[visible])
        gaussians = replace(gaussians, sh=sh)
    return gaussians


def _color_bounds(gaussians: Gaussians, image: np.ndarray, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the lowest and highest constant harmonic of each Gaussian, [N, 3] each, from the picture around it."""
    uv, _ = geometry.project(gaussians.means.double().cpu().numpy(), camera)
    # The bounds are the colors of the picture within `COLOR_WINDOW_PX` of the Gaussian's center, with a margin of
    # `COLOR_MARGIN`.
    bounds = []
    for extreme, margin in ((cv2.erode, -COLOR_MARGIN), (cv2.dilate, COLOR_MARGIN)):
        color, _ = geometry.sample_nearest(extreme(image, square(COLOR_WINDOW_PX)), uv)
        bounds.append(torch.from_numpy((color / 255 + margin).clip(0, 1) - 0.5).to(gaussians.sh) / SH0)
    return bounds[0], bounds[1]
