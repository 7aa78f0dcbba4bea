"""Completing depth behind what was removed, and refining it along the edges of an image.

Everything happens in disparity (1/z): the disparity of a plane is an affine function of the pixel, so that penalising
second differences continues floors and walls exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage, sparse
from scipy.sparse.linalg import cg, splu

CREASE_FLOOR = 1e-4  # weight left to a second difference across the strongest guide edge: keeps the system regular
LEAST_SAMPLES = 12  # four for each coefficient of a plane


def complete(
    disparity: np.ndarray,
    confidence: np.ndarray,
    guide: np.ndarray | None = None,
    *,
    ring: float = 0.05,
    stiffness: float = 100.0,
    edge: float = 0.1,
    most_unknowns: int = 60_000,
    keep: bool = True,
) -> np.ndarray:
    """Fill the pixels of zero confidence by second-order, edge-aware completion in disparity.

    Minimises  sum_p c_p (d_p - D_p)^2 + stiffness * sum w (d_xx^2 + 2 d_xy^2 + d_yy^2)  over the hole and a ring
    of known pixels around it; w falls across edges of the guide, so that a crease may lie there. An affine D makes both
    sums zero: planes are continued to rounding, whatever the guide's texture.

    PAPER leaves open: how the depth of a hole is found without a monocular estimator. Second order in disparity,
    because first-order filling bends every plane.

    Args:
        disparity: [H, W], read where confidence > 0.
        confidence: [H, W] >= 0, or bool; 0 = unknown.
        guide: [H, W, 3] or [H, W] image, uint8 or [0, 1], or None.
        ring: width of the surroundings that take part, as a fraction of the image's width.
        stiffness: weight of bending against the data, px^4; about 3 px are averaged at 100.
        edge: guide step (in [0, 1]) at which the weight of a second difference has fallen to 1/e.
        most_unknowns: above so many pixels a coarser grid is solved, and its correction interpolated.
        keep: known pixels keep their values; else those of the ring take the minimiser's, which is smooth at the rim.

    Returns:
        [H, W] float64: the completion where confidence is 0, elsewhere the input (see `keep`).

    Raises:
        ValueError: fewer than 3 known pixels next to some hole, or these on one line (no plane is fixed);
            known values that are not finite; shapes that differ.
    """
    disparity, confidence = np.asarray(disparity, np.float64), np.asarray(confidence, np.float64)
    _check(disparity, confidence, guide)
    hole = confidence <= 0
    completed = disparity.copy()
    if not hole.any():
        return completed
    gray = None if guide is None else _unit_range(guide)
    reach = max(2, round(ring * disparity.shape[1]))
    regions, count = ndimage.label(_dilate(hole, reach))
    for window, region in zip(ndimage.find_objects(regions), range(1, count + 1), strict=True):
        domain = regions[window] == region
        part = _complete_region(
            disparity[window], confidence[window], None if gray is None else gray[window], domain,
            stiffness, edge, most_unknowns,
        )  # fmt: skip
        inside = domain & hole[window] if keep else domain
        completed[window][inside] = part[inside]
    return completed


def _check(disparity: np.ndarray, confidence: np.ndarray, guide: np.ndarray | None) -> None:
    if disparity.ndim != 2 or disparity.shape != confidence.shape:
        raise ValueError(f"disparity {disparity.shape} and confidence {confidence.shape} must both be [H, W]")
    if guide is not None and guide.shape[:2] != disparity.shape:
        raise ValueError(f"guide is {guide.shape[:2]}, disparity is {disparity.shape}")
    if not np.isfinite(confidence).all() or (confidence < 0).any():
        raise ValueError("confidence must be finite and not negative")
    if not np.isfinite(disparity[confidence > 0]).all():
        raise ValueError("disparity is not finite on known pixels: give those confidence 0")


def _complete_region(disparity, confidence, guide, domain, stiffness, edge, most_unknowns):
    known = domain & (confidence > 0)
    _fixes_a_plane(known)
    if domain.sum() > most_unknowns:
        return _complete_coarsely(disparity, confidence, guide, domain, stiffness, edge, most_unknowns)
    # Solved as a correction to the best plane, in units of the data's spread: few digits are lost to the offset.
    plane = fit_plane(disparity, known * confidence)
    rest = np.where(known, disparity - plane, 0.0)
    unit = np.abs(rest).max()
    if unit <= 1e-13 * np.abs(disparity[known]).max():
        return plane
    bend = _bending(domain, guide, edge)
    data = np.where(known, confidence, 0.0)[domain]
    system = sparse.diags(data) + stiffness * bend.T @ bend
    solution = splu(
        system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    ).solve(data * rest[domain] / unit)
    filled = plane.copy()
    filled[domain] += unit * solution
    return filled


def _complete_coarsely(disparity, confidence, guide, domain, stiffness, edge, most_unknowns):
    factor = int(np.ceil(np.sqrt(domain.sum() / most_unknowns)))
    known = domain & (confidence > 0)
    plane = fit_plane(disparity, known * confidence)  # taken off first: blocks may then be averaged off-centre
    weight = np.where(known, confidence, 0.0)
    blocks = lambda array: _block_sum(array, factor)
    weights = blocks(weight)
    rest = np.divide(blocks(np.where(known, disparity - plane, 0.0) * weight), weights, where=weights > 0,
                     out=np.zeros_like(weights))  # fmt: skip
    if guide is not None:
        pixels = blocks(np.ones(domain.shape))
        guide = np.stack([blocks(channel) / pixels for channel in np.moveaxis(guide, -1, 0)], -1)
    coarse = _complete_region(
        rest, weights, guide, blocks(domain) > 0, stiffness / factor**2, edge, np.inf
    )  # a second difference over blocks is factor^2 larger, and there are factor^2 fewer
    at = [(np.arange(n) + 0.5) / factor - 0.5 for n in domain.shape]
    return plane + ndimage.map_coordinates(coarse, np.meshgrid(*at, indexing="ij"), order=1, mode="nearest")


def _block_sum(array: np.ndarray, factor: int) -> np.ndarray:
    height, width = (-(-n // factor) * factor for n in array.shape)
    padded = np.zeros((height, width))
    padded[: array.shape[0], : array.shape[1]] = array
    return padded.reshape(height // factor, factor, width // factor, factor).sum((1, 3))


def _fixes_a_plane(known: np.ndarray) -> None:
    rows, columns = np.nonzero(known)
    if len(rows) < 3 or np.linalg.matrix_rank(np.stack([rows - rows[0], columns - columns[0]])) < 2:
        raise ValueError(
            f"a hole has {len(rows)} known pixels around it, which fix no plane: "
            "mask less of the image, or widen the ring"
        )


def fit_plane(disparity: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The affine function of the pixel that fits `disparity` [H, W] best in L2 under `weights`, as [H, W] values."""
    return evaluate_plane(plane_coefficients(disparity, weights), disparity.shape)


