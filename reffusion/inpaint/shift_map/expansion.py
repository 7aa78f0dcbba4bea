"""Choice of one candidate for each pixel by expansion moves (Boykov et al. 2001).

Neighboring pixels with different candidates form a seam. The choice makes both candidates look alike along seams
(after Kwatra et al. 2003).
"""

from __future__ import annotations

import numpy as np

from reffusion.graph_cut import alpha_expansion

COLOR_WEIGHT = 0.7  # weight of color; the weight of detail (color minus local mean) is 1
GRADIENT_WEIGHT = 2.0  # weight of the difference of detail to the next pixel
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


def choose_candidates(cost: np.ndarray, look: np.ndarray, pairs: np.ndarray) -> np.ndarray:
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
    first, second = pairs.T

    def seam_cost(at_first: np.ndarray, at_second: np.ndarray) -> np.ndarray:
        at_pixel = lambda pixel: feature_distance(look[at_first, pixel], look[at_second, pixel])
        return COST_SCALE * (at_pixel(first) + at_pixel(second))

    return alpha_expansion(COST_SCALE * cost, pairs, seam_cost, cost.argmin(0))
