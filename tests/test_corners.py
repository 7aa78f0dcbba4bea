"""The narrow third face of a corner, here the side of a step in a wall, is found and continued behind an object."""

import numpy as np
import pytest
from scenes.cameras import look_at_camera, meet_box, world_rays

from reffusion.background.continuation import find_planes
from reffusion.background.corners import find_third_faces
from reffusion.background.visibility import DepthView, depth_range

NO_POINTS = np.zeros((0, 3))
SIZE, DEEP = 160, 0.35  # picture size in px; depth of the step between the front wall and the wall behind
LOW, HIGH = np.array([-0.25, -0.45, 0.0]), np.array([0.35, -0.15, 0.45])  # corners of the box before the edge


def edge_camera(turn):
    """Return a camera that looks at the edge, `turn` radians to the left of the wall's normal, where the side shows."""
    center = (-2.2 * np.sin(turn), -2.2 * np.cos(turn), 0.9)
    return look_at_camera(f"v{turn:.2f}", center, (0.0, 0.0, 0.3), (SIZE, SIZE), 170.0)


def edge_depth_view(view, step=0.0):
    """Return the depth of floor and walls, masked where the box is; `step`: height of every second floor board."""
    rays = world_rays(view)
    with np.errstate(divide="ignore", invalid="ignore"):
        floor, front, behind, side = (
            (value - view.center[axis]) / rays[..., axis] for axis, value in ((2, 0.0), (1, 0.0), (1, DEEP), (0, 0.0))
        )
        place = lambda way: view.center + rays * way[..., None]
        raised = (step - view.center[2]) / rays[..., 2]
        floor = np.where((raised > 0) & (place(raised)[..., 0] % 0.3 < 0.15), raised, floor)
        front = np.where((front > 0) & (place(front)[..., 0] > 0), front, np.inf)
        beside = place(side)[..., 1]
        side = np.where((side > 0) & (beside > 0) & (beside < DEEP), side, np.inf)
        depth = np.min([np.where(each > 0, each, np.inf) for each in (floor, front, behind, side)], axis=0)
    return DepthView.from_range(view, depth, depth_range(depth.astype(np.float32)), meet_box(view, LOW, HIGH)[1])


@pytest.fixture(scope="module")
def wall_planes():
    views = [edge_depth_view(edge_camera(turn)) for turn in np.linspace(0.1, 0.6, 12)]
    return find_planes((LOW + HIGH) / 2, 0.3, views, NO_POINTS)


def test_the_side_of_a_wall_goes_on_behind_a_thing_down_to_the_floor_and_not_into_the_wall(wall_planes):
    sides = [plane for plane in wall_planes if abs(plane.normal[0]) > 0.99]
    assert len(sides) == 1 and abs(sides[0].offset) < 0.01
    _, y, z = np.moveaxis(sides[0].cell_centers, -1, 0)
    known = sides[0].continued | sides[0].seen
    assert known[(y > 0.03) & (y < DEEP - 0.03) & (z > 0.03) & (z < 0.6)].mean() > 0.95
    assert sides[0].continued.sum() > 100
    assert not known[(y < -0.05) | (y > DEEP + 0.05) | (z < -0.05)].any()


def test_leaves_have_no_third_face():
    draws = np.random.default_rng(0)
    found = [(np.array([0.0, 0.0, 1.0]), 0.0), (np.array([0.0, 1.0, 0.0]), 0.0)]
    leaves = draws.uniform(-1, 1, (4000, 3))
    face = np.stack([draws.normal(0.1, 0.004, 200), *draws.uniform(-0.5, 0.5, (2, 200))], 1)
    free = np.ones(4200, bool)
    find_faces = lambda samples: find_third_faces(samples, free[: len(samples)], found, np.zeros(3), 0.5, 0.02)
    assert find_faces(leaves) == []
    ((normal, height),) = find_faces(np.concatenate([leaves[:1500], face]))
    assert height * normal[0] == pytest.approx(0.1, abs=0.005)
    assert find_third_faces(face, free[:200], found[:1], np.zeros(3), 0.5, 0.02) == [], "one plane has no corner"


@pytest.mark.integration
def test_sparse_points_tell_where_planes_lie_that_are_drawn_too_near():
    views = []
    for turn in np.linspace(0.1, 0.6, 12):
        true = edge_depth_view(edge_camera(turn))
        # As in haze, the rendered depth is too small, by up to 2 % in the top row.
        rows = np.linspace(0, 0.02, SIZE)[:, None]
        depth = true.depth * (1 - rows[::-1])
        views.append(DepthView.from_range(true.camera, depth, depth_range(depth.astype(np.float32)), true.masked))
    draws, count = np.random.default_rng(0), 150
    floor = np.stack([*draws.uniform(-0.5, 0.5, (2, count)), np.zeros(count)], 1)
    front = np.stack([draws.uniform(0, 0.5, count), np.zeros(count), draws.uniform(0, 0.6, count)], 1)
    points = np.concatenate([floor, front]) + draws.normal(0, 1e-3, (2 * count, 3))
    points = np.concatenate([points, draws.uniform(-0.6, 0.6, (100, 3))])
    with_points, without_points = (find_planes((LOW + HIGH) / 2, 0.3, views, each) for each in (points, NO_POINTS))
    for axis in (2, 1):
        off = lambda plane, axis=axis: np.degrees(np.arccos(abs(plane.normal[axis])))
        of_points, of_views = (min(planes, key=off) for planes in (with_points, without_points))
        assert off(of_points) < 0.2 and abs(of_points.offset) < 2e-3
        assert off(of_views) > 2 * off(of_points)
    line = np.stack([np.linspace(-0.5, 0.5, 200), np.zeros(200), np.zeros(200)], 1)  # does not determine a plane
    few = find_planes((LOW + HIGH) / 2, 0.3, views, line)
    assert all(np.allclose(a.normal, b.normal) for a, b in zip(few, without_points, strict=True))
    grass = np.stack([*draws.uniform(-0.5, 0.5, (2, 600)), draws.uniform(-0.05, 0.05, 600)], 1)  # has no sharp height
    rough = find_planes((LOW + HIGH) / 2, 0.3, views, grass)
    assert all(np.allclose(a.normal, b.normal) for a, b in zip(rough, without_points, strict=True))


def test_a_floor_that_is_drawn_twice_is_one_unless_points_tell_a_step():
    step = 0.033
    views = [edge_depth_view(edge_camera(turn), step) for turn in np.linspace(0.1, 0.6, 12)]
    draws, count = np.random.default_rng(0), 300
    floor = np.stack([*draws.uniform(-0.5, 0.3, (2, count)), draws.normal(0, 5e-4, count)], 1)
    boards = floor[:, :1] % 0.3 < 0.15
    heights = lambda points: sorted(
        abs(plane.offset)
        for plane in find_planes(np.array([0.0, -0.3, 0.1]), 0.15, views, points)
        if abs(plane.normal[2]) > 0.99
    )
    assert heights(floor) == pytest.approx([0], abs=2e-3)
    assert heights(floor + boards * [0, 0, step]) == pytest.approx([0, step], abs=2e-3)
