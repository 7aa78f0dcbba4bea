"""Choice of one candidate for each pixel by expansion moves (Boykov et al. 2001).

Neighboring pixels with different candidates form a seam. The choice makes both candidates look alike along seams
(after Kwatra et al. 2003).
"""

from __future__ import annotations

import numpy as np

from reffusion.graph_cut import min_cut

COLOR_WEIGHT = 0.7  # weight of color; the weight of detail (color minus local mean) is 1
GRADIENT_WEIGHT = 2.0  # weight of the difference of detail to the next pixel
ROUNDS = 2  # passes of expansion moves over all candidates
COST_SCALE = 0.1  # factor on all costs, so that their sum fits the 32-bit integers of the cut


def features(
    rows: np.ndarray, columns: np.ndarray, colors: np.ndarray, detail: np.ndarray, shape: tuple[int, int], stride: int
) -> np.ndarray:
    """Return [N, 8] float32, the features by which the appearance of a candidate is compared at N pixels.

    The features are the weighted color, the detail, and the weighted gradient of the gray detail.

    Args:
        rows, columns: [N], positions of the pixels, on a grid with a spacing of `stride` px.
        colors: [N, 3], colors in levels of 255.
        detail: [N, 3], colors minus their local mean.
        shape: height and width of the picture.
        stride: px, distance to the next pixel of the grid.
    """
    grid = np.zeros(shape, np.float32)
    gray = detail.mean(1)
    grid[rows, columns] = gray
    known = np.zeros(shape, bool)
    known[rows, columns] = True
    gradients = []
    for down, right in ((0, stride), (stride, 0)):
        row, column = np.minimum(rows + down, shape[0] - 1), np.minimum(columns + right, shape[1] - 1)
        gradients.append(np.where(known[row, column], grid[row, column] - gray, 0))
    gradient = GRADIENT_WEIGHT * np.stack(gradients, 1)
    return np.concatenate([COLOR_WEIGHT * colors, detail, gradient], 1).astype(np.float32)


def feature_distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return [..., N], the Euclidean distance of features [..., N, 8] divided by sqrt(3), in levels."""
    return np.linalg.norm(first - second, axis=-1) / np.sqrt(3)


def neighbor_pairs(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int], stride: int) -> np.ndarray:
    """Return [E, 2], all pairs of horizontal or vertical neighbors on a grid, as indices into the N pixels.

    Args:
        rows, columns: [N], positions of the pixels.
        shape: height and width of the picture.
        stride: px, the spacing of the grid.
    """
    index = np.full(shape, -1)
    index[rows, columns] = np.arange(len(rows))
    sides = ((index[:, :-stride], index[:, stride:]), (index[:-stride], index[stride:]))
    pairs = np.concatenate([np.stack([first.ravel(), second.ravel()], 1) for first, second in sides])
    return pairs[(pairs >= 0).all(1)]


def expand(cost: np.ndarray, look: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Choose one of L candidates for each of N pixels, so that the total cost is low.

    The total cost is the sum of all pixels' own costs and of a seam cost for each pair of neighbors. The seam cost is
    the feature distance between the candidates of the two neighbors, at the one pixel and at the other.

    Args:
        cost: [L, N], the cost of each candidate at each pixel.
        look: [L, N, 8], the `features` of the candidates.
        pairs: [E, 2], indices of neighboring pixels.

    Returns:
        [N] int, the index of the candidate of each pixel.
    """
    (first, second), pixels, labels = pairs.T, np.arange(cost.shape[1]), cost.argmin(0)
    at_both = lambda label: (look[label, first], look[label, second])
    seam = lambda one, two: feature_distance(one[0], two[0]) + feature_distance(one[1], two[1])
    look_first, look_second = at_both(labels[first]), at_both(labels[second])
    seams = seam(look_first, look_second)
    lowest = cost[labels, pixels].sum() + seams.sum()
    for candidate in list(range(len(cost))) * ROUNDS:
        look_candidate = at_both(candidate)
        first_moves, second_moves = seam(look_candidate, look_second), seam(look_first, look_candidate)
        keep, move = cost[labels, pixels].copy(), cost[candidate].copy()
        # As in Kolmogorov and Zabih 2004, the cost of a pair is split into costs of its pixels and a cost of a cut
        # between them.
        cut = np.maximum(first_moves + second_moves - seams, 0) / 2
        np.add.at(move, first, first_moves - seams - cut)
        np.add.at(move, second, cut - first_moves)
        shared = np.minimum(keep, move)
        moves = min_cut(COST_SCALE * (move - shared), COST_SCALE * (keep - shared), pairs, COST_SCALE * cut)
        proposal = np.where(moves, candidate, labels)
        if (proposal == labels).all():
            continue
        look_both = at_both(proposal[first]), at_both(proposal[second])
        total = cost[proposal, pixels].sum() + seam(*look_both).sum()
        if total < lowest:
            labels, lowest, (look_first, look_second), seams = proposal, total, look_both, seam(*look_both)
    return labels
