"""Exposure gains: the relative brightness of photographs, estimated from sparse points that several of them show."""

import numpy as np
import pytest
from scenes import wall_scene

from reffusion.fit import preparation
from reffusion.fit.gains import brightness_deviation, estimate_gains
from reffusion.io.scene import load_scene, load_views
from reffusion.params.fit import Params


@pytest.fixture(scope="module")
def wall_photos(tmp_path_factory):
    poses, _, _ = wall_scene.write_poses_and_fit(tmp_path_factory.mktemp("gains") / "wall", 1.5)
    scene = load_scene(poses)
    return scene, [scene.cameras[name] for name in scene.train], load_views(poses, scene.train)


def dim_photos(photos, bright):
    expose = lambda photo, gain: (photo * gain).round().clip(0, 255).astype(np.uint8)
    return {name: expose(photos[name], gain) for name, gain in zip(photos, bright, strict=True)}


def test_gains_are_robust_to_occluders(wall_photos):
    scene, cameras, photos = wall_photos
    bright = np.exp(np.random.default_rng(0).normal(0, 0.15, (len(cameras), 3)))
    bright /= bright.max() * 1.05
    pictures = dim_photos({camera.name: photos[camera.name] for camera in cameras}, bright)
    for photo in list(pictures.values())[::3]:  # an occluder covers a quarter of every third picture
        photo[: photo.shape[0] // 2, : photo.shape[1] // 2] = 200
    found = estimate_gains(scene.points, cameras, pictures)
    expected = bright / np.exp(np.log(bright).mean(0))
    assert np.abs(np.log(found / expected)).max() < 0.06
    assert brightness_deviation(found) > 0.05 > brightness_deviation(estimate_gains(scene.points, cameras, photos))


def test_gains_are_one_without_shared_points(wall_photos):
    scene, cameras, photos = wall_photos
    assert np.array_equal(estimate_gains(np.zeros((0, 3)), cameras, photos), np.ones((len(cameras), 3)))
    black = {name: np.zeros_like(photo) for name, photo in photos.items()}
    assert np.array_equal(estimate_gains(scene.points, cameras, black), np.ones((len(cameras), 3)))


def test_the_stage_fits_exposures_where_photographs_differ(wall_photos, capsys):
    scene, cameras, photos = wall_photos
    estimate = lambda how, images: preparation.estimate_exposures(Params(exposure=how), scene, cameras, images)
    bright = np.where(np.arange(len(cameras)) % 2, 0.6, 0.9)[:, None]
    uneven_ones = dim_photos({camera.name: photos[camera.name] for camera in cameras}, bright)
    assert estimate("auto", photos) is None and estimate("never", uneven_ones) is None
    assert estimate("always", photos) is not None
    found = estimate("auto", uneven_ones)
    assert brightness_deviation(found) == pytest.approx(np.log(bright).std(), abs=0.01)
    assert "exposures are fitted: the brightness of the same points differs by" in capsys.readouterr().out
    even = preparation.equalize_exposure(uneven_ones, cameras, found)
    assert brightness_deviation(estimate_gains(scene.points, cameras, even)) < 0.02
