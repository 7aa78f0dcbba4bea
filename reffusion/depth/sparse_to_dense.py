"""The depth of a photograph from the scene's sparse points alone: what lies between them is told by its colours.

For scenes of which few photographs are given: a fit to so few explains them by whatever stands before each camera,
while structure from motion knows where surfaces are.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from reffusion import geometry
from reffusion.types import Camera

ENOUGH = 30  # points that a view has to show, or nothing is told
ASKED = 16  # points that a pixel asks
UNIT = 320  # pixels are counted as if pictures were so wide
COLOUR = 0.25  # of these pixels: how far a unit of CIELAB counts
CLOSEST = 2.0  # of these pixels: nearer points do not count more
AROUND, NEARER = 8, 1.06  # a point is hidden where most of so many around it are nearer by this relative disparity
UNLIKE = 30  # levels of 255 by which a hidden point's colour differs from what the photograph shows there
TILT = 2.0  # relative disparity by which a point's plane may change it on the way to a pixel
NORMAL_FROM = 10  # points that a normal is fitted to
REWEIGHTED = 4  # times, so that the points of another surface lose their say
SMOOTHED = 5  # px, window of the median over the result


@dataclass(frozen=True)
class SparsePoints:
    """A scene's sparse points as pieces of surfaces.

    Attributes:
        positions: [P, 3]. colors: [P, 3] uint8. normals: [P, 3], of unit length and either sign.
    """

    positions: np.ndarray
    colors: np.ndarray
    normals: np.ndarray

    @classmethod
    def of(cls, positions: np.ndarray, colors: np.ndarray) -> SparsePoints:
        """With the normals of planes through each point's neighbours, robustly fitted. P > `NORMAL_FROM`."""
        _, index = cKDTree(positions).query(positions, k=NORMAL_FROM)
        around = positions[index]
        weights, normals = np.ones(index.shape), np.zeros(positions.shape)
        middle = np.median(around, axis=1)
        for _ in range(REWEIGHTED):
            offsets = around - middle[:, None]
            spread = np.einsum("pk,pki,pkj->pij", weights, offsets, offsets)
            normals = np.linalg.eigh(spread)[1][..., 0]
            misfit = np.abs(np.einsum("pki,pi->pk", around - positions[:, None], normals))
            scale = np.maximum(np.median(misfit, axis=1, keepdims=True), 1e-12)
            weights = 1 / (1 + (misfit / (2 * scale)) ** 2)
            middle = (weights[..., None] * around).sum(1) / weights.sum(1, keepdims=True)
        return cls(positions, colors, normals)


@dataclass(frozen=True)
class Known:
    """What is known of a view's depth in some of its pixels.

    Attributes:
        pixels: [S, 2] coordinates (x, y). planes: [S, 3], of the surface there: plane . (x, y, 1) along a ray is 1/z.
        disparity: [S], of the plane at the pixel.
    """

    pixels: np.ndarray
    planes: np.ndarray
    disparity: np.ndarray

    def taken(self, which: np.ndarray) -> Known:
        return Known(self.pixels[which], self.planes[which], self.disparity[which])

    def joined(self, more: Known) -> Known:
        both = zip((self.pixels, self.planes, self.disparity), (more.pixels, more.planes, more.disparity), strict=True)
        return Known(*(np.concatenate(each) for each in both))


def known(points: SparsePoints, camera: Camera, image: np.ndarray) -> Known:
    """The points that a photograph (uint8 [H, W, 3]) shows: in its frame, not behind what most points around them lie
    on, and of the colour that is seen there."""
    pixels, disparity, number = _shown(points, camera, image)
    normals = points.normals[number]
    reach = ((points.positions[number] - camera.center) * normals).sum(1, keepdims=True)
    planes = np.divide(normals, reach, out=np.zeros_like(normals), where=np.abs(reach) > 1e-9)
    return Known(pixels, planes @ camera.world_to_camera[:3, :3].T, disparity)


def depth_between(said: Known, camera: Camera, image: np.ndarray) -> np.ndarray | None:
    """[H, W] float64 camera z of a photograph, everywhere; None where too little is known.

    Each pixel asks what is known nearest to it in the picture and in colour, so that what lies across an edge has no
    say. Each answers with the depth of its own plane there; the weighted median is taken, so that depth steps from one
    surface to the next and does not slope.

    Args:
        image: uint8 [H, W, 3], what the camera shows.
    """
    if len(said.pixels) < ENOUGH:
        return None
    lab = cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    unit = UNIT / camera.width
    columns, rows = said.pixels.astype(int).T
    height, width = lab.shape[:2]
    centres = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    described = np.concatenate([unit * centres, COLOUR * lab], -1)
    there = np.column_stack([unit * said.pixels, COLOUR * lab[rows, columns]])
    asked = min(ASKED, len(there))
    away, index = cKDTree(there).query(described.reshape(-1, there.shape[1]), k=asked)
    rays, own = geometry.pixel_rays(camera).reshape(-1, 3), said.disparity[index]
    answers = np.einsum("pi,pki->pk", rays, said.planes[index]).clip(own / TILT, own * TILT)
    found = _weighted_median(answers, 1 / (away**2 + CLOSEST**2))
    return 1.0 / cv2.medianBlur(found.reshape(height, width).astype(np.float32), SMOOTHED).astype(np.float64)


def _shown(points: SparsePoints, camera: Camera, image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels [S, 2], disparities [S] and numbers [S] of what `known` tells."""
    uv, z = geometry.project(points.positions, camera)
    with np.errstate(invalid="ignore"):
        framed = (z > 0) & (uv >= 0).all(1) & (uv < (camera.width, camera.height)).all(1)
    number = np.flatnonzero(framed)
    uv, disparity = uv[number], 1 / z[number]
    if len(uv) <= AROUND:
        return uv, disparity, number
    _, index = cKDTree(uv).query(uv, k=AROUND + 1)
    behind = (disparity[index[:, 1:]] > NEARER * disparity[:, None]).mean(1) > 0.5
    # Within a pixel of where it should be: the least difference of any channel's largest.
    levels, around = points.colors[number].astype(int), []
    for shift in np.ndindex(3, 3):
        columns, rows = (uv + np.array(shift) - 1).astype(int).T
        seen = image[rows.clip(0, camera.height - 1), columns.clip(0, camera.width - 1)]
        around.append(np.abs(seen - levels).max(1))
    kept = ~behind & (np.min(around, axis=0) <= UNLIKE)
    return uv[kept], disparity[kept], number[kept]


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[N] of values [N, K] under weights [N, K] > 0."""
    order = np.argsort(values, axis=1)
    passed = np.take_along_axis(weights, order, axis=1).cumsum(1)
    middle = (passed < 0.5 * passed[:, -1:]).sum(1, keepdims=True)
    return np.take_along_axis(np.take_along_axis(values, order, axis=1), middle, axis=1)[:, 0]
