"""Cases of splat files: Mip-Splatting's 3D filter, values that editors clamp, quantised splats.

Mip-Splatting stores a *3D filter*, a size per Gaussian that widens it. Reading such a file *folds* the filter into
scales and opacities. *Rows* are the Gaussians of a file, before they become tensors.
"""

from __future__ import annotations

import math
import tempfile
from decimal import Decimal, localcontext
from functools import partial
from pathlib import Path

import numpy as np
import torch

from lab.stability.cases import EPS32, EPS64, EXACT, Case, nan_safe_max
from lab.stability.splatting import camera, cloud
from reffusion.io.compressed import load_spz, save_spz
from reffusion.io.ply import save_ply
from reffusion.io.splat_format import open_splat, save_splat
from reffusion.io.splat_rows import FLAT, MOST_LOGIT, Rows, drop_invalid, fold_filter
from reffusion.io.splats import load_splats
from reffusion.splat import rasterizer
from reffusion.types import PARAMETERS, Gaussians

# Log-scales, sizes of filters, and opacity logits: of similar and of very different size.
LOG_SCALES = (-40.0, -20.0, -5.0, 0.0, 7.0, 40.0)
FILTERS = (0.0, 1e-30, 1e-8, 3e-3, 1.0, 1e8)
LOGITS = (-90.0, -20.0, -1.0, 0.0, 4.0, 30.0)


def fold_filter_exactly(log_scale: float, size: float, logit: float) -> tuple[float, float, float]:
    """Fold a filter exactly, with 80 decimal digits, for a Gaussian whose axes are all equal.

    Args:
        log_scale: log-scale of all axes.
        size: size of the filter.
        logit: opacity logit.

    Returns:
        The log-scale, the logarithm of the opacity o, and the logarithm of 1 - o.
    """
    with localcontext() as context:
        context.prec = 80
        square, filter_ = (2 * Decimal(log_scale)).exp(), Decimal(size) ** 2
        opacity = 1 / (1 + (-Decimal(logit)).exp()) * (square / (square + filter_)).sqrt() ** 3
        return float((square + filter_).ln() / 2), float(opacity.ln()), float((1 - opacity).ln())


def fold_filter_error() -> float:
    """Return the largest error of `fold_filter` against `fold_filter_exactly`, over all values of this module.

    Compared are log-scales and, with opacities o, log o and log(1 - o). Each error is divided by 1 + the size of the
    exact value.
    """
    errors = []
    for log_scale in LOG_SCALES:
        for size in FILTERS:
            for logit in LOGITS:
                scales, logits = fold_filter(np.full((1, 3), log_scale), np.array([logit]), np.array([size]))
                scale, opacity, clear = fold_filter_exactly(log_scale, size, logit)
                logs = -np.logaddexp(0, -logits[0]), -np.logaddexp(0, logits[0])
                errors += [abs(scales[0, 0] - scale) / (1 + abs(scale)), abs(logs[0] - opacity) / (1 + abs(opacity))]
                errors.append(abs(logs[1] - clear) / (1 + abs(clear)))
    return nan_safe_max(*errors)


def count_invalid_rows() -> float:
    """Count lost rows and non-finite values after reading extreme rows, with infinite logits and flat axes."""
    grid = np.array(np.meshgrid([*LOG_SCALES, -np.inf], FILTERS, [*LOGITS, np.inf, -np.inf])).reshape(3, -1)
    scales, logits = fold_filter(np.repeat(grid[0][:, None], 3, 1), grid[2], grid[1])
    count = len(logits)
    rows = Rows(np.ones((count, 3)), np.ones((count, 4), np.float32), scales.astype(np.float32),
                logits.astype(np.float32), np.ones((count, 1, 3), np.float32))  # fmt: skip
    valid, _ = drop_invalid(rows)
    lost = count - len(valid)
    return float(lost + (~np.isfinite(valid.log_scales)).sum() + (~np.isfinite(valid.opacity_logits)).sum())


def rows_of(gaussians: Gaussians) -> Rows:
    """Return the rows of Gaussians."""
    means, *others = (getattr(gaussians, name).numpy() for name in PARAMETERS)
    return Rows(means.astype(np.float64), *others)


