"""Depth maps of a network or of a reference, aligned to the scale of the scene."""

from __future__ import annotations

import numpy as np

from reffusion import geometry
from reffusion.depth import alignment, bilateral
from reffusion.depth.background_depth import CompletionSettings, ViewDepth, continue_depth
from reffusion.depth.solverlog import NO_LOG, SolverLog


def align_estimate(
    view: ViewDepth, guide: np.ndarray, estimate: np.ndarray, settings: CompletionSettings, log: SolverLog = NO_LOG
) -> tuple[np.ndarray, str]:
    """A monocular estimate aligned to the scene, [H, W] float64 disparity, and a description of how well it fits.

    As in the paper: scale and offset are fitted by least squares on the known pixels; then the fast bilateral solver
    spreads the remaining residuals along the picture into the hole.

    PAPER leaves open: whether the alignment acts on depth or on disparity. It acts on disparity here, because that is
    what the estimators return, and an offset in one is no offset in the other.

    Args:
        guide: [H, W, 3] uint8 or [0, 1], the picture.
        estimate: [H, W], disparity up to scale and offset.
        log: records the result of each solver.

    Raises:
        Degenerate: fewer than 4 known pixels; a constant estimate; an estimate that falls where the disparity grows.
    """
    fitted = alignment.align(estimate, view.disparity, view.known, robust=settings.robust)
    if fitted.scale <= 0:
        raise geometry.Degenerate("reversed", "the estimate falls where the scene's disparity grows: is it depth?")
    aligned, confidence = fitted.apply(estimate), view.known.astype(np.float64)
    error = np.abs(view.disparity - aligned)[view.known]
    if settings.robust and np.median(error) > 0:  # outliers of the alignment must not be spread either
        confidence[view.known] = alignment.geman_mcclure_weights(error, 1.4826 * np.median(error))
    refined = bilateral.refine(aligned, view.disparity, confidence, guide, settings.solver, log.log_iteration)
    log.log_result("bilateral", refined, log.iterations)
    misfit = fitted.residual / np.abs(view.disparity[view.known]).mean()
    return refined, f"estimated, and aligned to {misfit:.1%} of the known disparity"


def align_depth_map(
    view: ViewDepth,
    guide: np.ndarray,
    depth: np.ndarray,
    points: np.ndarray,
    settings: CompletionSettings,
    log: SolverLog = NO_LOG,
) -> tuple[np.ndarray, str]:
    """A reference's own depth map aligned to the scene, [H, W] float64 disparity, and a description of the method.

    Args:
        depth: [H, W] depth or disparity of any scale and offset; NaN where it is missing, and there the surroundings
            are continued.

    Raises:
        ValueError: see `alignment.align_either`.
    """
    aligned, space = alignment.align_either(depth, view.depth, view.known)
    result, description = (
        1.0 / np.where(np.isfinite(aligned), aligned, 1.0),
        f"by the depth map that came along, as {space}",
    )
    missing = ~np.isfinite(aligned)
    if (missing & view.hole).any():
        rest, rest_description = continue_depth(view, guide, points, settings, log)
        result, description = (
            np.where(missing, rest, result),
            f"{description}; where it says nothing, {rest_description}",
        )
    return result, description
