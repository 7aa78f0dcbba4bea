"""What a depth model says of a view, brought to the scene's own scale."""

from __future__ import annotations

import numpy as np

from reffusion import geometry
from reffusion.depth import alignment, bilateral
from reffusion.depth.background_depth import Completion, Seen, continued
from reffusion.depth.solverlog import SILENT, SolverLog


def estimated(
    view: Seen, guide: np.ndarray, estimate: np.ndarray, how: Completion, solvers: SolverLog = SILENT
) -> tuple[np.ndarray, str]:
    """A picture's estimate brought to the scene, [H, W] float64 disparity; and how well it fitted, in words.

    As in the paper: scale and offset by L2 on the known pixels, then the fast bilateral solver, which spreads what
    still misfits there along the picture into the hole.

    PAPER leaves open: whether the alignment acts on depth or disparity; on disparity, for that is what the estimators
    give, and an offset in one is no offset in the other.

    Args:
        guide: [H, W, 3] uint8 or [0, 1], the picture.
        estimate: [H, W], disparity up to scale and offset.
        solvers: are told of what each solver finds.
    Raises:
        Degenerate: fewer than 4 known pixels; a constant estimate; one that falls where the disparity grows.
    """
    fitted = alignment.align(estimate, view.disparity, view.known, robust=how.robust)
    if fitted.scale <= 0:
        raise geometry.Degenerate("reversed", "the estimate falls where the scene's disparity grows: is it depth?")
    aligned, confidence = fitted.apply(estimate), view.known.astype(np.float64)
    error = np.abs(view.disparity - aligned)[view.known]
    if how.robust and np.median(error) > 0:  # what the alignment lets go of is not to be spread either
        confidence[view.known] = alignment.trusted(error, 1.4826 * np.median(error))
    refined = bilateral.refine(aligned, view.disparity, confidence, guide, how.solver, solvers.iterated)
    solvers.solved("bilateral", refined, solvers.iterations)
    misfit = fitted.residual / np.abs(view.disparity[view.known]).mean()
    return refined, f"estimated, and aligned to {misfit:.1%} of the known disparity"


def brought(
    view: Seen,
    guide: np.ndarray,
    depth: np.ndarray,
    points: np.ndarray,
    how: Completion,
    solvers: SolverLog = SILENT,
) -> tuple[np.ndarray, str]:
    """A depth map that came with the picture, brought to the scene, [H, W] float64 disparity; and how, in words.

    Args:
        depth: [H, W] depth or disparity of any scale and offset, NaN where it says nothing: there the surroundings
            are continued.
    Raises:
        ValueError: see `alignment.align_either`.
    """
    aligned, space = alignment.align_either(depth, view.depth, view.known)
    solved, said = 1.0 / np.where(np.isfinite(aligned), aligned, 1.0), f"by the depth map that came along, as {space}"
    silent = ~np.isfinite(aligned)
    if (silent & view.hole).any():
        rest, how_rest = continued(view, guide, points, how, solvers)
        solved, said = np.where(silent, rest, solved), f"{said}; where it says nothing, {how_rest}"
    return solved, said
