"""A plane in the world, and a map of what photographs say of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reffusion import geometry
from reffusion.types import Camera

CELLS = 160  # a side of a plane's map
LARGE = 0.5  # of the cells seen of the largest plane: a smaller one may cut through a round thing
BEFORE = 0.97  # of the depth shown: a plane must be nearer than that to hide it


@dataclass(frozen=True)
class Plane:
    """A plane in the world, and a map of what is known on it.

    Attributes:
        normal: [3], of unit length. height: normal . x on the plane.
        origin: [3] on the plane, the map's middle. along: [2, 3], the map's axes. pitch: side of a cell.
        goes_on: bool [CELLS, CELLS], unknown cells into which the plane continues.
        within: bool [CELLS, CELLS], these and what they enclose with what is seen of the plane: mirrored light makes a
            polished part look like a pit.
        free: bool [CELLS, CELLS], where views look through it: there it is not.
        seen: bool [CELLS, CELLS], where views show it.
        pit: bool [CELLS, CELLS], `free` cells that the plane surrounds: a mirror in it, or a window.
    """

    normal: np.ndarray
    height: float
    origin: np.ndarray
    along: np.ndarray
    pitch: float
    goes_on: np.ndarray
    within: np.ndarray
    free: np.ndarray
    seen: np.ndarray
    pit: np.ndarray

    def depth(self, camera: Camera) -> np.ndarray:
        """[H, W] camera z where a view's rays meet the plane; inf where they do not."""
        rays = geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (self.height - camera.center @ self.normal) / (rays @ self.normal)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.inf)

    def on(self, cells_meant: np.ndarray, depth: np.ndarray, camera: Camera, asked: np.ndarray) -> np.ndarray:
        """bool [H, W]: pixels of those asked, bool [H, W], whose rays meet the plane, at `depth`, in one of the cells
        meant (bool [CELLS, CELLS])."""
        asked = asked & np.isfinite(depth)
        rays = geometry.pixel_rays(camera)[asked] @ camera.world_to_camera[:3, :3]
        found = np.zeros_like(asked)
        found[asked] = self.in_cells(cells_meant, camera.center + rays * depth[asked, None])
        return found

    def in_cells(self, cells_meant: np.ndarray, points: np.ndarray) -> np.ndarray:
        """bool [P]: points [P, 3] that lie over one of the cells meant (bool [CELLS, CELLS])."""
        cells = self.cell_of(points)
        inside = ((cells >= 0) & (cells < CELLS)).all(-1)
        row, column = np.where(inside[:, None], cells, 0).T
        return inside & cells_meant[row, column]

    def cell_of(self, points: np.ndarray) -> np.ndarray:
        """[P, 2], row and column of the cells that points [P, 3] lie over, perhaps outside the map."""
        return np.floor((points - self.origin) @ self.along.T / self.pitch + CELLS / 2).astype(np.int64)

    @property
    def cells(self) -> np.ndarray:
        """[CELLS, CELLS, 3], the middle of each cell in the world."""
        steps = (np.arange(CELLS) + 0.5 - CELLS / 2) * self.pitch
        return self.origin + steps[:, None, None] * self.along[0] + steps[None, :, None] * self.along[1]


def without_pits(depth: np.ndarray, camera: Camera, planes: Sequence[Plane]) -> np.ndarray:
    """[H, W] float64, the depth that a view shows; that of a plane where it looks into a mirror in it, for what is
    polished goes on, and repeats itself, along the plane; or past a large plane, where most views show that."""
    depth, most = depth.astype(np.float64), max((plane.seen.sum() for plane in planes), default=0)
    for plane in planes:
        at = plane.depth(camera)
        wrong = plane.on(plane.pit, at, camera, at < depth)
        if plane.seen.sum() > LARGE * most:
            wrong |= plane.on(plane.seen, at, camera, at < BEFORE * depth)
        depth[wrong] = at[wrong]
    return depth