def clamping_error(gradients: bool) -> float:
    """Return the error of clamping infinite values when a file is read.

    The scene has an opaque, a transparent and two flat splats, written with infinite logits and log-scales. Reading
    clamps these to finite limits. The picture must be the same as with limits twice as large, which are practically
    infinite.

    Args:
        gradients: False compares the pictures and returns the largest difference of a color. True compares the
            gradients of each parameter and returns the largest L2 difference, relative to the gradient's norm.

    Returns:
        Infinity if a value is NaN.
    """
    original = cloud()
    original.opacity_logits[:2] = torch.tensor([math.inf, -math.inf])
    original.log_scales[2, 1] = original.log_scales[3, 0] = -math.inf
    with tempfile.TemporaryDirectory() as folder:
        save_ply(Path(folder) / "g.ply", original)
        read = load_splats(Path(folder) / "g.ply").gaussians()
    limit = read.map(torch.clone)
    limit.opacity_logits[:2] = torch.tensor([2 * MOST_LOGIT, -2 * MOST_LOGIT])
    limit.log_scales[2, 1] = limit.log_scales[3, 0] = 2 * FLAT
    errors = []
    for gaussians in (read, limit):
        leaves = gaussians.map(lambda p: p.requires_grad_())
        picture = rasterizer.render(leaves, camera()).color
        picture.square().sum().backward()
        errors.append((picture.detach(), [getattr(leaves, name).grad for name in PARAMETERS]))
    (picture, slopes), (other, others) = errors
    if not gradients:
        return (picture - other).abs().max().item()
    return nan_safe_max(
        *((a - b).norm().item() / max(b.norm().item(), 1e-5) for a, b in zip(slopes, others, strict=True))
    )


def splat_error(what: str) -> float:
    """Return the largest error of splats after writing and reading a .splat.

    Args:
        what: "opacities", whose error is in steps of 1/255, or "scales", whose error is that of log-scales.
    """
    original = cloud(500, degree=0)
    original.opacity_logits[:2] = torch.tensor([MOST_LOGIT, -MOST_LOGIT])
    original.log_scales[2] = FLAT
    rows = rows_of(original)
    with tempfile.TemporaryDirectory() as folder:
        save_splat(Path(folder) / "s.splat", rows)
        read, _ = drop_invalid(open_splat(Path(folder) / "s.splat")(slice(0, 500)))
    sigmoid = lambda logits: 1 / (1 + np.exp(-logits.astype(np.float64)))
    if what == "opacities":
        return float(np.abs(sigmoid(read.opacity_logits) - sigmoid(rows.opacity_logits)).max() * 255)
    return float(np.abs(read.log_scales - rows.log_scales).max())


def spz_error(extent: float) -> float:
    """Return the largest error of positions, in extents, after writing and reading a .spz; infinity if rows are lost.

    Args:
        extent: factor on the positions.
    """
    original = cloud(500, degree=3)
    rows = rows_of(original)
    rows = Rows(rows.means * extent, *list(vars(rows).values())[1:])
    with tempfile.TemporaryDirectory() as folder:
        save_spz(Path(folder) / "s.spz", rows)
        read, _ = drop_invalid(load_spz(Path(folder) / "s.spz"))
    return math.inf if len(read) < 500 else float(np.abs(read.means - rows.means).max() / extent)


CASES = (
    # A rounding of log(size) is 2^-53 of up to 70, twice that in the exponent, thrice in the product over axes.
    Case("filter_3D, sizes from 0 to 1e8, scales e-40 to e40", "worst error of a logarithm, over 1 + its size",
         2 * 3 * 70 * EPS64, fold_filter_error),
    Case("filter_3D with infinite logits and flat axes", "values that are not finite, and rows lost", EXACT,
         count_invalid_rows),
    # Clamping changes the opacity by e^-20 = 2e-9 and an axis by 2e-9 extents. Both are below a rounding of float32 in
    # the sum over eight splats.
    Case("infinite opacities and flat scales, picture", "largest difference from their limits", 8 * EPS32,
         partial(clamping_error, False)),
    Case("infinite opacities and flat scales, gradients", "worst relative difference of a block from the limits'",
         1e-3, partial(clamping_error, True)),
    Case("quantised in a .splat, opacities", "worst error in steps of 1/255", 0.5 + 1e-3,
         partial(splat_error, "opacities")),
    # A size is a float32: its logarithm, of up to 20, is off by a rounding of the size and one of itself.
    Case("quantised in a .splat, log-scales", "worst error", 21 * EPS32 + EPS32, partial(splat_error, "scales")),
    # 24 bits with sign over the power of two above the extent, and one more: a step is 2^-21 of the largest coordinate,
    # which is that of 500 normal ones of 0.25; bounded by 20 fractional bits.
    *(Case(f"quantised in a .spz, extent {extent:g}", "worst error of a position in extents",
           max(2**-21, 2**-21 / extent) + EPS32, partial(spz_error, extent)) for extent in (1e-2, 1.0, 1e4)),
)  # fmt: skip
