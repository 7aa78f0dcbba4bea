"""Projection against its inverse, and the exact limits of the alignment of depth."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reffusion import geometry
from reffusion.types import Camera


def camera(width=40, height=30, seed=0):
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = rng.normal(size=3)
    return Camera("view", width, height, 35.0, 33.0, 19.2, 16.1, pose)


def test_unproject_inverts_project():
    view = camera()
    depth = np.random.default_rng(1).uniform(0.5, 4.0, (30, 40))
    uv, z = geometry.project(geometry.unproject(depth, view), view)
    rows, columns = np.mgrid[:30, :40]
    np.testing.assert_allclose(uv, np.stack([columns + 0.5, rows + 0.5], -1), atol=1e-10)
    np.testing.assert_allclose(z, depth, atol=1e-12)


def test_project_agrees_with_the_matrix_and_never_mirrors_points_behind():
    view = camera()
    ahead = view.center + 2.0 * view.world_to_camera[2, :3]
    (uv, z) = geometry.project(np.stack([ahead, 2 * view.center - ahead]), view)
    np.testing.assert_allclose(uv[0], [view.cx, view.cy], atol=1e-10)
    np.testing.assert_allclose(z, [2.0, -2.0], atol=1e-12)
    assert np.isnan(uv[1]).all()


def test_resized_views_see_the_same_points():
    view = camera()
    points = geometry.unproject(np.full((30, 40), 2.0), view)
    np.testing.assert_allclose(
        geometry.project(points, view.resized(80, 60))[0], 2 * geometry.project(points, view)[0], atol=1e-9
    )


def test_unproject_refuses_a_map_of_another_size():
    with pytest.raises(ValueError, match="view view is"):
        geometry.unproject(np.ones((4, 4)), camera())


def test_samples_outside_are_told():
    image = np.arange(6).reshape(2, 3)
    uv = np.array([[0.0, 0.0], [2.9, 1.9], [3.0, 0.5], [-0.1, 0.5], [np.nan, np.nan]])
    values, inside = geometry.sample_nearest(image, uv)
    assert inside.tolist() == [True, True, False, False, False]
    assert values[:2].tolist() == [0, 5]


@pytest.mark.parametrize("offset", [0.0, 1e4])
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e9])
def test_alignment_recovers_scale_and_offset_in_any_unit(offset, unit):
    x = np.random.default_rng(0).normal(size=(8, 9)) * unit + offset * unit
    fitted = geometry.align(x, -3.0 * x / unit + 7.0)
    assert fitted.scale == pytest.approx(-3.0 / unit, rel=1e-9)
    np.testing.assert_allclose(fitted.apply(x), -3.0 * x / unit + 7.0, rtol=1e-9, atol=1e-8)


def test_alignment_minimises_squares_on_known_pixels_only():
    rng = np.random.default_rng(0)
    x, w = rng.normal(size=50), (rng.random(50) > 0.3).astype(float)
    y = 2.0 * x + rng.normal(size=50)
    fitted = geometry.align(x, np.where(w > 0, y, 1e9), w)
    slope, intercept = np.polyfit(x[w > 0], y[w > 0], 1)
    assert (fitted.scale, fitted.offset) == pytest.approx((slope, intercept))
    assert fitted.residual == pytest.approx(np.sqrt(np.mean((y - fitted.apply(x))[w > 0] ** 2)))


def test_robust_alignment_lets_go_of_outliers():
    rng = np.random.default_rng(0)
    x = rng.normal(size=300)
    y = 2.0 * x + 1.0 + 1e-3 * rng.normal(size=300)
    y[:75] += 5.0
    fitted = geometry.align(x, y, robust=True)
    assert (fitted.scale, fitted.offset) == pytest.approx((2.0, 1.0), abs=1e-3)
    assert abs(geometry.align(x, y).offset - 1.0) > 1.0


@pytest.mark.parametrize(
    ("x", "weights", "message"),
    [
        (np.array([1.0, 2.0, 3.0]), None, "at least 4"),
        (np.arange(9.0), np.arange(9) < 3, "at least 4"),
        (np.full(9, 2.5), None, "constant"),
        (1e5 + 1e-7 * np.arange(9.0), None, "constant"),
        (np.array([1.0, 2.0, 3.0, np.nan, 5.0]), None, "not finite"),
    ],
)
def test_degenerate_alignments_are_refused(x, weights, message):
    with pytest.raises(ValueError, match=message):
        geometry.align(x, np.ones_like(x), weights)


def test_disparity_and_depth_are_aligned_each_in_its_space():
    rng = np.random.default_rng(0)
    depth = rng.uniform(1.0, 5.0, (10, 12))
    known = rng.random((10, 12)) > 0.4
    estimate = (1.0 / depth - 0.05) * 40.0
    np.testing.assert_allclose(geometry.align_depth(estimate, depth, known), depth, rtol=1e-9)
    np.testing.assert_allclose(geometry.align_depth(3.0 * depth + 1, depth, known, space="depth"), depth, rtol=1e-9)
    with pytest.raises(ValueError, match="is it depth"):
        geometry.align_depth(depth, depth, known, space="disparity")


def test_alignment_beyond_infinity_stays_finite():
    depth = np.array([[1.0, 2.0, 4.0, 4.0], [1.0, 2.0, 4.0, 4.0]])
    estimate = 1.0 / depth
    estimate[:, 3] = -1.0
    known = np.ones_like(depth)
    known[:, 3] = 0
    assert geometry.align_depth(estimate, depth, known)[0].tolist() == pytest.approx([1.0, 2.0, 4.0, 4.0])
