"""Plane sweep stereo: the depth of one photograph around a hole, found by comparing it with neighboring photographs.

The rendered depth of Gaussians is rough, and too small wherever faint Gaussians float in front of a surface. But a
surface that continues into a hole must be accurate to a thousandth of its depth, or a step shows at the hole's border.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy import ndimage

from reffusion import geometry, morphology
from reffusion.background.continuation import align_plane
from reffusion.background.model import Background
from reffusion.background.visibility import DepthView
from reffusion.io.images import to_gray
from reffusion.types import Camera

NEIGHBORS = 6  # neighboring photographs that are compared at most
MIN_ANGLE, MAX_ANGLE = 4.0, 35.0  # degrees between a neighbor and the view, as seen from the surface
RANGE, STEPS = 0.03, 21  # relative disparity that is searched to either side, and the number of disparities tried
WINDOW = 0.024  # of the image's width: side of the compared window
SMOOTHING = 0.02  # of the image's width: side of the median filter of the initial depth; rough depth distorts windows
MIN_CONTRAST = 2.5  # levels of 255: standard deviation in a window below which the window is too plain to be compared
MIN_CORRELATION = 0.55  # smallest mean correlation with the better half of the neighbors at which depth is accepted
RING = 0.1  # of the image's width: width of the ring around a hole in which depth is searched


def refine_background(background: Background, camera: Camera, hole: np.ndarray) -> tuple[Background, np.ndarray]:
    """Return the background with the depth of one view, and all planes, corrected around a hole by plane sweep stereo.

    Args:
        background: the photographs, depth views and planes around the object.
        camera: the view.
        hole: bool [H, W], the pixels to be filled. Depth is searched in a ring around the hole and the object, outside
            the hole.

    Returns:
        The background with corrected depth and planes, and bool [H, W], the pixels at which the sweep found depth.
    """
    depth = background.photographed_depth(camera)
    ring = morphology.dilate(hole | background.masks[camera.name], RING) & ~hole & (depth > 0)
    photos = background.photos
    swept = sweep_depth(photos[camera.name], depth, ring, camera, background.views, photos)
    found = swept > 0
    improve = lambda view: replace(view, depth=np.where(found, swept, view.depth).astype(view.depth.dtype))
    views = [improve(view) if view.camera.name == camera.name else view for view in background.views]
    planes = [align_plane(plane, swept, camera, hole) for plane in background.planes]
    return replace(background, views=views, planes=planes), found


def sweep_depth(
    photo: np.ndarray,
    depth: np.ndarray,
    pixels: np.ndarray,
    camera: Camera,
    views: Sequence[DepthView],
    photos: Mapping[str, np.ndarray],
) -> np.ndarray:
    """Return [H, W] float64, the camera z at which the other photographs agree best with the view's.

    Args:
        photo: [H, W, 3] uint8, the photograph of the view.
        depth: [H, W], approximate depth of the view, correct to within `RANGE`; 0 where unknown.
        pixels: bool [H, W], the pixels whose depth is searched.
        camera: the view.
        views: depth views of the scene, from which neighbors are chosen. Their masked pixels (the object's) do not
            count.
        photos: view name -> uint8 [H, W, 3], the photographs of `views`.

    Returns:
        The depth; 0 outside `pixels`, and where no depth agrees well enough. All 0 if there are fewer than two
        neighbors.
    """
    found = np.zeros(pixels.shape)
    pixels = pixels & (depth > 0)
    if not pixels.any():
        return found
    side = morphology.to_pixels(WINDOW, camera.width) | 1
    rows, columns = (slice(max(at.min() - side, 0), at.max() + side + 1) for at in np.nonzero(pixels))
    known = pixels[rows, columns]
    base = _smooth_depth(depth[rows, columns], known, morphology.to_pixels(SMOOTHING, camera.width) | 1)
    rays = (geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3])[rows, columns]
    neighbors = _select_neighbors(camera, camera.center + rays[known].mean(0) * np.median(base[known]), views)
    if len(neighbors) < 2:
        return found
    gray = to_gray(photo)[rows, columns]
    factors = np.linspace(1 - RANGE, 1 + RANGE, STEPS)
    surfaces = (camera.center + rays * (base / factor)[..., None] for factor in factors)
    scores = np.stack([_correlation(gray, points, known, neighbors, photos, side) for points in surfaces])
    best = scores.argmax(0)
    inner = (best > 0) & (best < STEPS - 1) & known & (scores.max(0) > MIN_CORRELATION)
    here, low, high = (np.take_along_axis(scores, (best + k).clip(0, STEPS - 1)[None], 0)[0] for k in (0, -1, 1))
    curvature = low - 2 * here + high
    is_peak = curvature < -1e-9
    offset = np.where(is_peak, 0.5 * (low - high) / np.where(is_peak, curvature, -1.0), 0.0).clip(-0.5, 0.5)
    factor = factors[0] + (best + offset) * (factors[1] - factors[0])
    found[rows, columns] = np.where(inner, base / factor, 0.0)
    return found


def _smooth_depth(depth: np.ndarray, known: np.ndarray, side: int) -> np.ndarray:
    """Return the depth map [H, W] after a median filter of `side` px, with pixels that are not `known` filled first."""
    # Before, each pixel that is not `known` takes the depth of the nearest known pixel.
    return ndimage.median_filter(depth[morphology.nearest_known(known)].astype(np.float64), side)


def _select_neighbors(camera: Camera, point: np.ndarray, views: Sequence[DepthView]) -> list[DepthView]:
    """Return up to `NEIGHBORS` views whose direction to a point is `MIN_ANGLE` to `MAX_ANGLE` off that of `camera`."""
    direction = lambda center: (center - point) / max(np.linalg.norm(center - point), 1e-12)
    angles = [
        np.degrees(np.arccos(np.clip(direction(v.camera.center) @ direction(camera.center), -1, 1))) for v in views
    ]
    # The angle, in degrees, is the one at the point between the camera and the view. From twice
    # `NEIGHBORS` views on, every second or further one is taken, by increasing angle.
    chosen = sorted(
        (angle, k)
        for k, angle in enumerate(angles)
        if MIN_ANGLE < angle < MAX_ANGLE and views[k].camera.name != camera.name
    )
    spread = chosen[:: max(1, len(chosen) // NEIGHBORS)][:NEIGHBORS]
    return [views[k] for _, k in spread]


def _correlation(
    gray: np.ndarray,
    points: np.ndarray,
    known: np.ndarray,
    neighbors: Sequence[DepthView],
    photos: Mapping[str, np.ndarray],
    side: int,
) -> np.ndarray:
    """Return [H, W] in [-1, 1], how well the neighbors' photographs agree with the view's for a surface at `points`."""
    mean = lambda values: cv2.boxFilter(values, -1, (side, side), borderType=cv2.BORDER_CONSTANT)
    # The value is the normalized correlation of windows of `side` px over the `known` pixels, averaged over the better
    # half of the neighbors. A neighbor whose window cannot be compared counts as -1.
    scores = []
    for view in neighbors:
        uv, z = geometry.project(points.reshape(-1, 3), view.camera)
        at = uv.reshape(*gray.shape, 2).astype(np.float32) - np.float32(0.5)
        other = cv2.remap(to_gray(photos[view.camera.name]), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        masked, inside = geometry.sample_nearest(view.masked, uv)
        visible = (inside & ~masked & (z > 0)).reshape(gray.shape) & known
        weight = visible.astype(np.float32)
        total = np.maximum(mean(weight), 1e-6)
        a, b = (np.where(visible, image, 0) for image in (gray, other))
        mean_a, mean_b = mean(a) / total, mean(b) / total
        var_a, var_b = mean(a * a) / total - mean_a**2, mean(b * b) / total - mean_b**2
        covariance = mean(a * b) / total - mean_a * mean_b
        tells = visible & (total > 0.3) & (var_a > MIN_CONTRAST**2) & (var_b > MIN_CONTRAST**2)
        scores.append(np.where(tells, covariance / np.sqrt(np.maximum(var_a * var_b, 1e-6)), -1.0))
    return np.sort(scores, axis=0)[-((len(scores) + 1) // 2) :].mean(0)
