"""Few photographs: depth between sparse points has edges, and a fit on it shows other views."""

import numpy as np
import pytest
import torch
from small_scene import camera

from reffusion import geometry
from reffusion.depth.between import SparsePoints, depth_between
from reffusion.fit import few
from reffusion.io.images import save_image
from reffusion.io.ply import load_ply
from reffusion.io.scene import save_scene
from reffusion.params.fit import Params
from reffusion.splat import rasterizer
from reffusion.types import Scene, Similarity
from stages import fit as stage

WALL, NEAR, HALF = 2.0, 1.5, 0.2  # depth of the wall and of a square before it; half its side
NONE: dict[str, np.ndarray] = {}


def shown(view):
    """Depth [H, W] and picture uint8 [H, W, 3] of the wall, with the square before it."""
    rays = (geometry.pixel_rays(view) @ view.world_to_camera[:3, :3]).reshape(view.height, view.width, 3)
    at = lambda z: view.center + rays * ((z - view.center[2]) / rays[..., 2:])
    square = (np.abs(at(NEAR)[..., :2]) < HALF).all(-1)
    points = at(WALL)
    x, y = points[..., 0], points[..., 1]
    wall = np.stack([0.3 + 0.1 * np.sin(9 * x), 0.4 + 0.1 * np.cos(8 * y), 0.7 + 0.1 * np.sin(6 * (x + y))], -1)
    picture = np.where(square[..., None], (0.9, 0.5, 0.1), wall)
    return np.where(square, NEAR, WALL) - view.center[2], (255 * picture).round().astype(np.uint8)


def sparse(count=700, seed=0):
    """Points of the wall, those behind the square too, as other cameras saw them, and of the square."""
    draw = np.random.default_rng(seed)
    wall = np.column_stack([draw.uniform(-1.2, 1.2, count), draw.uniform(-0.9, 0.9, count), np.full(count, WALL)])
    square = np.column_stack([draw.uniform(-HALF, HALF, (60, 2)) * 0.97, np.full(60, NEAR)])
    x, y = wall[:, 0], wall[:, 1]
    blue = np.stack([0.3 + 0.1 * np.sin(9 * x), 0.4 + 0.1 * np.cos(8 * y), 0.7 + 0.1 * np.sin(6 * (x + y))], -1)
    colors = np.concatenate([255 * blue, np.tile((229.5, 127.5, 25.5), (60, 1))])
    return np.concatenate([wall, square]), colors.round().astype(np.uint8)


def test_depth_steps_where_the_picture_does_and_hidden_points_are_silent():
    points, view = SparsePoints.of(*sparse()), camera("a", 0.1)
    depth, picture = shown(view)
    found = depth_between(points, view, picture)
    wrong = np.abs(found / depth - 1) > 0.01
    assert wrong.mean() < 0.02  # at the very edge, by the median
    assert np.abs(points.normals[:700, 2]).min() > 0.7 and np.allclose(np.linalg.norm(points.normals, axis=1), 1)


def test_a_slanted_plane_is_met_between_and_beyond_its_points():
    draw, view = np.random.default_rng(1), camera("a", 0.0)
    positions = np.column_stack([draw.uniform(-0.5, 0.5, 300), draw.uniform(-0.4, 0.4, 300), np.zeros(300)])
    positions[:, 2] = 2 + 0.5 * positions[:, 0] - 0.3 * positions[:, 1]
    grey = np.full((view.height, view.width, 3), 128, np.uint8)
    found = depth_between(SparsePoints.of(positions, np.full((300, 3), 128, np.uint8)), view, grey)
    rays = geometry.pixel_rays(view).reshape(view.height, view.width, 3)
    true = 2 / (1 - 0.5 * rays[..., 0] + 0.3 * rays[..., 1])
    assert np.abs(found / true - 1)[2:-2, 2:-2].max() < 2e-3


def test_too_few_points_tell_nothing():
    positions, colors = sparse()
    view = camera("a", 0.0)
    assert depth_between(SparsePoints.of(positions[:20], colors[:20]), view, shown(view)[1]) is None
    params = Params(sh={"degree": 0})
    assert few.surfaces([view], {"a": shown(view)[1]}, positions[:10], colors[:10], NONE, params) is None
    behind = positions * (1, 1, -1)
    assert few.surfaces([view], {"a": shown(view)[1]}, behind, colors, NONE, params) is None


def test_a_further_view_adds_what_those_before_do_not_show():
    views = [camera("a", 0.0), camera("b", 0.1)]
    images = {view.name: shown(view)[1] for view in views}
    params = Params(sh={"degree": 0})
    one, both = (few.surfaces(views[:k], images, *sparse(), NONE, params) for k in (1, 2))
    pixels = views[0].width * views[0].height
    assert 1.9 * pixels < len(one) < 2 * pixels, "but for what is beside the square"
    assert len(one) < len(both) < 2.4 * pixels
    hidden = {"a": np.ones((views[0].height, views[0].width), bool)}
    assert len(few.surfaces(views[:1], images, *sparse(), hidden, params)) == 0


def written(folder, train):
    """A `poses` folder of the room, these views given; the views to look from."""
    views = {view.name: view for view in (camera(f"v{k}", x) for k, x in enumerate((0.0, -0.12, 0.06)))}
    points, colors = sparse()
    save_scene(folder, Scene(views, train, ("v2",), frozenset(train), points, colors, Similarity(1.0, np.zeros(3))))
    for name in train:
        save_image(folder / "images" / f"{name}.png", shown(views[name])[1])
    return views


@pytest.mark.parametrize("train", [("v0",), ("v0", "v1")])
def test_other_views_are_shown_better_than_by_a_fit_from_points(tmp_path, train, capsys):
    view = written(tmp_path / "poses", train)["v2"]
    error = {}
    for way in ("fewer_harmonics", "surfaces"):
        (tmp_path / way).mkdir()
        params = Params(iterations=100, few_views=way).changed({"densify.cap_max": 3000, "init.opacity": 0.5})
        stage.run(params, tmp_path / way, poses=tmp_path / "poses")
        with torch.no_grad():
            drawn = rasterizer.render(load_ply(tmp_path / way / "gaussians.ply"), view).color.numpy()
        error[way] = np.abs(drawn - shown(view)[1] / 255)[8:-8, 16:-16].mean()
    assert error["surfaces"] < 0.5 * error["fewer_harmonics"]
    assert "Gaussians on surfaces between 760 points" in capsys.readouterr().out


def test_an_interrupted_fit_from_surfaces_goes_on_to_the_same_end(tmp_path, monkeypatch):
    written(tmp_path / "poses", ("v0", "v1"))
    params = Params(iterations=60, few_views="surfaces", checkpoint_seconds=0.001)
    for name in ("whole", "broken"):
        (tmp_path / name).mkdir()
    stage.run(params, tmp_path / "whole", poses=tmp_path / "poses")
    from reffusion.fit import reconstruction

    steps, do = [], reconstruction.step

    def stopping(*given):
        steps.append(given)
        if len(steps) == 7:
            raise KeyboardInterrupt
        return do(*given)

    monkeypatch.setattr(reconstruction, "step", stopping)
    with pytest.raises(KeyboardInterrupt):
        stage.run(params, tmp_path / "broken", poses=tmp_path / "poses")
    monkeypatch.setattr(reconstruction, "step", do)
    stage.run(params, tmp_path / "broken", poses=tmp_path / "poses")
    whole, broken = (load_ply(tmp_path / name / "gaussians.ply") for name in ("whole", "broken"))
    assert torch.equal(whole.means, broken.means) and torch.equal(whole.sh, broken.sh)
