"""Few photographs: dense depth from sparse points keeps edges, and a fit from this depth generalizes to other views."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes.cameras import world_rays
from scenes.wall_scene import front_camera

from reffusion import geometry
from reffusion.depth import patchmatch, sparse_to_dense
from reffusion.depth.multiview_depth import estimate_multiview_depth
from reffusion.depth.sparse_to_dense import SparsePoints, visible_samples
from reffusion.fit import few_views
from reffusion.io.images import save_image
from reffusion.io.ply import load_ply
from reffusion.io.scene import save_scene
from reffusion.params.fit import Params
from reffusion.splat import rasterizer
from reffusion.types import Scene, Similarity
from stages import fit as stage

pytestmark = pytest.mark.integration

WALL, NEAR, HALF = 2.0, 1.5, 0.2  # z of the wall, z of a square in front of the wall, half the side of the square
NONE: dict[str, np.ndarray] = {}


def interpolate_depth(points, view, picture):
    return sparse_to_dense.interpolate_depth(visible_samples(points, view, picture), view, picture)


def render_wall_and_square(view):
    """Return depth [H, W] and picture uint8 [H, W, 3] of the wall with the square in front of it."""
    rays = (world_rays(view)).reshape(view.height, view.width, 3)
    at = lambda z: view.center + rays * ((z - view.center[2]) / rays[..., 2:])
    square = (np.abs(at(NEAR)[..., :2]) < HALF).all(-1)
    points = at(WALL)
    x, y = points[..., 0], points[..., 1]
    wall = np.stack([0.3 + 0.1 * np.sin(9 * x), 0.4 + 0.1 * np.cos(8 * y), 0.7 + 0.1 * np.sin(6 * (x + y))], -1)
    picture = np.where(square[..., None], (0.9, 0.5, 0.1), wall)
    return np.where(square, NEAR, WALL) - view.center[2], (255 * picture).round().astype(np.uint8)


def sample_wall_and_square(count=700, seed=0):
    """Return points [count + 60, 3] and colors uint8 [count + 60, 3]: `count` of the whole wall, 60 of the square.

    Some of the wall's points lie behind the square.
    """
    draw = np.random.default_rng(seed)
    wall = np.column_stack([draw.uniform(-1.2, 1.2, count), draw.uniform(-0.9, 0.9, count), np.full(count, WALL)])
    square = np.column_stack([draw.uniform(-HALF, HALF, (60, 2)) * 0.97, np.full(60, NEAR)])
    x, y = wall[:, 0], wall[:, 1]
    blue = np.stack([0.3 + 0.1 * np.sin(9 * x), 0.4 + 0.1 * np.cos(8 * y), 0.7 + 0.1 * np.sin(6 * (x + y))], -1)
    colors = np.concatenate([255 * blue, np.tile((229.5, 127.5, 25.5), (60, 1))])
    return np.concatenate([wall, square]), colors.round().astype(np.uint8)


def test_depth_steps_where_the_picture_does_and_hidden_points_are_silent():
    points, view = SparsePoints.of(*sample_wall_and_square()), front_camera("a", 0.1)
    depth, picture = render_wall_and_square(view)
    found = interpolate_depth(points, view, picture)
    wrong = np.abs(found / depth - 1) > 0.01
    assert wrong.mean() < 0.02  # the median moves depth edges a little
    assert np.abs(points.normals[:700, 2]).min() > 0.7 and np.allclose(np.linalg.norm(points.normals, axis=1), 1)


def test_a_slanted_plane_is_met_between_and_beyond_its_points():
    draw, view = np.random.default_rng(1), front_camera("a", 0.0)
    positions = np.column_stack([draw.uniform(-0.5, 0.5, 300), draw.uniform(-0.4, 0.4, 300), np.zeros(300)])
    positions[:, 2] = 2 + 0.5 * positions[:, 0] - 0.3 * positions[:, 1]
    gray = np.full((view.height, view.width, 3), 128, np.uint8)
    found = interpolate_depth(SparsePoints.of(positions, np.full((300, 3), 128, np.uint8)), view, gray)
    rays = geometry.pixel_rays(view).reshape(view.height, view.width, 3)
    true = 2 / (1 - 0.5 * rays[..., 0] + 0.3 * rays[..., 1])
    assert np.abs(found / true - 1)[2:-2, 2:-2].max() < 2e-3


def test_too_few_points_tell_nothing():
    positions, colors = sample_wall_and_square()
    view = front_camera("a", 0.0)
    assert (
        interpolate_depth(SparsePoints.of(positions[:20], colors[:20]), view, render_wall_and_square(view)[1]) is None
    )
    params = Params(sh={"degree": 0})
    assert (
        few_views.gaussians_on_surfaces(
            [view], {"a": render_wall_and_square(view)[1]}, positions[:10], colors[:10], NONE, params
        )
        is None
    )
    behind = positions * (1, 1, -1)
    assert (
        few_views.gaussians_on_surfaces([view], {"a": render_wall_and_square(view)[1]}, behind, colors, NONE, params)
        is None
    )


def aperiodic_color(points):
    """Return uint8 [..., 3], the colors of points [..., 3] in a three-dimensional pattern without period."""
    x, y, z = np.moveaxis(points, -1, 0)
    waves = [np.sin(31 * x + 17 * y + 9 * z), np.sin(23 * y - 29 * x + 5), np.sin(41 * x * y + 37 * y), np.cos(53 * x)]
    return (127 + 30 * np.stack([waves[0] + waves[2], waves[1] + waves[3], waves[2] + waves[3]], -1)).astype(np.uint8)


def render_slanted_plane(view):
    """Return depth [H, W] and picture uint8 [H, W, 3] of the plane z = 2 + 0.5 x - 0.3 y."""
    rays = world_rays(view)
    normal = np.array([0.5, -0.3, -1.0])
    depth = -(view.center @ normal + 2) / (rays @ normal)
    return depth, aperiodic_color(view.center + rays * depth[..., None])


def test_photographs_tell_a_slanted_plane_within_a_thousandth():
    views = [front_camera(name, x, y) for name, x, y in (("a", 0.0, 0.0), ("b", 0.5, 0.05), ("c", -0.4, 0.1))]
    (true, picture), *others = map(render_slanted_plane, views)
    seen = [(view, image) for view, (_, image) in zip(views[1:], others, strict=True)]
    rays, draw = geometry.pixel_rays(views[0]), np.random.default_rng(0)
    planes = patchmatch.estimate_planes(views[0], picture, seen, 1.06 * true, draw)
    error = np.abs(1 / (planes * rays).sum(-1) / true - 1)[8:-8, 8:-8]
    assert np.median(error) < 1e-3 and (error < 5e-3).mean() > 0.97, (np.median(error), (error < 5e-3).mean())


def test_depth_stays_where_photographs_have_no_texture():
    views, gray = [front_camera("a", 0.0), front_camera("b", 0.2)], np.full((72, 96, 3), 90, np.uint8)
    believed = np.full((72, 96), 2.0)
    planes = patchmatch.estimate_planes(views[0], gray, [(views[1], gray)], believed, np.random.default_rng(0))
    depth = 1 / (planes * geometry.pixel_rays(views[0])).sum(-1)
    assert np.abs(depth / believed - 1).max() < 1e-6
    away = front_camera("away", 50.0)  # this view does not show the surface
    planes = patchmatch.estimate_planes(views[0], gray, [(away, gray)], believed, np.random.default_rng(0))
    assert np.abs((planes * geometry.pixel_rays(views[0])).sum(-1) - 0.5).max() < 1e-6


@pytest.mark.parametrize("spacing", [1, 2, 3])
def test_other_photographs_may_be_of_another_size_and_threads_do_not_matter(monkeypatch, spacing):
    monkeypatch.setattr(patchmatch, "REFERENCE_WIDTH", 96 / spacing)
    views = [
        front_camera("a", 0.0),
        front_camera("b", 0.5),
        replace(front_camera("c", -0.4), width=60, height=72, cx=30.0),
    ]
    (true, picture), *others = map(render_slanted_plane, views)
    seen = [(view, image) for view, (_, image) in zip(views[1:], others, strict=True)]
    found, before = [], torch.get_num_threads()
    for count in (1, 4):
        torch.set_num_threads(count)
        found.append(patchmatch.estimate_planes(views[0], picture, seen, 1.06 * true, np.random.default_rng(3)))
    torch.set_num_threads(before)
    assert np.array_equal(*found)
    depth = 1 / (found[0] * geometry.pixel_rays(views[0])).sum(-1)
    assert spacing > 1 or np.median(np.abs(depth / true - 1)) < 1e-3  # larger spacings need larger pictures


def render_aperiodic_square(view):
    """Return depth [H, W] and picture uint8 [H, W, 3] of a square before a wall, with an aperiodic pattern."""
    rays = world_rays(view)
    at = lambda z: view.center + rays * ((z - view.center[2]) / rays[..., 2:])
    square = (np.abs(at(NEAR)[..., :2]) < HALF).all(-1)
    depth = np.where(square, NEAR, WALL) - view.center[2]
    return depth, aperiodic_color(view.center + rays * depth[..., None])


def test_points_behind_the_visible_surface_are_refuted():
    draw = np.random.default_rng(0)
    wall = np.column_stack([draw.uniform(-1.2, 1.2, 900), draw.uniform(-0.9, 0.9, 900), np.full(900, WALL)])
    square = np.column_stack([draw.uniform(-HALF, HALF, (25, 2)), np.full(25, NEAR)])
    views = [front_camera("a", 0.0), front_camera("b", 0.3), front_camera("c", -0.25, 0.05)]
    pictures = {view.name: render_aperiodic_square(view)[1] for view in views}
    positions = np.concatenate([wall, square])
    colors = aperiodic_color(positions)
    # Wall points behind the square get the color of the square, and outnumber the square's own points.
    uv, _ = geometry.project(wall, views[0])
    behind = (np.abs(wall[:, :2]) < HALF * WALL / NEAR).all(1)
    colors[: len(wall)][behind] = geometry.sample_nearest(pictures["a"], uv)[0][behind]
    points = SparsePoints.of(positions, colors)
    estimates = estimate_multiview_depth(points, views, pictures, NONE, seed=0)
    true, inner = render_aperiodic_square(views[0])[0], (slice(22, 50), slice(34, 62))
    wrong = lambda depth: (np.abs(depth / true - 1) > 0.02)[inner].mean()
    assert wrong(estimates["a"].depth) < 0.2 < 0.4 < wrong(interpolate_depth(points, views[0], pictures["a"]))
    assert (np.abs(estimates["a"].depth / true - 1) < 0.01)[estimates["a"].confirmed].mean() > 0.97
    alone = estimate_multiview_depth(points, views[:1], pictures, NONE, seed=0)["a"]
    assert not alone.confirmed.any() and not alone.refuted.any(), "one photograph alone is sure of nothing"
    hidden = {"a": np.ones(true.shape, bool)}
    assert not estimate_multiview_depth(points, views, pictures, hidden, seed=0)["a"].confirmed.any()


def test_a_further_view_adds_what_those_before_do_not_show():
    views = [front_camera("a", 0.0), front_camera("b", 0.1)]
    images = {view.name: render_wall_and_square(view)[1] for view in views}
    params = Params(sh={"degree": 0})
    one, both = (
        few_views.gaussians_on_surfaces(views[:k], images, *sample_wall_and_square(), NONE, params) for k in (1, 2)
    )
    pixels = views[0].width * views[0].height
    assert 1.9 * pixels < len(one) < 2 * pixels, "but for what is beside the square"
    assert len(one) < len(both) < 2.4 * pixels
    hidden = {"a": np.ones((views[0].height, views[0].width), bool)}
    assert len(few_views.gaussians_on_surfaces(views[:1], images, *sample_wall_and_square(), hidden, params)) == 0


def write_room_poses(folder, train):
    """Write a `poses` folder with the training views `train`; return all views, by name."""
    views = {view.name: view for view in (front_camera(f"v{k}", x) for k, x in enumerate((0.0, -0.12, 0.06)))}
    points, colors = sample_wall_and_square()
    save_scene(folder, Scene(views, train, ("v2",), frozenset(train), points, colors, Similarity(1.0, np.zeros(3))))
    for name in train:
        save_image(folder / "images" / f"{name}.png", render_wall_and_square(views[name])[1])
    return views


@pytest.mark.parametrize("train", [("v0",), ("v0", "v1")])
def test_other_views_are_shown_better_than_by_a_fit_from_points(tmp_path, train, capsys):
    view = write_room_poses(tmp_path / "poses", train)["v2"]
    error = {}
    for way in ("fewer_harmonics", "surfaces"):
        (tmp_path / way).mkdir()
        params = Params(iterations=100, few_views=way).changed({"densify.cap_max": 3000, "init.opacity": 0.5})
        stage.run(params, tmp_path / way, poses=tmp_path / "poses")
        with torch.no_grad():
            rendering = rasterizer.render(load_ply(tmp_path / way / "gaussians.ply"), view).color.numpy()
        error[way] = np.abs(rendering - render_wall_and_square(view)[1] / 255)[8:-8, 16:-16].mean()
    assert error["surfaces"] < 0.5 * error["fewer_harmonics"]
    assert "Gaussians on surfaces between 760 points" in capsys.readouterr().out
