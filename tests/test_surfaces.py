"""Completed surfaces: their depth from photo-consistency, and their view-dependent color from the surroundings."""

import numpy as np
import pytest
import torch
from scenes.cameras import look_at_camera, make_camera, world_rays
from scenes.gaussians import round_gaussians

from reffusion.background import continuation
from reffusion.background.plane import CELLS, Plane, remove_reflected_depth
from reffusion.background.visibility import DepthView, depth_range
from reffusion.initialize import sweep, view_dependent_color
from reffusion.morphology import dilate
from reffusion.splat.pure_torch import colors, harmonics
from reffusion.types import Camera, Gaussians

SIZE, FOCAL = 160, 180.0
HOLE = np.zeros((SIZE, SIZE), bool)
HOLE[62:98, 62:98] = True


PLACES = [(0, 0.1), (1, 0), (-1, 0.3), (0.2, 1), (0, -1), (0.8, 0.9)]
CAMERAS = [  # they look at the origin of the ground z = 0
    look_at_camera(f"v{k}", (x, y, 3.0), (0.0, 0.0, 0.0), (SIZE, SIZE), FOCAL, up=(0.0, 1.0, 0.0))
    for k, (x, y) in enumerate(PLACES)
]


def intersect_ground(view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth [H, W] and the points [H, W, 3] of the ground in the view."""
    rays = world_rays(view)
    depth = -view.center[2] / rays[..., 2]
    return depth, view.center + rays * depth[..., None]


def reflection(way: np.ndarray) -> np.ndarray:
    """Return the reflection [..., 1] that is added to the ground's color; it is stronger if seen from the right.

    Args:
        way: [..., 3], the direction from the ground to the camera.
    """
    return (0.5 * way[..., 0] / np.linalg.norm(way, axis=-1))[..., None]


def paint_ground(view: Camera, shines: bool = False) -> np.ndarray:
    """Return the view's picture of speckled ground, uint8 [H, W, 3], with a reflection if `shines`."""
    _, points = intersect_ground(view)
    waves = sum(np.sin(points[..., :2] @ way + phase) for way, phase in WAVES)
    light = 0.45 + 0.12 * waves[..., None] / np.sqrt(len(WAVES)) * np.ones(3)
    light = light + reflection(view.center - points) if shines else light
    return np.round(light.clip(0, 1) * 255).astype(np.uint8)


WAVES = [(np.array([np.cos(a), np.sin(a)]) * f, a * 7) for f in (9.0, 17.0, 31.0) for a in np.arange(0, np.pi, 0.5)]


@pytest.fixture(scope="module")
def ground_views() -> list[DepthView]:
    depths = [intersect_ground(view)[0].astype(np.float32) for view in CAMERAS]
    return [
        DepthView.from_range(view, depth, depth_range(depth), HOLE) for view, depth in zip(CAMERAS, depths, strict=True)
    ]


def uneven_depth(depth: np.ndarray) -> np.ndarray:
    """Return the depth with noise of 2 %, and 2 % too near, as rendered Gaussians show it."""
    return depth * (0.98 + 0.02 * np.random.default_rng(0).standard_normal(depth.shape))


def test_photographs_tell_the_depth_that_splats_show_too_near(ground_views):
    view, photos = CAMERAS[0], {each.name: paint_ground(each) for each in CAMERAS}
    true, ring = intersect_ground(view)[0], dilate(HOLE, 0.1) & ~HOLE
    found = sweep.sweep_depth(photos["v0"], uneven_depth(true), ring, view, ground_views, photos)
    known = found > 0
    assert known[ring].mean() > 0.7 and not known[~ring].any()
    assert abs(np.median(found[known] / true[known]) - 1) < 0.003
    plain = {name: np.full_like(photo, 128) for name, photo in photos.items()}
    assert not sweep.sweep_depth(plain["v0"], uneven_depth(true), ring, view, ground_views, plain).any()
    assert not sweep.sweep_depth(photos["v0"], uneven_depth(true), ring, view, ground_views[:1], photos).any()


def tilted_plane(height: float, tilt: float) -> Plane:
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    cells = np.ones((CELLS,) * 2, bool)
    return Plane(normal, height, np.zeros(3), np.eye(3)[:2], 0.05, cells, cells, ~cells, cells, np.zeros_like(cells))


def test_a_plane_moves_onto_what_is_known_around_the_hole():
    true, ring = intersect_ground(CAMERAS[0])[0], dilate(HOLE, 0.1) & ~HOLE
    noise = 1 + 0.004 * np.random.default_rng(1).standard_normal(true.shape)
    far = np.random.default_rng(2).random(true.shape) < 0.2  # a farther surface at a fifth of the pixels
    depth = np.where(ring, np.where(far, 1.5, noise) * true, 0.0)
    moved = continuation.align_plane(tilted_plane(0.08, 0.02), depth, CAMERAS[0], HOLE)
    assert np.abs(moved.depth(CAMERAS[0])[HOLE] / true[HOLE] - 1).max() < 0.003
    off = tilted_plane(0.08, 0.02)
    assert continuation.align_plane(off, np.zeros_like(depth), CAMERAS[0], HOLE) is off
    one_sided = np.where(np.arange(SIZE)[:, None] < 64, depth, 0.0) * np.where(np.arange(SIZE) < 64, 1.03, 1.0)
    still = continuation.align_plane(tilted_plane(0.0, 0.0), one_sided, CAMERAS[0], HOLE)
    assert np.abs(still.depth(CAMERAS[0])[HOLE] / true[HOLE] - 1).max() < continuation.ALIGN_LIMIT


def hole_gaussians(sh_degree: int) -> Gaussians:
    """Return Gaussians on the ground in the hole, whose colors are those of the first view in all directions."""
    view = CAMERAS[0]
    points, picture = intersect_ground(view)[1][HOLE], paint_ground(view, shines=True)[HOLE] / 255
    return round_gaussians(points, picture, np.exp(-4.0), 2.0, (sh_degree + 1) ** 2)


def test_new_gaussians_reflect_as_the_surface_around_them(ground_views):
    photos = {view.name: paint_ground(view, shines=True) for view in CAMERAS}
    fresh = hole_gaussians(1)
    every = torch.ones(len(fresh), dtype=torch.bool)
    around = view_dependent_color.measure_change(
        photos["v0"], intersect_ground(CAMERAS[0])[0], HOLE, CAMERAS[0], ground_views, photos
    )
    lit = view_dependent_color.transfer_sh(fresh, every, CAMERAS[0], around, ground_views)
    torch.testing.assert_close(colors(lit, CAMERAS[0], 1), colors(fresh, CAMERAS[0], 1), atol=1e-4, rtol=0)
    for view in CAMERAS[1:]:
        means = lit.means.double().numpy()
        change = reflection(view.center - means) - reflection(CAMERAS[0].center - means)
        expected = colors(fresh, CAMERAS[0], 1).numpy() + change
        before, after = (np.abs(colors(each, view, 1).numpy() - expected).mean() for each in (fresh, lit))
        assert after < 0.04 and (before < 0.06 or after < before / 3)


def test_a_matte_surface_stays_matte(ground_views):
    photos = {view.name: paint_ground(view) for view in CAMERAS}
    fresh = hole_gaussians(1)
    around = view_dependent_color.measure_change(
        photos["v0"], intersect_ground(CAMERAS[0])[0], HOLE, CAMERAS[0], ground_views, photos
    )
    lit = view_dependent_color.transfer_sh(
        fresh, torch.ones(len(fresh), dtype=torch.bool), CAMERAS[0], around, ground_views
    )
    torch.testing.assert_close(lit.sh, fresh.sh, atol=0.01, rtol=0)


def test_a_shadow_that_a_reference_does_not_show_is_no_shine(ground_views):
    light = {view.name: paint_ground(view) for view in CAMERAS}
    photos = {name: (photo * 0.6).astype(np.uint8) for name, photo in light.items()}
    fresh = hole_gaussians(1)
    around = view_dependent_color.measure_change(
        light["v0"], intersect_ground(CAMERAS[0])[0], HOLE, CAMERAS[0], ground_views, photos
    )
    lit = view_dependent_color.transfer_sh(
        fresh, torch.ones(len(fresh), dtype=torch.bool), CAMERAS[0], around, ground_views
    )
    torch.testing.assert_close(lit.sh, fresh.sh, atol=0.01, rtol=0)


def test_no_reflection_is_transferred_without_observations_or_harmonics(ground_views):
    photos = {view.name: paint_ground(view, shines=True) for view in CAMERAS}
    flat, fresh = hole_gaussians(0), hole_gaussians(1)
    around = view_dependent_color.measure_change(
        photos["v0"], intersect_ground(CAMERAS[0])[0], HOLE, CAMERAS[0], ground_views, photos
    )
    every = torch.ones(len(fresh), dtype=torch.bool)
    assert view_dependent_color.transfer_sh(flat, every, CAMERAS[0], around, ground_views) is flat
    assert view_dependent_color.transfer_sh(fresh, ~every, CAMERAS[0], around, ground_views) is fresh
    blind = view_dependent_color.measure_change(
        photos["v0"], np.zeros_like(HOLE, float), HOLE, CAMERAS[0], ground_views, photos
    )
    assert view_dependent_color.transfer_sh(fresh, every, CAMERAS[0], blind, ground_views) is fresh


def test_harmonics_are_orthonormal():
    ways = torch.randn(200_000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    basis = harmonics(ways, 3)
    gram = 4 * np.pi * basis.T @ basis / len(ways)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=0.03, rtol=0)


def test_points_inside_a_plane_differ_from_points_beyond_it():
    rows, columns = np.mgrid[:CELLS, :CELLS] - CELLS / 2
    away = np.hypot(rows, columns)
    seen = (away > 20) & (away < 60)
    free = (away < 20) | (away > 60)
    free[95, 120], seen[95, 120] = True, False
    assert (continuation._enclosed_patches(seen, free) == (away < 20)).all(), (
        "a plate in a table, no speck, nor the garden"
    )
    hidden = (rows > 10) & (columns < -10)
    assert continuation._enclosed_patches(seen & ~hidden, away < 20).sum() > 0.95 * (away < 20).sum(), "partly hidden"
    open_to_a_side = seen & ~((np.abs(rows) < 6) & (columns > 0))
    assert not continuation._enclosed_patches(open_to_a_side, free | ~open_to_a_side).any()


def test_a_mirror_has_the_depth_of_its_plane():
    view = make_camera("a", (64, 64), 70.0)
    whole, nowhere = np.ones((CELLS,) * 2, bool), np.zeros((CELLS,) * 2, bool)
    plate = nowhere.copy()
    plate[CELLS // 2 - 10 : CELLS // 2 + 10, CELLS // 2 - 10 : CELLS // 2 + 10] = True
    wall = Plane(
        np.array([0.0, 0, 1]), 2.0, np.array([0.0, 0, 2]), np.eye(3)[:2], 0.02, nowhere, nowhere, plate, whole, plate
    )
    mirrored = wall.pixels_on(plate, wall.depth(view), view, np.ones((64, 64), bool))
    depth = np.where(mirrored, 3.5, 2.0)
    depth[:, :30] = 1.5  # something stands before the left of it
    found = remove_reflected_depth(depth, view, [wall])
    assert 100 < mirrored.sum() < 2000 and (found == np.minimum(depth, 2.0)).all()
