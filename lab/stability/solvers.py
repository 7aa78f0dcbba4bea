"""Cases of depth completion and of the bilateral solver: little known data, holes at the border, constant guides.

The maps are disparity [40, 56], a plane. The *guide* of a solver is the picture whose edges it respects.
"""

from __future__ import annotations

import numpy as np

from lab.stability.cases import EPS64, EXACT, UNCLEAR, Case, count_unclear_refusal, nan_safe_max
from reffusion.depth import bilateral, completion
from reffusion.depth.planes import planar_model
from reffusion.seeding import generator

ROWS, COLUMNS = np.mgrid[:40, :56].astype(float)
PLANE = 0.4 + 0.003 * COLUMNS - 0.002 * ROWS
HOLE = (ROWS > 12) & (ROWS < 28) & (COLUMNS > 18) & (COLUMNS < 36)
CORNER = (ROWS > 25) & (COLUMNS > 35)
FLAT = np.full((40, 56, 3), 128, np.uint8)


def noise_guide() -> np.ndarray:
    """Return a guide of pure noise, uint8 [H, W, 3]."""
    return np.random.default_rng(0).integers(0, 255, (40, 56, 3)).astype(np.uint8)


def confidence_at(*pixels: tuple[int, int]) -> np.ndarray:
    """Return a confidence map [H, W] that is 1 at the given pixels (row, column) and 0 elsewhere."""
    confidence = np.zeros(PLANE.shape)
    for pixel in pixels:
        confidence[pixel] = 1.0
    return confidence


def plane_error(hole: np.ndarray, guide: np.ndarray | None = None, unit: float = 1.0, offset: float = 0.0) -> float:
    """Complete a plane with a hole and return the largest relative error.

    Args:
        hole: bool [H, W], True for the unknown pixels.
        guide: guide of the completion; None for none.
        unit: factor on the disparity.
        offset: number that is added to the disparity before the multiplication by `unit`.
    """
    disparity = unit * (PLANE + offset)
    completed = completion.complete(np.where(hole, 9.0 * unit, disparity), ~hole, guide)
    return float(np.abs(completed / disparity - 1.0).max())


def refuse_completion_without_data() -> float:
    """Return 0 if a completion without known pixels is refused with the cause, else 1."""
    return count_unclear_refusal(lambda: completion.complete(PLANE, np.zeros(PLANE.shape)), "fix no plane")


def refuse_solving_without_data() -> float:
    """Return 0 if the bilateral solver refuses input without confidence and names the cause, else 1."""
    return count_unclear_refusal(
        lambda: bilateral.solve(PLANE, np.zeros(PLANE.shape), FLAT), "no pixel of positive confidence"
    )


def refuse_completion_of_one_pixel() -> float:
    """Return 0 if a completion from a single known pixel is refused with the cause, else 1."""
    return count_unclear_refusal(
        lambda: completion.complete(PLANE, confidence_at((3, 3))), "1 known pixels", "fix no plane"
    )


def one_pixel_error() -> float:
    """Return the largest relative error of the bilateral solver with one known pixel.

    The value of this pixel must result everywhere. The guide is constant, then noise.
    """
    solved = [bilateral.solve(PLANE, confidence_at((3, 3)), guide) for guide in (FLAT, noise_guide())]
    return float(nan_safe_max(*(np.abs(s / PLANE[3, 3] - 1.0).max() for s in solved)))


def two_pixels_error() -> float:
    """Return how far the bilateral solver's result leaves the range of two known pixels, relative to this range.

    The guide is constant, then noise. The number is at most 0 if the result stays inside the range.
    """
    known = confidence_at((3, 3), (30, 50))
    low, high = sorted((PLANE[3, 3], PLANE[30, 50]))
    solved = np.concatenate([bilateral.solve(PLANE, known, guide).ravel() for guide in (FLAT, noise_guide())])
    return float(nan_safe_max(low - solved.min(), solved.max() - high) / (high - low))


def faint_confidence_error() -> float:
    """Return the largest relative error of a constant map after the bilateral solver with a confidence of 1e-8."""
    solved = bilateral.solve(np.full(PLANE.shape, 3.25), np.full(PLANE.shape, 1e-8), noise_guide())
    return float(np.abs(solved / 3.25 - 1.0).max())


