"""Clicks become masks: in one photograph, in all views by the Gaussians, and on the page in a browser."""

import itertools
import threading
import time
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scenes import capture as captures
from scenes import wall_scene
from scenes.browser import open_page
from scenes.gaussians import round_gaussians
from scenes.stage_runs import run_masks
from scipy import ndimage

from reffusion.capture.click_coordinates import distort_mask, distort_points, undistort_points
from reffusion.clicks import propagation_without_network, scene_segmentation
from reffusion.clicks.corrections import apply_marks
from reffusion.clicks.events import Event
from reffusion.clicks.fitted_views import FittedViews
from reffusion.clicks.marks import Mark, confirmed_pixels, stroke_pixels
from reffusion.clicks.propagation_with_network import Projection, change_where_votes_agree, find_voting_pixels
from reffusion.clicks.refinement import redraw_masks
from reffusion.clicks.scene_segmentation import correct_scene, segment_own_view, segment_scene
from reffusion.clicks.segmenter import Candidate
from reffusion.clicks.single_view import ViewEvidence, pick_by_size
from reffusion.gaussians.neighbors import find_neighbors
from reffusion.graph_cut import min_cut
from reffusion.io.files import BadInput
from reffusion.io.images import load_image, load_mask, save_image, save_mask, to_uint8
from reffusion.io.scene import load_mask_sets
from reffusion.masks import voting
from reffusion.morphology import dilate
from reffusion.params.poses import Params as Poses
from reffusion.splat import rasterizer
from report import mask
from report.app.app import App
from report.app.mask_step import MaskStep
from report.app.scenes import OpenScene
from report.app.server import Server
from report.mask_session import Capture, Session
from stages import masks, poses

pytestmark = pytest.mark.integration

NEAR = 1.7


def make_clicks(*points):
    """Return one mark for each click (x, y); a third entry False says that the click is not on the object."""
    return [Mark(np.array([p[:2]], float), len(p) < 3) for p in points]


def click_mask(picture, *points, relief=None, before=None):
    """Return the mask, bool [H, W], after clicks on a picture; `before` is the mask before the clicks."""
    return apply_marks(ViewEvidence(picture, relief), make_clicks(*points), before)


# ---------------------------------------------------------------------------------------------- one photograph


def test_the_cut_is_the_cheapest_of_all():
    draw = np.random.default_rng(0)
    for _ in range(20):
        pairs = np.array(list(itertools.combinations(range(8), 2)))[draw.permutation(28)[:14]]
        for_object, for_other, strength = (draw.integers(0, 9, n) / 4 for n in (8, 8, 14))
        labels = np.array(list(itertools.product((False, True), repeat=8)))
        border = (labels[:, pairs[:, 0]] != labels[:, pairs[:, 1]]) @ strength
        costs = labels @ for_object + ~labels @ for_other + border
        found = min_cut(for_object, for_other, pairs, strength)
        cost = found @ for_object + ~found @ for_other + (found[pairs[:, 0]] != found[pairs[:, 1]]) @ strength
        assert cost == pytest.approx(costs.min())


