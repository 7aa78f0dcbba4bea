"""Image metrics, compared with independent implementations and at limits: one pixel, constant or equal images."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reffusion.metrics import image_metrics, lpips
from reffusion.metrics.image_metrics import Box, mask_box


def noisy_pair(height, width, seed=0, noise=0.1):
    rng = np.random.default_rng(seed)
    truth = rng.random((height, width, 3))
    return np.clip(truth + noise * rng.standard_normal(truth.shape), 0, 1), truth


# --- bounding box of the mask


def test_box_grows_by_a_tenth_of_its_extent_on_each_side():
    mask = np.zeros((100, 200), bool)
    mask[40:60, 50:80] = True  # 20 rows, 30 columns
    assert mask_box(mask, 0.1) == Box(47, 38, 83, 62)
    assert mask_box(mask, 0.0) == Box(50, 40, 80, 60)


def test_box_is_rounded_outwards_and_clipped_at_the_border():
    mask = np.zeros((30, 30), bool)
    mask[0:5, 27:30] = True
    assert mask_box(mask, 0.1) == Box(26, 0, 30, 6)
    assert mask_box(np.ones((7, 9), bool), 5.0) == Box(0, 0, 9, 7)


def test_an_empty_mask_has_no_box_and_one_pixel_has_one():
    assert mask_box(np.zeros((4, 5), bool)) is None
    mask = np.zeros((4, 5), bool)
    mask[2, 3] = True
    assert mask_box(mask, 0.0) == Box(3, 2, 4, 3)
    assert mask_box(np.ones((1, 1), bool), 0.1) == Box(0, 0, 1, 1)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_box_holds_the_mask_and_lies_in_the_image(seed, dilation):
    rng = np.random.default_rng(seed)
    mask = rng.random((int(rng.integers(1, 20)), int(rng.integers(1, 20)))) < 0.2
    box = mask_box(mask, dilation)
    if box is None:
        assert not mask.any()
    else:
        assert box.crop(mask).sum() == mask.sum()
        assert 0 <= box.left < box.right <= mask.shape[1] and 0 <= box.top < box.bottom <= mask.shape[0]


# --- PSNR


def test_psnr_of_a_known_error():
    truth = np.full((5, 7, 3), 0.5)
    assert image_metrics.psnr(truth + 0.1, truth) == pytest.approx(20.0)
    assert image_metrics.psnr(np.full((1, 1, 3), 1, np.uint8), np.zeros((1, 1, 3), np.uint8)) == pytest.approx(
        48.1308, 1e-5
    )
    assert image_metrics.psnr(truth, truth) == math.inf


def test_a_mean_counts_an_identical_view_as_the_cap_and_skips_what_is_missing():
    assert image_metrics.mean([math.inf, 20.0, None]) == 60.0
    assert image_metrics.mean([0.25, 0.75]) == 0.5
    assert image_metrics.mean([None, None]) is None and image_metrics.mean([]) is None


# --- SSIM


def ssim_by_definition(x, y):
    """Compute the SSIM of Wang et al., averaged over channels and all Gaussian windows of 11 px inside the image."""
    line = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    weight = np.outer(line, line) / line.sum() ** 2
    values = []
    for channel in range(3):
        for i in range(x.shape[0] - 10):
            for j in range(x.shape[1] - 10):
                a, b = (z[i : i + 11, j : j + 11, channel] for z in (x, y))
                ma, mb = (weight * a).sum(), (weight * b).sum()
                va, vb = (weight * (a - ma) ** 2).sum(), (weight * (b - mb) ** 2).sum()
                cov = (weight * (a - ma) * (b - mb)).sum()
                c1, c2 = 0.01**2, 0.03**2
                values.append((2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))
    return np.mean(values)


def test_ssim_equals_its_definition_over_the_valid_region():
    image, truth = noisy_pair(17, 14)
    assert image_metrics.ssim(image, truth) == pytest.approx(ssim_by_definition(image, truth), abs=1e-10)


def test_ssim_edges():
    image, truth = noisy_pair(11, 11)
    assert image_metrics.ssim(image, truth) == pytest.approx(ssim_by_definition(image, truth), abs=1e-10)
    assert image_metrics.ssim(truth, truth) == pytest.approx(1.0)
    black, white = np.zeros((12, 12, 3)), np.ones((12, 12, 3))
    assert image_metrics.ssim(black, white) == pytest.approx(1e-4 / (1 + 1e-4))
    with pytest.raises(ValueError, match="11 px"):
        image_metrics.ssim(image[:10], truth[:10])


# --- scores outside the mask


def test_outside_a_mask_only_what_lies_outside_counts():
    image, truth = noisy_pair(40, 50)
    mask = np.zeros((40, 50), bool)
    mask[10:25, 15:35] = True
    found = image_metrics.score_outside(image, truth, mask)
    assert found["psnr_outside"] == pytest.approx(-10 * np.log10(((image - truth)[~mask] ** 2).mean()))
    other = np.where(mask[..., None], np.random.default_rng(1).random((40, 50, 3)), image)
    assert image_metrics.score_outside(other, truth, mask) == found
    right = np.where(mask[..., None], image, truth)
    clean = image_metrics.score_outside(right, truth, mask)
    assert clean["psnr_outside"] == math.inf and clean["ssim_outside"] == pytest.approx(1) and not clean["flip_outside"]


def test_outside_nothing_is_the_whole_picture_and_outside_all_is_nothing():
    image, truth = noisy_pair(20, 30)
    found, whole = (
        image_metrics.score_outside(image, truth, np.zeros((20, 30), bool)),
        image_metrics.score(image, truth),
    )
    assert found == {f"{name}_outside": pytest.approx(value) for name, value in whole.items()}
    assert set(image_metrics.score_outside(image, truth, np.ones((20, 30), bool)).values()) == {None}
    small = image_metrics.score_outside(image[:10], truth[:10], np.zeros((10, 30), bool))
    assert small["ssim_outside"] is None and small["flip_outside"] > 0


def test_where_the_truth_shows_the_object_only_the_outside_is_scored():
    image, truth = noisy_pair(40, 50)
    mask = np.zeros((40, 50), bool)
    mask[10:25, 15:35] = True
    found = image_metrics.score_view(image, truth, mask_box(mask), mask=mask, shows_object=True)
    names = {name for name, value in found.items() if value is not None}
    assert names == {"psnr_outside", "ssim_outside", "flip_outside"} and tuple(found) == image_metrics.COLUMNS


# --- FLIP


def test_flip_is_zero_for_identical_one_for_the_worst_and_grows_between():
    image, truth = noisy_pair(32, 32, noise=0.02)
    worse, _ = noisy_pair(32, 32, noise=0.3)
    assert image_metrics.flip(truth, truth) == 0.0
    assert 0 < image_metrics.flip(image, truth) < image_metrics.flip(worse, truth) < 1
    black, white = np.zeros((40, 40, 3)), np.ones((40, 40, 3))
    assert 0.9 < image_metrics.flip(white, black) <= 1.0


def test_flip_is_that_of_its_authors():
    """The FLIP mean and map equal those of flip-evaluator, for random colors, odd image sizes and smooth images."""
    import flip_evaluator

    draw = np.random.default_rng(3)
    rough, smooth = draw.random((67, 121, 3)), np.linspace(0, 1, 90 * 80 * 3).reshape(90, 80, 3)
    for truth, image in [(rough, draw.random(rough.shape)), (smooth, smooth[::-1]), (smooth, 0.9 * smooth + 0.05)]:
        pair = (np.ascontiguousarray(x, np.float32) for x in (truth, image))
        settings = {"ppd": image_metrics.PIXELS_PER_DEGREE}
        theirs = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False, computeMeanError=False, parameters=settings)
        ours = image_metrics.flip_map(image, truth)
        assert np.abs(ours - theirs[0].reshape(ours.shape)).max() < 1e-4 and ours.dtype == np.float32
        assert abs(ours.mean() - theirs[0].mean()) < 2e-6


def test_flip_of_one_pixel_and_of_a_view_into_a_larger_array():
    black, white = np.zeros((1, 1, 3), np.uint8), np.full((1, 1, 3), 255, np.uint8)
    assert image_metrics.flip(black, black) == 0.0 < image_metrics.flip(white, black)
    image, truth = noisy_pair(40, 40)
    window = Box(5, 7, 30, 22)
    copies = window.crop(image).copy(), window.crop(truth).copy()
    assert image_metrics.flip(window.crop(image), window.crop(truth)) == image_metrics.flip(*copies)


# --- images that every metric refuses


@pytest.mark.parametrize("metric", [image_metrics.psnr, image_metrics.ssim, image_metrics.flip])
def test_bad_images_are_refused(metric):
    image, truth = noisy_pair(16, 16)
    for wrong, message in [
        (image[:, :15], "one size"),
        (image[..., :1], "one size"),
        (np.full_like(image, np.nan), r"\[0, 1\]"),
        (image * 255, r"\[0, 1\]"),
        ((image * 255).astype(np.int32), "uint8 or float"),
    ]:
        with pytest.raises(ValueError, match=message):
            metric(wrong, truth)
    with pytest.raises(ValueError, match="at least one pixel"):
        metric(image[:0], truth[:0])


def test_bytes_and_floats_score_alike():
    image, truth = ((255 * x).round().astype(np.uint8) for x in noisy_pair(20, 20))
    for metric in (image_metrics.psnr, image_metrics.ssim, image_metrics.flip):
        assert metric(image, truth) == pytest.approx(metric(image / 255, truth / 255), rel=1e-6)


# --- the scores of one view


def test_score_view_leaves_out_what_is_too_small():
    image, truth = noisy_pair(40, 50)
    targets = image_metrics.lpips_targets(truth[4:34, 3:13], {"vgg": lpips.Lpips("vgg")})
    row = image_metrics.score_view(image, truth, Box(3, 4, 13, 34), targets)  # 10 px wide
    assert tuple(row) == image_metrics.COLUMNS
    assert row["psnr_box"] == image_metrics.psnr(image[4:34, 3:13], truth[4:34, 3:13])
    assert row["ssim_box"] is None and row["lpips_vgg_box"] is None and row["lpips_alex_box"] is None
    assert row["ssim_full"] == image_metrics.ssim(image, truth)
    row = image_metrics.score_view(image, truth, None)
    assert row["psnr_box"] is None and row["flip_box"] is None and row["psnr_full"] is not None


def test_side_by_side_draws_the_box_and_leaves_the_pictures_alone():
    first, second = (np.full((6, 8, 3), v, np.uint8) for v in (10, 200))
    strip = image_metrics.join_side_by_side([first, second], Box(2, 1, 6, 5))
    assert strip.shape == (6, 20, 3) and (strip[:, 8:12] == 255).all()
    assert (strip[1, 2] == (255, 220, 0)).all() and (strip[4, 17] == (255, 220, 0)).all()
    assert (strip[2, 3] == 10).all() and (strip[0, 0] == 10).all() and (strip[2, 15] == 200).all()
    assert (first == 10).all()
    assert image_metrics.join_side_by_side([np.zeros((1, 1, 3), np.uint8)], Box(0, 0, 1, 1)).shape == (1, 1, 3)