def unequal_confidence_error() -> float:
    """Return how far the solver's result leaves the range of its data, relative to this range.

    The confidence varies from 1e-8 to 1e4.
    """
    random = np.random.default_rng(0)
    confidence = 10 ** random.uniform(-8, 4, PLANE.shape)
    solved = bilateral.solve(PLANE, confidence, noise_guide())
    return float(nan_safe_max(PLANE.min() - solved.min(), solved.max() - PLANE.max()) / np.ptp(PLANE))


def one_row_error() -> float:
    """Return the largest relative error of a constant map, one pixel high, after the bilateral solver."""
    solved = bilateral.solve(np.full((1, 56), 3.25), np.ones((1, 56)), noise_guide()[:1])
    return float(np.abs(solved / 3.25 - 1.0).max())


def border_hole_error() -> float:
    """Return the largest relative error of an exact estimate after a refinement with a hole at the border.

    The estimate has no misfit to the known data, so it must not change.
    """
    refined = bilateral.refine(PLANE, np.where(CORNER, 9.0, PLANE), (~CORNER).astype(float), FLAT)
    return float(np.abs(refined / PLANE - 1.0).max())


def refuse_one_known_line() -> float:
    """Return 0 if a completion from one known column is refused with the cause, else 1.

    A plane needs a known band two pixels wide.
    """
    return count_unclear_refusal(lambda: completion.complete(PLANE, COLUMNS < 1), "fix no plane")


def constant_plane_error() -> float:
    """Return the largest relative error of the planes that are found among samples of a constant disparity."""
    rows, columns = np.nonzero(~HOLE)
    pixels = np.stack([columns, rows], 1) + 0.5
    model = planar_model(pixels, np.full(len(rows), 0.7), PLANE.shape, generator(0, "stability"))
    return float(np.abs(model.disparity / 0.7 - 1.0).max())


# A plane has no data misfit and no bending, so only the rounding of its fit over some 2,000 pixels is left.
ROUNDING = 16 * np.sqrt(PLANE.size) * EPS64
CG_TOL = 1e-8  # relative residual at which the solver stops

CASES = (
    Case("completion, zero confidence everywhere", UNCLEAR, EXACT, refuse_completion_without_data),
    Case("solver, zero confidence everywhere", UNCLEAR, EXACT, refuse_solving_without_data),
    Case("completion, one known pixel", UNCLEAR, EXACT, refuse_completion_of_one_pixel),
    Case("solver, one known pixel", "relative error of the constant", 4 * EPS64, one_pixel_error),
    # The exact solution stays in the range of its data (maximum principle); conjugate gradients stop at 1e-8 of the
    # right-hand side, which the condition number, 1e5 without data, may enlarge.
    Case("solver, two known pixels", "how far outside their range, relative to it", 1e5 * CG_TOL, two_pixels_error),
    Case("solver, confidence 1e-8 everywhere", "relative error of a constant", 4 * EPS64, faint_confidence_error),
    Case("solver, confidence 1e-8 to 1e4", "how far outside the data's range, relative to it", 1e5 * CG_TOL,
         unequal_confidence_error),
    Case("solver, image one pixel high", "relative error of a constant", 4 * EPS64, one_row_error),
    Case("solver, hole touching the border", "relative error of an estimate without misfit", 4 * EPS64,
         border_hole_error),
    Case("completion, hole touching the border", "relative error of a plane", ROUNDING, lambda: plane_error(CORNER)),
    Case("completion, hole over three borders", "relative error of a plane", ROUNDING,
         lambda: plane_error(COLUMNS > 8)),
    Case("completion, one line known", UNCLEAR, EXACT, refuse_one_known_line),
    Case("completion, constant guide", "relative error of a plane", ROUNDING, lambda: plane_error(HOLE, FLAT)),
    Case("completion, guide of noise", "relative error of a plane", ROUNDING, lambda: plane_error(HOLE, noise_guide())),
    Case("completion, disparities of 1e-8", "relative error of a plane", ROUNDING,
         lambda: plane_error(HOLE, unit=1e-8)),
    Case("completion, disparities of 1e8", "relative error of a plane", ROUNDING, lambda: plane_error(HOLE, unit=1e8)),
    Case("completion, offset 1e6 of the slope", "relative error of a plane", ROUNDING,
         lambda: plane_error(HOLE, offset=1e6)),
    Case("rooms of constant disparity", "relative error", ROUNDING, constant_plane_error),
)  # fmt: skip
