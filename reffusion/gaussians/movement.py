"""Search for the movement of a scene: how an editor scaled, rotated and shifted its Gaussians.

Neither the order nor the positions of the Gaussians tell which one is which, but their colors, opacities and shapes do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

SAMPLE_SIZE = 20_000  # Gaussians of the moved scene for which a partner of the same looks is searched
PAIRS = 2000  # most distinct pairs, with which movements are tried
TRIPLES = 100_000  # triples of pairs that are drawn
TRIALS = 300  # most triples of consistent distances that are tried
DISTANCE_ERROR = 0.02  # relative difference up to which distances in a triple are consistent
# Largest distance of a pair from a movement that explains it, as a share of the scene's extent: at first and at last.
FIRST_ERROR, LAST_ERROR = 0.02, 0.002
# A movement is right if so large a share of the pairs that it explains roughly are explained precisely. Else the scene
# was stretched.
ROUGH_ERROR, RIGHT_SHARE = 0.1, 0.5
STILL_ERROR = 1e-4  # movements by a smaller share of the extent are errors of quantized positions
SCALE_BIN = 0.05  # width of the bins in which pairs vote for the logarithm of the scale
LEAST_PAIRS = 20  # pairs that a movement must explain
SHAPE_WEIGHT = 0.1  # of differences of log-scales beside those of colors and opacities, which are in [0, 1]
MOST_SHAPE = 5.0  # larger differences of log-scales count as this one: editors clamp flat axes
SAME_LOOKS = 0.1  # largest difference of colors, opacities and weighted shapes of one Gaussian in two files
MIRROR_LEAD = 1.5  # a scene counts as mirrored if that explains so many times as many pairs


@dataclass(frozen=True)
class Cloud:
    """What is known of N Gaussians to recognize them.

    Attributes:
        means: [N, 3] float64.
        log_scales: [N, 3], logarithms of the standard deviations.
        colors: [N, 3], without spherical harmonics of degree 1 and above; those of 3DGS are mostly in [0, 1].
        opacities: [N], in [0, 1].
    """

    means: np.ndarray
    log_scales: np.ndarray
    colors: np.ndarray
    opacities: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    def take(self, chosen: np.ndarray | slice) -> Cloud:
        """Return the Gaussians chosen by a boolean mask [N], by indices or by a slice."""
        return Cloud(*(array[chosen] for array in vars(self).values()))

    def looks(self) -> np.ndarray:
        """Return [N, 6], what no similarity changes: color, opacity, and two differences of sorted log-scales."""
        shapes = np.diff(np.sort(self.log_scales, axis=1), axis=1).clip(0, MOST_SHAPE)
        return np.column_stack([self.colors.clip(0, 1), self.opacities, SHAPE_WEIGHT * shapes])


@dataclass(frozen=True)
class Movement:
    """A similarity y = scale * rotation @ x + shift.

    Attributes:
        scale: positive.
        rotation: [3, 3] float64, orthogonal; its determinant is -1 if the movement mirrors.
        shift: [3] float64.
    """

    scale: float
    rotation: np.ndarray
    shift: np.ndarray

    @property
    def mirrors(self) -> bool:
        """Whether the movement turns left into right."""
        return bool(np.linalg.det(self.rotation) < 0)

    @property
    def is_still(self) -> bool:
        """Whether the movement changes nothing."""
        return self.scale == 1 and np.array_equal(self.rotation, np.eye(3)) and not self.shift.any()

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Return the points [..., 3] after the movement."""
        return self.scale * points @ self.rotation.T + self.shift

    def invert(self, points: np.ndarray) -> np.ndarray:
        """Return the points [..., 3] before the movement, given those after it."""
        return (points - self.shift) @ self.rotation / self.scale

    def describe(self) -> str:
        """Return what the movement does, as "scaled by 2, turned by 30 degrees and shifted"; "" if nothing."""
        angle = np.degrees(np.arccos(np.clip((np.trace(self.rotation) - 1) / 2, -1, 1)))
        parts = [f"scaled by {self.scale:.4g}"] if abs(self.scale - 1) > 1e-4 else []
        parts += [f"turned by {angle:.3g} degrees"] if angle > 0.01 else []
        parts += ["shifted"] if self.shift.any() else []
        return " and ".join(filter(None, [", ".join(parts[:-1]), *parts[-1:]]))


STILL = Movement(1.0, np.eye(3), np.zeros(3))


