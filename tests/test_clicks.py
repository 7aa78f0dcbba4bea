"""Clicks become masks: in one photograph, in all views through the Gaussians, and in a browser."""

import itertools
import threading
import time

import numpy as np
import pytest
import torch
from scenes import capture as captures
from scenes import wall_scene
from scenes.browser import open_page
from scenes.gaussians import round_gaussians
from scenes.stage_runs import run_masks

from reffusion.capture.click_coordinates import distort_mask, distort_points, undistort_points
from reffusion.clicks import all_views
from reffusion.clicks.marks import Clicks
from reffusion.clicks.single_view import correct_mask, segment_view
from reffusion.graph_cut import min_cut
from reffusion.io.files import BadInput
from reffusion.io.images import load_image, load_mask, save_image, save_mask, to_uint8
from reffusion.io.scene import load_mask_sets
from reffusion.masks import voting
from reffusion.params.poses import Params as Poses
from reffusion.splat import rasterizer
from report.mask import Server
from report.mask_session import Capture, Session
from stages import masks, poses

pytestmark = pytest.mark.integration

NEAR = 1.7


def make_clicks(*points):
    """Clicks at (x, y); a third entry False marks a click beside the object."""
    return Clicks(np.array([p[:2] for p in points], float), np.array([len(p) < 3 for p in points]))


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
    """A noisy blue slope with a red disk that has a yellow stripe, and the mask of the disk."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    disk = np.hypot(rows - 120, columns - 150) < 60
    noise = np.random.default_rng(1).normal(0, 6, (*shape, 3))
    picture = np.stack([40 + columns / 8, 60 + rows / 8, 140 + columns / 8], -1)
    picture[disk] = (200, 50, 40)
    picture[disk & (abs(rows - 120) < 12)] = (220, 200, 60)
    return (picture + noise).clip(0, 255).astype(np.uint8), disk


def test_one_click_finds_what_is_of_one_colour_and_another_the_rest():
    picture, disk = disk_picture()
    rows = np.mgrid[:240, :320][0]
    red = disk & (abs(rows - 120) >= 12)
    assert wall_scene.iou(segment_view(picture, make_clicks((150, 85), (150, 155))) & red, red) > 0.97
    assert wall_scene.iou(segment_view(picture, make_clicks((150, 85), (150, 155), (150, 120))), disk) > 0.97
    assert not segment_view(picture, make_clicks((10, 10, False))).any()
    assert not segment_view(picture, Clicks(np.zeros((0, 2)), np.zeros(0, bool))).any()


def test_where_the_depth_is_known_a_click_goes_as_far_as_the_surface():
    picture, disk = disk_picture()
    picture[:, 180:] = picture[70:90, 140:160].mean((0, 1))  # what stands behind has the disk's colour, and touches it
    relief = np.where(disk, 0.0, 300.0)
    alone, flat = (
        segment_view(picture, make_clicks((150, 85))),
        segment_view(picture, make_clicks((150, 85)), 0 * relief),
    )
    assert wall_scene.iou(alone, disk) < 0.9 and (alone == flat).all()
    assert wall_scene.iou(segment_view(picture, make_clicks((150, 85)), relief), disk) > 0.95
    half = disk & (np.mgrid[:240, :320][1] < 150)
    assert wall_scene.iou(correct_mask(picture, half, make_clicks((165, 90)), relief), disk) > 0.9


def test_a_click_takes_back_what_it_is_on():
    picture, disk = disk_picture()
    stripe = disk & (abs(np.mgrid[:240, :320][0] - 120) < 12)
    without = correct_mask(picture, disk, make_clicks((150, 120, False)))
    assert not without[115:125, 140:160].any() and wall_scene.iou(without, disk & ~stripe) > 0.9
    again = correct_mask(picture, without, make_clicks((150, 120)))
    assert wall_scene.iou(again, disk) > 0.95


def test_a_plain_picture_of_any_size_is_no_error():
    for shape in ((1, 1, 3), (2, 300, 3), (40, 40, 3)):
        found = segment_view(np.full(shape, 7, np.uint8), make_clicks((shape[1] / 2, shape[0] / 2)))
        assert found.shape == shape[:2]


# ---------------------------------------------------------------------------------------------- all views


@pytest.fixture(scope="module")
def clicked_scene(tmp_path_factory):
    """The wall with a square before it, photographed with the square, without masks."""
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


def test_a_mask_in_one_view_stays_as_it_was_given(clicked_scene):
    _, placed, _ = clicked_scene
    everything, _ = wall_scene.wall_and_square(NEAR)
    image_of = lambda name: load_image(placed / "images" / f"{name}.png")
    near = all_views.find_neighbours(everything)
    found = all_views.segment_by_clicks(everything, near, wall_scene.CAMERAS, image_of, {}, {"a1": square_mask("a1")})
    assert (found.masks["a1"] == square_mask("a1")).all()
    shown = all_views.object_mask(everything, found.labels, wall_scene.CAMERAS["a4"], image_of("a4"))
    assert wall_scene.iou(shown, square_mask("a4")) > 0.9


def sheet_points(origin, along, up, color, step=0.04):
    """Small round Gaussians on a parallelogram: means [n, 3] and colours [n, 3]."""
    origin, along, up = (np.array(each, float) for each in (origin, along, up))
    rows, columns = (np.arange(step / 2, np.linalg.norm(each), step) / np.linalg.norm(each) for each in (up, along))
    means = (origin + rows[:, None, None] * up + columns[None, :, None] * along).reshape(-1, 3)
    return means, np.broadcast_to(color, means.shape)


def test_sides_that_no_click_shows_are_found_by_the_other_photographs():
    parts = [
        sheet_points((-4, -2, 4), (8, 0, 0), (0, 4, 0), (0.2, 0.3, 0.7)),  # the wall
        sheet_points(
            (-0.5, -0.5, 2.5), (1, 0, 0), (0, 1, 0), (0.8, 0.5, 0.2)
        ),  # a box: its front, and its sides in shade
        sheet_points((-0.5, -0.5, 2.5), (0, 0, 0.8), (0, 1, 0), (0.5, 0.3, 0.12)),
        sheet_points((0.5, -0.5, 2.5), (0, 0, 0.8), (0, 1, 0), (0.5, 0.3, 0.12)),
    ]
    means, colors = (np.concatenate(each) for each in zip(*parts, strict=True))
    scene = round_gaussians(means, colors, 0.025, 4.0)
    cameras = {name: wall_scene.front_camera(name, x) for name, x in (("left", -1.6), ("middle", 0.0), ("right", 1.6))}
    with torch.no_grad():
        images = {n: to_uint8(rasterizer.render(scene, c).color.clamp(0, 1).numpy()) for n, c in cameras.items()}
    box = torch.arange(len(means)) >= len(parts[0][0])
    near, mask = all_views.find_neighbours(scene), voting.render_labels(scene, box, cameras["middle"]) > 0.5
    found = all_views.label_gaussians(scene, near, cameras, {"middle": mask}, images.__getitem__)
    assert (found & box).sum() > 0.95 * box.sum() and (found & ~box).sum() < 0.01 * box.sum()


# ---------------------------------------------------------------------------------------------- what a scene brings


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


# ---------------------------------------------------------------------------------------------- the page


@pytest.fixture
def page_server(clicked_scene, tmp_path):
    _, placed, fit = clicked_scene
    capture = Capture(tmp_path, tmp_path / "masks", placed, fit, {})
    server = Server(Session(capture, lambda: True), port=18090)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    while server.session.gaussians is None:
        time.sleep(0.05)
    yield server
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("width", [1280, 390])
def test_clicks_in_a_browser_make_masks_that_are_saved(page_server, tmp_path, width):
    with open_page(page_server.address, width) as tab:
        tab.wait_for_function("state && state.fit && view")
        name = tab.evaluate("view")
        box = tab.locator("#stage").bounding_box()
        column, row = np.argwhere(square_mask(name)).mean(0)[::-1] / (wall_scene.WIDTH, wall_scene.HEIGHT)
        at = (box["x"] + column * box["width"], box["y"] + row * box["height"])
        tab.mouse.click(*at)
        tab.wait_for_function("!pending && !state.busy && state.views.every(v => v.mask !== null)", timeout=60_000)
        assert wall_scene.iou(page_server.session.masks[name], square_mask(name)) > 0.9
        tab.mouse.click(*at, button="right")
        tab.wait_for_function("!pending && !state.busy && of(view).clicks.length === 2")
        assert not page_server.session.masks[name][round(row * wall_scene.HEIGHT), round(column * wall_scene.WIDTH)]
        tab.keyboard.press("Control+z")
        tab.wait_for_function("!pending && !state.busy && of(view).clicks.length === 1")
        tab.keyboard.press("ArrowRight")
        assert tab.evaluate("view") != name
        tab.locator("#save").click()
        tab.wait_for_function("document.getElementById('status').textContent.includes('saved')")
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
    for each in wall_scene.TRAIN:
        assert wall_scene.iou(load_mask(tmp_path / "masks" / f"{each}.png"), square_mask(each)) > 0.85


def test_clicks_are_restored_the_next_time(page_server, tmp_path):
    page_server.session.click("a2", [(48.0, 36.0, True)])
    page_server.session.save()
    again = Session(page_server.session.capture, lambda: True)
    assert again.clicks == {"a2": [(48.0, 36.0, True)]}
    again.save()  # its own files it may write again


def test_masks_of_others_are_never_overwritten(page_server, tmp_path):
    save_mask(tmp_path / "masks/a3.png", square_mask("a3"))
    before = load_image(tmp_path / "masks/a3.png")
    page_server.session.click("a2", [(48.0, 36.0, True)])
    with pytest.raises(ValueError, match=r"a3\.png: not written by this page"):
        page_server.session.save()
    assert (load_image(tmp_path / "masks/a3.png") == before).all()
    assert sorted(p.name for p in (tmp_path / "masks").iterdir()) == ["a3.png"]


def test_the_page_is_served_on_localhost_only(page_server):
    import urllib.error
    import urllib.request

    for headers in ({"Host": "elsewhere.example"}, {"Origin": "http://elsewhere.example"}):
        request = urllib.request.Request(page_server.address + "save", b"{}", headers)
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(request)
    request = urllib.request.Request(page_server.address + "clicks", b'{"view": "a9", "clicks": [[1, 1, "+"]]}')
    with pytest.raises(urllib.error.HTTPError, match="400"):
        urllib.request.urlopen(request)
