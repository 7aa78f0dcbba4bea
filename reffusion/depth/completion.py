"""Smooth completion of depth behind a removed object, with creases where an image has edges.

All computation is in disparity (1/z). The disparity of a plane is an affine function of the pixel, so a penalty on
second differences continues floors and walls exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from reffusion.depth.planes import fit_plane
from reffusion.geometry import Degenerate

CREASE_FLOOR = 1e-4  # weight of a second difference across the strongest edge of the guide: keeps the system regular
STENCILS = (  # (row, column, factor) of the second differences along x, along y, and mixed
    ((0, 0, 1), (0, 1, -2), (0, 2, 1)),
    ((0, 0, 1), (1, 0, -2), (2, 0, 1)),
    ((0, 0, 1), (0, 1, -1), (1, 0, -1), (1, 1, 1)),
)


@dataclass(frozen=True)
class Plate:
    """Settings of the thin plate that is fitted through a hole.

    Attributes:
        ring: Width of the ring of known pixels around the hole that take part, as a fraction of the image's width.
        stiffness: Weight of bending relative to the data, in px^4. At 100 the fit averages over about 3 px.
        edge: Color step in the guide (in [0, 1]) at which the weight of a second difference has fallen to 1/e.
        most_unknowns: Number of pixels above which a coarser grid is solved and its solution interpolated.
    """

    ring: float = 0.05
    stiffness: float = 100.0
    edge: float = 0.1
    most_unknowns: float = 60_000

    def coarser(self, factor: int) -> Plate:
        """Return the settings of the same plate on blocks of `factor` x `factor` pixels.

        The coarser plate is always solved directly (`most_unknowns` is infinite).
        """
        # Between blocks, a squared second difference is factor^4 times as large, and there are factor^2 times fewer.
        return replace(self, stiffness=self.stiffness / factor**2, most_unknowns=np.inf)


DEFAULT_PLATE = Plate()


def complete(
    disparity: np.ndarray,
    confidence: np.ndarray,
    guide: np.ndarray | None = None,
    plate: Plate = DEFAULT_PLATE,
    *,
    keep: bool = True,
) -> np.ndarray:
    """Fill the pixels of zero confidence in a disparity map by a thin plate that may crease at edges of the guide.

    The result minimizes  sum_p c_p (d_p - D_p)^2 + stiffness * sum w (d_xx^2 + 2 d_xy^2 + d_yy^2)  over the hole and a
    ring of known pixels around it. D is the disparity and c is the confidence. The weight w is small across edges of
    the guide, so that a crease may lie there. An affine D makes both sums zero: planes are continued exactly (up to
    rounding), whatever the guide's texture.

    PAPER leaves open: how the depth of a hole is found without a monocular estimator. Second differences of the
    disparity are penalized, because a penalty on first differences bends every plane.

    Args:
        disparity: [H, W], read where `confidence` > 0.
        confidence: [H, W] >= 0, or bool; 0 marks the pixels to fill.
        guide: Image [H, W, 3] or [H, W], uint8 or in [0, 1]. None: the weight w is the same everywhere.
        plate: Settings of the plate.
        keep: If True, known pixels keep their values. If False, known pixels in the ring get the values of the plate,
            so that there is no step at the hole's border.

    Returns:
        [H, W] float64, the plate where the confidence is 0, and elsewhere the input (but see `keep`).

    Raises:
        Degenerate: A hole has fewer than 3 known pixels around it, or all of them lie on one line. Such pixels
            determine no plane.
        ValueError: Known values are not finite, or shapes differ.
    """
    disparity, confidence = np.asarray(disparity, np.float64), np.asarray(confidence, np.float64)
    check_maps(disparity, confidence, guide)
    hole = confidence <= 0
    completed = disparity.copy()
    if not hole.any():
        return completed
    colors = None if guide is None else unit_range(guide)
    ring_px = max(2, round(plate.ring * disparity.shape[1]))
    regions, count = ndimage.label(ndimage.distance_transform_edt(~hole) <= ring_px)
    for window, region in zip(ndimage.find_objects(regions), range(1, count + 1), strict=True):
        domain = regions[window] == region
        window_colors = None if colors is None else colors[window]
        filled = _complete_region(disparity[window], confidence[window], window_colors, domain, plate)
        updated = domain & hole[window] if keep else domain
        completed[window][updated] = filled[updated]
    return completed


def check_maps(disparity: np.ndarray, confidence: np.ndarray, guide: np.ndarray | None) -> None:
    """Raise ValueError if the maps are not fit for a solver.

    Both maps must be [H, W], the guide must have the same height and width, the confidence must be finite and not
    negative, and the disparity must be finite where the confidence is positive.
    """
    if disparity.ndim != 2 or disparity.shape != confidence.shape:
        raise ValueError(f"disparity {disparity.shape} and confidence {confidence.shape} must both be [H, W]")
    if guide is not None and guide.shape[:2] != disparity.shape:
        raise ValueError(f"guide is {guide.shape[:2]}, disparity is {disparity.shape}")
    if not np.isfinite(confidence).all() or (confidence < 0).any():
        raise ValueError("confidence must be finite and not negative")
    if not np.isfinite(disparity[confidence > 0]).all():
        raise ValueError("disparity is not finite on known pixels: give those confidence 0")


def _complete_region(disparity, confidence, guide, domain, plate: Plate) -> np.ndarray:
    """Return disparity [H, W], completed inside `domain`, and elsewhere the plane that fits the known pixels best."""
    # `domain` is True at the pixels of a hole and of the ring around it.
    known = domain & (confidence > 0)
    _check_determines_plane(known)
    # Solve for a correction to the best plane, in units of the data's spread: few digits are lost to the offset.
    plane = fit_plane(disparity, known * confidence)
    residual = np.where(known, disparity - plane, 0.0)
    data = np.where(known, confidence, 0.0)
    if domain.sum() > plate.most_unknowns:
        return plane + _solve_coarsely(residual, data, guide, domain, plate)
    scale = np.abs(residual).max()
    if scale <= 1e-13 * np.abs(disparity[known]).max():
        return plane
    filled = plane.copy()
    filled[domain] += scale * factorize(build_system(data, guide, domain, plate)).solve(
        data[domain] * residual[domain] / scale
    )
    return filled


def build_system(confidence: np.ndarray, guide: np.ndarray | None, domain: np.ndarray, plate: Plate = DEFAULT_PLATE):
    """Return the sparse matrix of the completion over the P pixels of `domain`, [P, P], symmetric positive definite.

    Args:
        confidence: [H, W] >= 0, positive at 3 pixels of the domain that are not on one line.
        guide: [H, W, C] in [0, 1]. None: all second differences have the same weight.
        domain: bool [H, W]. Rows and columns of the matrix have the row-major order of its pixels.
        plate: Settings of the plate.
    """
    bend = _bending(domain, guide, plate.edge)
    return (sparse.diags(confidence[domain]) + plate.stiffness * bend.T @ bend).tocsc()


def factorize(system: sparse.csc_matrix):
    """Return the sparse LU factors of a symmetric matrix, whose method `solve` takes a right-hand side."""
    return splu(system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _solve_coarsely(residual, data, guide, domain, plate: Plate) -> np.ndarray:
    """Return the correction to the plane, [H, W], solved over blocks of pixels and interpolated."""
    factor = int(np.ceil(np.sqrt(domain.sum() / plate.most_unknowns)))
    blocks = lambda array: _block_sum(array, factor)
    weights = blocks(data)
    # A block's mean may come from pixels on one side of the block. This does little harm, because `residual` is the
    # small difference from the plane.
    means = np.divide(blocks(residual * data), weights, where=weights > 0, out=np.zeros_like(weights))
    if guide is not None:
        pixels = blocks(np.ones(domain.shape))
        guide = np.stack([blocks(channel) / pixels for channel in np.moveaxis(guide, -1, 0)], -1)
    coarse = _complete_region(means, weights, guide, blocks(domain) > 0, plate.coarser(factor))
    coordinates = [(np.arange(n) + 0.5) / factor - 0.5 for n in domain.shape]
    return ndimage.map_coordinates(coarse, np.meshgrid(*coordinates, indexing="ij"), order=1, mode="nearest")


def _block_sum(array: np.ndarray, factor: int) -> np.ndarray:
    """Return the sums of an array [H, W] over blocks of `factor` x `factor` pixels; missing pixels count as 0."""
    height, width = (-(-n // factor) * factor for n in array.shape)
    padded = np.zeros((height, width))
    padded[: array.shape[0], : array.shape[1]] = array
    return padded.reshape(height // factor, factor, width // factor, factor).sum((1, 3))


def _check_determines_plane(known: np.ndarray) -> None:
    """Raise Degenerate if the known pixels, bool [H, W], are fewer than 3 or lie on one line."""
    rows, columns = np.nonzero(known)
    if len(rows) < 3 or np.linalg.matrix_rank(np.stack([rows - rows[0], columns - columns[0]])) < 2:
        raise Degenerate(
            "no plane",
            f"a hole has {len(rows)} known pixels around it, which fix no plane: "
            "mask less of the image, or widen the ring",
        )


def _bending(domain: np.ndarray, guide: np.ndarray | None, edge: float) -> sparse.csr_matrix:
    """Return the sparse matrix [equations, P] of weighted second differences over the P pixels of the domain."""
    # The differences are d_xx, d_yy and d_xy, of which d_xy has the weight 2.
    index = np.full(domain.shape, -1)
    index[domain] = np.arange(domain.sum())
    return sparse.vstack([_stencil_rows(index, guide, stencil, edge) for stencil in STENCILS]).tocsr()


def _stencil_rows(index: np.ndarray, guide: np.ndarray | None, stencil, edge: float) -> sparse.csr_matrix:
    """Return the rows of `_bending` for one of `STENCILS`; `index` [H, W] numbers the pixels, -1 outside the domain."""
    stencil_height, stencil_width = (1 + max(s[axis] for s in stencil) for axis in (0, 1))
    height, width = index.shape
    shifted = lambda array, dr, dc: array[dr : height - stencil_height + 1 + dr, dc : width - stencil_width + 1 + dc]
    cells = np.stack([shifted(index, dr, dc) for dr, dc, _ in stencil], -1)
    valid = (cells >= 0).all(-1)
    cells = cells[valid]
    weight = np.full(len(cells), 2.0 if len(stencil) == 4 else 1.0)
    if guide is not None:
        colors = np.stack([shifted(guide, dr, dc)[valid] for dr, dc, _ in stencil], -1)
        step = colors.max(-1) - colors.min(-1)  # [M, channels]
        weight *= CREASE_FLOOR + (1 - CREASE_FLOOR) * np.exp(-((step**2).sum(-1) / edge**2))
    values = np.sqrt(weight)[:, None] * np.array([s[2] for s in stencil], np.float64)
    rows = np.repeat(np.arange(len(cells)), len(stencil))
    shape = (len(cells), index.max() + 1)
    return sparse.csr_matrix((values.ravel(), (rows, cells.ravel())), shape=shape)


def unit_range(guide: np.ndarray) -> np.ndarray:
    """Return a guide [H, W] or [H, W, C], uint8 or in [0, 1], as float64 [H, W, C] in [0, 1]."""
    guide = guide / 255.0 if guide.dtype == np.uint8 else np.asarray(guide, np.float64)
    return guide[..., None] if guide.ndim == 2 else guide