def fit_movement(points: np.ndarray, moved: np.ndarray, mirrors: bool = False) -> Movement:
    """Fit the movement that takes points [P, 3] to the moved ones by least squares, P >= 3 (Umeyama, 1991).

    Args:
        mirrors: True fits a movement that mirrors.
    """
    center, moved_center = points.mean(0), moved.mean(0)
    centered, moved_centered = points - center, moved - moved_center
    left, strengths, right = np.linalg.svd(moved_centered.T @ centered)
    signs = np.ones(3)
    signs[2] = np.sign(np.linalg.det(left) * np.linalg.det(right)) * (-1 if mirrors else 1)
    rotation = (left * signs) @ right
    scale = float((strengths * signs).sum() / max((centered**2).sum(), 1e-300))
    return Movement(scale, rotation, moved_center - scale * rotation @ center)


def find_movement(whole: Cloud, moved: Cloud) -> Movement | None:
    """Return the movement that takes Gaussians of the whole scene to those of the moved one; None if none is found.

    The moved scene may lack Gaussians, have others, and be quantized and in another order. It was moved as one. The
    result is `STILL` if the movement is within the errors of quantization.

    Args:
        whole: N >= 2 Gaussians.
        moved: M >= 1 Gaussians.
    """
    sample = moved.take(slice(None, None, max(1, len(moved) // SAMPLE_SIZE)))
    distances, nearest = cKDTree(whole.looks()).query(sample.looks(), 2, workers=-1)
    distinct = np.argsort(distances[:, 0] - distances[:, 1], kind="stable")[:PAIRS]
    distinct = distinct[distances[distinct, 0] < SAME_LOOKS]
    partners, sample = whole.take(nearest[distinct, 0]), sample.take(distinct)
    growth = sample.log_scales.max(1) - partners.log_scales.max(1)
    if len(growth) < LEAST_PAIRS:
        return None
    # Right pairs agree about the scale, and wrong ones do not.
    votes = [np.count_nonzero(np.abs(growth - each) < SCALE_BIN) for each in growth]
    agreed = np.abs(growth - growth[int(np.argmax(votes))]) < 2 * SCALE_BIN
    points, targets = partners.means[agreed], sample.means[agreed]
    found = [_search(points, targets, float(np.exp(np.median(growth[agreed]))), mirrors) for mirrors in (False, True)]
    (movement, count), (mirrored, mirrored_count) = found
    best, most = (mirrored, mirrored_count) if mirrored_count > MIRROR_LEAD * count else (movement, count)
    if most < LEAST_PAIRS:
        return None
    extent = np.linalg.norm(np.ptp(points, axis=0))
    return STILL if _errors(best, points, points).max() < STILL_ERROR * extent else best


def _search(points: np.ndarray, targets: np.ndarray, scale: float, mirrors: bool) -> tuple[Movement, int]:
    """Return the movement that explains most pairs of points and targets [P, 3], and their number; 0 if it is wrong."""
    draws = np.random.default_rng(0)
    extent = float(np.linalg.norm(np.percentile(targets, 90, axis=0) - np.percentile(targets, 10, axis=0)))
    triples = draws.integers(len(points), size=(TRIPLES, 3))
    sides = [scale * np.linalg.norm(points[triples] - points[np.roll(triples, 1, axis=1)], axis=2)]
    sides += [np.linalg.norm(targets[triples] - targets[np.roll(triples, 1, axis=1)], axis=2)]
    # The scale itself is known only as well as the sizes of Gaussians are quantized.
    ratios = np.log(np.maximum(sides[1], 1e-300) / np.maximum(sides[0], 1e-300))
    consistent = (np.ptp(ratios, axis=1) < DISTANCE_ERROR) & (np.abs(ratios.mean(1)) < 2 * SCALE_BIN)
    consistent &= sides[1].min(1) > 0.1 * extent
    best, most = STILL, 0
    for triple in triples[consistent][:TRIALS]:
        movement = fit_movement(points[triple], targets[triple], mirrors)
        count = np.count_nonzero(_errors(movement, points, targets) < FIRST_ERROR * extent)
        best, most = (movement, count) if count > most else (best, most)
    for share in np.geomspace(FIRST_ERROR, LAST_ERROR, 6) if most >= 3 else ():
        near = _errors(best, points, targets) < share * extent
        if np.count_nonzero(near) < 3:
            return best, 0
        best = fit_movement(points[near], targets[near], mirrors)
    if most >= 3:  # wrong pairs that happen to be near have larger errors than right ones
        errors = _errors(best, points, targets)
        near = errors <= 3 * np.median(errors[errors < LAST_ERROR * extent])
        best = fit_movement(points[near], targets[near], mirrors) if np.count_nonzero(near) >= 3 else best
    errors = _errors(best, points, targets)
    right, roughly_right = (int(np.count_nonzero(errors < share * extent)) for share in (LAST_ERROR, ROUGH_ERROR))
    return best, right if right > RIGHT_SHARE * roughly_right else 0


def _errors(movement: Movement, points: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the distances [P] of the moved points from the targets."""
    return np.linalg.norm(movement.apply(points) - targets, axis=1)