def plane_coefficients(disparity: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[3] float64 (a, b, c): disparity ~ a x + b y + c with x, y = (column, row) / width."""
    rows, columns = np.nonzero(weights > 0)
    width = disparity.shape[1]
    x, y, w = columns / width, rows / width, np.sqrt(weights[rows, columns])
    x0, y0 = x.mean(), y.mean()  # centred: the slopes do not fight the offset
    design = np.stack([x - x0, y - y0, np.ones_like(x)], 1)
    a, b, c = np.linalg.lstsq(design * w[:, None], disparity[rows, columns] * w, rcond=None)[0]
    return np.array([a, b, c - a * x0 - b * y0])


def evaluate_plane(coefficients: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """[H, W] values of a x + b y + c with x, y = (column, row) / width."""
    rows, columns = np.mgrid[: shape[0], : shape[1]] / shape[1]
    a, b, c = coefficients
    return a * columns + b * rows + c


def _bending(domain: np.ndarray, guide: np.ndarray | None, edge: float) -> sparse.csr_matrix:
    """[equations, pixels of the domain] weighted second differences: xx, yy, and xy counted twice."""
    index = np.full(domain.shape, -1)
    index[domain] = np.arange(domain.sum())
    blocks = []
    for stencil in (((0, 0, 1), (0, 1, -2), (0, 2, 1)), ((0, 0, 1), (1, 0, -2), (2, 0, 1)),
                    ((0, 0, 1), (0, 1, -1), (1, 0, -1), (1, 1, 1))):  # fmt: skip
        blocks.append(_stencil_rows(index, guide, stencil, edge))
    return sparse.vstack(blocks).tocsr()


def _stencil_rows(index: np.ndarray, guide: np.ndarray | None, stencil, edge: float) -> sparse.csr_matrix:
    tall, wide = (1 + max(s[axis] for s in stencil) for axis in (0, 1))
    height, width = index.shape
    view = lambda array, dr, dc: array[dr : height - tall + 1 + dr, dc : width - wide + 1 + dc]
    cells = np.stack([view(index, dr, dc) for dr, dc, _ in stencil], -1)
    valid = (cells >= 0).all(-1)
    cells = cells[valid]
    weight = np.full(len(cells), 2.0 if len(stencil) == 4 else 1.0)
    if guide is not None:
        colors = np.stack([view(guide, dr, dc)[valid] for dr, dc, _ in stencil], -1)
        step = colors.max(-1) - colors.min(-1)  # [M, channels]
        weight *= CREASE_FLOOR + (1 - CREASE_FLOOR) * np.exp(-((step**2).sum(-1) / edge**2))
    values = np.sqrt(weight)[:, None] * np.array([s[2] for s in stencil], np.float64)
    rows = np.repeat(np.arange(len(cells)), len(stencil))
    shape = (len(cells), index.max() + 1)
    return sparse.csr_matrix((values.ravel(), (rows, cells.ravel())), shape=shape)


def _unit_range(guide: np.ndarray) -> np.ndarray:
    """[H, W, channels] float64 in [0, 1]."""
    guide = guide / 255.0 if guide.dtype == np.uint8 else np.asarray(guide, np.float64)
    return guide[..., None] if guide.ndim == 2 else guide


def _dilate(mask: np.ndarray, pixels: float) -> np.ndarray:
    return ndimage.distance_transform_edt(~mask) <= pixels if mask.any() else mask


@dataclass(frozen=True)
class PlanarModel:
    """Disparity as maxima and minima of planes: rooms are concave (the nearer plane shows), boxes convex.

    Attributes:
        disparity: [H, W] float64, everywhere.
        explained: share of the surroundings within the tolerance, in [0, 1].
        planes: how many planes take part.
    """

    disparity: np.ndarray
    explained: float
    planes: int


def planar_model(
    pixels: np.ndarray,
    disparity: np.ndarray,
    shape: tuple[int, int],
    draws: torch.Generator,
    *,
    tolerance: float = 0.01,
    gain: float = 0.03,
    trials: int = 500,
    most_planes: int = 6,
) -> PlanarModel:
    """The planes that surround a hole, continued until they meet.

    Planes are found one after another among the samples (three drawn, the best supported plane fitted to its own, these
    set aside). Starting with the best supported one, each of the others joins as maximum or as minimum with the model
    so far, if that explains more of the samples. So the plane of something that stands before the wall does not cut
    through the hole: as a maximum it would hide the wall beside it.

    PAPER leaves open: the completion. This is the hypothesis for rooms; the smooth one is `complete`.

    Args:
        pixels: [S, 2] image points of the samples around the hole, (x, y) in pixels.
        disparity: [S], positive.
        shape: (H, W) of the model wanted.
        draws: a CPU generator.
        tolerance: relative disparity within which a sample is explained.
        gain: least growth of the explained share for which a plane joins.
        trials: draws of three samples for each plane.
        most_planes: candidates.

    Raises:
        ValueError: fewer than 12 samples, or all on one line.
    """
    scaled = np.column_stack([pixels / shape[1], np.ones(len(pixels))])
    if len(pixels) < LEAST_SAMPLES or np.linalg.matrix_rank(scaled, tol=1e-6) < 3:
        raise ValueError(f"{len(pixels)} samples around the hole fix no plane: {LEAST_SAMPLES} off one line are needed")
    planes = _planes_in(scaled, disparity, draws, tolerance, trials, most_planes)
    candidates = [scaled @ plane for plane in planes]
    fits = lambda values: np.mean(np.abs(values - disparity) < tolerance * disparity)
    start = max(range(len(planes)), key=lambda k: fits(candidates[k]))
    at_samples, whole, used = candidates[start], _plane_values(planes[start], shape), 1
    while True:
        ways = [(join, k) for k in range(len(planes)) for join in (np.maximum, np.minimum)]
        join, k = max(ways, key=lambda way: fits(way[0](at_samples, candidates[way[1]])))
        joined = join(at_samples, candidates[k])
        if fits(joined) < fits(at_samples) + gain:
            return PlanarModel(whole, float(fits(at_samples)), used)
        at_samples, whole, used = joined, join(whole, _plane_values(planes[k], shape)), used + 1


def _plane_values(plane: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """[H, W] at pixel centres."""
    a, b, c = plane
    return evaluate_plane(np.array([a, b, c + 0.5 * (a + b) / shape[1]]), shape)


def _planes_in(points, values, draws, tolerance, trials, most_planes) -> list[np.ndarray]:
    """Coefficients [3] of planes, values ~ points [S, 3] @ plane, each fitted to its own samples; at least one."""
    near = tolerance * values
    free, planes = np.ones(len(values), bool), []
    while free.sum() >= max(LEAST_SAMPLES, 0.03 * len(values)) and len(planes) < most_planes:
        index = np.flatnonzero(free)
        picks = index[torch.randint(len(index), (trials, 3), generator=draws).numpy()]
        regular = np.abs(np.linalg.det(points[picks])) > 1e-4  # a triangle of about 1% of the width a side
        if not regular.any():
            break
        trial = np.linalg.solve(points[picks[regular]], values[picks[regular]][..., None])[..., 0]
        sample = index[:: max(1, len(index) // 4000)]
        support = (np.abs(trial @ points[sample].T - values[sample]) < near[sample]).sum(1)
        plane = trial[support.argmax()]
        inliers = free & (np.abs(points @ plane - values) < near)
        for _ in range(10):
            if inliers.sum() < 3:
                break
            plane = np.linalg.lstsq(points[inliers], values[inliers], rcond=None)[0]
            misfit = np.abs(points @ plane - values)
            # Beside a crease the other plane's samples are near, too: they stand out from the plane's own noise.
            inliers = free & (misfit < np.minimum(near, 4.0 * np.median(misfit[inliers])))
        free &= np.abs(points @ plane - values) >= near
        planes.append(plane)
    return planes or [np.linalg.lstsq(points, values, rcond=None)[0]]


def bilateral_solve(
    target: np.ndarray,
    confidence: np.ndarray,
    guide: np.ndarray,
    *,
    smoothness: float = 128.0,
    sigma_spatial: float = 8.0,
    sigma_luma: float = 8.0,
    sigma_chroma: float = 8.0,
    rounds: int = 20,
) -> np.ndarray:
    """The fast bilateral solver (Barron and Poole 2016): smooth within, not across, the guide's edges.

    Minimises  sum_p c_p (x_p - t_p)^2 + smoothness/2 sum_pq W_pq (x_p - x_q)^2  with W the bistochastic bilateral
    affinity, over the vertices of the guide's bilateral grid. The result is constant in each cell of the grid: give it
    a correction to be spread, not the depth itself (see `refine`). Written here because OpenCV's is left out of wheels
    built without Eigen.

    PAPER leaves open: the solver's parameters. Those of its authors' and OpenCV's defaults.

    Args:
        target: [H, W], read where confidence > 0.
        confidence: [H, W] >= 0.
        guide: [H, W, 3] uint8 or [0, 1].
        smoothness: lambda, weight of smoothness against the data.
        sigma_spatial: cell size in pixels.
        sigma_luma, sigma_chroma: cell sizes in levels of 8-bit YUV.
        rounds: bistochastisation steps.

    Returns:
        [H, W] float64. Cells that no confidence reaches hold the mean of the target under the confidence.

    Raises:
        ValueError: no pixel of positive confidence; non-finite target there; shapes that differ.
    """
    target, confidence = np.asarray(target, np.float64), np.asarray(confidence, np.float64)
    _check(target, confidence, guide)
    if guide.ndim != 3:
        raise ValueError("the bilateral solver's guide must be [H, W, 3]")
    if not (confidence > 0).any():
        raise ValueError("the bilateral solver got no pixel of positive confidence")
    mean = (confidence[confidence > 0] @ target[confidence > 0]) / confidence.sum()
    offset = np.where(confidence > 0, target - mean, 0.0)
    cell, coordinates = _bilateral_grid(guide, sigma_spatial, sigma_luma, sigma_chroma)
    gather = lambda values: np.bincount(cell, values.ravel(), minlength=len(coordinates))
    blur, mass = _grid_blur(coordinates), gather(np.ones(target.shape))
    balance = np.ones(len(mass))
    for _ in range(rounds):
        balance = np.sqrt(balance * mass / (blur @ balance))
    scale = sparse.diags(balance)
    laplacian = sparse.diags(balance * (blur @ balance)) - scale @ blur @ scale
    data = gather(confidence)
    system = smoothness * laplacian + sparse.diags(data + 1e-9 * mass)  # unreached cells: regular, and 0
    solution, stalled = cg(system.tocsr(), gather(confidence * offset), rtol=1e-8, maxiter=5000,
                           M=sparse.diags(1.0 / system.diagonal()))  # fmt: skip
    if stalled:
        raise ValueError(f"the bilateral solver did not converge at smoothness {smoothness}: take a smaller one")
    return mean + solution[cell].reshape(target.shape)


def _bilateral_grid(guide, sigma_spatial, sigma_luma, sigma_chroma) -> tuple[np.ndarray, np.ndarray]:
    """(vertex of each pixel [H*W], integer coordinates of the vertices [V, 5])."""
    levels = 255.0 * _unit_range(guide)
    luma = levels @ (0.299, 0.587, 0.114)
    chroma = (levels[..., [2, 0]] - luma[..., None]) * (0.564, 0.713)
    rows, columns = np.mgrid[: guide.shape[0], : guide.shape[1]]
    position = np.stack([columns, rows, luma, chroma[..., 0], chroma[..., 1]], -1).reshape(-1, 5)
    sizes = np.array([sigma_spatial, sigma_spatial, sigma_luma, sigma_chroma, sigma_chroma])
    coordinates, cell = np.unique(np.round(position / sizes).astype(np.int64), axis=0, return_inverse=True)
    return cell.ravel(), coordinates


def _grid_blur(coordinates: np.ndarray) -> sparse.csr_matrix:
    """Sum over the five axes of the kernel (1, 2, 1) between occupied vertices, [V, V]."""
    low = coordinates.min(0) - 1
    sides = coordinates.max(0) - low + 2
    strides = np.concatenate([np.cumprod(sides[:0:-1])[::-1], [1]])
    keys = (coordinates - low) @ strides
    order = np.argsort(keys)
    blur = sparse.diags(np.full(len(keys), 2.0 * len(strides)))
    for stride in strides:
        at = np.searchsorted(keys, keys + stride, sorter=order)
        neighbour = order[np.minimum(at, len(keys) - 1)]
        found = np.flatnonzero(keys[neighbour] == keys + stride)
        link = sparse.coo_matrix((np.ones(len(found)), (found, neighbour[found])), shape=blur.shape)
        blur = blur + link + link.T
    return blur.tocsr()


def refine(
    estimate: np.ndarray,
    disparity: np.ndarray,
    confidence: np.ndarray,
    guide: np.ndarray,
    *,
    smoothness: float = 128.0,
    sigma_spatial: float = 8.0,
    sigma_luma: float = 8.0,
    sigma_chroma: float = 8.0,
) -> np.ndarray:
    """An aligned estimate plus its misfit on known pixels, spread by the bilateral solver along the guide.

    Args, errors: `bilateral_solve`; estimate and disparity are [H, W], the latter read where confidence > 0.

    Returns:
        [H, W] float64 disparity: an estimate without misfit passes unchanged.
    """
    misfit = np.where(confidence > 0, disparity - np.asarray(estimate, np.float64), 0.0)
    return estimate + bilateral_solve(
        misfit, confidence, guide, smoothness=smoothness, sigma_spatial=sigma_spatial,
        sigma_luma=sigma_luma, sigma_chroma=sigma_chroma,
    )  # fmt: skip
