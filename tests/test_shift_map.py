"""The shift map: holes filled with large pieces of the same photograph."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes.images import disk_mask

from reffusion import geometry
from reffusion.inpaint.normals import mean_normals
from reffusion.inpaint.shift_map.photo_offsets import fill_from_photo, frequent_offsets
from reffusion.inpaint.source_image import without_geometry
from reffusion.types import Camera

pytestmark = pytest.mark.integration

HEIGHT, WIDTH = 120, 200
PATH = slice(40, 56)
HOLE = disk_mask((HEIGHT, WIDTH), 58, 100, 27)


def paint_lawn(path: bool = True) -> np.ndarray:
    """Return a picture, uint8 [H, W, 3], of grass and, if `path`, a pale path across it."""
    draws = np.random.default_rng(0)
    green = np.array([70, 110, 50]) + draws.normal(0, 18, (HEIGHT, WIDTH, 1))
    if path:
        green[PATH] = np.array([170, 165, 160]) + draws.normal(0, 6, (16, WIDTH, 1))
    return green.clip(0, 255).astype(np.uint8)


def fill_and_mark(image: np.ndarray, seed: int = 0, **fields) -> tuple[np.ndarray, np.ndarray]:
    photo = replace(without_geometry(image, HOLE), **fields)  # type: ignore[arg-type]
    found = fill_from_photo(photo, HOLE, photo, seed=seed)
    return found.image, found.filled


def gradient_energy(image: np.ndarray) -> float:
    inner = HOLE[1:, 1:]
    gray = image.astype(float).mean(2)
    return float((np.diff(gray, axis=0)[:, 1:][inner] ** 2 + np.diff(gray, axis=1)[1:][inner] ** 2).mean())


@pytest.mark.parametrize("seed", range(3))
def test_a_path_goes_on_and_the_lawn_stays_as_sharp_as_it_is(seed):
    truth = paint_lawn()
    image = np.where(HOLE[..., None], np.uint8((255, 0, 0)), truth)
    painted, filled = fill_and_mark(image, seed)
    assert filled[HOLE].all() and (painted[~HOLE] == image[~HOLE]).all()
    inside = HOLE.copy()
    inside[:42], inside[54:] = False, False
    assert np.abs(painted[inside].mean(0) - truth[inside].mean(0)).max() < 6, "the path"
    below = HOLE.copy()
    below[:60] = False
    assert np.abs(painted[below].mean(0) - truth[below].mean(0)).max() < 6, "the lawn"
    assert 0.8 < gradient_energy(painted) / gradient_energy(truth) < 1.15
    assert (fill_and_mark(image, seed)[0] == painted).all(), "the same seed, the same picture"


def test_pixels_of_other_slope_or_layer_are_not_copied():
    """The lower part of the picture is plain and has the lawn's color, but another normal or layer than the hole.

    Patches alone could not distinguish it from the lawn, so the hole would be filled with plain color.
    """
    truth = paint_lawn(path=False)
    truth[80:] = (90, 100, 90)
    image = np.where(HOLE[..., None], np.uint8((255, 0, 0)), truth)
    normal = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    normal[..., 2] = 1
    normal[80:] = (0, 1, 0)
    normal[HOLE] = (0, 0, 1)
    assert gradient_energy(fill_and_mark(image, normal=normal)[0]) > 0.8 * gradient_energy(truth)
    layer = np.zeros((HEIGHT, WIDTH), np.int64)
    layer[HOLE] = 1
    assert not fill_and_mark(image, layer=layer)[1].any(), "nothing else of it is shown"


def test_without_source_pixels_nothing_is_filled():
    image = paint_lawn()
    nowhere = np.zeros((HEIGHT, WIDTH), bool)
    none = fill_from_photo(without_geometry(image, nowhere), nowhere, without_geometry(image, nowhere))
    assert not none.filled.any() and (none.image == image).all()
    assert not fill_and_mark(image, usable=nowhere)[1].any()
    everywhere = ~nowhere
    assert not fill_from_photo(
        without_geometry(image, everywhere), everywhere, without_geometry(image, everywhere)
    ).filled.any()


def test_stripes_repeat_by_their_period():
    stripes = np.broadcast_to((np.arange(WIDTH) % 20 < 7)[None, :, None] * 100.0, (HEIGHT, WIDTH, 3))
    stripes = stripes + np.random.default_rng(0).normal(0, 1, stripes.shape)
    found = frequent_offsets(stripes, np.ones((HEIGHT, WIDTH), bool), np.zeros((HEIGHT, WIDTH)), 64, seed=0)
    beside = np.abs(found[:20, 1] - 20 * np.round(found[:20, 1] / 20))
    assert beside.max() <= 1


def test_patches_that_are_all_too_near_to_each_other_have_no_offsets():
    readable = np.zeros((HEIGHT, WIDTH), bool)
    readable[40:70, 40:70] = True
    noise = np.random.default_rng(0).normal(0, 20, (HEIGHT, WIDTH, 3))
    offsets = lambda width: frequent_offsets(noise, readable, np.zeros((HEIGHT, WIDTH)), width, seed=0)
    assert len(offsets(8 * 40)) == 0
    assert len(offsets(8 * 10)) > 0


def test_slopes_are_those_of_the_ground_and_short_among_leaves():
    tilt, pose = np.deg2rad(60.0), np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, -np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), -np.cos(tilt)]]
    pose[:3, 3] = -pose[:3, :3] @ np.array([0.0, 0.0, 1.0])
    view = Camera("a", WIDTH, HEIGHT, 150.0, 150.0, WIDTH / 2, HEIGHT / 2, pose)
    rays = geometry.pixel_rays(view) @ pose[:3, :3]
    depth = np.where(rays[..., 2] < -0.05, 1.0 / np.maximum(-rays[..., 2], 0.05), 0.0)
    known = (depth > 0) & (depth < 3)
    found = mean_normals(depth, known, view)
    middle = found[HEIGHT // 2 : -20, 40:-40].reshape(-1, 3)
    assert np.abs(middle - (0, 0, 1)).max() < 0.02
    rough = 1 + 2 * cv2.GaussianBlur(np.random.default_rng(0).normal(0, 1, depth.shape), (0, 0), 3)
    leaves = mean_normals(depth * rough, known, view)[HEIGHT // 2 : -20, 40:-40]
    assert np.linalg.norm(leaves, axis=-1).mean() < 0.8
    assert (mean_normals(depth, np.zeros_like(known), view) == 0).all()


def test_without_matching_slopes_nothing_is_filled():
    normal = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    normal[..., 2] = 1
    normal[HOLE] = (0, 1, 0)
    image = np.where(HOLE[..., None], np.uint8((255, 0, 0)), paint_lawn())
    assert not fill_and_mark(image, normal=normal)[1].any()


def test_a_plane_seen_edge_on_stops_nothing():
    surface, flat = np.ones((HEIGHT, WIDTH), np.int64), np.broadcast_to(np.eye(2), (HEIGHT, WIDTH, 2, 2)).copy()
    flat[:, :60], flat[:20] = 0.0, np.inf
    image = np.where(HOLE[..., None], np.uint8((255, 0, 0)), paint_lawn())
    painted, filled = fill_and_mark(image, plane=surface, to_plane=flat)
    assert filled[HOLE].all() and gradient_energy(painted) > 0.8 * gradient_energy(paint_lawn())
