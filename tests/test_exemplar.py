"""Exemplar inpainting: patches of photographs are moved along surfaces into the hole, and blended without seams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes.cameras import look_at_camera
from scenes.images import disk_mask, rectangle_mask

from reffusion import geometry
from reffusion.background.mirrors import render_mirrors
from reffusion.background.model import Background
from reffusion.background.plane import CELLS, Plane
from reffusion.background.visibility import DepthView, depth_range
from reffusion.inpaint import exemplar, plane_frames
from reffusion.inpaint.classical import telea
from reffusion.inpaint.patchmatch import completion, search
from reffusion.inpaint.patchmatch.completion import complete
from reffusion.inpaint.patchmatch.matches import NO_MATCH, PATCH_RADIUS, PyramidLevel
from reffusion.inpaint.poisson import blend
from reffusion.inpaint.shift_map import plane_symmetry
from reffusion.inpaint.shift_map.plane_motions import fill_plane
from reffusion.inpaint.shift_map.plane_symmetry import MIN_CELLS, PlanePixels, find_symmetry
from reffusion.inpaint.source_image import flat_source
from reffusion.types import Camera

pytestmark = pytest.mark.integration

SIDE = 128
HOLE = disk_mask((SIDE, SIDE), 70, 62, 24)
RED = (255, 0, 0)


def complete_alone(image, mask, seed=0):
    return complete(flat_source(image, mask), mask, [flat_source(image, mask)], seed=seed).image


def checker_image():
    rows, columns = np.mgrid[:96, :128] // 8
    return np.where((rows + columns) % 2, 200, 60).astype(np.uint8)[..., None].repeat(3, 2)


def middle_mask():
    return rectangle_mask((96, 128), (30, 61), (45, 84))


def test_a_pattern_is_continued_as_sharp_as_it_is():
    """The mean error in the hole of a checkerboard (period 16 px) is below a tenth of half the board's contrast."""
    wrong = lambda painted: np.abs(painted[middle_mask()].astype(int) - checker_image()[middle_mask()]).mean()
    assert (
        wrong(complete_alone(checker_image(), middle_mask())) < 0.1 * 70 < wrong(telea(checker_image(), middle_mask()))
    )


def test_only_the_hole_changes_and_its_content_does_not_count():
    noise = np.random.default_rng(0).integers(0, 256, (96, 128, 3), np.uint8)
    image = np.where(np.arange(128)[None, :, None] < 64, checker_image(), noise)
    painted = complete_alone(image, middle_mask())
    assert (painted[~middle_mask()] == image[~middle_mask()]).all() and painted.dtype == np.uint8
    poisoned = np.where(middle_mask()[..., None], np.uint8(RED), image)
    assert (complete_alone(poisoned, middle_mask()) == painted).all()
    assert (complete_alone(image, middle_mask()) == painted).all(), "the same seed, the same picture"
    assert (complete_alone(image, np.zeros_like(middle_mask())) == image).all()


@pytest.mark.parametrize("kind", ["a pixel", "specks", "at the border", "nearly all"])
def test_every_hole_is_filled(kind):
    image, mask = np.random.default_rng(1).integers(60, 200, (64, 80, 3), np.uint8), np.zeros((64, 80), bool)
    if kind == "a pixel":
        mask[30, 40] = True
    elif kind == "specks":
        mask[:] = np.random.default_rng(2).random(mask.shape) < 0.05
    elif kind == "at the border":
        mask[20:, :30] = True
    else:
        mask[8:] = True
    painted = complete_alone(image, mask)
    assert (painted[~mask] == image[~mask]).all() and painted[mask].min() >= 20, "no pixel is left black"


