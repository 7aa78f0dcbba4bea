"""Cleaning of the rows of splat files: invalid rows are dropped or clamped, and Mip-Splatting's 3D filter is folded in.

A row holds the parameters of one Gaussian (splat). Other tools write infinite opacity logits for opaque splats,
log-scales of minus infinity for flat splats, single rows with NaN, and rows of zeros as padding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# In float32 the sigmoid of 20 is 1, and that of -20 is far below 1/255, the least opacity that is rendered.
MOST_LOGIT = 20.0
# Log-scale that stands for an axis without extent: a size of 2e-9 units. This is far below a pixel, and the product of
# three such sizes is still above 0 in float32.
FLAT = -20.0
MOST_SCALE = 80.0  # log-scale: in float32 the exponential of 88.7 is infinite
BAD_SHARE = 0.5  # largest share of invalid rows; a file with more is refused
DEGREE = 3  # highest degree of spherical harmonics that is rendered


@dataclass(frozen=True)
class Rows:
    """The N splats of a file, or of a block of its rows, parametrized as `reffusion.types.Gaussians`.

    Attributes:
        means: [N, 3] float64.
        quaternions: [N, 4] float32, wxyz, of any length.
        log_scales: [N, 3] float32, logarithms of the standard deviations.
        opacity_logits: [N] float32.
        sh: [N, K, 3] float32, spherical harmonics.
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
        """The normalized quaternions, [N, 4]. Zero quaternions become the identity (1, 0, 0, 0)."""
        lengths = np.linalg.norm(self.quaternions, axis=1, keepdims=True)
        return np.where(lengths > 0, self.quaternions / np.maximum(lengths, 1e-30), [1.0, 0.0, 0.0, 0.0])

    def take(self, chosen: np.ndarray | slice) -> Rows:
        """Return the chosen rows. `chosen` is any index of numpy for the first axis."""
        return Rows(*(array[chosen] for array in vars(self).values()))


def rotate_rows(rows: Rows, rotation: np.ndarray) -> Rows:
    """Return the rows rotated about the origin, with their spherical harmonics.

    Args:
        rotation: [3, 3].
    """
    from reffusion.splat.rotation import rotate_harmonics, rotate_quaternions

    means, quaternions = rows.means @ rotation.T, rotate_quaternions(rows.quaternions, rotation)
    return Rows(means, quaternions, rows.log_scales, rows.opacity_logits, rotate_harmonics(rows.sh, rotation))


@dataclass(frozen=True)
class Repairs:
    """The numbers of rows and values that `drop_invalid` dropped or changed.

    Attributes:
        invalid: rows that were dropped because of NaN, infinite or too large values.
        padding: rows that were dropped because all their values are zero.
        opacities: infinite opacity logits that were clamped.
        scales: log-scales of minus infinity that were clamped.
    """

    invalid: int = 0
    padding: int = 0
    opacities: int = 0
    scales: int = 0

    def __add__(self, other: Repairs) -> Repairs:
        return Repairs(*(a + b for a, b in zip(vars(self).values(), vars(other).values(), strict=True)))

    def sentence(self, count: int) -> str:
        """Describe in words how a file of `count` rows was changed; "" if it was not changed."""
        dropped = [f"{self.invalid} with NaN or infinite values"] if self.invalid else []
        dropped += [f"{self.padding} of zeros only (padding)"] if self.padding else []
        clamped = [f"{self.opacities} infinite opacities"] if self.opacities else []
        clamped += [f"{self.scales} scales of minus infinity"] if self.scales else []
        total = self.invalid + self.padding
        parts = [f"{total} of {count} splats are dropped: {' and '.join(dropped)}"] if dropped else []
        parts += [f"{' and '.join(clamped)} are clamped to finite values that look the same"] if clamped else []
        return "; ".join(parts)


def drop_invalid(rows: Rows) -> tuple[Rows, Repairs]:
    """Drop invalid rows, and clamp extreme opacities and scales to finite values that look the same.

    A row is dropped if it has a NaN, an infinite position, rotation or color, or a log-scale of `MOST_SCALE` or more,
    or if all its values are zero. A row whose only zero parameter is the quaternion is kept, because 3DGS renders a
    zero quaternion as the identity.

    Returns:
        The remaining rows, and the numbers of dropped rows and of infinite values that were clamped. Finite values that
        are clamped are not counted.
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
    """Fold the 3D filter of Mip-Splatting into scales and opacities.

    With f the standard deviation of a Gaussian's filter:

        scale' = sqrt(scale^2 + f^2),  opacity' = opacity * prod(scale) / prod(scale')

    The computation is in logarithms. log(scale' / scale) is half the softplus of 2 (log f - log scale), which neither
    overflows nor cancels. The logit of a probability p is log p - log(1 - p), where 1 - p is computed by expm1.

    Args:
        log_scales: [N, 3].
        logits: [N], opacity logits.
        sizes: [N], standard deviations f of the filters; their sign is ignored, and 0 changes nothing.

    Returns:
        log_scales: [N, 3] float64, widened by the filter.
        logits: [N] float64, of the lower opacities.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        filters = np.log(np.abs(np.asarray(sizes, np.float64)))[:, None]
        scales = np.asarray(log_scales, np.float64)
        widened = np.logaddexp(2 * scales, 2 * filters) / 2
        growth = np.logaddexp(0.0, 2 * (filters - scales)) / 2
        # a filter of size zero changes nothing; without this line a flat axis would give inf - inf
        growth = np.where(np.isneginf(filters), 0.0, growth)
        log_opacity = -np.logaddexp(0.0, -np.asarray(logits, np.float64)) - growth.sum(1)
        return widened, log_opacity - np.log(-np.expm1(log_opacity))
