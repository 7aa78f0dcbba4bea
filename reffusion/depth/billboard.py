"""Depth of what a picture draws in front of a scene, where nothing tells it: a billboard with thickness."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from reffusion import geometry
from reffusion.gaussians.surfels import surface_normals
from reffusion.types import Camera

FOOT = 0.05  # of its height: the lowest pixels, that stand on the surface beneath
BULGE = 0.5  # of its half width: how far its middle comes towards the camera
FACING = 0.3  # least sine between the view and a surface's normal for something to stand upright on it
GOOD_WITHIN = 30  # degrees from the reference's view: further round its back is missing


def standing(drawn: np.ndarray, depth: np.ndarray, camera: Camera) -> np.ndarray:
    """[H, W] camera z: `depth`, and on `drawn` that of a standing shape.

    Each piece stands upright where its lowest pixels meet the surface that is there, and bulges towards the camera
    away from its outline. Its sides and its back are not known.

    Args:
        drawn: bool [H, W], pixels of what was drawn in. depth: [H, W] float64, above 0, of the scene without it.
    """
    pieces, count = ndimage.label(drawn, np.ones((3, 3)))
    normals, rays = surface_normals(depth, camera), geometry.pixel_rays(camera)
    found = depth.copy()
    for piece in (pieces == k for k in range(1, count + 1)):
        foot, normal = _foot(piece, depth, normals, camera)
        sight = foot - camera.center
        scale = camera.world_to_camera[2, :3] @ sight
        facing = _upright(sight / np.linalg.norm(sight), normal)
        towards = facing @ camera.world_to_camera[:3, :3].T  # the same in camera axes
        flat = (facing @ sight) / np.minimum(rays @ towards, -1e-3)
        bulge = _profile(piece) * BULGE * _half_width(piece) * scale / camera.fx
        nearer = np.clip(flat, 0.5 * scale, 2 * scale) - bulge
        found[piece] = np.minimum(nearer, depth)[piece]
    return found


def _foot(piece: np.ndarray, depth: np.ndarray, normals: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Where it stands: the middle of the surface points [3] under its lowest pixels, and their normal [3]."""
    rows, columns = np.nonzero(piece)
    lowest = np.full(piece.shape[1], -1)
    np.maximum.at(lowest, columns, rows)
    feet = np.flatnonzero(lowest >= rows.max() - FOOT * (np.ptp(rows) + 1))
    beneath = np.minimum(lowest[feet] + 1, piece.shape[0] - 1), feet
    normal = np.median(normals[beneath], 0)
    return np.median(geometry.unproject(depth, camera)[beneath], 0), normal / np.linalg.norm(normal)


def _upright(sight: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """[3] unit normal, towards the camera, of a plane that stands on a surface; on a wall it faces the camera."""
    across = sight - (sight @ normal) * normal
    length = np.linalg.norm(across)
    return -sight if length < FACING else -across / length


def _profile(piece: np.ndarray) -> np.ndarray:
    """[H, W] in [0, 1]: 0 at the outline, 1 in the middle, round between."""
    inward = np.maximum(ndimage.distance_transform_edt(np.pad(piece, 1))[1:-1, 1:-1] - 1, 0)
    share = inward / max(inward.max(), 1.0)
    return np.sqrt(1 - (1 - share) ** 2)


def _half_width(piece: np.ndarray) -> float:
    """Pixels: half the width of its widest row."""
    return piece.sum(1).max() / 2
