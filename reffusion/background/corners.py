"""The third face of a corner: a face that few samples show, because photographs see it at a slant, between two that
many do."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from reffusion import geometry
from reffusion.background.plane import BEFORE, Plane
from reffusion.background.visibility import Witness

SQUARE = 0.2  # cosine between two planes up to which they may be two faces of a box or a room
NEAR = 0.75  # of the object's radius: how far from its middle the third face may pass
FEWEST, LEAST_SHARE = 50, 0.01  # samples that it must explain, and their share of all
SHARP = 4.0  # times as many as lie beside it, equally far to either side: no face of a cloud of leaves is sharp
STEPS = 4  # heights that are tried within a plane's thickness


def third_faces(
    samples: np.ndarray,
    free: np.ndarray,
    found: Sequence[tuple[np.ndarray, float]],
    centre: np.ndarray,
    radius: float,
    near: float,
) -> list[tuple[np.ndarray, float]]:
    """(normal, height) of the planes at right angles to two of those found that samples show sharply.

    One direction is left there, so that few samples tell where along it the face is; three of them, drawn at random,
    would make a hundred planes as good.

    Args:
        samples: [S, 3]. free: bool [S], those that none of the planes found explains.
        centre: [3], the middle of what is removed; radius: of most of it. near: distance within which a sample belongs
            to a plane.
    """
    enough, more = max(FEWEST, LEAST_SHARE * len(samples)), []
    for (one, _), (other, _) in combinations(found, 2):
        if abs(one @ other) > SQUARE:
            continue
        normal = np.cross(one, other)
        normal /= np.linalg.norm(normal)
        if any(abs(normal @ known) > 1 - SQUARE for known, _ in more):
            continue
        away = np.sort((samples[free] - centre) @ normal)
        within = lambda low, high, away=away: np.searchsorted(away, high) - np.searchsorted(away, low)
        tried = np.arange(-NEAR * radius, NEAR * radius, near / STEPS)
        support = within(tried - near, tried + near)
        best = support.argmax()
        at = tried[best]
        beside = max(within(at - 3 * near, at - near), within(at + near, at + 3 * near))
        if support[best] >= enough and support[best] > SHARP * beside:
            own = away[within(-np.inf, at - near) : within(-np.inf, at + near)]
            more.append((normal, float(np.median(own) + centre @ normal)))
    return more


def reached(plane: Plane, before: Sequence[Plane], views: Sequence[Witness]) -> np.ndarray:
    """bool [CELLS, CELLS]: what the object hides from some view, and would be seen by it past all that is known of the
    planes before, where they are seen and where they go on: the face of a box does not go on within the box."""
    points, found = plane.cells.reshape(-1, 3), np.zeros(plane.seen.size, bool)
    for view in views:
        uv, z = geometry.project(points, view.camera)
        masked, inside = geometry.sample_nearest(view.hidden, uv)
        asked = np.nonzero(inside & masked & (z > 0) & ~found)[0]
        rays, clear = points[asked] - view.camera.center, np.ones(len(asked), bool)
        for other in before:
            with np.errstate(divide="ignore", invalid="ignore"):
                way = (other.height - view.camera.center @ other.normal) / (rays @ other.normal)
            meets = (way > 0) & (way < BEFORE)
            where = view.camera.center + rays * np.where(meets, way, 0)[:, None]
            clear &= ~(meets & other.in_cells(other.seen | other.goes_on, where))
        found[asked[clear]] = True
    return found.reshape(plane.seen.shape)
