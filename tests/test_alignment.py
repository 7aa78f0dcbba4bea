"""Alignment of estimated disparity or depth with known depth: exact recovery, outliers and degenerate input."""

import numpy as np
import pytest

from reffusion.depth.alignment import align, align_depth


@pytest.mark.parametrize("offset", [0.0, 1e4])
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e9])
def test_alignment_recovers_scale_and_offset_in_any_unit(offset, unit):
    x = np.random.default_rng(0).normal(size=(8, 9)) * unit + offset * unit
    fitted = align(x, -3.0 * x / unit + 7.0)
    assert fitted.scale == pytest.approx(-3.0 / unit, rel=1e-9)
    np.testing.assert_allclose(fitted.apply(x), -3.0 * x / unit + 7.0, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("weights", ["equal", "random", "known or not"])
def test_alignment_solves_the_weighted_normal_equations(weights):
    draw = np.random.default_rng(0)
    x, noise = draw.normal(3, 2, 200), draw.normal(0, 0.3, 200)
    y = 0.7 * x - 1.2 + noise
    w = {"equal": np.ones(200), "random": draw.random(200), "known or not": draw.random(200) > 0.3}[weights] * 1.0
    matrix = np.array([[(w * x * x).sum(), (w * x).sum()], [(w * x).sum(), w.sum()]])
    scale, offset = np.linalg.inv(matrix) @ ((w * x * y).sum(), (w * y).sum())
    found = align(x, np.where(w > 0, y, 1e9), w)
    np.testing.assert_allclose((found.scale, found.offset), (scale, offset), rtol=1e-10)
    misfit = np.sqrt((w * (y - scale * x - offset) ** 2).sum() / w.sum())
    assert found.residual == pytest.approx(misfit, rel=1e-9)


def test_robust_alignment_lets_go_of_outliers():
    rng = np.random.default_rng(0)
    x = rng.normal(size=300)
    y = 2.0 * x + 1.0 + 1e-3 * rng.normal(size=300)
    y[:75] += 5.0
    fitted = align(x, y, robust=True)
    assert (fitted.scale, fitted.offset) == pytest.approx((2.0, 1.0), abs=1e-3)
    assert abs(align(x, y).offset - 1.0) > 1.0


@pytest.mark.parametrize(
    ("x", "weights", "message"),
    [
        (np.array([1.0, 2.0, 3.0]), None, "at least 4"),
        (np.arange(9.0), np.arange(9) < 3, "at least 4"),
        (np.full(9, 2.5), None, "constant"),
        (1e5 + 1e-7 * np.arange(9.0), None, "constant"),
        (np.array([1.0, 2.0, 3.0, np.nan, 5.0]), None, "not finite"),
    ],
)
def test_degenerate_alignments_are_refused(x, weights, message):
    with pytest.raises(ValueError, match=message):
        align(x, np.ones_like(x), weights)


def test_disparity_and_depth_are_aligned_each_in_its_space():
    rng = np.random.default_rng(0)
    depth = rng.uniform(1.0, 5.0, (10, 12))
    known = rng.random((10, 12)) > 0.4
    estimate = (1.0 / depth - 0.05) * 40.0
    np.testing.assert_allclose(align_depth(estimate, depth, known), depth, rtol=1e-9)
    np.testing.assert_allclose(align_depth(3.0 * depth + 1, depth, known, space="depth"), depth, rtol=1e-9)
    with pytest.raises(ValueError, match="is it depth"):
        align_depth(depth, depth, known, space="disparity")


def test_alignment_beyond_infinity_stays_finite():
    depth = np.array([[1.0, 2.0, 4.0, 4.0], [1.0, 2.0, 4.0, 4.0]])
    estimate = 1.0 / depth
    estimate[:, 3] = -1.0
    known = np.ones_like(depth)
    known[:, 3] = 0
    assert align_depth(estimate, depth, known)[0].tolist() == pytest.approx([1.0, 2.0, 4.0, 4.0])