@pytest.mark.parametrize("shape", [(67, 93), (96, 64)])
def test_sources_may_have_other_sizes(shape):
    rng = np.random.default_rng(3)
    stripes = np.where(np.arange(shape[1])[None, :] % 6 < 3, 40, 210).astype(np.uint8)
    source = np.broadcast_to(stripes[..., None], (*shape, 3)) + rng.integers(0, 5, (*shape, 3), np.uint8)
    image, nothing = np.full((96, 128, 3), 128, np.uint8), np.zeros(shape, bool)
    beside = np.abs(np.arange(128) - 64) > 30
    image[:, beside] = np.where(np.arange(128) % 6 < 3, 40, 210)[None, beside, None]
    painted = complete(flat_source(image, middle_mask()), middle_mask(), [flat_source(source, nothing)]).image
    assert painted[middle_mask()].std() > 50, "striped as the only source is"


def test_masked_pixels_of_a_source_never_show():
    image, mask, red = checker_image(), middle_mask(), np.zeros((96, 128), bool)
    red[::12, ::9] = True
    other = np.where(red[..., None], np.uint8(RED), checker_image())
    source = replace(flat_source(other, red), usable=np.ones_like(red))
    painted = complete(flat_source(image, mask), mask, [source, flat_source(image, mask)]).image[mask].astype(int)
    assert (painted[:, 0] - painted[:, 1]).max() < 30


def test_a_hole_that_no_patch_suits_is_the_worst_completion():
    """The only source shows the hole's plane from a distance 100 times smaller, so no patch has a suitable scale."""
    image, mask = checker_image(), middle_mask()
    target = replace(flat_source(image, mask), plane=np.ones((96, 128), np.int64))
    source = replace(target, to_plane=target.to_plane / 100, pixel_size=target.pixel_size / 100)
    found = complete(target, mask, [source], smooth=[1])
    assert found.misfit >= NO_MATCH and (found.image[~mask] == image[~mask]).all()
    assert complete(target, mask, [target], smooth=[1]).misfit < 1e4


# ------------------------------------------------------------------------------------------------ along a plane


CAMERAS = [
    look_at_camera(name, center, (0.0, 0.0, 0.0), (SIDE, SIDE), 140.0)
    for name, center in (("a", (0.0, -1.2, 0.7)), ("b", (0.7, -1.0, 0.8)), ("c", (-0.8, -0.9, 0.6)))
]
EVERYWHERE, NOWHERE = np.ones((CELLS, CELLS), bool), np.zeros((CELLS, CELLS), bool)
FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0, np.zeros(3), np.eye(3)[:2], 4 / CELLS, EVERYWHERE, EVERYWHERE, NOWHERE,
              EVERYWHERE, NOWHERE)  # fmt: skip


def paint_planks(view: Camera) -> np.ndarray:
    """Return a picture uint8 [H, W, 3] of a floor of planks, 0.12 wide, that run away from camera a."""
    depth = FLOOR.depth(view)
    x, y, _ = np.moveaxis(geometry.unproject(np.where(np.isfinite(depth), depth, 1.0), view), -1, 0)
    joint = np.abs((x + 0.3 * y) / 0.12 % 1 - 0.5) > 0.42
    tone = 150 + 25 * np.sin(7 * np.floor((x + 0.3 * y) / 0.12 + 0.5)) + 6 * np.sin(40 * y)
    return np.where(joint, 40, tone)[..., None].repeat(3, 2).astype(np.uint8)


def floor_background() -> Background:
    views = []
    for view in CAMERAS:
        depth = FLOOR.depth(view)
        depth = np.where(np.isfinite(depth) & (depth < 5), depth, 0).astype(np.float32)
        views.append(DepthView.from_range(view, depth, depth_range(depth), HOLE))
    return Background(views, {view.name: paint_planks(view) for view in CAMERAS}, planes=[FLOOR], radius=1.0)


def test_planks_run_on_in_their_own_perspective():
    image = np.where(HOLE[..., None], np.uint8(RED), paint_planks(CAMERAS[0]))

    found = exemplar.complete_view(image, HOLE, CAMERAS[0], HOLE, floor_background(), range(3))
    off = np.mean([np.abs(each.image.astype(int) - paint_planks(CAMERAS[0]))[HOLE].mean() for each in found])
    plain = np.abs(telea(image, HOLE).astype(int) - paint_planks(CAMERAS[0]))[HOLE].mean()
    assert off < 0.6 * plain


