"""The choice of the reference that supplies a surface if several references bring depth, on analytic surfaces."""

import numpy as np
import pytest
from scenes.cameras import orbit_camera

from reffusion import geometry
from reffusion.initialize.sharing import ReferenceSurface, select_finest, unchanged_rim

SIZE = 64


def sphere_camera(name, azimuth, height, away=3.0):
    return orbit_camera(name, azimuth, height, away, np.zeros(3), SIZE, 90.0)


FRONT, SIDE = sphere_camera("front", 0.0, 3.0), sphere_camera("side", 0.0, 0.4)


def floor_depth(camera, z=0.0):
    """Return the depth [H, W] of the horizontal plane at height z, 0 above the horizon."""
    rays = geometry.unproject(np.ones((SIZE, SIZE)), camera) - camera.center
    with np.errstate(divide="ignore"):
        depth = (z - camera.center[2]) / rays[..., 2]
    return np.where(depth > 0, depth, 0.0)


def make_surface(camera, depth, pixels=None):
    known = depth > 0
    return ReferenceSurface(camera, depth, known if pixels is None else known & pixels)


def is_near_origin(camera, depth, radius):
    points = geometry.unproject(np.where(depth > 0, depth, 1e6), camera)
    return np.linalg.norm(points, axis=-1) < radius


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_surface_is_drawn_by_the_view_that_shows_it_most_finely(order):
    views = [
        make_surface(camera, floor_depth(camera), is_near_origin(camera, floor_depth(camera), 0.5))
        for camera in (FRONT, SIDE)
    ]
    finest = dict(zip(order, select_finest([views[k] for k in order]), strict=True))
    assert (finest[0] == views[0].pixels).mean() > 0.98
    assert finest[1].sum() < 0.1 * views[1].pixels.sum()  # only pixels at the border between both


def test_of_two_equal_views_the_earlier_is_used():
    same = make_surface(FRONT, floor_depth(FRONT))
    first, second = select_finest([same, same])
    assert np.array_equal(first, same.pixels) and not second.any()


def test_a_surface_of_one_view_stays_with_it():
    wide = make_surface(SIDE, floor_depth(SIDE), is_near_origin(SIDE, floor_depth(SIDE), 0.5))
    narrow = make_surface(FRONT, floor_depth(FRONT), is_near_origin(FRONT, floor_depth(FRONT), 0.2))
    _, remaining = select_finest([narrow, wide])
    away = is_near_origin(SIDE, floor_depth(SIDE), 0.25)
    assert np.array_equal(remaining & ~away, wide.pixels & ~away)
    assert remaining[is_near_origin(SIDE, floor_depth(SIDE), 0.15)].mean() < 0.05


def test_a_surface_is_dropped_where_another_view_sees_past_it():
    """One view has a sheet above the floor. The other view sees the floor behind it, so the sheet is dropped."""
    sheet = floor_depth(SIDE, z=0.2)
    hanging = is_near_origin(SIDE, sheet, 0.4)
    depth = np.where(hanging, sheet, floor_depth(SIDE))
    finest, _ = select_finest(
        [make_surface(SIDE, depth, hanging), make_surface(FRONT, floor_depth(FRONT), np.zeros((SIZE, SIZE), bool))]
    )
    assert not finest[hanging].any()


def test_without_depth_nothing_is_selected():
    empty = np.zeros((SIZE, SIZE))
    whole = make_surface(SIDE, floor_depth(SIDE))
    finest, nothing = select_finest([whole, ReferenceSurface(FRONT, empty, np.zeros((SIZE, SIZE), bool))])
    assert np.array_equal(finest, whole.pixels) and not nothing.any()
    assert np.isinf(ReferenceSurface(FRONT, empty, whole.pixels).footprints).all()


def test_a_pixel_is_as_wide_as_its_slant_makes_it():
    depth = floor_depth(SIDE)
    row = SIZE * 3 // 4
    below, above = geometry.unproject(depth, SIDE)[[row, row + 1], SIZE // 2]
    assert make_surface(SIDE, depth).footprints[row, SIZE // 2] == pytest.approx(np.linalg.norm(below - above), rel=0.1)


def test_a_rim_that_looks_like_the_photograph_is_left():
    random = np.random.default_rng(0)
    photo = random.integers(0, 256, (40, 40, 3), np.uint8)
    image, mask, thing = photo.copy(), np.zeros((40, 40), bool), np.zeros((40, 40), bool)
    mask[8:32, 8:32] = thing[12:28, 12:28] = True
    image[thing] = (photo[thing].astype(int) + 128) % 256
    image[18:22, 18:22] = photo[18:22, 18:22]  # here the object happens to have the photograph's color
    assert np.array_equal(unchanged_rim(image, photo, mask), mask & ~thing)
