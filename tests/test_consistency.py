"""Color differences of neighboring views after reprojection, on planes whose warp is known in closed form."""

import numpy as np
import pytest
from scenes.cameras import make_camera, world_rays, yaw
from scenes.images import rectangle_mask

from reffusion.metrics import consistency
from reffusion.metrics.consistency import RenderedView

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0


def turned_camera(name, x=0.0, angle=0.0):
    """Return a camera at (x, 0, 0), turned about the vertical axis by `angle` radians."""
    return make_camera(name, (WIDTH, HEIGHT), FOCAL, (x, 0.0, 0.0), yaw(angle))


def render_plane(view, slope=0.0, shift=0.0):
    """Return depth [H, W] and picture of the plane z = 2 + slope x; colors are linear in x and y, plus `shift`."""
    rays = world_rays(view)
    start = view.center
    depth = (2 + slope * start[0] - start[2]) / (rays[..., 2] - slope * rays[..., 0])
    points = start + depth[..., None] * rays
    color = np.stack([0.5 + 0.2 * points[..., 0], 0.5 + 0.3 * points[..., 1], np.full(depth.shape, 0.3)], -1) + shift
    return depth, np.round(color * 255).astype(np.uint8)


def plane_view(view, mask=None, **scene):
    depth, picture = render_plane(view, **scene)
    return RenderedView(view, picture, depth, np.ones((HEIGHT, WIDTH), bool) if mask is None else mask)


def inner_mask():
    return rectangle_mask((HEIGHT, WIDTH), (10, 40), (20, 44))


def test_views_of_one_plane_agree_to_the_rounding_of_their_pictures():
    for other in (turned_camera("b", 0.2), turned_camera("b", -0.1, 0.05)):
        for slope in (0.0, 0.3):
            value, share = consistency.reprojected_color_difference(
                plane_view(turned_camera("a"), inner_mask(), slope=slope), plane_view(other, slope=slope)
            )
            assert value < 1.2 / 255 and share == 1.0


def test_a_color_that_changes_from_view_to_view_is_the_difference():
    a, b = plane_view(turned_camera("a"), inner_mask()), plane_view(turned_camera("b", 0.2), shift=0.2)
    value, share = consistency.reprojected_color_difference(a, b)
    assert value == pytest.approx(0.2, abs=1.2 / 255) and share == 1.0


def test_a_wrong_depth_shows_as_the_slope_of_the_picture_times_the_shift():
    """The difference equals the color gradient times the shift of the pixels.

    At half its depth, a point lands 6 px off in a view 0.2 to the side. Red changes by 0.2 * 2 / 60 for each pixel.
    """
    a, b = plane_view(turned_camera("a"), inner_mask()), plane_view(turned_camera("b", 0.2))
    value, _ = consistency.reprojected_color_difference(a._replace(depth=a.depth / 2), b._replace(depth=b.depth / 2))
    assert value == pytest.approx(6 * 0.2 * 2 / 60 / 3, abs=1.2 / 255)


def test_what_the_neighbor_does_not_see_is_not_compared():
    a, b = plane_view(turned_camera("a"), inner_mask()), plane_view(turned_camera("b", 0.2))
    half = np.where(np.arange(WIDTH) < WIDTH // 2, 0.5, b.depth)  # a nearer surface occludes the left half of b
    poisoned = np.where((half < 1)[..., None], np.uint8(255), b.picture)
    value, share = consistency.reprojected_color_difference(a, b._replace(depth=half, picture=poisoned))
    # The mask's columns 20 to 43 land 6 px to the left, so only columns 38 to 43 land in the right half.
    assert share == pytest.approx(6 / 24) and value < 1.2 / 255 + 1 / 255
    assert consistency.reprojected_color_difference(a, plane_view(turned_camera("b", 50.0))) == (None, 0.0)
    assert consistency.reprojected_color_difference(a._replace(mask=np.zeros_like(a.mask)), b) == (None, None)
    assert consistency.reprojected_color_difference(a._replace(depth=np.zeros_like(a.depth)), b) == (None, 0.0)


def test_where_the_neighbor_shows_nothing_at_all_it_disagrees():
    a, b = plane_view(turned_camera("a"), inner_mask()), plane_view(turned_camera("b", 0.2))
    empty = b._replace(depth=np.zeros_like(b.depth), picture=np.zeros_like(b.picture))
    value, share = consistency.reprojected_color_difference(a, empty)
    assert share == 1.0 and value == pytest.approx(a.picture[a.mask].mean() / 255, abs=1e-9)


def test_depth_is_continued_through_a_mask():
    depth, _ = render_plane(turned_camera("a"), slope=0.3)
    broken = np.where(inner_mask(), 0.7, depth)
    assert np.abs(consistency.continue_surrounding_depth(broken, inner_mask()) / depth - 1).max() < 1e-6
    assert (consistency.continue_surrounding_depth(broken, np.ones_like(inner_mask())) == 0).all()


def test_pixels_without_depth_beside_a_mask_do_not_bend_the_continuation():
    depth, _ = render_plane(turned_camera("a"), slope=0.3)
    is_unknown = np.random.default_rng(0).random(depth.shape) < 0.1
    is_unknown[:, :18] = True  # no depth, as beside the captured scene
    found = consistency.continue_surrounding_depth(np.where(is_unknown, 0.0, depth), inner_mask())
    assert np.abs(found / depth - 1)[inner_mask()].max() < 1e-6
