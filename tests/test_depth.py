"""Depth completion continues planes and creases; the bilateral solver smooths within edges."""

import numpy as np
import pytest

from reffusion.depth import bilateral, completion, planes
from reffusion.depth.completion import Plate
from reffusion.depth.inpaint_depth import inpaint_depth
from reffusion.seeding import generator

ROWS, COLUMNS = np.mgrid[:48, :64].astype(float)
PLANE = 0.4 + 0.003 * COLUMNS - 0.002 * ROWS
INNER = (ROWS > 14) & (ROWS < 34) & (COLUMNS > 20) & (COLUMNS < 45)


def room_corner():
    """Return the disparity [H, W] of a floor below a wall, and a picture [H, W, 3] in which the two colors differ."""
    floor, wall = 0.5 + 0.02 * (ROWS - 24.0), 0.5 + 0.001 * (COLUMNS - 32)
    picture = np.where((floor > wall)[..., None], (0.8, 0.5, 0.2), (0.3, 0.4, 0.6))
    return np.maximum(floor, wall), picture


def hide_hole(disparity, hole, filler=9.0):
    return np.where(hole, filler, disparity)


@pytest.mark.parametrize("textured", [False, True])
@pytest.mark.parametrize("hole", [INNER, INNER | ((ROWS < 20) & (COLUMNS > 30)), COLUMNS > 10])
def test_a_plane_is_continued_to_rounding(hole, textured):
    guide = np.random.default_rng(0).random((48, 64, 3)) if textured else None
    completed = completion.complete(hide_hole(PLANE, hole), ~hole, guide)
    np.testing.assert_allclose(completed, PLANE, rtol=1e-12)


def test_known_pixels_are_returned_as_they_are():
    noisy = PLANE + 0.01 * np.random.default_rng(0).normal(size=PLANE.shape)
    completed = completion.complete(noisy, ~INNER)
    assert (completed == noisy)[~INNER].all()
    assert np.abs(completed - PLANE)[INNER].max() < 0.03


def test_a_crease_that_the_guide_shows_is_continued():
    disparity, picture = room_corner()
    with_guide = np.abs(completion.complete(hide_hole(disparity, INNER), ~INNER, picture) - disparity)[INNER]
    without = np.abs(completion.complete(hide_hole(disparity, INNER), ~INNER) - disparity)[INNER]
    assert with_guide.max() < 2e-3 < 0.02 < without.max()


def test_two_holes_do_not_disturb_each_other():
    left, right = (COLUMNS < 20) & INNER.T[:48, :48].any(), COLUMNS > 60
    hole = left & (COLUMNS > 6) & (ROWS > 10) & (ROWS < 30) | right
    disparity = np.where(COLUMNS > 40, 1.0 + 0.01 * ROWS, PLANE)
    np.testing.assert_allclose(
        completion.complete(hide_hole(disparity, hole), ~hole, plate=Plate(ring=0.04)), disparity, rtol=1e-10
    )


def test_the_coarse_path_agrees_with_the_fine_one():
    disparity = PLANE + 0.01 * np.sin(COLUMNS / 15) * np.cos(ROWS / 20)
    fine = completion.complete(disparity, ~INNER)
    coarse = completion.complete(disparity, ~INNER, plate=Plate(most_unknowns=400))
    assert np.abs(fine - coarse).max() < 3e-4
    np.testing.assert_allclose(completion.complete(PLANE, ~INNER, plate=Plate(most_unknowns=400)), PLANE, rtol=1e-12)


def test_nothing_to_complete_is_a_copy():
    completed = completion.complete(PLANE, np.ones(PLANE.shape))
    assert (completed == PLANE).all() and completed is not PLANE


@pytest.mark.parametrize("known", [[], [(3, 3)], [(3, 3), (3, 9)], [(3, 3), (3, 9), (3, 20)]])
def test_too_few_known_pixels_are_refused(known):
    confidence = np.zeros(PLANE.shape)
    for pixel in known:
        confidence[pixel] = 1.0
    with pytest.raises(ValueError, match="fix no plane"):
        completion.complete(PLANE, confidence)