def disk_picture(shape=(240, 320)):
    """Return a picture of a red disk with a yellow stripe on a noisy blue gradient, and the mask of the disk."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    disk = np.hypot(rows - 120, columns - 150) < 60
    noise = np.random.default_rng(1).normal(0, 6, (*shape, 3))
    picture = np.stack([40 + columns / 8, 60 + rows / 8, 140 + columns / 8], -1)
    picture[disk] = (200, 50, 40)
    picture[disk & (abs(rows - 120) < 12)] = (220, 200, 60)
    return (picture + noise).clip(0, 255).astype(np.uint8), disk


def test_one_click_finds_what_is_of_one_color_and_another_the_rest():
    picture, disk = disk_picture()
    rows = np.mgrid[:240, :320][0]
    red = disk & (abs(rows - 120) >= 12)
    assert wall_scene.iou(click_mask(picture, (150, 85), (150, 155)) & red, red) > 0.97
    assert wall_scene.iou(click_mask(picture, (150, 85), (150, 155), (150, 120)), disk) > 0.97
    assert not click_mask(picture, (10, 10, False)).any()
    assert not click_mask(picture).any()


def test_where_the_depth_is_known_a_click_goes_as_far_as_the_surface():
    picture, disk = disk_picture()
    # The background right of column 180 has the disk's color and touches the disk.
    picture[:, 180:] = picture[70:90, 140:160].mean((0, 1))
    relief = np.where(disk, 0.0, 300.0)
    alone, flat = click_mask(picture, (150, 85)), click_mask(picture, (150, 85), relief=0 * relief)
    assert wall_scene.iou(alone, disk) < 0.9 and (alone == flat).all()
    assert wall_scene.iou(click_mask(picture, (150, 85), relief=relief), disk) > 0.95
    half = disk & (np.mgrid[:240, :320][1] < 150)
    assert wall_scene.iou(click_mask(picture, (165, 90), relief=relief, before=half), disk) > 0.9


def test_a_click_on_a_small_mistake_changes_little():
    """The mask lacks a few pixels at the rim of the disk. The network proposes nothing but the whole picture."""
    picture, disk = disk_picture()
    rows, columns = np.mgrid[:240, :320]
    before = disk & ~((np.hypot(rows - 120, columns - 206) < 4) & disk)
    everything = Candidate(np.ones_like(disk), 0.9)
    view = ViewEvidence(picture, np.where(disk, 0.0, 300.0), lambda prompt: [everything] * 3)
    found = apply_marks(view, make_clicks((150, 90), (206, 120)), before, first=1)
    assert found[120, 206] and (found ^ before).sum() < 60


def test_a_click_takes_back_what_it_is_on():
    picture, disk = disk_picture()
    stripe = disk & (abs(np.mgrid[:240, :320][0] - 120) < 12)
    without = click_mask(picture, (150, 120, False), before=disk)
    assert not without[115:125, 140:160].any() and wall_scene.iou(without, disk & ~stripe) > 0.9
    assert wall_scene.iou(click_mask(picture, (150, 120), before=without), disk) > 0.95


def test_a_click_outside_the_picture_is_one_on_its_border():
    picture, _ = disk_picture()
    corner = np.zeros(picture.shape[:2], bool)
    corner[:30, :40] = True
    outside, on_border = (
        apply_marks(ViewEvidence(picture), make_clicks(at), corner) for at in ((-9, -9, False), (0, 0, False))
    )
    assert not outside[0, 0] and (outside == on_border).all()


def test_a_correction_keeps_the_region_around_an_earlier_click():
    """A foot of an animal stands on a plinth. The network proposes the animal without its foot, and with it."""
    rows, columns = np.mgrid[:240, :320]
    animal = np.hypot(rows - 90, columns - 150) < 50
    foot = (abs(columns - 150) < 14) & (rows >= 120) & (rows < 172) & ~animal
    plinth = (abs(columns - 150) < 60) & (rows >= 160) & (rows < 220) & ~foot
    picture = np.full((240, 320, 3), (60, 90, 150), np.uint8)
    picture[animal], picture[foot], picture[plinth] = (200, 50, 40), (150, 140, 120), (140, 130, 115)
    candidates = [Candidate(each, 0.9) for each in (animal, animal | foot, animal | foot | plinth)]
    clicks = make_clicks((150, 90), (150, 165), (180, 200, False))
    view = ViewEvidence(picture, np.where(animal, 0.0, 300.0), lambda prompt: candidates)
    found = apply_marks(view, clicks, animal | foot | plinth, first=2)
    assert found[foot].mean() > 0.5 and found[plinth].mean() < 0.5


def test_a_correction_changes_one_region_and_keeps_what_marks_confirm():
    """Marks are random clicks and strokes, on the object or beside it.

    A click changes at most one connected region, a stroke at most five. The mask agrees with all pixels that marks
    confirm.
    """
    picture, _ = disk_picture((120, 160))
    picture = picture[:120, 70:230]
    draw = np.random.default_rng(0)
    for _ in range(6):
        marks, mask = make_clicks((80, 85)), None
        mask = apply_marks(ViewEvidence(picture), marks)
        for _ in range(5):
            at = draw.uniform((2, 2), (158, 118), (2, 2))
            radius = float(draw.choice([0.0, 4.0]))
            marks.append(Mark(at if radius else at[:1], bool(draw.integers(2)), radius))
            before, mask = mask, apply_marks(ViewEvidence(picture), marks, mask, first=len(marks) - 1)
            assert ndimage.label(mask != before, np.ones((3, 3)))[1] <= (5 if radius else 1)
            confirmed = confirmed_pixels(marks, mask.shape)
            assert mask[confirmed == 1].all() and not mask[confirmed == -1].any()


def test_a_stroke_covers_the_brush_along_its_path():
    stroke = Mark(np.array([[10.0, 10.0], [30.0, 10.0], [30.0, 25.0]]), True, 3.0)
    rows, columns = np.mgrid[:40, :50] + 0.5
    distance = np.minimum(
        np.hypot(columns - columns.clip(10, 30), rows - 10), np.hypot(columns - 30, rows - rows.clip(10, 25))
    )
    painted = stroke_pixels(stroke, (40, 50))
    assert painted[distance < 2].all() and not painted[distance > 4.2].any()


def test_a_plain_picture_of_any_size_is_no_error():
    for shape in ((1, 1, 3), (2, 300, 3), (40, 40, 3)):
        assert click_mask(np.full(shape, 7, np.uint8), (shape[1] / 2, shape[0] / 2)).shape == shape[:2]


def test_of_the_networks_masks_the_one_with_edges_around_it_is_selected():
    picture, disk = disk_picture()
    half = disk & (np.mgrid[:240, :320][1] < 150)
    wide = ndimage.binary_dilation(disk, iterations=12)
    view = ViewEvidence(picture, None, lambda _: [Candidate(each, 0.9) for each in (half, disk, wide)])
    assert (apply_marks(view, make_clicks((120, 120))) == disk).all()


def test_a_first_click_takes_no_pixel_below_an_earlier_stroke_that_is_not_the_object():
    picture, disk = disk_picture()
    stroke = Mark(np.array([[90.0, 120.0], [110.0, 120.0]]), False, radius=6.0)
    view = ViewEvidence(picture, None, lambda _: [Candidate(disk, 0.9)])
    found = apply_marks(view, [stroke, *make_clicks((140, 120))])
    assert (found == disk & ~stroke_pixels(stroke, disk.shape)).all() and (found != disk).any()


# ---------------------------------------------------------------------------------------------- all views


@pytest.fixture(scope="module")
def clicked_scene(tmp_path_factory):
    """Write a wall and a square in front of it, photographed without masks; return the folders of run, poses, fit."""
    folder = tmp_path_factory.mktemp("clicked")
    placed, fit, _ = wall_scene.write_poses_and_fit(folder, NEAR, masks={})
    everything, _ = wall_scene.wall_and_square(NEAR)
    for name in wall_scene.TRAIN:
        with torch.no_grad():
            drawn = rasterizer.render(everything, wall_scene.CAMERAS[name]).color.clamp(0, 1).numpy()
        save_image(placed / "images" / f"{name}.png", to_uint8(drawn))
    wall_scene.write_capture_photos(folder / "given", placed, wall_scene.CAMERAS)
    return folder, placed, fit


def square_mask(name):
    return wall_scene.true_mask(wall_scene.CAMERAS[name], NEAR)


def test_clicks_in_one_view_give_the_masks_of_all(clicked_scene, tmp_path):
    _, placed, fit = clicked_scene
    middle = np.argwhere(square_mask("a2")).mean(0)[::-1] + 0.5
    params = masks.Params(clicks={"a2": [[*middle, "+"]]})
    run_masks(placed, fit, tmp_path, params)
    for name, found in load_mask_sets(tmp_path, wall_scene.CAMERAS).items():
        if name in wall_scene.TRAIN:
            assert (
                wall_scene.iou(found.raw, square_mask(name)) > 0.9
                and wall_scene.iou(found.consistent, square_mask(name)) > 0.85
            )
        else:
            assert not found.raw.any(), "test photographs do not show it"


def test_clicks_on_nothing_are_refused(clicked_scene, tmp_path):
    _, placed, fit = clicked_scene
    with pytest.raises(ValueError, match="click in the middle of the object"):
        run_masks(placed, fit, tmp_path, masks.Params(clicks={"a2": [[3, 3, "-"]]}))


def fitted_views(ask=None):
    """Return the fitted views of the wall and the square; `ask(view)` returns the segmentation network for a view."""
    everything, _ = wall_scene.wall_and_square(NEAR)
    cameras = {name: wall_scene.CAMERAS[name] for name in wall_scene.TRAIN}

    @cache
    def evidence_of(name):
        with torch.no_grad():
            image = to_uint8(rasterizer.render(everything, cameras[name]).color.clamp(0, 1).numpy())
        relief = propagation_without_network.surface_relief(everything, cameras[name])
        return ViewEvidence(image, relief, ask and ask(name))

    return FittedViews(everything, cameras, evidence_of)


def test_a_mask_in_one_view_stays_as_it_was_given():
    found = segment_scene(fitted_views(), [], {"a1": square_mask("a1")})
    assert (found["a1"] == square_mask("a1")).all()
    assert wall_scene.iou(found["a4"], square_mask("a4")) > 0.9


def middle_mark(name, positive=True, radius=0.0, above=0.0):
    row, column = np.argwhere(square_mask(name)).mean(0) + 0.5
    return Mark(np.array([[column, row - above]]), positive, radius)


def test_views_that_are_marked_before_all_have_masks_stay_as_their_own_marks_made_them():
    """A notch is erased in each of two views; only a later mark in the same view changes it."""
    views = fitted_views()
    events = [Event(name, mark, is_early=True) for name in ("a0", "a4") for mark in (
        middle_mark(name), middle_mark(name, False, radius=2.0))]  # fmt: skip
    own = {name: segment_own_view(views.evidence_of, events[k : k + 2])[name] for k, name in ((0, "a0"), (2, "a4"))}
    found = segment_scene(views, events, {})
    assert all((found[name] == own[name]).all() for name in own)
    added = Event("a4", middle_mark("a4", radius=2.0))
    assert segment_scene(views, [*events, added], {})["a4"].sum() > own["a4"].sum()


def test_marks_that_follow_each_other_in_a_view_are_spread_together(monkeypatch):
    spread, propagate = [], scene_segmentation.propagate
    monkeypatch.setattr(
        scene_segmentation,
        "propagate",
        lambda views, masks, *former: spread.append({*masks}) or propagate(views, masks, *former),
    )
    strokes = [Event("a4", middle_mark("a4", False, 2.0, above=k)) for k in (0, 2, 4)]
    segment_scene(fitted_views(), [Event("a0", middle_mark("a0")), *strokes], {})
    assert spread == [{"a0"}, {"a0", "a4"}]


def test_a_network_that_knows_the_object_in_parts_gives_the_whole_in_all_views():
    """The network knows the upper and the lower half of the square as two separate objects."""

    def ask(name):
        square = square_mask(name)
        rows = np.mgrid[: wall_scene.HEIGHT, : wall_scene.WIDTH][0]
        middle = np.nonzero(square)[0].mean()
        halves = [square & (rows < middle), square & (rows >= middle)]

        def answer(prompt):
            column, row = prompt.clicks.points[0].astype(int)
            mask = next((half for half in halves if half[row, column]), ~square)
            return [Candidate(mask & False, 0.5), Candidate(mask, 0.9), Candidate(mask, 0.95)]

        return answer

    found = segment_scene(fitted_views(ask), [], {"a2": square_mask("a2")})
    assert min(wall_scene.iou(found[name], square_mask(name)) for name in wall_scene.TRAIN) > 0.95


def test_rough_masks_are_drawn_anew():
    """The given masks are 2 px too large or too small, and one view has none. The network knows the square."""

    def ask(name):
        square = square_mask(name)

        def answer(prompt):
            column, row = prompt.clicks.points[0].astype(int)
            mask = square if square[row, column] else ~square
            return [Candidate(mask & False, 0.5), Candidate(mask, 0.9), Candidate(mask, 0.95)]

        return answer

    width = wall_scene.WIDTH
    rough = {
        name: dilate(square_mask(name), 2 / width) if k % 2 else ~dilate(~square_mask(name), 2 / width)
        for k, name in enumerate(wall_scene.TRAIN[:-1])
    }
    assert max(wall_scene.iou(rough[name], square_mask(name)) for name in rough) < 0.8
    found = redraw_masks(fitted_views(ask), rough)
    assert min(wall_scene.iou(found[name], square_mask(name)) for name in wall_scene.TRAIN) > 0.95


def test_a_stroke_in_one_view_corrects_the_others():
    views = fitted_views()
    whole = {name: square_mask(name) for name in wall_scene.TRAIN}
    lower = {
        name: np.mgrid[: wall_scene.HEIGHT, : wall_scene.WIDTH][0] > np.nonzero(m)[0].mean()
        for name, m in whole.items()
    }
    masks = {name: mask & lower[name] for name, mask in whole.items()}
    rows, columns = np.nonzero(whole["a0"] & ~lower["a0"])
    radius = (np.ptp(rows) + 1) / 2
    path = np.array([[x + 0.5, rows.mean() + 0.5] for x in (columns.min() + radius, columns.max() - radius)])
    stroke = Event("a0", Mark(path, True, radius))
    found = correct_scene(views, [stroke], 1, masks, (), {})
    gain = {name: wall_scene.iou(found[name], whole[name]) - wall_scene.iou(masks[name], whole[name]) for name in whole}
    assert gain["a0"] > 0.05
    assert min(gain.values()) > 0.5 * gain["a0"]
    erased = Event("a4", Mark(stroke.mark.points, False, 40.0))
    back = correct_scene(views, [stroke, erased], 1, found, {"a0"}, {})
    assert (back["a0"] == found["a0"]).all(), "a view with marks stays as they made it"
    assert back["a4"].sum() < found["a4"].sum()


def sheet_points(origin, along, up, color, step=0.04):
    """Place Gaussians on a grid with distance `step` on the parallelogram spanned by `along` and `up` at `origin`.

    Returns:
        Means [n, 3] and colors [n, 3].
    """
    origin, along, up = (np.array(each, float) for each in (origin, along, up))
    rows, columns = (np.arange(step / 2, np.linalg.norm(each), step) / np.linalg.norm(each) for each in (up, along))
    means = (origin + rows[:, None, None] * up + columns[None, :, None] * along).reshape(-1, 3)
    return means, np.broadcast_to(color, means.shape)


@cache
def box_scene():
    """Return a scene of a wall and a box before it, cameras at its left, middle and right, photographs, and bool [N].

    The middle camera shows the front of the box alone. The other two show one of its two darker sides, too. The bool
    array is True for the Gaussians of the box.
    """
    parts = [
        sheet_points((-4, -2, 4), (8, 0, 0), (0, 4, 0), (0.2, 0.3, 0.7)),  # the wall
        sheet_points((-0.5, -0.5, 2.5), (1, 0, 0), (0, 1, 0), (0.8, 0.5, 0.2)),
        sheet_points((-0.5, -0.5, 2.5), (0, 0, 0.8), (0, 1, 0), (0.5, 0.3, 0.12)),
        sheet_points((0.5, -0.5, 2.5), (0, 0, 0.8), (0, 1, 0), (0.5, 0.3, 0.12)),
    ]
    means, colors = (np.concatenate(each) for each in zip(*parts, strict=True))
    scene = round_gaussians(means, colors, 0.025, 4.0)
    cameras = {name: wall_scene.front_camera(name, x) for name, x in (("left", -1.2), ("middle", 0.0), ("right", 1.2))}
    with torch.no_grad():
        images = {n: to_uint8(rasterizer.render(scene, c).color.clamp(0, 1).numpy()) for n, c in cameras.items()}
    return scene, cameras, images, torch.arange(len(means)) >= len(parts[0][0])


def test_sides_that_no_click_shows_are_found_by_the_other_photographs():
    scene, cameras, images, box = box_scene()
    near, mask = find_neighbors(scene), voting.render_labels(scene, box, cameras["middle"]) > 0.5
    found = propagation_without_network.label_gaussians(scene, near, cameras, {"middle": mask}, images.__getitem__)
    assert (found & box).sum() > 0.95 * box.sum() and (found & ~box).sum() < 0.01 * box.sum()


def test_a_stroke_reaches_sides_that_its_view_does_not_show():
    """All masks lack the right quarter of the box. A stroke is made in the middle view, which shows the front alone.

    In the right view, the network adds the side of the box.
    """
    scene, cameras, images, box = box_scene()
    right = scene.means[:, 0] > 0.25
    whole = {name: voting.render_labels(scene, box, c) > 0.5 for name, c in cameras.items()}
    lost = {name: voting.render_labels(scene, box & right, c) > 0.5 for name, c in cameras.items()}
    masks = {name: whole[name] & ~lost[name] for name in whole}

    def evidence_of(name):
        relief = propagation_without_network.surface_relief(scene, cameras[name])
        return ViewEvidence(images[name], relief, lambda prompt: [Candidate(whole[name], 0.9)])

    rows, columns = np.nonzero(lost["middle"])
    radius = (columns.max() - columns.min()) / 2
    path = np.stack([np.full(2, columns.mean()), [rows.min() + radius, rows.max() - radius]], 1) + 0.5
    stroke = Event("middle", Mark(path, True, radius))
    found = correct_scene(FittedViews(scene, cameras, evidence_of), [stroke], 1, masks, (), {})
    gained = {name: found[name] & ~masks[name] for name in found}
    assert all((gained[name] & ~whole[name]).sum() < 0.05 * whole[name].sum() for name in gained)
    assert (gained["right"] & lost["right"]).sum() > 0.85 * lost["right"].sum()


def test_a_border_of_a_mask_beyond_a_step_in_depth_does_not_vote():
    """A vertical bar, 10 px wide and 60 px before a wall, is covered by a stroke that is 3 px too wide on each side."""
    relief, mask = np.full((300, 300), 60.0), np.zeros((300, 300), bool)
    relief[:, 140:150] = 0
    mask[60:240, 137:153] = True
    found = find_voting_pixels(mask, relief)
    assert not found[:, :139].any() and not found[:, 151:].any() and found[60:240, 142:148].all()
    assert (find_voting_pixels(mask, relief * 0) == mask).all(), "without a step, all pixels vote"


def test_a_former_mask_changes_only_in_regions_that_votes_are_for():
    former, new, votes = np.zeros((3, 20, 20))
    former[5:10, 5:10] = new[5:10, 5:10] = votes[5:10, 5:10] = 1
    new[5:10, 10:13] = votes[5:10, 10:13] = 1  # the votes are for this part,
    new[15:18, 2:5] = 1  # nobody votes on this part,
    new[5, 5] = 0  # and the votes are against this removal
    found = change_where_votes_agree(former > 0, new > 0, Projection(votes > 0, votes, np.zeros((20, 20))))
    assert (found == (votes > 0)).all()


@pytest.mark.parametrize(("size", "pixels"), [("small", 10), ("middle", 90), ("large", 1000)])
def test_the_middle_size_is_the_geometric_mean_of_the_others(size, pixels):
    masks = [np.arange(1000) < count for count in (10, 40, 90, 700, 1000)]
    assert pick_by_size(masks, size).sum() == pixels


@pytest.mark.parametrize("has_network", [True, False])
def test_a_box_adds_and_removes_the_thing_inside_it(has_network):
    """A red disk, 12 px in radius, is on gray ground; the network also knows the whole picture."""
    rows, columns = np.mgrid[:80, :100]
    disk = np.hypot(rows - 39.5, columns - 49.5) < 12
    picture = np.random.default_rng(0).integers(100, 140, (80, 100, 3)).astype(np.uint8)
    picture[disk] = (200, 30, 30)
    ask = lambda prompt: [Candidate(disk, 0.9), Candidate(disk | True, 0.5)]
    view, corners = ViewEvidence(picture, None, ask if has_network else None), np.array([[64.0, 54.0], [36.0, 26.0]])
    added = apply_marks(view, [Mark(corners, True)])
    assert wall_scene.iou(added, disk) > 0.95
    assert not apply_marks(view, [Mark(corners, True), Mark(corners, False)], added, first=1)[disk].any()
    large = apply_marks(view, [Mark(corners, True, size="large")])
    assert large.sum() == 28 * 28, "the whole box"


# ---------------------------------------------------------------------------------------- clicks that a scene gives


def test_clicks_find_their_place_through_the_lens():
    lens = captures.make_truth(captures.OPENCV).lens
    points = np.array([[1.0, 2.0], [50.0, 30.0], [190.0, 140.0]])
    there = undistort_points(points, lens, (192, 144))
    assert np.abs(distort_points(there, lens, (192, 144)) - points).max() < 1e-3
    mask = np.zeros((72, 96), bool)
    mask[30:40, 40:60] = True
    photo = distort_mask(mask, lens, (192, 144))
    corners = distort_points(np.array([[40.0, 30.0], [60.0, 40.0]]), lens, (192, 144)).round().astype(int)
    assert photo.shape == (144, 192)
    rows, columns = np.nonzero(photo)
    assert abs(columns.min() - corners[0, 0]) <= 2 and abs(rows.max() + 1 - corners[1, 1]) <= 2


def write_small_capture(folder, with_masks=False):
    some = captures.make_truth()
    captures.write_pictures(folder / "images", sorted(some.world_to_camera))
    captures.write_model(folder / "sparse/0", some, ending=".png")
    if with_masks:
        captures.write_masks(folder / "masks", ["v01"])
    return folder


@pytest.mark.parametrize(("clicks", "said"), [
    ({"v9": [[1, 1]]}, "v9"),
    ({"v00": [[1, 1, "-"]]}, "none is on the object"),
    ({"v00": [[97, 1]]}, r"\[97, 1\] lies outside of 'v00', which has 96x72 px"),
    ({"v01": [[1, 1]]}, "has a mask"),
    ({"v00": [[1, 1]], "v00.png": [[2, 2]]}, "named twice"),
])  # fmt: skip
def test_contradicting_clicks_are_refused(tmp_path, clicks, said):
    folder = write_small_capture(tmp_path / "scene", with_masks="v01" in clicks)
    (tmp_path / "out").mkdir()
    with pytest.raises(BadInput, match=said):
        poses.run(Poses(clicks=clicks), tmp_path / "out", scene=folder)


@pytest.mark.parametrize("click", [[1], [1, 2, 3], [1, 2, "*"], [-1, 2], "1, 2", [1, 2, "+", 4], ["a", 2]])
def test_invalid_clicks_are_refused(click):
    with pytest.raises(ValueError):
        masks.Params(clicks={"v00": [click]})


# ------------------------------------------------------------------------------- the page in the browser


def test_the_page_runs_the_stages_that_it_reads(tmp_path, monkeypatch):
    """The capture has no masks, and no stage has run on it. A variant has the masks and the fit of its scene."""
    folder = write_small_capture(tmp_path / "scene")
    words = ["mask", "--scene", str(folder), "--runs", str(tmp_path / "runs"), "--variant", "masked"]
    monkeypatch.setattr("sys.argv", words)
    opened = []
    monkeypatch.setattr(mask, "serve", lambda app, *_: opened.append(app))
    mask.main()
    app = opened[0]
    assert app.begin_masks(app.scenes["scene"])
    app.close()
    capture = app.scenes["scene"].mask_step.session.capture
    assert capture.masks == folder / "masks" and capture.given == {}
    assert capture.fit == tmp_path / "runs/scene/fit", "which this command makes"


class MaskPage:
    """The mask page of a session on a server that runs in a thread."""

    def __init__(self, session, folder):
        self.session, app = session, App(folder / "runs")
        app.add(OpenScene("scene", folder, folder / "runs/scene", MaskStep(session, scene="scene")))
        self.server = Server(app, port=18090)
        self.address = self.server.link("scenes/scene/mask/")
        self.thread = threading.Thread(target=self.server.serve, daemon=True)
        self.thread.start()

    def close(self):
        self.server.stop()
        self.thread.join()


@pytest.fixture
def page_server(clicked_scene, tmp_path):
    _, placed, fit = clicked_scene
    capture = Capture(tmp_path, tmp_path / "masks", placed, fit, {})
    page = MaskPage(Session(capture, lambda: True), tmp_path)
    while page.session.gaussians is None or not page.server.server.started:
        time.sleep(0.05)
    yield page
    page.close()


@pytest.mark.parametrize("width", [1280, 390])
def test_clicks_in_a_browser_make_masks_that_are_saved(page_server, tmp_path, width):
    with open_page(page_server.address, width) as tab:
        tab.wait_for_function("state && state.fit && view")
        name = tab.evaluate("view")
        column, row = np.argwhere(square_mask(name)).mean(0)[::-1] + 0.5
        sheet = tab.evaluate("place()")
        at = (sheet["left"] + column * sheet["scale"], sheet["top"] + row * sheet["scale"])
        tab.mouse.click(*at)
        tab.wait_for_function("!pending && !state.busy && state.views.every(v => v.mask !== null)", timeout=60_000)
        assert wall_scene.iou(page_server.session.masks[name], square_mask(name)) > 0.9
        tab.mouse.click(*at, button="right")
        tab.wait_for_function("!pending && !state.busy && of(view).marks.length === 2")
        assert not page_server.session.masks[name][int(row), int(column)]
        tab.keyboard.press("Control+z")
        tab.wait_for_function("!pending && !state.busy && of(view).marks.length === 1")
        tab.keyboard.press("b")
        tab.locator("#erase").click()
        tab.mouse.move(*at)
        tab.mouse.down()
        tab.mouse.move(at[0] + 10, at[1])
        tab.mouse.up()
        tab.wait_for_function("!pending && !state.busy && of(view).marks.length === 2")
        assert not page_server.session.masks[name][int(row), int(column)]
        tab.locator("#in").click()
        assert tab.evaluate("place().scale") > 1.4 * sheet["scale"]
        tab.locator("#list li button").last.click()
        tab.wait_for_function("!pending && !state.busy && of(view).marks.length === 1")
        tab.keyboard.press("ArrowRight")
        assert tab.evaluate("view") != name
        tab.locator("#save").click()
        tab.wait_for_function("!document.getElementById('saved').hidden")
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
    for each in wall_scene.TRAIN:
        assert wall_scene.iou(load_mask(tmp_path / "masks" / f"{each}.png"), square_mask(each)) > 0.85


def test_clicks_are_restored_the_next_time(page_server, tmp_path):
    page_server.session.mark("a2", [(48.0, 36.0)], True)
    page_server.session.save()
    before, capture = page_server.session, page_server.session.capture
    saved = {name: load_mask(tmp_path / "masks" / f"{name}.png") for name in wall_scene.TRAIN}
    again = Session(replace(capture, saved=saved), lambda: False)
    (event,) = again.events
    assert event.view == "a2" and event.mark.points.tolist() == [[48.0, 36.0]] and event.mark.positive
    state = again.state()
    assert not state["unsaved"] and all(view["mask"] is not None for view in state["views"]), "before any computation"
    assert all((again.masks[name] == before.masks[name]).all() for name in saved)
    again.save()  # the page may overwrite files that it wrote


def test_only_marks_that_differ_from_the_saved_ones_are_unsaved(clicked_scene, tmp_path):
    _, placed, fit = clicked_scene
    session = Session(Capture(tmp_path, tmp_path / "masks", placed, fit, {}), lambda: False)
    session.mark("a2", [(48.0, 36.0)], True)
    assert session.unsaved
    session.undo()
    assert not session.unsaved, "there are no marks, as in the beginning"
    session.mark("a2", [(48.0, 36.0)], True)
    session.save()
    session.clear("a2")
    assert session.unsaved
    session.undo()
    assert not session.unsaved


def test_the_page_says_what_a_mark_changed_and_takes_another_size(clicked_scene, tmp_path):
    _, placed, fit = clicked_scene
    session = Session(Capture(tmp_path, tmp_path / "masks", placed, fit, {}), lambda: False)
    session.mark("a2", [(48.0, 36.0)], True)
    session.save()  # waits for the masks
    area = session.masks["a2"].mean()
    assert session.state()["views"][2]["marks"][0]["effect"] == area
    session.mark("a2", [(2.0, 2.0)], True, radius=4.0)
    session.save()
    ((name, share),) = session.state()["changes"]
    assert name == "a2" and share == pytest.approx(1 - area / session.masks["a2"].mean())
    with pytest.raises(ValueError, match="a click or a box has the size small, middle, large or none"):
        session.resize(1, "small")
    session.resize(0, "large")
    assert session.events[0].mark.size == "large" and session.undo() == "a2" and session.events[0].mark.size == ""


def test_a_mask_is_gone_after_its_marks_are_cleared(clicked_scene, tmp_path):
    """Without a fit, a view has a mask only by its own marks, so the mask file is removed with the marks."""
    _, placed, fit = clicked_scene
    session = Session(Capture(tmp_path, tmp_path / "masks", placed, fit, {}), lambda: False)
    session.mark("a2", [(48.0, 36.0)], True)
    session.mark("a3", [(48.0, 36.0)], True)
    assert session.save()["written"] == 2
    session = Session(Capture(tmp_path, tmp_path / "masks", placed, fit, {}), lambda: False)
    session.clear("a3")
    assert session.save()["written"] == 1
    assert [path.name for path in (tmp_path / "masks").iterdir()] == ["a2.png"]


def test_undo_takes_back_every_change_also_a_removal(clicked_scene, tmp_path):
    _, placed, fit = clicked_scene
    capture = Capture(tmp_path, tmp_path / "masks", placed, fit, {})
    session = Session(capture, lambda: False)
    for x in (40.0, 48.0):
        session.mark("a2", [(x, 36.0)], True)
    session.mark("a3", [(48.0, 36.0)], True)
    marks = lambda: [(event.view, event.mark.points[0, 0]) for event in session.events]
    three = marks()
    session.clear("a2")
    assert session.undo() == "a2" and marks() == three
    session.remove(0)
    assert session.undo() == "a2" and marks() == three
    assert session.undo() == "a3" and marks() == three[:2]
    session.save()
    session = Session(capture, lambda: False)
    assert session.undo() == "a2" and marks() == three[:1], "marks that were saved earlier"
    assert session.undo() == "a2" and marks() == [] and session.undo() == "" and not session.state()["can_undo"]


def test_ignored_pixels_need_a_file_and_leave_a_part_of_their_view(clicked_scene, tmp_path):
    _, placed, fit = clicked_scene
    file, stroke = tmp_path / "ignore/a2.png", [(30.0, 30.0), (60.0, 30.0)]
    capture = Capture(tmp_path, tmp_path / "masks", placed, fit, {"a2": square_mask("a2")}, {}, {"a2": file})
    session = Session(capture, lambda: False)
    with pytest.raises(ValueError, match="`ignore: none` is set"):
        session.mark("a3", stroke, True, 5.0, ignores=True)
    with pytest.raises(ValueError, match="a mask of your own"):
        session.mark("a2", stroke, True, 5.0)
    session.mark("a2", stroke, True, 96.0, ignores=True)
    with pytest.raises(ValueError, match="all of a2 would be ignored"):
        session.save()
    assert not file.exists()
    session.mark("a2", stroke, False, 5.0, ignores=True)
    assert session.save() == {"written": 0, "kept": 1, "ignored": 1} and not session.unsaved
    assert not load_mask(file)[30, 30:60].any() and load_mask(file)[0, 0]


def test_masks_of_others_are_never_overwritten(page_server, tmp_path):
    save_mask(tmp_path / "masks/a3.png", square_mask("a3"))
    before = load_image(tmp_path / "masks/a3.png")
    page_server.session.mark("a2", [(48.0, 36.0)], True)
    with pytest.raises(ValueError, match=r"a3\.png: not written by this page"):
        page_server.session.save()
    assert (load_image(tmp_path / "masks/a3.png") == before).all()
    assert sorted(p.name for p in (tmp_path / "masks").iterdir()) == ["a3.png"]


def test_marks_that_do_not_fit_the_scene_are_refused(page_server):
    import urllib.error
    import urllib.request

    for content, status in (
        (b'{"view": "a9", "points": [[1, 1]], "sign": "+", "radius": 0}', "400"),
        (b'{"view": "a2", "points": [[1, 1e9]], "sign": "+", "radius": 0}', "400"),
        (b'{"view": "a2", "points": [[1, 1], [2, 2], [3, 3]], "sign": "+", "radius": 0}', "400"),
        (b'{"view": "a2"}', "404"),
        (b"[", "400"),
        (b" " * 2_000_001, "413"),
    ):
        request = urllib.request.Request(page_server.server.link("scenes/scene/mask/mark"), content)
        with pytest.raises(urllib.error.HTTPError, match=status):
            urllib.request.urlopen(request)
    assert not page_server.session.events
