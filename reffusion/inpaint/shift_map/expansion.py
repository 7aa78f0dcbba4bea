"""Pieces of pictures cut where they agree, by expansion moves (after Kwatra et al. 2003 and Boykov et al. 2001)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from reffusion.graph_cut import least_cut
from reffusion.inpaint.poisson import blended

RING = 6  # px around a hole in which pieces are compared with what is known
UNKNOWN = 500.0  # cost of a pixel that a piece does not show
COLOR, CHANGE = 0.7, 2.0  # weight of the tone, and of changes from pixel to pixel, beside finer colour
ROUNDS = 2  # of expansion over all pieces
SCALE = 0.1  # of costs, so that their sum fits whole numbers of 32 bits


def looks(
    rows: np.ndarray, columns: np.ndarray, colors: np.ndarray, fine: np.ndarray, shape: tuple[int, int], stride: int
) -> np.ndarray:
    """[N, 8] float32, what is compared of pixels ([N] rows and columns): colours, their finer part, [N, 3] each, and
    its changes to the next pixel."""
    grid = np.zeros(shape, np.float32)
    grey = fine.mean(1)
    grid[rows, columns] = grey
    there = np.zeros(shape, bool)
    there[rows, columns] = True
    changes = []
    for down, along in ((0, stride), (stride, 0)):
        row, column = np.minimum(rows + down, shape[0] - 1), np.minimum(columns + along, shape[1] - 1)
        changes.append(np.where(there[row, column], grid[row, column] - grey, 0))
    return np.concatenate([COLOR * colors, fine, CHANGE * np.stack(changes, 1)], 1).astype(np.float32)


def apart(look: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[..., N], how much what is compared differs, in levels."""
    return np.linalg.norm(look - other, axis=-1) / np.sqrt(3)


def side_by_side(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int], stride: int) -> np.ndarray:
    """[E, 2], numbers of pixels next to each other."""
    index = np.full(shape, -1)
    index[rows, columns] = np.arange(len(rows))
    sides = ((index[:, :-stride], index[:, stride:]), (index[:-stride], index[stride:]))
    pairs = np.concatenate([np.stack([first.ravel(), second.ravel()], 1) for first, second in sides])
    return pairs[(pairs >= 0).all(1)]


def expanded(cost: np.ndarray, look: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """[N], labels of low total cost: [L, N] each, and between neighbours the difference of what both labels show
    ([L, N, 8]) in both places."""
    (first, second), pixels, labels = pairs.T, np.arange(cost.shape[1]), cost.argmin(0)
    at_both = lambda taken: (look[taken, first], look[taken, second])
    differ = lambda one, two: apart(one[0], two[0]) + apart(one[1], two[1])
    here, there = at_both(labels[first]), at_both(labels[second])
    stays = differ(here, there)
    least = cost[labels, pixels].sum() + stays.sum()
    for piece in list(range(len(cost))) * ROUNDS:
        shown = at_both(piece)
        first_moves, second_moves = differ(shown, there), differ(here, shown)
        keep, move = cost[labels, pixels].copy(), cost[piece].copy()
        # As in Kolmogorov and Zabih 2004: what a pair costs more than its parts is the cost of a border in it.
        border = np.maximum(first_moves + second_moves - stays, 0) / 2
        np.add.at(move, first, first_moves - stays - border)
        np.add.at(move, second, border - first_moves)
        shared = np.minimum(keep, move)
        found = np.where(
            least_cut(SCALE * (move - shared), SCALE * (keep - shared), pairs, SCALE * border), piece, labels
        )
        if (found == labels).all():
            continue
        moved = at_both(found[first]), at_both(found[second])
        total = cost[found, pixels].sum() + differ(*moved).sum()
        if total < least:
            labels, least, (here, there), stays = found, total, moved, differ(*moved)
    return labels


def assembled(
    image: np.ndarray,
    hole: np.ndarray,
    beside: np.ndarray,
    label: np.ndarray,
    shown: Iterable[tuple[np.ndarray, np.ndarray]],
    tone: float,
) -> tuple[np.ndarray, np.ndarray]:
    """A picture, uint8 [H, W, 3], with its hole put together from pieces that are blended by their changes, and which
    of its pixels are, bool [H, W].

    Args:
        image: read outside the hole only. hole: bool [H, W]. beside: bool [H, W], what outside it goes on in it.
        label: int [H, W], the number of the piece that a pixel takes.
        shown: of each piece what it shows, float32 [H, W, 3], and where it shows something, bool [H, W].
        tone: weight of the pieces' own tone.
    """
    own, shows = image.astype(np.float32), np.zeros_like(hole)
    changes, counts = np.zeros((2, *own.shape), np.float32), np.zeros((2, *hole.shape), np.float32)
    for k, (picture, valid) in enumerate(shown):
        mine = valid & (label == k)
        if not mine.any():
            continue
        own[mine & hole], shows = picture[mine & hole], shows | mine
        for axis, (down, along) in enumerate(((0, 1), (1, 0))):
            before = (slice(None, -down or None), slice(None, -along or None))
            after = (slice(down, None), slice(along, None))
            for here in (mine[before], mine[after]):  # each of two neighbours says how the one differs from the other
                both = here & valid[before] & valid[after]
                changes[axis][before][both] += (picture[after] - picture[before])[both]
                counts[axis][before] += both
    filled = hole & shows
    if not filled.any():
        return image, filled
    right, below = changes / np.maximum(counts, 1)[..., None]
    found = image.copy()
    found[filled] = blended(own, filled, right, below, own, beside, tone).clip(0, 255).round().astype(np.uint8)
    return found, filled
