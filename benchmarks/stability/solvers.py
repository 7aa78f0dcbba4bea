"""Cases of completion (`depth`) and of the bilateral solver: almost nothing known, holes at the border, flat guides."""

from __future__ import annotations

import numpy as np

from benchmarks.stability.cases import EPS64, EXACT, UNCLEAR, Case, largest, unclear
from reffusion.depth import bilateral, completion
from reffusion.depth.planes import planar_model
from reffusion.seeding import generator

ROWS, COLUMNS = np.mgrid[:40, :56].astype(float)
PLANE = 0.4 + 0.003 * COLUMNS - 0.002 * ROWS
HOLE = (ROWS > 12) & (ROWS < 28) & (COLUMNS > 18) & (COLUMNS < 36)
CORNER = (ROWS > 25) & (COLUMNS > 35)
FLAT = np.full((40, 56, 3), 128, np.uint8)


def textured() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 255, (40, 56, 3)).astype(np.uint8)


def only(*pixels: tuple[int, int]) -> np.ndarray:
    confidence = np.zeros(PLANE.shape)
    for pixel in pixels:
        confidence[pixel] = 1.0
    return confidence


def plane_error(hole: np.ndarray, guide: np.ndarray | None = None, unit: float = 1.0, offset: float = 0.0) -> float:
    """A plane behind the hole, in this unit and this many units from zero: largest relative error."""
    disparity = unit * (PLANE + offset)
    completed = completion.complete(np.where(hole, 9.0 * unit, disparity), ~hole, guide)
    return float(np.abs(completed / disparity - 1.0).max())


def nothing_known_to_complete() -> float:
    return unclear(lambda: completion.complete(PLANE, np.zeros(PLANE.shape)), "fix no plane")


def nothing_known_to_solve() -> float:
    return unclear(lambda: bilateral.solve(PLANE, np.zeros(PLANE.shape), FLAT), "no pixel of positive confidence")


def one_pixel_to_complete() -> float:
    return unclear(lambda: completion.complete(PLANE, only((3, 3))), "1 known pixels", "fix no plane")


def one_pixel_to_solve() -> float:
    """One known pixel says one value, everywhere; relative error."""
    solved = [bilateral.solve(PLANE, only((3, 3)), guide) for guide in (FLAT, textured())]
    return float(largest(*(np.abs(s / PLANE[3, 3] - 1.0).max() for s in solved)))


def two_pixels_to_solve() -> float:
    """Two known pixels: how far outside their values the solution gets, relative to their difference."""
    known = only((3, 3), (30, 50))
    low, high = sorted((PLANE[3, 3], PLANE[30, 50]))
    solved = np.concatenate([bilateral.solve(PLANE, known, guide).ravel() for guide in (FLAT, textured())])
    return float(largest(low - solved.min(), solved.max() - high) / (high - low))


def faint_confidence() -> float:
    """Confidence of 1e-8 everywhere: a constant stays one; relative error."""
    solved = bilateral.solve(np.full(PLANE.shape, 3.25), np.full(PLANE.shape, 1e-8), textured())
    return float(np.abs(solved / 3.25 - 1.0).max())


def unequal_confidence() -> float:
    """Confidence from 1e-8 to 1e4: the solution outside the range of its data, relative to that range."""
    random = np.random.default_rng(0)
    confidence = 10 ** random.uniform(-8, 4, PLANE.shape)
    solved = bilateral.solve(PLANE, confidence, textured())
    return float(largest(PLANE.min() - solved.min(), solved.max() - PLANE.max()) / np.ptp(PLANE))


def one_row() -> float:
    """A picture one pixel high: the solver keeps a constant; relative error."""
    solved = bilateral.solve(np.full((1, 56), 3.25), np.ones((1, 56)), textured()[:1])
    return float(np.abs(solved / 3.25 - 1.0).max())


