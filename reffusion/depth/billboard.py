"""Depth of an object that a reference inserts without a depth map: an upright billboard with thickness."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from reffusion import geometry
from reffusion.gaussians.surfels import surface_normals
from reffusion.types import Camera

FOOT_SHARE = 0.05  # of the object's height: pixels this far above the bottom still stand on the surface below
BULGE = 0.5  # of the half width: how far the middle bulges towards the camera
# Sine of the angle between the viewing direction and the surface's normal. Below it the camera looks at the surface
# head-on, as at a wall, and the billboard faces the camera instead of standing upright.
MIN_SINE = 0.3
MAX_ANGLE_DEG = 30  # degrees from the reference's view; beyond this the missing back becomes visible


def billboard_depth(object_pixels: np.ndarray, depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Return a copy of `depth`, [H, W] camera z, with the depth of upright billboards at `object_pixels`.

    Each connected component of the object becomes one billboard. The billboard stands upright on the surface below its
    lowest pixels, or faces the camera if the camera looks at this surface almost head-on, as at a wall. It bulges
    towards the camera inside its outline, and is nowhere farther than `depth`.

    Args:
        object_pixels: bool [H, W], True at pixels of the inserted object.
        depth: [H, W] float64 > 0, of the scene without the object.
        camera: The camera of the view.
    """
    components, count = ndimage.label(object_pixels, np.ones((3, 3)))
    normals, rays = surface_normals(depth, camera), geometry.pixel_rays(camera)
    result = depth.copy()
    for component in (components == k for k in range(1, count + 1)):
        foot_point, normal = _foot(component, depth, normals, camera)
        view_direction = foot_point - camera.center
        foot_depth = camera.world_to_camera[2, :3] @ view_direction
        facing_normal = _billboard_normal(view_direction / np.linalg.norm(view_direction), normal)
        camera_normal = facing_normal @ camera.world_to_camera[:3, :3].T  # in camera axes
        plane_depth = (facing_normal @ view_direction) / np.minimum(rays @ camera_normal, -1e-3)
        bulge_depth = _profile(component) * BULGE * (component.sum(1).max() / 2) * foot_depth / camera.fx
        object_depth = np.clip(plane_depth, 0.5 * foot_depth, 2 * foot_depth) - bulge_depth
        result[component] = np.minimum(object_depth, depth)[component]
    return result


def _foot(
    component: np.ndarray, depth: np.ndarray, normals: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Return the point where an object meets the surface below it, and the unit normal of this surface, [3] each."""
    rows, columns = np.nonzero(component)
    lowest = np.full(component.shape[1], -1)
    np.maximum.at(lowest, columns, rows)
    foot_columns = np.flatnonzero(lowest >= rows.max() - FOOT_SHARE * (np.ptp(rows) + 1))
    # Point and normal are medians over the surface one pixel below the lowest pixels of the object. `depth` and
    # `normals` are those of the scene without the object.
    below = np.minimum(lowest[foot_columns] + 1, component.shape[0] - 1), foot_columns
    normal = np.median(normals[below], 0)
    return np.median(geometry.unproject(depth, camera)[below], 0), normal / np.linalg.norm(normal)


def _billboard_normal(view_direction: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the unit normal [3] of a plane that stands upright on a surface and is turned towards the camera."""
    # `view_direction` is the unit vector from the camera to the foot of the object.
    across = view_direction - (view_direction @ normal) * normal
    length = np.linalg.norm(across)
    # If the camera looks at the surface almost head-on, as at a wall, the plane faces the camera.
    return -view_direction if length < MIN_SINE else -across / length


def _profile(component: np.ndarray) -> np.ndarray:
    """Return [H, W] in [0, 1], the height of a rounded bulge: 0 at the outline of a component and 1 in its middle."""
    distance = np.maximum(ndimage.distance_transform_edt(np.pad(component, 1))[1:-1, 1:-1] - 1, 0)
    normalized = distance / max(distance.max(), 1.0)
    return np.sqrt(1 - (1 - normalized) ** 2)
