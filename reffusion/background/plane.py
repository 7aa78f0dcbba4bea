"""A plane in the world, with a map of where photographs show it, see through it, and where it continues unseen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reffusion import geometry
from reffusion.types import Camera

CELLS = 160  # side of a plane's map, in cells
LARGE = 0.5  # of the seen cells of the largest plane: a smaller plane may only cut through a round thing
IN_FRONT = 0.97  # of a depth: a plane nearer than this occludes it


@dataclass(frozen=True)
class Plane:
    """A plane in the world, and what is known of it, cell by cell.

    Attributes:
        normal: [3], unit length. offset: normal . x of the points x on the plane.
        origin: [3], the point on the plane at the middle of the map. axes: [2, 3], unit axes of the map.
        cell_size: side of a cell, in world units.
        continued: bool [CELLS, CELLS], unobserved cells into which the plane continues.
        enclosed: bool [CELLS, CELLS], `continued`, and what it encloses together with `seen`: reflections make a
            polished part look like a pit.
        free: bool [CELLS, CELLS], views see through the plane there: it does not exist there.
        seen: bool [CELLS, CELLS], views show the plane there.
        reflective: bool [CELLS, CELLS], `free` cells that the plane surrounds: a mirror in it, or a window.
    """

    normal: np.ndarray
    offset: float
    origin: np.ndarray
    axes: np.ndarray
    cell_size: float
    continued: np.ndarray
    enclosed: np.ndarray
    free: np.ndarray
    seen: np.ndarray
    reflective: np.ndarray

    def depth(self, camera: Camera) -> np.ndarray:
        """[H, W] camera z at which the rays of a view meet the plane; inf where they do not."""
        rays = geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (self.offset - camera.center @ self.normal) / (rays @ self.normal)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.inf)

    def pixels_on(self, cells: np.ndarray, depth: np.ndarray, camera: Camera, pixels: np.ndarray) -> np.ndarray:
        """bool [H, W]: those of `pixels`, bool [H, W], whose rays meet the plane, at `depth`, in one of `cells`, bool
        [CELLS, CELLS]."""
        pixels = pixels & np.isfinite(depth)
        rays = geometry.pixel_rays(camera)[pixels] @ camera.world_to_camera[:3, :3]
        found = np.zeros_like(pixels)
        found[pixels] = self.contains(cells, camera.center + rays * depth[pixels, None])
        return found

    def contains(self, cells: np.ndarray, points: np.ndarray) -> np.ndarray:
        """bool [P]: points [P, 3] that project into one of `cells`, bool [CELLS, CELLS]."""
        index = self.cell_index(points)
        inside = ((index >= 0) & (index < CELLS)).all(-1)
        row, column = np.where(inside[:, None], index, 0).T
        return inside & cells[row, column]

    def cell_index(self, points: np.ndarray) -> np.ndarray:
        """[P, 2], row and column of the cells into which points [P, 3] project; may lie outside the map."""
        return np.floor((points - self.origin) @ self.axes.T / self.cell_size + CELLS / 2).astype(np.int64)

    @property
    def cell_centers(self) -> np.ndarray:
        """[CELLS, CELLS, 3], the middle of each cell in the world."""
        steps = (np.arange(CELLS) + 0.5 - CELLS / 2) * self.cell_size
        return self.origin + steps[:, None, None] * self.axes[0] + steps[None, :, None] * self.axes[1]


def remove_reflected_depth(depth: np.ndarray, camera: Camera, planes: Sequence[Plane]) -> np.ndarray:
    """[H, W] float64: the depth that a view shows, with the depth of a plane where the view looks into a mirror in it.

    A polished surface continues, and repeats itself, along its plane. The same holds where this view sees past a large
    plane that most views show.
    """
    depth, most = depth.astype(np.float64), max((plane.seen.sum() for plane in planes), default=0)
    for plane in planes:
        plane_depth = plane.depth(camera)
        wrong = plane.pixels_on(plane.reflective, plane_depth, camera, plane_depth < depth)
        if plane.seen.sum() > LARGE * most:
            wrong |= plane.pixels_on(plane.seen, plane_depth, camera, plane_depth < IN_FRONT * depth)
        depth[wrong] = plane_depth[wrong]
    return depth
