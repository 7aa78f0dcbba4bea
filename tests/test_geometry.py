"""Projection, unprojection, and angles between views."""

from dataclasses import replace

import numpy as np
import pytest
from scenes.cameras import make_camera
from scipy.spatial.transform import Rotation

from reffusion import geometry
from reffusion.types import Camera


def random_camera(width=40, height=30, seed=0):
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = rng.normal(size=3)
    return Camera("view", width, height, 35.0, 33.0, 19.2, 16.1, pose)


def test_unproject_inverts_project():
    view = random_camera()
    depth = np.random.default_rng(1).uniform(0.5, 4.0, (30, 40))
    uv, z = geometry.project(geometry.unproject(depth, view), view)
    rows, columns = np.mgrid[:30, :40]
    np.testing.assert_allclose(uv, np.stack([columns + 0.5, rows + 0.5], -1), atol=1e-10)
    np.testing.assert_allclose(z, depth, atol=1e-12)


def test_project_agrees_with_the_matrix_and_never_mirrors_points_behind():
    view = random_camera()
    ahead = view.center + 2.0 * view.world_to_camera[2, :3]
    (uv, z) = geometry.project(np.stack([ahead, 2 * view.center - ahead]), view)
    np.testing.assert_allclose(uv[0], [view.cx, view.cy], atol=1e-10)
    np.testing.assert_allclose(z, [2.0, -2.0], atol=1e-12)
    assert np.isnan(uv[1]).all()


def test_resized_views_see_the_same_points():
    view = random_camera()
    points = geometry.unproject(np.full((30, 40), 2.0), view)
    np.testing.assert_allclose(
        geometry.project(points, view.resized(80, 60))[0], 2 * geometry.project(points, view)[0], atol=1e-9
    )


def test_unproject_refuses_a_map_of_another_size():
    with pytest.raises(ValueError, match="view view is"):
        geometry.unproject(np.ones((4, 4)), random_camera())


def test_samples_outside_the_image_are_marked():
    image = np.arange(6).reshape(2, 3)
    uv = np.array([[0.0, 0.0], [2.9, 1.9], [3.0, 0.5], [-0.1, 0.5], [np.nan, np.nan]])
    values, inside = geometry.sample_nearest(image, uv)
    assert inside.tolist() == [True, True, False, False, False]
    assert values[:2].tolist() == [0, 5]


def off_square_camera(*center):
    """Return a camera with fx = 35 px and fy = 33 px at `center`."""
    return replace(make_camera("view", (40, 30), 35.0, center), fy=33.0)


def test_the_angle_between_views_is_the_smallest_and_is_taken_at_the_point():
    point, view = np.array([1.0, 0.0, 0.0]), off_square_camera(3.0, 0.0, 0.0)
    for degrees in (0.0, 1e-3, 40.0, 90.0, 179.0, 180.0):
        turned = np.radians(degrees)
        # The second camera is farther from the point: the distance must not change the angle.
        other = off_square_camera(1 + 5 * np.cos(turned), 5 * np.sin(turned), 0.0)
        assert geometry.angle_between_views(point, view, [other]) == pytest.approx(degrees, abs=1e-4)
    aside = [off_square_camera(1.0, 2.0, 0.0), off_square_camera(3.0, 2.0, 0.0)]
    assert geometry.angle_between_views(point, view, aside) == pytest.approx(45)
    assert geometry.angle_between_views(point * 1e-200, off_square_camera(3e-200, 0.0, 0.0), aside[:1]) <= 180
    assert geometry.angle_between_views(view.center, view, aside) == 180, "from where it stands it has no direction"
