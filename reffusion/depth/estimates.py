"""Alignment of depth maps, from a network or from a reference, with the scale of the scene."""

from __future__ import annotations

import numpy as np

from reffusion import geometry
from reffusion.depth import alignment, bilateral
from reffusion.depth.background_depth import CompletionSettings, ViewDepth, continue_depth
from reffusion.depth.solverlog import NO_LOG, SolverLog


def align_estimate(
    view: ViewDepth, guide: np.ndarray, estimate: np.ndarray, log: SolverLog = NO_LOG
) -> tuple[np.ndarray, str]:
    """Return a monocular estimate aligned with the scene, and a description of the error of the fit.

    As in the paper, scale and offset are fitted by least squares on the known pixels. Then the fast bilateral solver
    spreads the remaining residuals of these pixels into the hole, up to edges of the picture.

    PAPER leaves open: whether the alignment acts on depth or on disparity. It acts on disparity here, because the
    estimators return disparity, and an offset in one is no offset in the other.

    Args:
        view: The scene's depth and the pixels at which it is known.
        guide: [H, W, 3] the picture, uint8 or in [0, 1].
        estimate: [H, W], disparity up to scale and offset.
        log: Records the result of the solver.

    Returns:
        disparity: [H, W] float64, at all pixels; at known pixels it is about that of the view.
        description: The root mean square error of the alignment at known pixels, before the solver, relative to their
            mean disparity, in words.

    Raises:
        Degenerate: There are fewer than 4 known pixels, the estimate is constant there or falls where the disparity
            grows, or the bilateral solver does not converge.
        ValueError: The estimate is not finite at a known pixel, or shapes differ.
    """
    fitted = alignment.align(estimate, view.disparity, view.known)
    if fitted.scale <= 0:
        raise geometry.Degenerate("reversed", "the estimate falls where the scene's disparity grows: is it depth?")
    aligned, confidence = fitted.apply(estimate), view.known.astype(np.float64)
    refined = bilateral.refine(aligned, view.disparity, confidence, guide, watch=log.log_iteration)
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
    """Return the depth map of a reference as disparity aligned with the scene, and a description of the method.

    Args:
        view: The scene's depth and the pixels at which it is known.
        guide: [H, W, 3] the reference's picture, uint8 or in [0, 1].
        depth: [H, W] depth or disparity of any scale and offset, NaN where unknown. Where the depth is unknown in the
            hole, the surroundings are continued (`background_depth.continue_depth`).
        points: [P, 3] sparse points of the scene, for this continuation.
        settings: Settings of this continuation.
        log: Records the results of its solvers.

    Returns:
        disparity: [H, W] float64, the aligned map where it is known. If it is unknown in the hole, the continuation
            fills all unknown pixels; else unknown pixels, which all lie outside the hole, have the view's disparity.
        description: The method, in words.

    Raises:
        Degenerate, ValueError: As `alignment.align_either` and, if it is used, the continuation.
    """
    aligned, space = alignment.align_either(depth, view.depth, view.known)
    missing = ~np.isfinite(aligned)
    result, description = (
        np.where(missing, view.disparity, 1.0 / np.where(missing, 1.0, aligned)),
        f"by the depth map that came along, as {space}",
    )
    if (missing & view.hole).any():
        rest, rest_description = continue_depth(view, guide, points, settings, log)
        result, description = (
            np.where(missing, rest, result),
            f"{description}; where it says nothing, {rest_description}",
        )
    return result, description
