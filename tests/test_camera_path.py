"""The camera path around a capture, and the video along this path."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from scenes import wall_scene
from scenes.cameras import make_scene

from reffusion import geometry
from reffusion.io.ply import save_ply
from reffusion.io.scene import save_scene
from reffusion.types import Camera, Similarity
from report import camera_path, turntable


def ring_cameras(count: int, radius: float, height: float = 0.3) -> list[Camera]:
    """Return cameras on a circle about the y axis that look at the origin; their image rows go down along +y."""
    turns = 2 * np.pi * np.arange(count) / count
    centers = np.stack([radius * np.cos(turns), np.full(count, -height), radius * np.sin(turns)], 1)
    poses = [camera_path.look_at(center, np.zeros(3), np.array([0.0, 1.0, 0.0])) for center in centers]
    return [Camera(str(k), 64, 48, 60.0, 60.0, 31.0, 25.0, pose) for k, pose in enumerate(poses)]


def test_a_ring_of_cameras_gives_the_ring_back():
    made = camera_path.ellipse_path(ring_cameras(9, 2.0), np.random.default_rng(0).normal(0, 0.1, (50, 3)), 12)
    centers = np.stack([camera.center for camera in made])
    assert np.allclose(np.hypot(centers[:, 0], centers[:, 2]), 2.0) and np.allclose(centers[:, 1], -0.3)
    steps = np.linalg.norm(np.diff(centers, axis=0, append=centers[:1]), axis=1)
    assert np.allclose(steps, steps[0]), "closed, and even"
    assert np.allclose(camera_path.focus_point(ring_cameras(9, 2.0), np.zeros((0, 3))), 0, atol=0.02)


def test_the_central_view_looks_at_the_middle_of_the_capture():
    ring = ring_cameras(8, 2.0)
    aside = [replace(camera, world_to_camera=turn(20.0) @ camera.world_to_camera) for camera in ring[:3]]
    near = [camera for camera in ring_cameras(8, 0.5) if camera.name == "5"]
    found = camera_path.find_central_view([*aside, *near, *ring], np.zeros((0, 3)))
    assert any(found is camera for camera in ring)


def test_of_central_views_the_one_at_the_broad_side_is_found():
    points = np.random.default_rng(0).normal(0, 1, (200, 3)) * (0.3, 0.1, 0.02)  # a flat thing across z
    found = camera_path.find_central_view(ring_cameras(8, 2.0), points)
    assert abs(found.center[2]) > 1.9


def turn(degrees: float) -> np.ndarray:
    """Return the pose [4, 4] of a camera that is turned to its side."""
    pose, angle = np.eye(4), np.radians(degrees)
    pose[np.ix_([0, 2], [0, 2])] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    return pose


def test_every_camera_looks_at_the_focus_upright():
    cameras = list(wall_scene.CAMERAS.values())
    points = np.array([[0.0, 0.0, 2.0]])
    target = camera_path.focus_point(cameras, points)
    assert target[2] == pytest.approx(2.0, abs=0.05), "parallel axes: the points say how far"
    for camera in camera_path.ellipse_path(cameras, points, 8):
        rotation = camera.world_to_camera[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) > 0
        pixels, depth = geometry.project(target[None], camera)
        assert np.allclose(pixels[0], (camera.width / 2, camera.height / 2)) and depth[0] > 0
        assert rotation[1, 1] > 0.9, "rows go down as the photographs' do"


def test_degenerate_captures_have_a_path():
    above = [camera_path.look_at(np.array([0.0, -2.0, 0.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))]
    one = [Camera("v", 8, 6, 9.0, 9.0, 4.0, 3.0, above[0])]
    for camera in camera_path.ellipse_path(one, np.zeros((0, 3)), 3):
        assert np.isfinite(camera.world_to_camera).all() and np.allclose(camera.center, (0, -2, 0))
    with pytest.raises(ValueError, match="needs a camera"):
        camera_path.ellipse_path([], np.zeros((0, 3)), 3)


def test_the_video_shows_the_result_of_a_variant_in_the_scenes_poses(tmp_path):
    gaussians, labels = wall_scene.wall_and_square(1.0)
    similarity = Similarity(2.0, np.array([0.1, 0.2, 0.3]))
    train = {name: wall_scene.CAMERAS[name] for name in wall_scene.TRAIN}
    points = gaussians.means.double().numpy()[~labels.numpy()]
    scene = make_scene(train, points=points, similarity=similarity)
    save_scene(tmp_path / "x" / "poses", scene)
    with pytest.raises(ValueError, match="make scene=x all"):
        turntable.make(tmp_path / "x@no_sds")
    wall = gaussians.map(lambda p: p[~labels])
    save_ply(tmp_path / "x@no_sds" / "evaluate" / "scene.ply", wall, similarity=similarity)
    film, frames = cv2.VideoCapture(str(turntable.make(tmp_path / "x@no_sds", frames=6))), []
    while (read := film.read())[0]:
        frames.append(read[1])
    assert len(frames) == 6 and frames[0].shape == (wall_scene.HEIGHT, wall_scene.WIDTH, 3)
    first = camera_path.ellipse_path(list(train.values()), points, 6)[0]
    rendering = turntable.rasterizer.render(wall, first).color
    assert (torch.from_numpy(frames[0][..., ::-1].copy()) / 255 - rendering).abs().mean() < 0.03, "but for compression"
    with pytest.raises(ValueError, match=r"fit/gaussians\.ply is missing"):
        turntable.make_wipe(tmp_path / "x@no_sds")
    save_ply(tmp_path / "x" / "fit" / "gaussians.ply", gaussians)
    with Image.open(turntable.make_wipe(tmp_path / "x@no_sds", frames=4)) as film:
        assert film.n_frames == 4 and film.width == turntable.WIPE_WIDTH
        video = cv2.VideoCapture(str(tmp_path / "x@no_sds/before_after.webm"))
        assert video.get(cv2.CAP_PROP_FRAME_WIDTH) == turntable.WIPE_WIDTH, "small photographs are enlarged"
        for frame, has_object in ((0, True), (2, False)):
            film.seek(frame)
            red, green, _ = np.moveaxis(np.asarray(film.convert("RGB"), int), -1, 0)
            assert (red - green > 170).any() == has_object, "the line starts on the right, which is before"
