"""Unproject a completed view: estimate the depth behind the object, and add a disk for each pixel."""

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
from reffusion.gaussians.sheets import Sheets, sheet_gaussians
from reffusion.initialize.draft import Draft
from reffusion.initialize.view_dependent_color import measure_change, transfer_sh
from reffusion.morphology import square
from reffusion.splat import rasterizer
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians, Reference

COLOR_WINDOW_PX = 2  # radius in which the picture bounds a Gaussian's colour
COLOR_MARGIN = 0.1  # of [0, 1]: how far beyond these bounds it may lie


@torch.no_grad()
def estimate_depth(
    remaining: Gaussians,
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
    """The depth of the scene without the object in one view.

    The reference's own depth map is used where it has one; with a depth model's answer the paper's way
    (`depth.estimates`); otherwise the surroundings are continued into the hole.

    Args:
        remaining: the Gaussians that remain.
        reference: its camera and picture.
        hole: bool [H, W], the pixels to fill.
        mask: bool [H, W], C of the view.
        points: [P, 3] sparse points of the scene.
        completion: settings.
        disparity: [H, W], a depth model's answer to the reference, up to scale and offset; None without a model.
        log: receives a series for each solver (docs/development.md#traces).
        hints: what else is known of the depth. farthest: see `background_depth.continue_depth`.

    Returns:
        Depth [H, W] float64, as rendered where that is known, else estimated; the estimate at all pixels; and the way
        it was found, in words.

    Raises:
        ValueError: naming the view, where too little is known around the hole, or the estimate does not fit.
    """
    rendering = rasterizer.render(remaining, reference.camera, sh_degree=0)
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
            solved, words = estimates.align_estimate(view, reference.image, disparity, completion, solvers)
        # Nothing is beyond infinity: the farthest depth that can be told stands in for it.
        estimate = 1.0 / np.maximum(solved, view.least_disparity)
    except ValueError as error:
        raise ValueError(f"reference {reference.camera.name}: {error}") from error
    return np.where(view.known, view.depth, estimate), estimate, words


@torch.no_grad()
def find_hole(draft: Draft, reference: Reference, mask: np.ndarray, min_alpha: float) -> np.ndarray:
    """bool [H, W]: the pixels that a reference has to fill.

    These are the pixels of its mask that no earlier reference filled, and pixels of C, `mask`, that the Gaussians
    cover by less than `min_alpha`, e.g. where floaters were dropped.
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
    """bool [H, W]: those of `pixels`, bool [H, W], whose surface another view sees through into nothing.

    Beside the hole, behind the object, lie Gaussians that few views looked at from about one side. From there they
    cover the ground; from the other side they leave a black gap between the ground and the new surface.

    Args:
        camera: the view. depth: [H, W] of its surface.
        views: other cameras, and C in them, bool; gaps are looked for in C only.
        min_alpha: alpha below which there is nothing.
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
    draft: Draft, reference: Reference, depth: np.ndarray, pixels: np.ndarray, background: Background, sheets: Sheets
) -> Draft:
    """The draft with a surface at `depth`, [H, W], that shows these pixels of the reference, bool [H, W]."""
    camera = reference.camera
    added = sheet_gaussians(reference.image, depth, pixels, camera, draft.gaussians.sh.shape[1], sheets)
    old_count, draft = len(draft.gaussians), draft.add(added.map(lambda p: p.to(draft.gaussians.means)))
    gaussians = draft.gaussians
    is_added = torch.arange(len(gaussians), device=draft.is_new.device) >= old_count
    if sheets.view_dependent:
        known = background.photographed_depth(camera)
        hole = pixels | background.masks[camera.name]
        change = measure_change(reference.image, known, hole, camera, background.views, background.photos)
        gaussians = transfer_sh(gaussians, is_added, camera, change, background.views)
    gaussians = match_colors(gaussians, is_added, reference.image, pixels, camera, sheets.color_steps)
    return Draft(gaussians, draft.is_new)


@torch.no_grad()
def match_colors(
    gaussians: Gaussians, labels: torch.Tensor, image: np.ndarray, pixels: np.ndarray, camera: Camera, steps: int
) -> Gaussians:
    """The labelled Gaussians' constant colours, corrected until the view shows `image` on `pixels`.

    Each step adds to a Gaussian the mean residual of the pixels it is blended into, by weight, which undoes the blur of
    the footprints. An occluded Gaussian cannot show the picture whatever its colour; its colour is bounded by the
    picture around it, or it would stand out as a speck in other views.

    Args:
        image: [H, W, 3] uint8; pixels: bool [H, W]; labels: bool [N]; steps: corrections.
    """
    target = torch.from_numpy(image).to(gaussians.means) / 255
    chosen = torch.from_numpy(pixels)[..., None].to(gaussians.means)
    low, high = _color_bounds(gaussians, image, camera)
    for _ in range(steps):
        residual = (target - rasterizer.render(gaussians, camera).color) * chosen
        gathered = rasterizer.accumulate(gaussians, camera, torch.cat([residual, chosen], -1))
        visible = labels & (gathered[:, 3] > 1e-3)
        sh = gaussians.sh.clone()
        sh[visible, 0] += gathered[visible, :3] / gathered[visible, 3:] / SH0
        sh[visible, 0] = sh[visible, 0].clamp(low[visible], high[visible])
        gaussians = replace(gaussians, sh=sh)
    return gaussians


def _color_bounds(gaussians: Gaussians, image: np.ndarray, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """[N, 3] twice: bounds of the constant coefficients, from the picture's colours around each Gaussian."""
    uv, _ = geometry.project(gaussians.means.double().cpu().numpy(), camera)
    bounds = []
    for extreme, margin in ((cv2.erode, -COLOR_MARGIN), (cv2.dilate, COLOR_MARGIN)):
        color, _ = geometry.sample_nearest(extreme(image, square(COLOR_WINDOW_PX)), uv)
        bounds.append(torch.from_numpy((color / 255 + margin).clip(0, 1) - 0.5).to(gaussians.sh) / SH0)
    return bounds[0], bounds[1]
