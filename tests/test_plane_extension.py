"""Planes that go on beyond the capture: a striped floor and a wall, of which the training views show a part."""

import numpy as np
import pytest
import torch
from scenes.cameras import look_at_camera

from reffusion.inpaint.plane_extension import extend_planes
from reffusion.splat import rasterizer
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians

CELL = 0.05
SIZE, FOCAL = (48, 36), 40.0


def plane_gaussians(first: np.ndarray, second: np.ndarray, corner: np.ndarray, count: int) -> Gaussians:
    """Return opaque balls on a square grid of `count` cells a side, in stripes along the second axis."""
    index = np.stack(np.meshgrid(np.arange(count), np.arange(count), indexing="ij"), -1).reshape(-1, 2)
    means = corner + CELL * (index[:, :1] * first + index[:, 1:] * second)
    color = np.where((index[:, :1] // 6 % 2) == 0, [[0.8, 0.7, 0.5]], [[0.3, 0.25, 0.2]])
    arrays = (
        means,
        np.tile([1.0, 0, 0, 0], (len(index), 1)),
        np.full((len(index), 3), np.log(0.6 * CELL)),
        np.full(len(index), 5.0),
        ((color - 0.5) / SH0)[:, None],
    )
    return Gaussians(*(torch.from_numpy(np.asarray(array)).float() for array in arrays))


def room() -> Gaussians:
    """Return a floor at z = 0 and a wall at y = 2, both 6 wide."""
    x, y, z = np.eye(3)
    floor = plane_gaussians(x, y, np.array([-3.0, -4.0, 0.0]), 120)
    wall = plane_gaussians(x, z, np.array([-3.0, 2.0, 0.0]), 120)
    return floor.zip_map(wall, lambda a, b: torch.cat([a, b]))


def view(name: str, x: float, target: tuple[float, float, float]) -> Camera:
    return look_at_camera(name, (x, -1.5, 1.2), target, SIZE, FOCAL)


@pytest.fixture(scope="module")
def training_views() -> list[Camera]:
    return [view(f"v{k}", 0.2 * k - 0.4, (0.1 * k - 0.2, 2.0, 0.5)) for k in range(5)]


@pytest.fixture(scope="module")
def captured(training_views: list[Camera]) -> Gaussians:
    """Return the Gaussians of the room that the training views frame; nobody knows the others."""
    whole = room()
    points = whole.means.double().numpy()
    framed = np.zeros(len(points), bool)
    for camera in training_views:
        local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        uv = local[:, :2] / local[:, 2:] * FOCAL + (24, 18)
        framed |= (local[:, 2] > 0) & (uv > -1).all(1) & (uv < (49, 37)).all(1)
    return whole.map(lambda p: p[torch.from_numpy(framed)])


@pytest.fixture(scope="module")
def extension(captured: Gaussians, training_views: list[Camera]) -> Gaussians:
    return extend_planes(captured, training_views)


def test_floor_and_wall_go_on_where_they_are(extension):
    points = extension.means.numpy()
    on_floor, on_wall = np.abs(points[:, 2]) < 0.1, np.abs(points[:, 1] - 2) < 0.1
    assert len(points) > 500 and (on_floor | on_wall).mean() > 0.99
    assert on_floor.sum() > 300 and on_wall.sum() > 300
    assert (points[:, 1] < 2.15).all() and (points[:, 2] > -0.15).all(), "planes end where they meet"


def test_a_view_beside_the_capture_shows_the_room(captured, extension, training_views):
    beside = view("beside", 0.4, (0.9, 2.0, 0.3))
    both = captured.zip_map(extension, lambda a, b: torch.cat([a, b]))
    draw = lambda gaussians: rasterizer.render(gaussians, beside)
    truth, before, after = (draw(each) for each in (room(), captured, both))
    unseen = before.alpha < 0.2
    assert unseen.float().mean() > 0.1
    assert (after.alpha[unseen] > 0.9).float().mean() > 0.7
    error = lambda rendering: (rendering.color - truth.color).abs()[unseen].mean()
    assert error(after) < 0.6 * error(before)


def test_training_views_do_not_change(captured, extension, training_views):
    both = captured.zip_map(extension, lambda a, b: torch.cat([a, b]))
    for camera in training_views:
        difference = (rasterizer.render(both, camera).color - rasterizer.render(captured, camera).color).abs()
        assert difference.mean() < 5e-3


def test_a_plane_inside_the_capture_does_not_go_on(training_views):
    x, _, z = np.eye(3)
    board = plane_gaussians(x, z, np.array([-0.4, 1.5, 0.2]), 20)
    assert len(extend_planes(board, training_views)) == 0
    assert len(extend_planes(board.map(lambda p: p[:0]), training_views)) == 0
