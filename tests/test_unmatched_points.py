"""Initial points where no match between views gives one: at the depth beside them, and not before what others see."""

import numpy as np
from scenes.cameras import make_camera, project_points

from reffusion.fit.unmatched import CELL, REACH, place_unmatched

SIZE, FOCAL, DEPTH = (160, 120), 150.0, 3.0
HERE = make_camera("here", SIZE, FOCAL, (0.0, 0.0, 0.0), np.eye(3))


def wall(depth: float, columns: tuple[float, float], camera=HERE) -> np.ndarray:
    """Return a point for each second pixel of some columns of a camera at the origin, at a depth."""
    x, y = np.meshgrid(np.arange(*columns, 2.0), np.arange(1.0, SIZE[1], 2.0))
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    return (rays * depth).reshape(-1, 3)


def picture() -> np.ndarray:
    """Return uint8 [H, W, 3] whose red is the column and whose green is the row."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    return np.stack([x, y, np.zeros_like(x)], -1).astype(np.uint8)


def test_points_continue_the_surface_beside_them():
    added, colors = place_unmatched([HERE], {"here": picture()}, wall(DEPTH, (0, 80)))
    places = project_points(added, HERE)
    np.testing.assert_allclose(added[:, 2], DEPTH, rtol=1e-9)
    assert places[:, 0].min() > 80 + (REACH - 1) * CELL
    assert len(added) == len(np.unique(places // CELL, axis=0)) > 0.8 * (80 - REACH * CELL) * SIZE[1] / CELL**2
    np.testing.assert_allclose(colors[:, :2], places, atol=CELL)


def test_no_point_stands_before_what_another_view_sees():
    """Beside a pole lies forest that one view alone shows; another view sees a far wall through the same place."""
    there = make_camera("there", SIZE, FOCAL, (1.5, 0.0, 0.0), np.eye(3))
    far = wall(9.0, (0, SIZE[0])) + np.array([1.5, 0.0, 0.0])
    far = far[project_points(far, HERE)[:, 0] > SIZE[0]]
    added, _ = place_unmatched(
        [HERE, there], {"here": picture(), "there": picture()}, np.concatenate([wall(DEPTH, (0, 40)), far])
    )
    assert len(added)
    shown = project_points(added, there)
    before = (added[:, 2] < 0.9 * 9.0) & (shown > 0).all(1) & (shown < SIZE).all(1)
    seen = np.unique((project_points(far, there) // CELL).astype(int), axis=0)
    assert not any((cell == seen).all(1).any() for cell in (shown[before] // CELL).astype(int))


def test_views_that_show_points_everywhere_or_nowhere_get_none():
    for points in (wall(DEPTH, (0, SIZE[0])), np.array([[0.0, 0.0, -1.0]])):
        added, colors = place_unmatched([HERE], {"here": picture()}, points)
        assert added.shape == (0, 3) and colors.shape == (0, 3)
