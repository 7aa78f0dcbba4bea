"""Dense depth of a photograph, interpolated between sparse points with the help of the photograph's colors.

It serves scenes with few photographs. A fit of Gaussians explains few photographs by Gaussians just in front of each
camera, while structure from motion knows where surfaces are.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from reffusion import geometry
from reffusion.depth.discontinuities import weighted_median
from reffusion.types import Camera

MIN_POINTS = 30  # visible points that a view needs
NEIGHBORS = 16  # number of nearest points from which each pixel is interpolated
REFERENCE_WIDTH = 320  # px: distances are measured as if pictures were this wide
COLOR_WEIGHT = 0.25  # such pixels per unit of CIELAB: the distance that a difference in color adds
MIN_DISTANCE = 2.0  # such pixels: nearer points get hardly more weight
OCCLUSION_NEIGHBORS, OCCLUSION_RATIO = (
    8,
    1.06,
)  # a point is occluded if most of this many neighbors exceed its disparity by this factor
MAX_COLOR_DIFFERENCE = 30  # levels of 255: a point whose color differs more from the photograph is occluded
MAX_EXTRAPOLATION = 2.0  # factor by which the plane of a point may change its disparity on the way to a pixel
NORMAL_NEIGHBORS = 10  # nearest points that a normal is fitted to
REWEIGHTINGS = 4  # of the fit of a normal, so that points of another surface lose their weight
MEDIAN_SIZE = 5  # px, window of the median filter over the result


@dataclass(frozen=True)
class SparsePoints:
    """A scene's sparse points, with the normals of the surfaces on which they lie.

    Attributes:
        positions: [P, 3].
        colors: [P, 3] uint8.
        normals: [P, 3] unit vectors of either sign.
    """

    positions: np.ndarray
    colors: np.ndarray
    normals: np.ndarray

    @classmethod
    def of(cls, positions: np.ndarray, colors: np.ndarray) -> SparsePoints:
        """Build `SparsePoints`, with normals estimated by robust fits of planes to the neighbors of each point.

        Args:
            positions: [P, 3] with P >= `NORMAL_NEIGHBORS`.
            colors: [P, 3] uint8.
        """
        _, index = cKDTree(positions).query(positions, k=NORMAL_NEIGHBORS)
        neighbors = positions[index]
        weights, normals = np.ones(index.shape), np.zeros(positions.shape)
        middle = np.median(neighbors, axis=1)
        for _ in range(REWEIGHTINGS):
            offsets = neighbors - middle[:, None]
            spread = np.einsum("pk,pki,pkj->pij", weights, offsets, offsets)
            normals = np.linalg.eigh(spread)[1][..., 0]
            misfit = np.abs(np.einsum("pki,pi->pk", neighbors - positions[:, None], normals))
            scale = np.maximum(np.median(misfit, axis=1, keepdims=True), 1e-12)
            weights = 1 / (1 + (misfit / (2 * scale)) ** 2)
            middle = (weights[..., None] * neighbors).sum(1) / weights.sum(1, keepdims=True)
        return cls(positions, colors, normals)


@dataclass(frozen=True)
class DepthSamples:
    """Samples of the depth in one view.

    Attributes:
        pixels: [S, 2] image points (x, y) in pixels.
        planes: [S, 3], the plane of the surface at each sample, in camera axes: plane . (x, y, 1) = 1/z, where 1/z is
            the disparity at which the ray (x, y, 1) meets the plane.
        disparity: [S], the disparity of each sample.
    """

    pixels: np.ndarray
    planes: np.ndarray
    disparity: np.ndarray

    def select(self, selection: np.ndarray) -> DepthSamples:
        """Return the samples chosen by a boolean mask [S] or by indices."""
        return DepthSamples(self.pixels[selection], self.planes[selection], self.disparity[selection])

    def concatenate(self, other: DepthSamples) -> DepthSamples:
        """Return these samples followed by those of `other`."""
        pairs = zip(
            (self.pixels, self.planes, self.disparity), (other.pixels, other.planes, other.disparity), strict=True
        )
        return DepthSamples(*(np.concatenate(each) for each in pairs))


def visible_samples(points: SparsePoints, camera: Camera, image: np.ndarray) -> DepthSamples:
    """Return the sparse points that are visible in a photograph, as samples of its depth.

    A visible point lies in the photograph's frame, is not behind most of the points around it, and has about the color
    of the photograph at its pixel. If at most `OCCLUSION_NEIGHBORS` points lie in the frame, all of them are returned.

    Args:
        points: The scene's sparse points.
        camera: The camera of the photograph.
        image: uint8 [H, W, 3], the photograph.
    """
    pixels, disparity, index = _visible_points(points, camera, image)
    normals = points.normals[index]
    plane_distance = ((points.positions[index] - camera.center) * normals).sum(1, keepdims=True)
    planes = np.divide(normals, plane_distance, out=np.zeros_like(normals), where=np.abs(plane_distance) > 1e-9)
    return DepthSamples(pixels, planes @ camera.world_to_camera[:3, :3].T, disparity)


def interpolate_depth(samples: DepthSamples, camera: Camera, image: np.ndarray) -> np.ndarray | None:
    """Return the depth of a photograph at every pixel, interpolated between samples: [H, W] float64 camera z.

    Each pixel uses the samples that are nearest to it in position and color, so that samples across an edge do not
    count. Each of these samples proposes the disparity of its plane at the pixel, and the weighted median of the
    proposals is taken. With the median, depth steps from one surface to the next instead of sloping.

    Args:
        samples: The samples of the depth.
        camera: The camera of the photograph.
        image: uint8 [H, W, 3], the photograph.

    Returns:
        None if there are fewer than `MIN_POINTS` samples.
    """
    if len(samples.pixels) < MIN_POINTS:
        return None
    lab = cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    scale = REFERENCE_WIDTH / camera.width
    columns, rows = samples.pixels.astype(int).T
    height, width = lab.shape[:2]
    centers = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    pixel_features = np.concatenate([scale * centers, COLOR_WEIGHT * lab], -1)
    sample_features = np.column_stack([scale * samples.pixels, COLOR_WEIGHT * lab[rows, columns]])
    neighbors = min(NEIGHBORS, len(sample_features))
    distance, index = cKDTree(sample_features).query(pixel_features.reshape(-1, sample_features.shape[1]), k=neighbors)
    rays, sample_disparity = geometry.pixel_rays(camera).reshape(-1, 3), samples.disparity[index]
    low, high = sample_disparity / MAX_EXTRAPOLATION, sample_disparity * MAX_EXTRAPOLATION
    candidates = np.einsum("pi,pki->pk", rays, samples.planes[index]).clip(low, high)
    result = weighted_median(candidates, 1 / (distance**2 + MIN_DISTANCE**2))
    return 1.0 / cv2.medianBlur(result.reshape(height, width).astype(np.float32), MEDIAN_SIZE).astype(np.float64)


def _visible_points(
    points: SparsePoints, camera: Camera, image: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return image points [S, 2], disparities [S] and indices [S] of the points that are visible in a photograph."""
    uv, z = geometry.project(points.positions, camera)
    with np.errstate(invalid="ignore"):
        in_frame = geometry.is_in_frame(uv, z, camera)
    index = np.flatnonzero(in_frame)
    uv, disparity = uv[index], 1 / z[index]
    if len(uv) <= OCCLUSION_NEIGHBORS:
        return uv, disparity, index
    _, neighbors = cKDTree(uv).query(uv, k=OCCLUSION_NEIGHBORS + 1)
    is_occluded = (disparity[neighbors[:, 1:]] > OCCLUSION_RATIO * disparity[:, None]).mean(1) > 0.5
    # The largest difference of any channel, at the best of the 3 x 3 pixels around the projection.
    point_colors, differences = points.colors[index].astype(int), []
    for shift in np.ndindex(3, 3):
        columns, rows = (uv + np.array(shift) - 1).astype(int).T
        image_colors = image[rows.clip(0, camera.height - 1), columns.clip(0, camera.width - 1)]
        differences.append(np.abs(image_colors - point_colors).max(1))
    is_visible = ~is_occluded & (np.min(differences, axis=0) <= MAX_COLOR_DIFFERENCE)
    return uv[is_visible], disparity[is_visible], index[is_visible]
