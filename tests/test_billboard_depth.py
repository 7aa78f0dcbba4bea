"""An object that a reference adds without a depth map stands upright on the surface below the object."""

import numpy as np
from scenes.cameras import make_camera, world_rays

from reffusion import geometry
from reffusion.depth.billboard import billboard_depth
from reffusion.types import Camera

TILT = np.radians(25)  # radians; the camera looks down by this angle on a floor 1 below the camera


def tilted_floor_view() -> tuple[Camera, np.ndarray]:
    """Return a camera that looks down on a floor, and its depth map [H, W] of the floor and of a wall at z = 4."""
    c, s = np.cos(TILT), np.sin(TILT)  # world: x right, y down, z ahead
    camera = make_camera("v", (96, 72), 80.0, rotation=np.array([[1, 0, 0], [0, c, -s], [0, s, c]]))
    rays = world_rays(camera)
    with np.errstate(divide="ignore"):
        floor = np.where(rays[..., 1] > 0, 1.0 / rays[..., 1], np.inf)
    return camera, np.minimum(floor, 4.0 / rays[..., 2])


def test_an_object_stands_upright_where_it_meets_the_floor():
    camera, depth = tilted_floor_view()
    mask = np.zeros(depth.shape, bool)
    mask[20:50, 38:58] = True
    found = billboard_depth(mask, depth, camera)
    assert (found[~mask] == depth[~mask]).all() and (found[mask] <= depth[mask]).all()
    points = geometry.unproject(found, camera)
    foot, rim = points[49, 48], points[20:50, 38]
    assert abs(foot[1] - 1.0) < 0.05, "its foot is on the floor"
    assert abs(foot[2] - geometry.unproject(depth, camera)[50, 48, 2]) < 0.1
    assert np.ptp(rim[:, 2]) < 0.15 * np.ptp(rim[:, 1]), "its outline is upright"
    middle, edge = points[35, 48, 2], points[35, 38, 2]
    assert 0.05 < edge - middle < 0.2, "and its middle comes nearer by about half of half its width"


def test_an_object_on_a_wall_faces_the_camera():
    camera = make_camera("v", (96, 72), 80.0)
    depth, mask = np.full((72, 96), 2.0), np.zeros((72, 96), bool)
    mask[30:40, 40:50] = True
    found = billboard_depth(mask, depth, camera)
    assert np.isfinite(found).all() and (found[mask] <= 2.0).all() and found[mask].min() > 1.8
