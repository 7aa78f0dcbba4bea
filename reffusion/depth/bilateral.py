"""The fast bilateral solver (Barron and Poole 2016). It smooths a map, except across the edges of an image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import cg

from reffusion.depth.completion import check_maps, unit_range
from reffusion.geometry import Degenerate

UNREACHED = 1e-9  # added to every pixel's confidence: keeps the system regular, and cells without data at the mean


@dataclass(frozen=True)
class Solver:
    """Parameters of the bilateral solver.

    PAPER leaves open: their values. These are the defaults of its authors and of OpenCV.

    Attributes:
        smoothness: The weight lambda of the smoothness term relative to the data term.
        spatial: Size of the bilateral grid's cells in pixels.
        luma, chroma: Size of the cells in levels of 8-bit YUV.
        rounds: Number of bistochastization steps.
    """

    smoothness: float = 128.0
    spatial: float = 8.0
    luma: float = 8.0
    chroma: float = 8.0
    rounds: int = 20


DEFAULT_SOLVER = Solver()
# Called after each iteration with its number and a function that returns the current result and relative residual.
Watch = Callable[[int, Callable[[], tuple[np.ndarray, float]]], None]


def refine(
    estimate: np.ndarray,
    disparity: np.ndarray,
    confidence: np.ndarray,
    guide: np.ndarray,
    solver: Solver = DEFAULT_SOLVER,
    watch: Watch | None = None,
) -> np.ndarray:
    """Return an aligned estimate of the disparity, corrected so that it agrees better with the known pixels.

    The residuals of the known pixels are spread by `solve` to all pixels, up to edges of the guide, and added to the
    estimate.

    Args:
        estimate: [H, W] disparity.
        disparity: [H, W], the known disparity, read where `confidence` > 0.
        confidence: [H, W] >= 0.
        guide: [H, W, 3] image, uint8 or in [0, 1].
        solver: Parameters of the solver.
        watch: Called after each iteration of the solver (see `Watch`); its function returns the corrected estimate.

    Returns:
        [H, W] float64. An estimate without residuals is returned unchanged.

    Raises:
        Degenerate, ValueError: As `solve`.
    """
    misfit = np.where(confidence > 0, disparity - np.asarray(estimate, np.float64), 0.0)
    callback = watch and (lambda step, get_state: watch(step, lambda: (estimate + (state := get_state())[0], state[1])))
    return estimate + solve(misfit, confidence, guide, solver, callback)


def solve(
    target: np.ndarray,
    confidence: np.ndarray,
    guide: np.ndarray,
    solver: Solver = DEFAULT_SOLVER,
    watch: Watch | None = None,
) -> np.ndarray:
    """Minimize  sum_p c_p (x_p - t_p)^2 + smoothness/2 sum_pq W_pq (x_p - x_q)^2  over maps x.

    Here t is the target, c is the confidence and W is the bistochastic bilateral affinity of the guide. The unknowns
    are the vertices of the guide's bilateral grid. The result is constant in each cell of the grid, so pass a
    correction to be spread, not the depth itself (see `refine`). OpenCV's implementation is not used because wheels
    built without Eigen lack it.

    Args:
        target: [H, W], read where `confidence` > 0.
        confidence: [H, W] >= 0.
        guide: [H, W, 3] image, uint8 or in [0, 1].
        solver: Parameters of the solver.
        watch: Called after each iteration, see `Watch`. A constant target takes no iteration.

    Returns:
        [H, W] float64. Cells that no confidence reaches have the confidence-weighted mean of the target.

    Raises:
        Degenerate: The solver does not converge.
        ValueError: No pixel has positive confidence, the target is not finite at such a pixel, or shapes differ.
    """
    target, confidence = np.asarray(target, np.float64), np.asarray(confidence, np.float64)
    check_maps(target, confidence, guide)
    if guide.ndim != 3:
        raise ValueError("the bilateral solver's guide must be [H, W, 3]")
    if not (confidence > 0).any():
        raise ValueError("the bilateral solver got no pixel of positive confidence")
    mean = (confidence[confidence > 0] @ target[confidence > 0]) / confidence.sum()
    offset = np.where(confidence > 0, target - mean, 0.0)
    scale = np.abs(offset).max()  # scaled to 1, so that very small values lose no precision
    if scale == 0:
        return np.full(target.shape, mean)
    system, cell = build_system(confidence, guide, solver)
    right = np.bincount(cell, (confidence * (offset / scale)).ravel(), minlength=system.shape[0])
    to_pixels, steps = lambda cells: mean + scale * cells[cell].reshape(target.shape), 0

    def callback(current: np.ndarray) -> None:
        nonlocal steps
        steps += 1
        watch(
            steps, lambda: (to_pixels(current), float(np.linalg.norm(right - system @ current) / np.linalg.norm(right)))
        )

    solution, failed = cg(system, right, rtol=1e-8, maxiter=5000, M=sparse.diags(1.0 / system.diagonal()),
                           callback=callback if watch else None)  # fmt: skip
    if failed:
        raise Degenerate(
            "no convergence",
            f"the bilateral solver did not converge at smoothness {solver.smoothness}: take a smaller one",
        )
    return to_pixels(solution)


def build_system(
    confidence: np.ndarray, guide: np.ndarray, solver: Solver = DEFAULT_SOLVER
) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Return the matrix of the solver's linear system, [V, V], and the index of each pixel's vertex, int [H * W].

    The matrix is symmetric and positive definite. V is the number of vertices of the bilateral grid. The pixels are in
    row-major order.

    Args:
        confidence: [H, W] >= 0.
        guide: [H, W, 3] image, uint8 or in [0, 1].
        solver: Parameters of the solver.
    """
    cell, coordinates = _grid(guide, solver)
    gather = lambda values: np.bincount(cell, values.ravel(), minlength=len(coordinates))
    mass = gather(np.ones(confidence.shape))
    data = sparse.diags(gather(confidence) + UNREACHED * mass)
    system = solver.smoothness * _laplacian(_blur(coordinates), mass, solver.rounds) + data
    return system.tocsr(), cell


