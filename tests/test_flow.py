"""3D points from optical flow: exact for exact matches, robust to a wrong match, and far away without parallax."""

import numpy as np
import pytest
from scenes.cameras import make_camera, project_points, world_rays, yaw

from reffusion.capture import flow
from reffusion.io.images import resize_image
from reffusion.types import Camera

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0


def rig_camera(name: str, x: float, y: float = 0.0, turn: float = 0.0) -> Camera:
    """Return a camera at (x, y, -1) that looks along z, then rotated about y by `turn` radians."""
    return make_camera(name, (WIDTH, HEIGHT), FOCAL, (x, y, -1.0), yaw(turn))


CAMERAS = [
    rig_camera("a", 0.0),
    rig_camera("b", 0.08),
    rig_camera("c", -0.07, 0.03, 0.05),
    rig_camera("d", 0.02, -0.09),
]


def make_matches(places_there, here, seen=None) -> flow.Matches:
    """Return the matches of view a with the other views.

    Args:
        places_there: positions in px of the matches in each other view, the views along the first axis.
        here: positions in px in view a.
        seen: bool, True for valid matches; None if all are valid.
    """
    places = np.array(places_there)
    names = tuple(view.name for view in CAMERAS[1:])
    return flow.Matches("a", here, names, places, np.ones(places.shape[:2], bool) if seen is None else seen)


BY_NAME = {view.name: view for view in CAMERAS}


def random_points() -> np.ndarray:
    return np.random.default_rng(0).uniform((-0.3, -0.2, -0.2), (0.3, 0.2, 8.0), (500, 3))


def test_exact_matches_give_exact_depths():
    points, others = random_points(), CAMERAS[1:]
    matches = make_matches([project_points(points, o) for o in others], project_points(points, CAMERAS[0]))
    depth, known = flow.depths_from_matches(matches, BY_NAME)
    assert known.all()
    np.testing.assert_allclose(depth, points[:, 2] + 1, rtol=1e-6)
    assert np.abs(flow.flow_residuals(matches, BY_NAME, depth)).max() < 1e-3
    np.testing.assert_allclose(flow.unproject(CAMERAS[0], matches.pixels, depth), points, atol=1e-5)


def test_a_wrong_match_in_one_view_does_not_matter():
    points, others = random_points(), CAMERAS[1:]
    places = [project_points(points, o) for o in others]
    places[1] = places[1] + (25.0, -14.0)
    depth, known = flow.depths_from_matches(make_matches(places, project_points(points, CAMERAS[0])), BY_NAME)
    assert known.mean() > 0.8
    assert (np.abs(depth / (points[:, 2] + 1) - 1) < 1e-3)[known].mean() > 0.97


def test_what_moves_or_matches_nothing_is_left_out():
    points, others, rng = random_points(), CAMERAS[1:], np.random.default_rng(1)
    here = project_points(points, CAMERAS[0])
    scattered = [project_points(points, o) + rng.normal(0, 30, (len(points), 2)) for o in others]
    assert flow.depths_from_matches(make_matches(scattered, here), BY_NAME)[1].mean() < 0.05
    nowhere = make_matches([project_points(points, o) for o in others], here, np.zeros((3, len(points)), bool))
    assert not flow.depths_from_matches(nowhere, BY_NAME)[1].any()


def test_without_parallax_a_point_is_far_and_one_that_would_be_behind_is_none():
    directions = np.random.default_rng(2).uniform((-0.3, -0.2, 1.0), (0.3, 0.2, 1.0), (200, 3))
    others, here = CAMERAS[1:], project_points(CAMERAS[0].center + directions, CAMERAS[0])
    depth, known = flow.depths_from_matches(
        make_matches([project_points(o.center + directions, o) for o in others], here), BY_NAME
    )
    assert known.all() and (depth > 1e4).all()
    behind = [project_points(o.center + directions + 0.3 * (o.center - CAMERAS[0].center), o) for o in others]
    assert not flow.depths_from_matches(make_matches(behind, here), BY_NAME)[1].any()


def paint_slope(slope: float) -> dict[str, np.ndarray]:
    """Return view name -> picture of the plane z = 1 + slope x, whose texture is noise at several scales."""
    rng, pictures = np.random.default_rng(3), {}
    waves = rng.normal(0, 14, (60, 2)), rng.uniform(0, 6.3, (60, 3))
    for view in CAMERAS:
        rays = world_rays(view)
        reach = (1 + slope * view.center[0] - view.center[2]) / (rays[..., 2] - slope * rays[..., 0])
        at = view.center + rays * reach[..., None]
        field = np.sin((at[..., :2] @ waves[0].T)[..., None] + waves[1]).sum(2) / 60**0.5
        pictures[view.name] = (127 + 70 * field).clip(0, 255).astype(np.uint8)
    return pictures


@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_a_painted_plane_comes_back(slope):
    points, colors = flow.triangulate_points(CAMERAS, paint_slope(slope), 3)
    cells = WIDTH * HEIGHT / 9
    assert 0.6 * cells < len(points) < 2 * cells  # later views add points that the first view does not see
    assert colors.shape == points.shape and colors.dtype == np.uint8
    away = np.abs(points[:, 2] - 1 - slope * points[:, 0]) / 2
    assert np.median(away) < 0.01 and np.quantile(away, 0.95) < 0.05


def test_views_of_several_sizes_and_lenses_match(slope=0.3):
    """One view has 0.6 times the size, one is cropped to portrait format, and one is larger."""
    pictures, cameras = paint_slope(slope), []
    for view, factor, left in zip(CAMERAS, (1.0, 0.6, 1.0, 1.5), (0, 0, 30, 0), strict=True):
        size = round((WIDTH - 2 * left) * factor), round(HEIGHT * factor)
        cut = np.ascontiguousarray(pictures[view.name][:, left : WIDTH - left])
        pictures[view.name] = resize_image(cut, size)
        focal, middle = FOCAL * factor, ((WIDTH / 2 - left) * factor, HEIGHT / 2 * factor)
        cameras.append(Camera(view.name, *size, focal, focal, *middle, view.world_to_camera))
    points, _ = flow.triangulate_points(cameras, pictures, 3)
    assert len(points) > 0.6 * WIDTH * HEIGHT / 9
    away = np.abs(points[:, 2] - 1 - slope * points[:, 0]) / 2
    assert np.median(away) < 0.01 and np.quantile(away, 0.95) < 0.05


def test_plain_pictures_give_nothing():
    plain = {name: np.full_like(picture, 90) for name, picture in paint_slope(0.0).items()}
    assert len(flow.triangulate_points(CAMERAS, plain, 3)[0]) == 0


def test_lonely_views_and_opposite_ones_give_nothing():
    pictures = paint_slope(0.0)
    assert len(flow.triangulate_points(CAMERAS[:1], pictures, 3)[0]) == 0
    opposite = [CAMERAS[0], rig_camera("b", 0.1, turn=np.pi)]
    assert len(flow.triangulate_points(opposite, pictures, 3)[0]) == 0


def test_the_same_pictures_give_the_same_points():
    first, second = (flow.triangulate_points(CAMERAS, paint_slope(0.2), 4) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
