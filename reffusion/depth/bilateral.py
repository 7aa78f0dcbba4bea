"""The fast bilateral solver (Barron and Poole 2016): a map made smooth within, not across, an image's edges."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import cg

from reffusion.depth.completion import check_maps, extremes_ratio, unit_range
from reffusion.geometry import Degenerate

UNREACHED = 1e-9  # confidence of every pixel beside its own: cells without data are regular, and 0


@dataclass(frozen=True)
class Solver:
    """The solver's parameters.

    PAPER leaves open: their values. Those of its authors' and OpenCV's defaults.

    Attributes:
        smoothness: lambda, weight of smoothness against the data.
        spatial: cell size in pixels.
        luma, chroma: cell sizes in levels of 8-bit YUV.
        rounds: bistochastisation steps.
    """

    smoothness: float = 128.0
    spatial: float = 8.0
    luma: float = 8.0
    chroma: float = 8.0
    rounds: int = 20


USUAL = Solver()
# What is told after each iteration: its number, and a function that gives the result so far and the relative residual.
Watch = Callable[[int, Callable[[], tuple[np.ndarray, float]]], None]


def refine(
    estimate: np.ndarray,
    disparity: np.ndarray,
    confidence: np.ndarray,
    guide: np.ndarray,
    solver: Solver = USUAL,
    watch: Watch | None = None,
) -> np.ndarray:
    """An aligned estimate plus its misfit on known pixels, spread by the solver along the guide.

    Args, errors: `solve`; estimate and disparity are [H, W], the latter read where confidence > 0.

    Returns:
        [H, W] float64 disparity: an estimate without misfit passes unchanged.
    """
    misfit = np.where(confidence > 0, disparity - np.asarray(estimate, np.float64), 0.0)
    told = watch and (lambda step, look: watch(step, lambda: (estimate + (now := look())[0], now[1])))
    return estimate + solve(misfit, confidence, guide, solver, told)


def solve(
    target: np.ndarray,
    confidence: np.ndarray,
    guide: np.ndarray,
    solver: Solver = USUAL,
    watch: Watch | None = None,
) -> np.ndarray:
    """Minimises  sum_p c_p (x_p - t_p)^2 + smoothness/2 sum_pq W_pq (x_p - x_q)^2.

    W is the bistochastic bilateral affinity, the unknowns are the vertices of the guide's bilateral grid. The result
    is constant in each cell of the grid: give it a correction to be spread, not the depth itself (see `refine`).
    Written here because OpenCV's is left out of wheels built without Eigen.

    Args:
        target: [H, W], read where confidence > 0.
        confidence: [H, W] >= 0.
        guide: [H, W, 3] uint8 or [0, 1].
        solver: parameters.
        watch: told after each iteration, and once more with the last.

    Returns:
        [H, W] float64. Cells that no confidence reaches hold the mean of the target under the confidence.

    Raises:
        Degenerate: no convergence.
        ValueError: no pixel of positive confidence; non-finite target there; shapes that differ.
    """
    target, confidence = np.asarray(target, np.float64), np.asarray(confidence, np.float64)
    check_maps(target, confidence, guide)
    if guide.ndim != 3:
        raise ValueError("the bilateral solver's guide must be [H, W, 3]")
    if not (confidence > 0).any():
        raise ValueError("the bilateral solver got no pixel of positive confidence")
    mean = (confidence[confidence > 0] @ target[confidence > 0]) / confidence.sum()
    offset = np.where(confidence > 0, target - mean, 0.0)
    unit = np.abs(offset).max()  # so that the smallest numbers are as good as any
    if unit == 0:
        return np.full(target.shape, mean)
    system, cell = system_of(confidence, guide, solver)
    right = np.bincount(cell, (confidence * (offset / unit)).ravel(), minlength=system.shape[0])
    whole, steps = lambda cells: mean + unit * cells[cell].reshape(target.shape), 0

    def told(now: np.ndarray) -> None:
        nonlocal steps
        steps += 1
        watch(steps, lambda: (whole(now), float(np.linalg.norm(right - system @ now) / np.linalg.norm(right))))

    solution, stalled = cg(system, right, rtol=1e-8, maxiter=5000, M=sparse.diags(1.0 / system.diagonal()),
                           callback=told if watch else None)  # fmt: skip
    if stalled:
        raise Degenerate(
            "no convergence",
            f"the bilateral solver did not converge at smoothness {solver.smoothness}: take a smaller one",
        )
    return whole(solution)


def system_of(
    confidence: np.ndarray, guide: np.ndarray, solver: Solver = USUAL
) -> tuple[sparse.csr_matrix, np.ndarray]:
    """The solver's matrix [V, V], symmetric and positive definite, and the vertex of each pixel [H * W]."""
    cell, coordinates = _grid(guide, solver)
    gather = lambda values: np.bincount(cell, values.ravel(), minlength=len(coordinates))
    mass = gather(np.ones(confidence.shape))
    data = sparse.diags(gather(confidence) + UNREACHED * mass)
    system = solver.smoothness * _laplacian(_blur(coordinates), mass, solver.rounds) + data
    return system.tocsr(), cell


