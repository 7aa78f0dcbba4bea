"""Steps of a depth map are sharp: no pixel has a depth between a surface and the surface behind it."""

import cv2
import numpy as np
import pytest
from scenes import wall_scene
from scenes.cameras import make_camera

from reffusion import geometry
from reffusion.depth.discontinuities import beside_steps, sharpen_steps
from reffusion.gaussians.surfels import surface_normals

SHAPE = (120, 160)
EVERYWHERE = np.ones(SHAPE, bool)


def floor_and_box():
    """Return a picture of a box on a floor, the true depth [H, W], and the pixels of the box."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    box = (abs(columns - 70) < 25) & (abs(rows - 60) < 30)
    floor = 1 / (0.1 + 0.003 * rows)
    noise = np.random.default_rng(0).normal(0, 8, (*SHAPE, 3))
    picture = (np.where(box[..., None], (150, 90, 60), (60, 80, 140)) + noise).clip(0, 255).astype(np.uint8)
    return picture, np.where(box, 1.9, floor), box


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.003, 0.0), (-0.0005, 0.002)])
def test_a_plane_of_any_slant_has_no_steps(slope):
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth = 1 / (0.3 + slope[0] * rows + slope[1] * columns)
    assert not beside_steps(depth).any()
    picture = np.random.default_rng(0).integers(0, 255, (*SHAPE, 3)).astype(np.uint8)
    assert (sharpen_steps(depth, picture, EVERYWHERE) == depth).all()


def test_a_ramp_between_two_surfaces_becomes_a_step_where_the_picture_has_its_edge():
    picture, depth, _ = floor_and_box()
    blurred = 1 / cv2.GaussianBlur(1 / depth, (0, 0), 1.0)
    wrong = lambda found: np.abs(found / depth - 1) > 0.05
    assert wrong(blurred).sum() > 300
    assert wrong(sharpen_steps(blurred, picture, EVERYWHERE)).sum() < 0.03 * wrong(blurred).sum()


def test_pixels_away_from_steps_keep_their_depth():
    picture, depth, box = floor_and_box()
    far = cv2.distanceTransform(
        (box ^ (cv2.erode(box.astype(np.uint8), np.ones((3, 3))) > 0)).astype(np.uint8) ^ 1, 2, 5
    )
    assert (sharpen_steps(depth, picture, EVERYWHERE) == depth)[far > 6].all()


def test_pixels_between_two_steps_face_the_camera():
    """A single pixel in front of a slanted plane has no surface that gives its slope."""
    view = make_camera("v", (64, 64), wall_scene.FOCAL, (0, 0, 0), np.eye(3))
    depth = 1 / (0.3 + 0.002 * np.mgrid[:64, :64][0])
    depth[30, 40] = 1.5
    normals = surface_normals(depth, view)
    direction = -geometry.pixel_rays(view)[30, 40]
    assert normals[30, 40] @ (0, 0, -1) > 0.999 and normals[30, 40] @ direction > 0.9
    assert normals[30, 38] @ normals[10, 10] > 0.999
