"""Initial points where no match between views gives one: at the depth beside them, and not before what others see."""

import numpy as np
from scenes.cameras import make_camera, project_points, yaw

from reffusion.fit.unmatched import CELL, FARTHER, REACH, points_for_empty_cells

SIZE, FOCAL, DEPTH = (160, 120), 150.0, 3.0
HERE = make_camera("here", SIZE, FOCAL, (0.0, 0.0, 0.0), np.eye(3))


def wall(depth: float, columns: tuple[float, float]) -> np.ndarray:
    """Return a point for each second pixel of some columns of a camera at the origin, at a depth."""
    x, y = np.meshgrid(np.arange(*columns, 2.0), np.arange(1.0, SIZE[1], 2.0))
    rays = np.stack([(x - HERE.cx) / HERE.fx, (y - HERE.cy) / HERE.fy, np.ones_like(x)], -1)
    return (rays * depth).reshape(-1, 3)


def picture() -> np.ndarray:
    """Return uint8 [H, W, 3] whose red is the column and whose green is the row."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    return np.stack([x, y, np.zeros_like(x)], -1).astype(np.uint8)


def test_points_continue_the_surface_beside_them():
    added, colors = points_for_empty_cells([HERE], {"here": picture()}, wall(DEPTH, (0, 80)))
    places = project_points(added, HERE)
    np.testing.assert_allclose(added[:, 2], DEPTH, rtol=1e-9)
    assert places[:, 0].min() > 80 + (REACH - 1) * CELL
    assert len(added) == len(np.unique(places // CELL, axis=0)) > 0.8 * (80 - REACH * CELL) * SIZE[1] / CELL**2
    np.testing.assert_allclose(colors[:, :2], places, atol=CELL)


def test_no_point_stands_before_what_another_view_sees():
    """Beside a pole lies forest that one view alone shows; another view looks across, at the pole and a wall."""
    across = make_camera("across", SIZE, FOCAL, (3.0, 0.0, DEPTH), yaw(-np.pi / 2))
    x, y, z = wall(7.0, (0, SIZE[0])).T
    far = np.stack([3.0 - z, y, DEPTH + x], 1)
    pole = wall(DEPTH, (0, 40))
    points = np.concatenate([pole, far])
    added, _ = points_for_empty_cells([HERE, across], {"here": picture(), "across": picture()}, points)
    own = added[added[:, 0] > 3.0 - 7.0 + 1e-6]
    shown = project_points(own, across)
    seen = (own[:, 0] < 3.0) & (shown > 0).all(1) & (shown < SIZE).all(1)
    assert not (3.0 - own[seen, 0] < 0.9 * (3.0 - pole[:, 0].max())).any()
    powers = np.log(own[:, 2] / DEPTH) / np.log(FARTHER)
    np.testing.assert_allclose(powers, powers.round(), atol=1e-6)
    assert powers.min() > -0.5 and powers.max() > 0.5, (
        "some stay beside the pole's depth or move away, none comes nearer"
    )


def test_no_point_stands_before_a_camera_that_looks_elsewhere():
    """Where the first view shows no point stands a camera that looks to the right, at another wall."""
    aside = make_camera("aside", SIZE, FOCAL, (0.8, 0.0, DEPTH), yaw(np.pi / 2))
    x, y, z = wall(2.0, (0, SIZE[0])).T
    points = np.concatenate([wall(DEPTH, (0, 80)), np.stack([z, y, -x], 1) + aside.center])
    added, _ = points_for_empty_cells([HERE, aside], {"here": picture(), "aside": picture()}, points)
    assert len(added) and np.linalg.norm(added - aside.center, axis=1).min() >= 0.5 * 2.0


def test_views_that_show_points_everywhere_or_nowhere_get_none():
    for points in (wall(DEPTH, (0, SIZE[0])), np.array([[0.0, 0.0, -1.0]])):
        added, colors = points_for_empty_cells([HERE], {"here": picture()}, points)
        assert added.shape == (0, 3) and colors.shape == (0, 3)