def plane_pixels(picture: np.ndarray, view: Camera) -> PlanePixels:
    """Return the pixels of `picture` that show the floor within a distance of 1.2 from its center."""
    places = plane_frames.plane_coordinates(np.ones((SIDE, SIDE), np.int64), view, [FLOOR])
    rows, columns = np.nonzero((np.linalg.norm(places, axis=-1) < 1.2) & np.isfinite(FLOOR.depth(view)))
    return PlanePixels(np.stack([columns, rows], 1), places[rows, columns], picture)


def test_a_floor_of_planks_repeats_itself_by_their_width():
    found = find_symmetry(plane_pixels(paint_planks(CAMERAS[0]), CAMERAS[0]))
    across = (found.motions @ (1.0, 0.3)) / 0.12  # each shift's component across the planks, in plank widths
    assert found.center is None and len(found.motions) > 5 and np.abs(across - across.round()).max() < 0.25
    assert np.abs(across).max() > 2


def paint_tabletop(view: Camera) -> np.ndarray:
    """Return a picture uint8 [H, W, 3] of twenty planks that meet in a point under a round plate."""
    depth = FLOOR.depth(view)
    x, y, _ = np.moveaxis(geometry.unproject(np.where(np.isfinite(depth), depth, 1.0), view), -1, 0)
    away, turn = np.hypot(x - 0.1, y - 0.4), np.arctan2(y - 0.4, x - 0.1) / (np.pi / 10)
    tone = np.where(np.abs(turn % 1 - 0.5) > 0.42, 40, 150 + 12 * np.sin(11 * np.floor(turn)))
    return np.where(away < 0.3, 215, tone)[..., None].repeat(3, 2).astype(np.uint8)


def test_planks_that_meet_in_a_point_are_turned_about_it():
    found = find_symmetry(plane_pixels(paint_tabletop(CAMERAS[0]), CAMERAS[0]))
    turns = found.motions[:, 0] / (np.pi / 10)
    assert np.linalg.norm(found.center - (0.1, 0.4)) < 0.03
    assert np.abs(turns - turns.round()).max() < 0.15 and np.abs(turns).min() > 0.5 and np.abs(turns).max() > 4
    places = np.random.default_rng(0).normal(size=(50, 2))
    moved, step = found.move(places, found.motions[0]), 1e-4 * np.array([0.6, 0.8])
    assert np.allclose(found.move(moved, -found.motions[0]), places), "a turn and its opposite"
    slope = (found.move(places + step, found.motions[0]) - moved) @ found.rotation(found.motions[0])
    assert np.allclose(slope, step, atol=1e-9), "rotation() is the derivative of move()"


def test_the_center_is_found_from_afar_though_a_part_of_the_top_is_seen():
    whole = plane_pixels(paint_tabletop(CAMERAS[0]), CAMERAS[0])
    right = whole.coordinates[:, 0] > -0.1
    seen, cell = PlanePixels(whole.pixels[right], whole.coordinates[right], whole.image), 2.4 / plane_symmetry.SIDE
    for away in ((6, -5), (-4, 6)):
        center, flat = plane_symmetry._refine_center(seen, np.array([0.1, 0.4]) + cell * np.array(away), cell)
        assert flat is not None and np.linalg.norm(center - (0.1, 0.4)) < 2 * cell, away


def test_a_texture_without_period_has_no_symmetry():
    noise = np.random.default_rng(0).integers(0, 256, (SIDE, SIDE, 3), np.uint8)
    some = plane_pixels(noise, CAMERAS[0])
    assert find_symmetry(some) is None
    smooth = np.repeat(np.linspace(0, 255, SIDE)[None, :, None], SIDE, 0).repeat(3, 2).astype(np.uint8)
    assert find_symmetry(plane_pixels(smooth, CAMERAS[0])) is None
    assert find_symmetry(PlanePixels(some.pixels[:MIN_CELLS], some.coordinates[:MIN_CELLS], some.image)) is None


