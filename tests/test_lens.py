"""Lens models agree with COLMAP, and pictures and masks are undistorted correctly."""

from __future__ import annotations

import numpy as np
import pytest
from scenes.capture import FISHEYE, HEIGHT, OPENCV, PINHOLE, RADIAL, WIDTH, Truth, make_truth, run_stages, write_capture

from reffusion.capture import lens
from reffusion.io.images import save_image, save_mask
from reffusion.io.scene import load_raw_masks, load_views


def splat_dots(truth: Truth, name: str) -> np.ndarray:
    """Return a distorted picture uint8 [H, W, 3] of soft dots on a plane, and the directions (x/z, y/z) [N, 2]."""
    pose = truth.world_to_camera[name]
    grid = np.stack(np.meshgrid(np.linspace(-1.2, 1.2, 5), np.linspace(-0.9, 0.9, 4), [0.0]), -1).reshape(-1, 3)
    at = grid @ pose[:3, :3].T + pose[:3, 3]
    directions = at[:, :2] / at[:, 2:]
    pixels = lens.to_pixels(directions, truth.lens)
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    squares = (columns[..., None] - pixels[:, 0]) ** 2 + (rows[..., None] - pixels[:, 1]) ** 2
    image = 230.0 * np.exp(-squares / (2 * 1.2**2)).sum(axis=2)
    return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, 2), directions


@pytest.mark.parametrize("model", [RADIAL, OPENCV, FISHEYE], ids=lambda m: m[0])
def test_a_dot_grid_undistorts_onto_the_pinhole(tmp_path, model):
    truth = make_truth(model)
    folder = write_capture(tmp_path / "s", "colmap", truth)
    directions = {}
    for name in truth.world_to_camera:
        image, directions[name] = splat_dots(truth, name)
        save_image(folder / "images" / f"{name}.png", image)
    scene, out = run_stages(folder)
    found = 0
    for name, image in load_views(out, scene.train).items():
        camera = scene.cameras[name]
        for u, v in directions[name] * (camera.fx, camera.fy) + (camera.cx, camera.cy):
            left, top = int(u) - 2, int(v) - 2
            patch = image[max(top, 0) : top + 5, max(left, 0) : left + 5, 0].astype(float)
            if patch.shape != (5, 5) or top < 0 or left < 0:
                continue
            # Fit a paraboloid, which is the logarithm of a Gaussian, because moments are biased by the window's edge.
            rows, columns = np.mgrid[top : top + 5, left : left + 5] + 0.5
            inside = patch > 40
            design = np.stack([columns, rows, columns**2, rows**2, columns * rows, np.ones_like(rows)], -1)[inside]
            a, b, c, d, e, _ = np.linalg.lstsq(design, np.log(patch[inside]), rcond=None)[0]
            peak = np.linalg.solve([[2 * c, e], [e, 2 * d]], [-a, -b])
            assert np.abs(peak - (u, v)).max() < 0.1
            found += 1
    assert found > 80


def test_masks_follow_the_image_through_the_lens(tmp_path):
    truth = make_truth(OPENCV)
    folder = write_capture(tmp_path / "s", "colmap", truth)
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    image = np.uint8(128 + 120 * np.sin(columns / 6) * np.sin(rows / 5))
    for name in truth.world_to_camera:
        save_image(folder / "images" / f"{name}.png", np.repeat(image[..., None], 3, 2))
        save_mask(folder / "masks" / f"{name}.png", image >= 160)
    scene, out = run_stages(folder, trust=True)  # all views show one picture
    images, masks = load_views(out, scene.train), load_raw_masks(out, scene.train)
    for name in scene.train:
        difference = (images[name][..., 0] >= 160) ^ masks[name]
        assert difference.sum() < 0.04 * masks[name].sum()


@pytest.mark.parametrize("model", [RADIAL, OPENCV, FISHEYE], ids=lambda m: m[0])
def test_no_border_is_left_and_little_is_cropped(model):
    whole = lens.from_colmap(model[0], WIDTH, HEIGHT, model[1])
    where = lens.sampling_map(whole, lens.undistorted_pinhole(whole))
    assert where.min() >= 0 and (where <= (WIDTH, HEIGHT)).all()
    touches = (
        where[:, 0, 0].min(),
        where[0, :, 1].min(),
        WIDTH - where[:, -1, 0].max(),
        HEIGHT - where[-1, :, 1].max(),
    )
    assert min(touches) < 1.0


@pytest.mark.parametrize(
    "model",
    [
        PINHOLE,
        RADIAL,
        OPENCV,
        FISHEYE,
        ("PINHOLE", (90.0, 92.0, 47.0, 36.0)),
        ("RADIAL", (90.0, 47.0, 36.0, 0.05, -0.02)),
        ("FULL_OPENCV", (90.0, 91.0, 47.0, 36.0, 0.06, -0.08, -0.001, 0.002, 0.01, 0.02, -0.01, 0.003)),
        ("SIMPLE_RADIAL_FISHEYE", (60.0, 47.0, 36.0, 0.02)),
        ("RADIAL_FISHEYE", (60.0, 47.0, 36.0, 0.02, -0.01)),
    ],
    ids=lambda m: m[0],
)
def test_lenses_agree_with_colmap(model):
    import pycolmap

    ours = lens.from_colmap(model[0], WIDTH, HEIGHT, model[1])
    theirs = pycolmap.Camera(model=model[0], width=WIDTH, height=HEIGHT, params=model[1])
    directions = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 2))
    pixels = lens.to_pixels(directions, ours)
    np.testing.assert_allclose(pixels, theirs.img_from_cam(np.c_[directions, np.ones(200)]), atol=1e-10)
    np.testing.assert_allclose(lens.to_directions(pixels, ours), directions, atol=1e-12)
    np.testing.assert_allclose(lens.to_pixels(np.zeros(2), ours), (ours.cx, ours.cy))


def test_a_lens_that_folds_over_is_refused():
    with pytest.raises(ValueError, match="cannot be undone"):
        lens.undistorted_pinhole(lens.from_colmap("SIMPLE_RADIAL", WIDTH, HEIGHT, (40.0, 48.0, 36.0, -0.5)))
    with pytest.raises(ValueError, match="FOV"):
        lens.from_colmap("FOV", WIDTH, HEIGHT, (40.0, 40.0, 48.0, 36.0, 0.9))
