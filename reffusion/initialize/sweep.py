"""The depth of what one photograph shows, found by comparing it with its neighbours: free of the splats' own bias.

The expected depth of splats is rough, and too near wherever haze hangs before a surface. A surface that is continued
into a hole must lie within a thousandth of its depth where it should, or its joints break at the hole's border.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from scipy import ndimage

from reffusion import geometry
from reffusion.background.visibility import Witness, pixels
from reffusion.types import Camera

NEIGHBOURS = 6
LEAST, MOST = 4.0, 35.0  # degrees between a neighbour and the view, as seen from the surface
REACH, STEPS = 0.03, 21  # relative disparity to either side that is tried, in so many steps
WINDOW = 0.024  # of the image's width: what is compared
SMOOTH = 0.02  # of it: the median of the depth that is corrected, so that roughness does not tear the window
TEXTURE = 2.5  # levels of 255: deviation in a window from which anything can be told
ALIKE = 0.55  # least mean correlation with the better half of the neighbours


def swept(
    photo: np.ndarray,
    depth: np.ndarray,
    wanted: np.ndarray,
    camera: Camera,
    views: Sequence[Witness],
    photos: Mapping[str, np.ndarray],
) -> np.ndarray:
    """[H, W] float64: camera z of the wanted pixels at which the other photographs agree best; 0 where none can tell.

    Args:
        photo: [H, W, 3] uint8, the view's picture.
        depth: [H, W], its depth to within some percent, 0 where unknown. wanted: bool [H, W].
        views: the scene's; they say nothing where they show the object. photos: their pictures.
    """
    found = np.zeros(wanted.shape)
    wanted = wanted & (depth > 0)
    if not wanted.any():
        return found
    side = pixels(WINDOW, camera.width) | 1
    rows, columns = (slice(max(at.min() - side, 0), at.max() + side + 1) for at in np.nonzero(wanted))
    near = wanted[rows, columns]
    base = _evened(depth[rows, columns], near, pixels(SMOOTH, camera.width) | 1)
    rays = (geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3])[rows, columns]
    others = _neighbours(camera, camera.center + rays[near].mean(0) * np.median(base[near]), views)
    if len(others) < 2:
        return found
    grey = _grey(photo)[rows, columns]
    factors = np.linspace(1 - REACH, 1 + REACH, STEPS)
    surfaces = (camera.center + rays * (base / factor)[..., None] for factor in factors)
    scores = np.stack([_agreement(grey, points, near, others, photos, side) for points in surfaces])
    best = scores.argmax(0)
    inner = (best > 0) & (best < STEPS - 1) & near & (scores.max(0) > ALIKE)
    here, low, high = (np.take_along_axis(scores, (best + k).clip(0, STEPS - 1)[None], 0)[0] for k in (0, -1, 1))
    bend = low - 2 * here + high
    offset = np.where(bend < -1e-9, 0.5 * (low - high) / np.where(bend < -1e-9, bend, -1.0), 0.0).clip(-0.5, 0.5)
    factor = factors[0] + (best + offset) * (factors[1] - factors[0])
    found[rows, columns] = np.where(inner, base / factor, 0.0)
    return found


def _evened(depth: np.ndarray, known: np.ndarray, side: int) -> np.ndarray:
    """The median depth around each pixel, of known ones; elsewhere that of the nearest."""
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return ndimage.median_filter(depth[tuple(nearest)].astype(np.float64), side)


def _neighbours(camera: Camera, middle: np.ndarray, views: Sequence[Witness]) -> list[Witness]:
    """The views that look at a point from another side, but not from too far off; the nearest first."""
    way = lambda center: (center - middle) / max(np.linalg.norm(center - middle), 1e-12)
    angles = [np.degrees(np.arccos(np.clip(way(v.camera.center) @ way(camera.center), -1, 1))) for v in views]
    chosen = sorted((a, k) for k, a in enumerate(angles) if LEAST < a < MOST and views[k].camera.name != camera.name)
    spread = chosen[:: max(1, len(chosen) // NEIGHBOURS)][:NEIGHBOURS]
    return [views[k] for _, k in spread]


def _agreement(
    grey: np.ndarray,
    points: np.ndarray,
    known: np.ndarray,
    others: Sequence[Witness],
    photos: Mapping[str, np.ndarray],
    side: int,
) -> np.ndarray:
    """[H, W] mean correlation with the better half of the others, if the surface were these points [H, W, 3]."""
    mean = lambda values: cv2.boxFilter(values, -1, (side, side), borderType=cv2.BORDER_CONSTANT)
    scores = []
    for view in others:
        uv, z = geometry.project(points.reshape(-1, 3), view.camera)
        at = uv.reshape(*grey.shape, 2).astype(np.float32) - np.float32(0.5)
        other = cv2.remap(_grey(photos[view.camera.name]), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        masked, inside = geometry.sample_nearest(view.hidden, uv)
        shown = (inside & ~masked & (z > 0)).reshape(grey.shape) & known
        weight = shown.astype(np.float32)
        total = np.maximum(mean(weight), 1e-6)
        a, b = (np.where(shown, image, 0) for image in (grey, other))
        mean_a, mean_b = mean(a) / total, mean(b) / total
        var_a, var_b = mean(a * a) / total - mean_a**2, mean(b * b) / total - mean_b**2
        both = mean(a * b) / total - mean_a * mean_b
        told = shown & (total > 0.3) & (var_a > TEXTURE**2) & (var_b > TEXTURE**2)
        scores.append(np.where(told, both / np.sqrt(np.maximum(var_a * var_b, 1e-6)), -1.0))
    return np.sort(scores, axis=0)[-((len(scores) + 1) // 2) :].mean(0)


def _grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