@pytest.mark.parametrize("shown", [paint_planks, paint_tabletop])
def test_joints_and_round_borders_go_on_where_a_floor_repeats_itself(shown):
    around = replace(floor_background(), photos={view.name: shown(view) for view in CAMERAS})
    truth = shown(CAMERAS[0]).astype(int)
    image = np.where(HOLE[..., None], np.uint8(RED), shown(CAMERAS[0]))
    target, sources, smooth, how = exemplar._find_surfaces(
        image,
        HOLE,
        CAMERAS[0],
        HOLE,
        around,
        render_mirrors([], CAMERAS[0], HOLE, []),
    )
    found = fill_plane(target, HOLE, sources, 1, how[1])
    picture, filled = found.image, found.filled
    assert filled[HOLE].mean() > 0.9 and not filled[~HOLE].any() and (picture[~filled] == image[~filled]).all()
    # Dark pixels are joints between planks; pixels brighter than 195 are the plate.
    dark = lambda done: done.mean(-1)[filled] < 90
    kind = lambda done: dark(done).astype(int) + 2 * (done.mean(-1)[filled] > 195)
    wrong = lambda done: (kind(done) != kind(truth)).mean()
    patches = np.mean([wrong(complete(target, HOLE, sources, smooth, k).image) for k in range(3)])
    assert wrong(picture) < 0.7 * patches


def test_a_hole_without_source_pixels_is_left():
    image = np.where(HOLE[..., None], np.uint8(RED), paint_planks(CAMERAS[0]))
    target, sources, _, how = exemplar._find_surfaces(
        image,
        HOLE,
        CAMERAS[0],
        HOLE,
        floor_background(),
        render_mirrors([], CAMERAS[0], HOLE, []),
    )
    found = fill_plane(
        target,
        HOLE,
        [replace(s, usable=np.zeros_like(HOLE)) for s in sources],
        1,
        how[1],
    )
    assert not found.filled.any() and found.image is image


def test_frames_are_the_derivative_of_a_planes_coordinates():
    view, h = CAMERAS[1], 1e-4
    frames = plane_frames.plane_jacobians(np.ones((SIDE, SIDE), np.int64), view, [FLOOR])
    for row, column in ((80, 30), (100, 90)):
        for axis, (dx, dy) in enumerate(((h, 0), (0, h))):
            coordinates = []
            for sign in (-1, 1):
                moved = replace(view, cx=view.cx - sign * dx, cy=view.cy - sign * dy)
                point = geometry.unproject(FLOOR.depth(moved), moved)[row, column]
                coordinates.append(FLOOR.axes @ (point - FLOOR.origin))
            numeric = (coordinates[1] - coordinates[0]) / (2 * h)
            assert np.allclose(frames[row, column, :, axis], numeric, rtol=1e-6, atol=1e-9)


def test_a_floor_is_smooth_and_grass_is_not():
    around = floor_background()
    assert exemplar._roughness(FLOOR, around) < 1e-6
    rng = np.random.default_rng(0)
    uneven = lambda view: replace(view, depth=view.depth * (1 + 0.03 * rng.standard_normal(view.depth.shape)))
    grass = replace(around, views=[uneven(view) for view in around.views])
    assert exemplar._roughness(FLOOR, grass) > exemplar.SMOOTH