def _grid(guide: np.ndarray, solver: Solver) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of each pixel's vertex in the bilateral grid, int [H * W], and the vertices, int [V, 5]."""
    levels = 255.0 * unit_range(guide)
    luma = levels @ (0.299, 0.587, 0.114)
    chroma = (levels[..., [2, 0]] - luma[..., None]) * (0.564, 0.713)
    rows, columns = np.mgrid[: guide.shape[0], : guide.shape[1]]
    # A vertex has the coordinates x, y, luma and two chroma components, in units of the cell sizes.
    position = np.stack([columns, rows, luma, chroma[..., 0], chroma[..., 1]], -1).reshape(-1, 5)
    sizes = np.array([solver.spatial, solver.spatial, solver.luma, solver.chroma, solver.chroma])
    coordinates = np.round(position / sizes).astype(np.int64)
    # Sort one key per row instead of rows: the same order, in a sixth of the time.
    _, first, cell = np.unique(_keys(coordinates)[0], return_index=True, return_inverse=True)
    return cell.ravel(), coordinates[first]


def _keys(coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return one integer key per row of coordinates, int [V, 5], and the increment of the key along each axis, [5]."""
    # The keys have the lexicographic order of the rows.
    low = coordinates.min(0) - 1
    sides = coordinates.max(0) - low + 2
    strides = np.concatenate([np.cumprod(sides[:0:-1])[::-1], [1]])
    return (coordinates - low) @ strides, strides


def _blur(coordinates: np.ndarray) -> sparse.csr_matrix:
    """Return the sparse matrix [V, V] that blurs the grid: the kernel (1, 2, 1) along each axis, summed over axes."""
    keys, strides = _keys(coordinates)  # increasing, because `_grid` sorts them
    blur = sparse.diags(np.full(len(keys), 2.0 * len(strides)))
    for stride in strides:
        neighbor = np.minimum(np.searchsorted(keys, keys + stride), len(keys) - 1)
        # Only vertices that contain pixels exist; the kernel skips missing neighbors.
        occupied = np.flatnonzero(keys[neighbor] == keys + stride)
        link = sparse.coo_matrix((np.ones(len(occupied)), (occupied, neighbor[occupied])), shape=blur.shape)
        blur = blur + link + link.T
    return blur.tocsr()


def _laplacian(blur: sparse.csr_matrix, mass: np.ndarray, rounds: int) -> sparse.csr_matrix:
    """Return the graph Laplacian [V, V] of the blur matrix after bistochastization to the row sums `mass`, [V]."""
    balance = np.ones(len(mass))
    # Bistochastization scales the blur matrix symmetrically so that its row sums become `mass`, the number of pixels of
    # each vertex.
    for _ in range(rounds):
        balance = np.sqrt(balance * mass / (blur @ balance))
    scale = sparse.diags(balance)
    return sparse.diags(balance * (blur @ balance)) - scale @ blur @ scale