def test_bad_arrays_are_refused():
    with pytest.raises(ValueError, match="not finite on known"):
        completion.complete(np.where(INNER, PLANE, np.nan), np.ones(PLANE.shape))
    with pytest.raises(ValueError, match="guide is"):
        completion.complete(PLANE, ~INNER, np.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match="not negative"):
        completion.complete(PLANE, -1.0 * INNER)
    with pytest.raises(ValueError, match="no pixel of positive confidence"):
        bilateral.solve(PLANE, np.zeros(PLANE.shape), np.zeros((48, 64, 3), np.uint8))


def test_the_solver_smooths_within_edges_and_not_across():
    step = np.where(COLUMNS < 32, 0.2, 0.8)
    guide = np.repeat(np.where(COLUMNS < 32, 90, 180)[..., None], 3, -1).astype(np.uint8)
    noisy = step + 0.05 * np.random.default_rng(0).normal(size=step.shape)
    solved = bilateral.solve(noisy, np.where(INNER, 0.0, 1.0), guide)
    assert np.abs(solved - step).max() < 0.02


def test_the_solver_keeps_constants_and_fills_unreached_cells_with_the_mean():
    guide = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    constant = np.full(PLANE.shape, 3.25)
    np.testing.assert_allclose(bilateral.solve(constant, (~INNER).astype(float), guide), 3.25, rtol=1e-12)


def test_refine_keeps_an_estimate_without_misfit_and_spreads_a_constant_one():
    guide = np.repeat((COLUMNS * 2)[..., None], 3, -1).astype(np.uint8)
    np.testing.assert_allclose(bilateral.refine(PLANE, hide_hole(PLANE, INNER), ~INNER, guide), PLANE, rtol=1e-12)
    shifted = bilateral.refine(PLANE - 0.1, hide_hole(PLANE, INNER), (~INNER).astype(float), guide)
    np.testing.assert_allclose(shifted, PLANE, rtol=1e-9)


def sample_disparity(disparity, keep):
    rows, columns = np.nonzero(keep)
    return np.stack([columns, rows], 1) + 0.5, disparity[rows, columns]


def test_planes_of_a_room_meet_in_their_crease():
    disparity, _ = room_corner()
    pixels, values = sample_disparity(disparity, ~INNER)
    model = planes.planar_model(pixels, values, disparity.shape, generator(0))
    np.testing.assert_allclose(model.disparity, disparity, rtol=1e-9)
    assert model.planes == 2 and model.explained == 1.0


def test_a_convex_edge_is_continued_too():
    disparity = np.minimum(0.4 + 0.01 * COLUMNS, 1.2 - 0.012 * COLUMNS)
    model = planes.planar_model(*sample_disparity(disparity, ~INNER), disparity.shape, generator(0))
    np.testing.assert_allclose(model.disparity, disparity, rtol=1e-9)


def test_a_plane_before_the_wall_does_not_cut_through_the_hole():
    disparity = np.where(COLUMNS > 50, PLANE + 0.3, PLANE) + 1e-4 * np.random.default_rng(0).normal(size=PLANE.shape)
    model = planes.planar_model(*sample_disparity(disparity, ~INNER), disparity.shape, generator(0))
    np.testing.assert_allclose(model.disparity[INNER], PLANE[INNER], rtol=1e-3)
    assert model.explained < 0.9


def test_too_few_samples_fix_no_plane():
    with pytest.raises(ValueError, match="fix no plane"):
        planes.planar_model(np.arange(22.0).reshape(11, 2), np.ones(11), (48, 64), generator(0))
    line = np.stack([np.arange(30.0), 2 * np.arange(30.0)], 1)
    with pytest.raises(ValueError, match="fix no plane"):
        planes.planar_model(line, np.ones(30), (48, 64), generator(0))


def test_far_pixels_keep_their_depth_beside_one_very_near():
    """One pixel is 3000 times nearer than all others, like a floater close to the camera."""
    depth, known = np.full((20, 20), 30.0), np.ones((20, 20), bool)
    depth[0, 0], known[8:12, 8:12] = 0.01, False
    found = inpaint_depth(depth, known)
    np.testing.assert_allclose(found[known], depth[known])
    assert (found[~known] == 0).all()
