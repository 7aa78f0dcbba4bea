"""Cleans rows of splat files for 3DGS: clamps or drops invalid ones, and folds Mip-Splatting's filter in.

Tools write infinite logits for opaque splats, scales of minus infinity for flat ones, single rows with NaN, and rows of
zeros as padding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# In float32 the sigmoid of 20 is 1, and that of -20 is far below 1/255, the least opacity that is rendered.
MOST_LOGIT = 20.0
# Log-scale of an axis without extent: 2e-9 units, far below a pixel, while products of three such sizes stay above 0.
FLAT = -20.0
MOST_SCALE = 80.0  # log-scale: in float32 the exponential of 88.7 is infinite
BAD_SHARE = 0.5  # largest share of invalid rows: with more it is no file of splats
DEGREE = 3  # highest degree of spherical harmonics that is rendered


@dataclass(frozen=True)
class Rows:
    """Splats of a file, or a block of them.

    Attributes:
        means: [N, 3] float64; quaternions: [N, 4] float32; log_scales: [N, 3] float32; opacity_logits: [N] float32;
        sh: [N, K, 3] float32.
    """

    means: np.ndarray
    quaternions: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    @property
    def unit_quaternions(self) -> np.ndarray:
        """[N, 4]: the quaternions normalised; that of no rotation for those that are zero."""
        lengths = np.linalg.norm(self.quaternions, axis=1, keepdims=True)
        return np.where(lengths > 0, self.quaternions / np.maximum(lengths, 1e-30), [1.0, 0.0, 0.0, 0.0])

    def take(self, chosen: np.ndarray | slice) -> Rows:
        return Rows(*(array[chosen] for array in vars(self).values()))


@dataclass(frozen=True)
class Repairs:
    """How many rows were dropped or changed.

    Attributes:
        invalid: dropped, with NaN or infinite values; padding: dropped, all zeros.
        opacities: clamped infinite logits; scales: clamped scales of minus infinity.
    """

    invalid: int = 0
    padding: int = 0
    opacities: int = 0
    scales: int = 0

    def __add__(self, other: Repairs) -> Repairs:
        return Repairs(*(a + b for a, b in zip(vars(self).values(), vars(other).values(), strict=True)))

    def sentence(self, count: int) -> str:
        """What was done to a file of `count` rows; empty if nothing."""
        dropped = [f"{self.invalid} with NaN or infinite values"] if self.invalid else []
        dropped += [f"{self.padding} of zeros only (padding)"] if self.padding else []
        clamped = [f"{self.opacities} infinite opacities"] if self.opacities else []
        clamped += [f"{self.scales} scales of minus infinity"] if self.scales else []
        total = self.invalid + self.padding
        parts = [f"{total} of {count} splats are dropped: {' and '.join(dropped)}"] if dropped else []
        parts += [f"{' and '.join(clamped)} are clamped to finite values that look the same"] if clamped else []
        return "; ".join(parts)


def drop_invalid(rows: Rows) -> tuple[Rows, Repairs]:
    """The valid rows, clamped, and what was done.

    Dropped are rows with NaN, an infinite position, rotation, colour or size, and rows of zeros. A zero quaternion
    alone stays: 3DGS renders it as the identity.
    """
    logits, scales = rows.opacity_logits, rows.log_scales
    with np.errstate(invalid="ignore", over="ignore"):
        invalid = ~np.isfinite(rows.means.astype(np.float32)).all(1) | ~np.isfinite(rows.quaternions).all(1)
        invalid |= ~np.isfinite(rows.sh).all((1, 2)) | np.isnan(logits) | ~(scales < MOST_SCALE).all(1)
    zero = ~(rows.means.any(1) | rows.quaternions.any(1) | scales.any(1) | (logits != 0) | rows.sh.any((1, 2)))
    kept = ~(invalid | zero)
    counts = Repairs(int(invalid.sum()), int(zero.sum()), int(np.isinf(logits[kept]).sum()),
                     int(np.isneginf(scales[kept]).sum()))  # fmt: skip
    found = rows if kept.all() else rows.take(kept)
    clamped = Rows(
        found.means,
        found.quaternions,
        np.maximum(found.log_scales, np.float32(FLAT)),
        np.clip(found.opacity_logits, np.float32(-MOST_LOGIT), np.float32(MOST_LOGIT)),
        found.sh,
    )
    return clamped, counts


def fold_filter(log_scales: np.ndarray, logits: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fold Mip-Splatting's 3D filter of standard deviations `sizes` [N] into log-scales [N, 3] and opacity logits [N],
    float64:

        scale' = sqrt(scale^2 + f^2),  opacity' = opacity * prod(scale) / prod(scale')

    In logarithms: log(scale'/scale) is half the softplus of 2 (log f - log scale), which neither overflows nor cancels;
    the logit of a probability p is log p - log(1 - p), with 1 - p by expm1.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        filters = np.log(np.abs(np.asarray(sizes, np.float64)))[:, None]
        scales = np.asarray(log_scales, np.float64)
        widened = np.logaddexp(2 * scales, 2 * filters) / 2
        growth = np.logaddexp(0.0, 2 * (filters - scales)) / 2
        # of a filter of no size and an axis of none: inf - inf, and nothing grows
        growth = np.where(np.isneginf(filters), 0.0, growth)
        log_opacity = -np.logaddexp(0.0, -np.asarray(logits, np.float64)) - growth.sum(1)
        return widened, log_opacity - np.log(-np.expm1(log_opacity))