def unseen_by_any() -> float:
    """A refinement whose known pixels all agree, hole to the border: relative error of the estimate it keeps."""
    refined = bilateral.refine(PLANE, np.where(CORNER, 9.0, PLANE), (~CORNER).astype(float), FLAT)
    return float(np.abs(refined / PLANE - 1.0).max())


def hole_everywhere_but_a_rim() -> float:
    """Only the outermost pixels of one side are known: a band, which fixes a plane only where it is two wide."""
    return unclear(lambda: completion.complete(PLANE, COLUMNS < 1), "fix no plane")


def rooms_of_constant_disparity() -> float:
    """Planes found among samples of one disparity: relative error."""
    rows, columns = np.nonzero(~HOLE)
    pixels = np.stack([columns, rows], 1) + 0.5
    model = planar_model(pixels, np.full(len(rows), 0.7), PLANE.shape, generator(0, "stability"))
    return float(np.abs(model.disparity / 0.7 - 1.0).max())


def condition_of_completion() -> float:
    """Condition number of the completion's system, hole of 17 px: stiffness times the fourth power of what a plate
    leaves free."""
    return completion.condition((~HOLE).astype(float))


def condition_of_solver() -> float:
    """How many times Jacobi's preconditioning lowers the solver's condition number, as 1 / that."""
    confidence = 10 ** np.random.default_rng(0).uniform(-2, 2, PLANE.shape)
    plain, scaled = bilateral.condition(confidence, textured())
    return scaled / plain


# Planes cost neither data nor bending, so only rounding is left: of the plane's fit, over some 2,000 pixels.
FITTED = 16 * np.sqrt(PLANE.size) * EPS64
CG = 1e-8  # relative residual at which the solver stops

CASES = (
    Case("completion, zero confidence everywhere", UNCLEAR, EXACT, nothing_known_to_complete),
    Case("solver, zero confidence everywhere", UNCLEAR, EXACT, nothing_known_to_solve),
    Case("completion, one known pixel", UNCLEAR, EXACT, one_pixel_to_complete),
    Case("solver, one known pixel", "relative error of the constant", 4 * EPS64, one_pixel_to_solve),
    # The exact solution keeps to its data's range (a maximum principle); conjugate gradients stop at 1e-8 of the right
    # hand side, which the condition number, 1e5 without data, may enlarge.
    Case("solver, two known pixels", "how far outside their range, relative to it", 1e5 * CG, two_pixels_to_solve),
    Case("solver, confidence 1e-8 everywhere", "relative error of a constant", 4 * EPS64, faint_confidence),
    Case("solver, confidence 1e-8 to 1e4", "how far outside the data's range, relative to it", 1e5 * CG,
         unequal_confidence),
    Case("solver, image one pixel high", "relative error of a constant", 4 * EPS64, one_row),
    Case("solver, hole touching the border", "relative error of an estimate without misfit", 4 * EPS64, unseen_by_any),
    Case("completion, hole touching the border", "relative error of a plane", FITTED, lambda: plane_error(CORNER)),
    Case("completion, hole over three borders", "relative error of a plane", FITTED,
         lambda: plane_error(COLUMNS > 8)),
    Case("completion, one line known", UNCLEAR, EXACT, hole_everywhere_but_a_rim),
    Case("completion, constant guide", "relative error of a plane", FITTED, lambda: plane_error(HOLE, FLAT)),
    Case("completion, guide of noise", "relative error of a plane", FITTED, lambda: plane_error(HOLE, textured())),
    Case("completion, disparities of 1e-8", "relative error of a plane", FITTED,
         lambda: plane_error(HOLE, unit=1e-8)),
    Case("completion, disparities of 1e8", "relative error of a plane", FITTED, lambda: plane_error(HOLE, unit=1e8)),
    Case("completion, offset 1e6 of the slope", "relative error of a plane", FITTED,
         lambda: plane_error(HOLE, offset=1e6)),
    Case("rooms of constant disparity", "relative error", FITTED, rooms_of_constant_disparity),
)  # fmt: skip
