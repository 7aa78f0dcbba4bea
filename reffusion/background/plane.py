"""Planes in the world, each with a map: where photographs show it, where they see through it, where it continues."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reffusion import geometry
from reffusion.types import Camera

CELLS = 160  # side of a plane's map, in cells
LARGE = 0.5  # of the seen cells of the largest plane: a plane with fewer may merely cut through a round thing
# A plane occludes a surface if its depth is less than this many times the surface's depth.
IN_FRONT = 1 - geometry.OTHER_SURFACE


@dataclass(frozen=True)
class Plane:
    """A plane in the world, with a map of square cells that tells where the plane exists.

    Attributes:
        normal: [3], unit normal.
        offset: the plane is normal . x = offset.
        origin: [3], the point on the plane at the middle of the map.
        axes: [2, 3], unit vectors of the map's rows (the direction in which the row index grows) and columns.
        cell_size: side of a cell, in world units.
        seen: bool [CELLS, CELLS], True where views show the plane, and not a surface of another plane that crosses it.
        free: bool [CELLS, CELLS], True where views see through the plane, so that the plane does not exist there unless
            the cell is `reflective`.
        reflective: bool [CELLS, CELLS], True for cells through which views see and which seen cells surround. The plane
            has a mirror or a window there. Most of these cells are also `free`.
        continued: bool [CELLS, CELLS], True for cells that no view shows and into which the plane continues.
        enclosed: bool [CELLS, CELLS], True for the cells of `continued`, and for further cells behind the object that
            the cells of `continued` and `seen` surround. Views may see through these further cells, because reflections
            make a polished surface look like a pit.
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
        """Return [H, W], the camera z at which the rays of a view meet the plane; inf where a ray does not meet it.

        The whole plane counts, without regard to its cells.
        """
        rays = geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (self.offset - camera.center @ self.normal) / (rays @ self.normal)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.inf)

    def pixels_on(self, cells: np.ndarray, depth: np.ndarray, camera: Camera, pixels: np.ndarray) -> np.ndarray:
        """Return bool [H, W], the pixels of a view whose rays meet the plane in a True cell of `cells`.

        Args:
            cells: bool [CELLS, CELLS].
            depth: [H, W], the plane's depth in the view, see `Plane.depth`.
            camera: the view.
            pixels: bool [H, W], the pixels to test; all others are False in the result.
        """
        pixels = pixels & np.isfinite(depth)
        rays = geometry.pixel_rays(camera)[pixels] @ camera.world_to_camera[:3, :3]
        found = np.zeros_like(pixels)
        found[pixels] = self.contains(cells, camera.center + rays * depth[pixels, None])
        return found

    def contains(self, cells: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return bool [P], which of the world points [P, 3] project orthogonally into a True cell of `cells`.

        Args:
            cells: bool [CELLS, CELLS].
        """
        index = self.cell_index(points)
        inside = ((index >= 0) & (index < CELLS)).all(-1)
        row, column = np.where(inside[:, None], index, 0).T
        return inside & cells[row, column]

    def cell_index(self, points: np.ndarray) -> np.ndarray:
        """Return int64 [P, 2], row and column of the cells into which world points [P, 3] project orthogonally.

        The cells may lie outside the map.
        """
        return np.floor((points - self.origin) @ self.axes.T / self.cell_size + CELLS / 2).astype(np.int64)

    @property
    def cell_centers(self) -> np.ndarray:
        """[CELLS, CELLS, 3], the middle of each cell in world coordinates."""
        steps = (np.arange(CELLS) + 0.5 - CELLS / 2) * self.cell_size
        return self.origin + steps[:, None, None] * self.axes[0] + steps[None, :, None] * self.axes[1]


def remove_reflected_depth(depth: np.ndarray, camera: Camera, planes: Sequence[Plane]) -> np.ndarray:
    """Return a depth map in which pixels that show a reflection have the depth of the plane that reflects.

    A pixel that shows a reflection in a polished surface has the depth of the reflected scene, which lies behind the
    plane of the surface. The surface itself, and its texture, continue along the plane. So a pixel gets the plane's
    depth if its depth lies behind a reflective cell of the plane. A pixel whose depth lies clearly behind a seen cell
    of a large plane also gets the plane's depth, because most views show the plane there.

    Args:
        depth: [H, W], the depth that the view shows; 0 where unknown.
        camera: the view.
        planes: the planes around the object.

    Returns:
        [H, W] float64, a new array.
    """
    depth, most = depth.astype(np.float64), max((plane.seen.sum() for plane in planes), default=0)
    for plane in planes:
        plane_depth = plane.depth(camera)
        wrong = plane.pixels_on(plane.reflective, plane_depth, camera, plane_depth < depth)
        if plane.seen.sum() > LARGE * most:
            wrong |= plane.pixels_on(plane.seen, plane_depth, camera, plane_depth < IN_FRONT * depth)
        depth[wrong] = plane_depth[wrong]
    return depth