def condition(confidence: np.ndarray, guide: np.ndarray, solver: Solver = USUAL) -> tuple[float, float]:
    """Condition numbers (largest over smallest eigenvalue) of the system: as it is, and preconditioned by Jacobi, as
    `solve` does. The square root of it is about the number of steps of conjugate gradients.

    Args: as `solve`.
    """
    system, _ = system_of(np.asarray(confidence, np.float64), guide, solver)
    root = sparse.diags(1.0 / np.sqrt(system.diagonal()))
    return extremes_ratio(system), extremes_ratio((root @ system @ root).tocsr())


def _grid(guide: np.ndarray, solver: Solver) -> tuple[np.ndarray, np.ndarray]:
    """(vertex of each pixel [H*W], integer coordinates of the vertices [V, 5])."""
    levels = 255.0 * unit_range(guide)
    luma = levels @ (0.299, 0.587, 0.114)
    chroma = (levels[..., [2, 0]] - luma[..., None]) * (0.564, 0.713)
    rows, columns = np.mgrid[: guide.shape[0], : guide.shape[1]]
    position = np.stack([columns, rows, luma, chroma[..., 0], chroma[..., 1]], -1).reshape(-1, 5)
    sizes = np.array([solver.spatial, solver.spatial, solver.luma, solver.chroma, solver.chroma])
    places = np.round(position / sizes).astype(np.int64)
    # Sorted as one number each, not as rows: the same order, in a sixth of the time.
    _, first, cell = np.unique(_keys(places)[0], return_index=True, return_inverse=True)
    return cell.ravel(), places[first]


def _keys(coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(a number for each row [V, 5] of integers, in the rows' order; what a step along each axis adds to it [5])."""
    low = coordinates.min(0) - 1
    sides = coordinates.max(0) - low + 2
    strides = np.concatenate([np.cumprod(sides[:0:-1])[::-1], [1]])
    return (coordinates - low) @ strides, strides


def _blur(coordinates: np.ndarray) -> sparse.csr_matrix:
    """Sum over the five axes of the kernel (1, 2, 1) between occupied vertices, [V, V]."""
    keys, strides = _keys(coordinates)  # rising: `_grid` sorts them
    blur = sparse.diags(np.full(len(keys), 2.0 * len(strides)))
    for stride in strides:
        neighbour = np.minimum(np.searchsorted(keys, keys + stride), len(keys) - 1)
        found = np.flatnonzero(keys[neighbour] == keys + stride)
        link = sparse.coo_matrix((np.ones(len(found)), (found, neighbour[found])), shape=blur.shape)
        blur = blur + link + link.T
    return blur.tocsr()


def _laplacian(blur: sparse.csr_matrix, mass: np.ndarray, rounds: int) -> sparse.csr_matrix:
    """Of the blur scaled from both sides until its rows sum to the cells' numbers of pixels, `mass` [V]."""
    balance = np.ones(len(mass))
    for _ in range(rounds):
        balance = np.sqrt(balance * mass / (blur @ balance))
    scale = sparse.diags(balance)
    return sparse.diags(balance * (blur @ balance)) - scale @ blur @ scale
