"""How a picture repeats itself, roughly: the shifts between its patches that look alike."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from reffusion import seeding

PEAKS = 400  # of the shifts, at most
FEWEST = 400  # places for patches, with fewer there are none
PLACES, ASKED = 12000, 6000  # patches that are compared, and how many of them ask
TOGETHER = 1500  # that ask at a time
WANDER = 40.0  # px by which chance moves the distance of those
ARM = 3  # px between the nine points at which a patch is compared
FAR = 1 / 8  # of the hole's width: nearer patches look alike because they are next to each other
NEAREST = 8.0  # px, the same at least
SPREAD, DISTINCT = 1.5, 9  # px: shifts so near to each other count together, and so wide a window has one peak


def frequent(values: np.ndarray, clear: np.ndarray, away: np.ndarray, width: float, seed: int) -> np.ndarray:
    """[M, 2] (rows, columns), the shifts between like patches, and back, the most frequent first (after He and Sun
    2012).

    Args:
        values: [H, W, C], what is compared. clear: bool [H, W], where.
        away: [H, W], px from the hole: patches near it ask. width: of the hole, px.
        seed: of the draw of those.
    """
    draws = np.random.default_rng(seeding.seed_for(seed, "offsets"))
    rows, columns = np.nonzero(ndimage.binary_erosion(clear, iterations=ARM + 1))
    if len(rows) < FEWEST:
        return np.zeros((0, 2), int)
    step = max(1, int(np.sqrt(len(rows) / PLACES)))
    some = (rows % step == 0) & (columns % step == 0)
    rows, columns = rows[some], columns[some]
    small = cv2.blur(values.astype(np.float32), (ARM, ARM))
    points = (-ARM, 0, ARM)
    patches = np.concatenate([small[rows + down, columns + along] for down in points for along in points], 1)
    turn = away[rows, columns] + draws.uniform(0, WANDER, len(rows))
    asked = np.argsort(turn, kind="stable")[:ASKED]
    far = max(FAR * width, NEAREST)
    square, found = (patches**2).sum(1), []
    for part in np.array_split(asked, -(-len(asked) // TOGETHER)):
        unlike = square - 2 * patches[part] @ patches.T
        unlike[(rows[part][:, None] - rows) ** 2 + (columns[part][:, None] - columns) ** 2 < far**2] = np.inf
        alike = unlike.argmin(1)
        found.append(np.stack([rows[alike] - rows[part], columns[alike] - columns[part]], 1))
    return _peaks(np.concatenate(found), clear.shape)


def _peaks(found: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Of shifts [N, 2] in a picture of a shape the most frequent, both ways."""
    height, width = shape
    count = np.zeros((2 * height + 1, 2 * width + 1), np.float32)
    np.add.at(count, (found[:, 0] + height, found[:, 1] + width), 1)
    count = cv2.GaussianBlur(count + count[::-1, ::-1], (0, 0), SPREAD)
    row, column = np.nonzero((count == cv2.dilate(count, np.ones((DISTINCT, DISTINCT)))) & (count > 0))
    most = np.argsort(-count[row, column], kind="stable")[:PEAKS]
    return np.stack([row[most] - height, column[most] - width], 1)