def test_the_misfit_is_the_mean_square_by_weight():
    """A float64 NumPy implementation gives the same misfit for a patch that is rotated and moved along the floor."""
    around = floor_background()
    own, other = (exemplar._source_image(view, around.photos[view.camera.name], around) for view in around.views[:2])
    seen = [(completion._color_features(each.image, each.masked), each.masked) for each in (own, other)]
    marked = [
        completion._with_geometry(values, each, [1], 1) for (values, _), each in zip(seen, (own, other), strict=True)
    ]
    pictures = completion._stack_sources(marked, [masked for _, masked in seen], [own, other], 1)
    mask = np.zeros((SIDE, SIDE), bool)
    mask[70, 62] = True
    target = replace(own, plane=np.ones((SIDE, SIDE), np.int64))
    target = replace(target, to_plane=plane_frames.plane_jacobians(target.plane, CAMERAS[0], [FLOOR]))
    pixels = completion._gather_hole(target, mask, 1, [1], pictures)
    now, weight = marked[0], np.random.default_rng(0).random((SIDE, SIDE)).astype(np.float32)
    row, column, angle = 100.0, 40.0, 0.2
    of = PyramidLevel(pixels, pictures, now, weight)
    found = search.misfit(0, True, 1, row, column, np.float32(angle), NO_MATCH, of)
    assert search.misfit(0, False, 1, row, column, np.float32(0), NO_MATCH, of) == NO_MATCH, (
        "along a plane nothing is shifted"
    )
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = pictures.to_pixels[1, 100, 40].reshape(2, 2) @ turn @ target.to_plane[70, 62]
    steps = np.arange(-PATCH_RADIUS, PATCH_RADIUS + 1)
    total = mass = 0.0
    for dy in steps:
        for dx in steps:
            x, y = np.array([column, row]) + matrix @ (dx, dy)
            j, i = int(np.floor(x)), int(np.floor(y))
            corners = pictures.values[1, i : i + 2, j : j + 2].astype(float)
            value = np.array([1 - (y - i), y - i]) @ np.moveaxis(np.array([1 - (x - j), x - j]) @ corners, 0, 0)
            w = float(weight[70 + dy, 62 + dx])
            total, mass = total + w * ((value - now[70 + dy, 62 + dx]) ** 2).sum(), mass + w
    assert np.isclose(found, total / mass, rtol=1e-4)


# ------------------------------------------------------------------------------------------------------- blending


def test_blending_its_own_gradients_returns_a_picture():
    rng, hole = np.random.default_rng(0), middle_mask()
    picture = rng.normal(size=(96, 128, 3))
    right, below = np.zeros_like(picture), np.zeros_like(picture)
    right[:, :-1], below[:-1] = np.diff(picture, axis=1), np.diff(picture, axis=0)
    assert np.allclose(blend(picture, hole, right, below, picture), picture[hole], atol=1e-9)
    shifted = blend(picture, hole, right, below, picture + 5)
    offset = np.zeros(hole.shape)
    offset[hole] = (shifted - picture[hole])[:, 0]
    assert offset[31, 46] < 1 < offset[45, 64], "a cast of the patches fades towards the hole's border"


def test_what_is_painted_reaches_over_the_rim_and_narrow_rests():
    mask, unknown = np.zeros((100, 200), bool), np.zeros((100, 200), bool)
    mask[20:80, 40:160] = True
    # The mask has two known strips: 4 px wide (to be painted too) and 60 px wide (not to be painted).
    unknown[20:80, 40:80] = unknown[20:80, 84:100] = True
    hole = exemplar.mask_to_paint(mask, unknown)
    assert hole[50, 82] and hole[50, 39] and not hole[50, 120] and not hole[50, 37] and not hole[10].any()


def test_a_nearer_surface_ends_at_the_prolongation_of_its_border():
    """A near surface (row 60 and below) is visible left and right of the object: its upper edge continues at row 60."""
    depth = np.full((120, 160), 4.0)
    depth[60:] = 1.0
    hidden = np.zeros((120, 160), bool)
    hidden[30:90, 60:100] = True
    found = exemplar._interpolate_depth(depth, ~hidden, hidden)
    assert np.allclose(found[30:60, 60:100], 4, rtol=0.01) and np.allclose(found[61:90, 60:100], 1, rtol=0.01)
    alone = exemplar._interpolate_depth(np.full((120, 160), 2.0), ~hidden, hidden)
    assert np.allclose(alone, 2, rtol=0.01)
