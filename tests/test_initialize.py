"""The stage `initialize`: new Gaussians lie on the hidden surface, reproduce the reference, and leave no holes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import wall_scene
from scenes.cameras import look_at_camera, make_camera, orbit_camera, yaw
from scenes.gaussians import join_gaussians
from scenes.stage_runs import run_through_masks, write_true_references

from reffusion import geometry
from reffusion.background.model import Background
from reffusion.depth import background_depth
from reffusion.depth.background_depth import CompletionSettings
from reffusion.gaussians.optimize import reconstruction_loss
from reffusion.gaussians.sheets import sheet_gaussians
from reffusion.gaussians.surfels import surface_gaussians, surface_normals
from reffusion.initialize import coverage
from reffusion.initialize import unprojection as rules
from reffusion.initialize.draft import Draft
from reffusion.initialize.refit import Supervision, crop_to_mask, repetitions
from reffusion.io.arrays import load_labels
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_mask_sets
from reffusion.splat import rasterizer
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Reference
from stages import initialize

pytestmark = pytest.mark.integration

NEAR = 1.7


@pytest.fixture(scope="module")
def masks_folders(tmp_path_factory):
    return run_through_masks(tmp_path_factory.mktemp("scene"), NEAR)


def slanted_disparity(degrees: float):
    """Return the disparity [H, W] of a plane through (0, 0, 2) turned about the vertical, its view, and its normal."""
    view = wall_scene.front_camera("v", 0.0)
    rays = geometry.pixel_rays(view)
    normal = np.array([np.sin(np.radians(degrees)), 0.0, -np.cos(np.radians(degrees))])
    return rays @ normal / (normal[2] * 2.0), view, normal


@pytest.mark.parametrize("degrees", [0.0, 40.0, -60.0])
def test_normals_of_a_plane_are_exact(degrees):
    disparity, view, normal = slanted_disparity(degrees)
    found = surface_normals(1 / disparity, view)
    np.testing.assert_allclose(found, np.broadcast_to(normal, found.shape), atol=1e-9)


def test_normals_beside_a_crease_belong_to_their_own_plane():
    left, view, _ = slanted_disparity(30.0)
    right = slanted_disparity(-30.0)[0]
    normals = surface_normals(1 / np.maximum(left, right), view)
    sides = np.sort(normals[36, :, 0])
    assert (np.abs(np.abs(sides) - 0.5) < 1e-9).all()


@pytest.mark.parametrize("degrees", [0.0, 40.0])
@pytest.mark.parametrize("closer", [1.0, 1.5])
@pytest.mark.parametrize("turn", [0.0, 65.0])
def test_the_new_surface_shows_no_holes_nearer_by_or_from_the_side(degrees, closer, turn):
    disparity, view, _ = slanted_disparity(degrees)
    black, whole = np.zeros((*disparity.shape, 3), np.uint8), np.ones(disparity.shape, bool)
    surface = sheet_gaussians(black, 1 / disparity, whole, view, 4)
    rotation = yaw(np.radians(turn))
    center = (0, 0, 2.0) - rotation.T @ (0, 0, 2 / closer)
    other = make_camera("w", (16, 16), wall_scene.FOCAL, center, rotation)
    assert rasterizer.render(surface, other).alpha.min() > 0.8


@pytest.mark.parametrize("degrees", [0.0, 40.0, 60.0])
def test_no_grid_shows_from_four_times_nearer(degrees):
    disparity, view, _ = slanted_disparity(degrees)
    white, whole = np.full((*disparity.shape, 3), 255, np.uint8), np.ones(disparity.shape, bool)
    near = view.cropped(view.width // 2 - 8, view.height // 2 - 8, 16, 16).resized(64, 64)
    alpha = rasterizer.render(sheet_gaussians(white, 1 / disparity, whole, view, 1), near).alpha
    assert alpha.min() > 0.9 and alpha.std() < 0.02


def floor_view(turn: float) -> Camera:
    """Return a camera at distance 2 from the origin, 30 degrees above the floor y = 0.

    Args:
        turn: Angle of the camera around the vertical, in degrees.
    """
    a, b = np.radians(turn), np.radians(30)
    forward = np.array([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)])  # y points down
    return look_at_camera(f"from {turn}", -2 * forward, (0.0, 0.0, 0.0), (48, 36), 60.0, up=(0.0, -1.0, 0.0))


def render_floor(view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth [H, W] of the floor and a smooth checkered picture [H, W, 3] of the floor, in [0, 1]."""
    rays, up = geometry.pixel_rays(view), view.world_to_camera[:3, 1]
    depth = (up @ view.world_to_camera[:3, 3]) / (rays @ up)
    points = geometry.unproject(depth, view)
    light = 0.5 + 0.2 * (np.sin(20 * points[..., 0]) + np.sin(20 * points[..., 2]))
    return depth, np.repeat(light[..., None], 3, 2)


def test_no_view_is_completed_from_behind_where_nobody_photographed():
    at = np.array([0.0, 0.0, 0.2])
    turns = {"photographed": 0, "beside": 40, "before the other": 205, "behind": 110, "the other": 180}
    cameras = [orbit_camera(name, angle, 0.5, 2.0, at, 32, 40.0) for name, angle in turns.items()]
    camera_only = frozenset({"beside", "before the other", "behind"})
    views = [type("View", (), {"camera": camera}) for camera in cameras]
    background = Background(views, {}, camera_only=camera_only)
    assert [camera.name for camera in coverage.cameras_near_photographs(background)] == [
        n for n in turns if n != "behind"
    ]
    everywhere = replace(background, camera_only=frozenset())
    assert coverage.cameras_near_photographs(everywhere) == cameras, "with photographs all views are"


def test_what_is_painted_on_the_new_surface_stays_in_place_from_the_other_side(monkeypatch):
    """With opaque Gaussians that occlude each other, colors that fit the reference are displaced in the opposite view.

    The two sheets of the new surface must reduce this error.
    """
    view, opposite = floor_view(0.0), floor_view(180.0)
    depth, picture = render_floor(view)
    reference = Reference(view, (picture * 255).round().astype(np.uint8), np.ones(depth.shape, bool))
    nothing = surface_gaussians(picture, depth, np.zeros(depth.shape, bool), view, sh_count=1)
    errors = []
    opaque = lambda *surface: surface_gaussians(*surface[:-1], sh_count=surface[-1], opacity=0.95, spread=0.4)
    for sheets in (opaque, sheet_gaussians):
        monkeypatch.setattr(rules, "sheet_gaussians", sheets)
        draft = rules.add_surface(Draft.start(nothing), reference, depth, reference.mask, Background([], {}), False)
        gaussians = draft.gaussians
        inner = (slice(14, 26), slice(14, 34))
        front, back = (rasterizer.render(gaussians, v).color.numpy() - render_floor(v)[1] for v in (view, opposite))
        assert np.abs(front[inner]).mean() < 0.02
        errors.append(np.sqrt((back[inner] ** 2).mean()))
    assert errors[1] < 0.6 * errors[0]


def test_bad_depth_is_refused():
    view = wall_scene.front_camera("v", 0.0)
    depth = np.ones((wall_scene.HEIGHT, wall_scene.WIDTH))
    depth[3, 3] = np.nan
    with pytest.raises(ValueError, match="not positive and finite"):
        surface_gaussians(np.zeros((*depth.shape, 3)), depth, np.ones(depth.shape, bool), view, sh_count=1)
    none = surface_gaussians(np.zeros((*depth.shape, 3)), depth, np.zeros(depth.shape, bool), view, sh_count=4)
    assert len(none) == 0 and none.sh.shape == (0, 4, 3)


def test_holes_left_by_faint_gaussians_are_filled(masks_folders, tmp_path):
    """After the masked Gaussians are removed, faint remaining Gaussians still cover a part of the hole.

    The hole to fill must contain the unobserved pixels, and stay inside the consistent mask.
    """
    view = wall_scene.CAMERAS["a2"]
    sets = load_mask_sets(masks_folders["masks"], ["a2"])["a2"]
    gaussians, labels = (
        load_ply(masks_folders["fit"] / "gaussians.ply"),
        load_labels(masks_folders["masks"] / "labels.npy"),
    )
    remaining = gaussians.map(lambda p: p[~labels])
    reference = Reference(view, wall_scene.photo(view), np.zeros_like(sets.invent))
    hole = rules.find_hole(Draft.start(remaining), reference, sets.consistent, 0.9)
    assert (hole & sets.unobserved).sum() > 0.9 * wall_scene.true_unobserved(view, NEAR).sum()
    assert not (hole & ~sets.consistent).any()


def test_sparse_points_count_where_they_are_visible():
    view = wall_scene.front_camera("v", 0.0)
    points = np.array([[0, 0, 2.0], [0, 0, 3.0], [0.9, 0, 2.0], [5, 0, 2.0], [0, 0, -2.0]])
    wall, left = (
        np.full((wall_scene.HEIGHT, wall_scene.WIDTH), 0.5),
        np.zeros((wall_scene.HEIGHT, wall_scene.WIDTH), bool),
    )
    left[:, :60] = True
    pixels, values = background_depth.visible_points(points, view, left, wall)
    np.testing.assert_allclose(pixels, [[wall_scene.WIDTH / 2, wall_scene.HEIGHT / 2]])
    assert values.tolist() == [0.5]


def test_the_reference_is_reproduced_by_matched_colors():
    view = wall_scene.front_camera("v", 0.0)
    picture, depth = wall_scene.photo(view), np.full((wall_scene.HEIGHT, wall_scene.WIDTH), wall_scene.WALL)
    everything = np.ones(depth.shape, bool)
    new = surface_gaussians(picture, depth, everything, view, sh_count=1, spread=0.4)
    labels = torch.ones(len(new), dtype=torch.bool)
    error = lambda g: np.abs(rasterizer.render(g, view).color.numpy() - picture / 255)[4:-4, 4:-4].mean()
    matched = rules.match_colors(new, labels, picture, everything, view)
    assert error(matched) < 0.5 * error(new)
    kept = rules.match_colors(new, ~labels, picture, everything, view)
    assert torch.equal(kept.sh, new.sh)


def test_a_hidden_gaussian_does_not_become_a_speck_of_another_color():
    """New Gaussians behind a red sheet cannot reproduce the picture in this view.

    Their colors must stay in the picture's range: an extreme color would be visible from other views.
    """
    view = wall_scene.front_camera("v", 0.0)
    picture = np.random.default_rng(0).integers(110, 140, (wall_scene.HEIGHT, wall_scene.WIDTH, 3)).astype(np.uint8)
    far, everything = (
        np.full((wall_scene.HEIGHT, wall_scene.WIDTH), wall_scene.WALL),
        np.ones((wall_scene.HEIGHT, wall_scene.WIDTH), bool),
    )
    red = np.zeros_like(picture) + np.uint8([255, 0, 0])
    before = surface_gaussians(red, 0.9 * far, everything, view, sh_count=1, spread=0.4)
    new = surface_gaussians(picture, far, everything, view, sh_count=1, spread=0.4)
    both = join_gaussians(before, new)
    labels = torch.arange(len(both)) >= len(before)
    colors = 0.5 + SH0 * rules.match_colors(both, labels, picture, everything, view).sh[labels, 0]
    assert colors.min() > 110 / 255 - 0.11 and colors.max() < 140 / 255 + 0.11


def test_refit_moves_the_gaussians_and_leaves_no_checkpoint(masks_folders, tmp_path):
    """Refitting is deterministic, keeps the number of Gaussians, and lowers the error against a photograph.

    Checkpoints are deleted when the refit is complete.
    """
    found = {}
    for name, steps in (("none", 0), ("first", 40), ("again", 40)):
        out = tmp_path / name
        out.mkdir()
        reference = write_true_references(out / "r", masks_folders["masks"], "a2")
        initialize.run(
            initialize.Params(refit_steps=steps, view_dependent_color=True, depth={"sweep": True}, extra_views=2),
            out,
            **masks_folders,
            reference=reference,
        )
        found[name] = load_ply(out / "gaussians.ply")
        visible = [path.name for path in out.rglob("*") if ".settle" not in path.parts]
        assert not list(out.rglob("checkpoint*")) and "settle" not in visible
    assert len(found["none"]) == len(found["first"])
    assert torch.equal(found["first"].means, found["again"].means)
    view = wall_scene.CAMERAS["a4"]
    error = {
        name: float((rasterizer.render(g, view).color - torch.from_numpy(wall_scene.photo(view)) / 255).abs().mean())
        for name, g in found.items()
    }
    assert error["first"] < error["none"]


def test_an_extra_view_with_few_pixels_is_sampled_less_than_the_reference():
    view = wall_scene.CAMERAS["a4"]
    picture, large, few = (
        wall_scene.photo(view),
        np.zeros((view.height, view.width), bool),
        np.zeros((view.height, view.width), bool),
    )
    large[10:40, 10:40], few[0, :3] = True, True
    supervise = lambda *masks: Supervision([view] * 40, {}, {}, [Reference(view, picture, mask) for mask in masks])
    assert repetitions(supervise(large)) == [20]
    assert repetitions(supervise(large, few, few, few)) == [20, 1, 1, 1]
    assert repetitions(supervise(large, large)) == [10, 10]
    assert repetitions(supervise()) == []


def test_a_gap_is_narrow_and_a_hole_is_not():
    gap, hole = np.zeros((100, 200), bool), np.zeros((100, 200), bool)
    gap[10:90, 50:54], hole[40:50, 50:60] = True, True
    assert coverage.is_narrow(gap) and not coverage.is_narrow(hole) and not coverage.is_narrow(gap | hole)
    gap[:, 54:58] = True
    assert not coverage.is_narrow(gap)


def test_a_completed_view_pulls_by_its_window_as_by_the_whole():
    """The crop around the mask gives the same loss and gradient as the whole view."""
    view, wall = (
        wall_scene.front_camera("v", 0.0),
        wall_scene.rectangle_gaussians(wall_scene.WALL, 2.0, 1.4, wall_scene.wall_color),
    )
    noise, mask = np.random.default_rng(0), np.zeros((wall_scene.HEIGHT, wall_scene.WIDTH), bool)
    mask[10:20, 12:30] = True
    picture = noise.integers(0, 256, (*mask.shape, 3), dtype=np.uint8)
    window, part, counts = crop_to_mask(Reference(view, picture, mask))
    assert window.width * window.height < 0.6 * mask.size
    found = []
    for camera, image, weights in ((view, picture, mask.astype(np.float32)), (window, part, counts)):
        leaves = wall.map(lambda p: p.clone().requires_grad_())
        rendering = rasterizer.render(leaves, camera).color
        loss = reconstruction_loss(rendering, torch.from_numpy(image) / 255, torch.from_numpy(weights))
        loss.backward()
        found.append((loss.detach(), leaves.sh.grad))
    torch.testing.assert_close(found[0], found[1], rtol=1e-3, atol=1e-7)


def test_the_back_of_a_thing_is_drawn_though_its_front_shows_from_behind():
    """pixels_in_front() finds the pixels where a reference shows a surface in front of all Gaussians.

    Pixels where the Gaussians already show this surface are not found.
    """
    view, near = wall_scene.front_camera("v", 0.0), 1.4
    wall = wall_scene.rectangle_gaussians(wall_scene.WALL, 2.0, 1.4, wall_scene.wall_color)
    mask, hidden = wall_scene.true_mask(view, near), np.zeros((wall_scene.HEIGHT, wall_scene.WIDTH), bool)
    reference = Reference(view, np.zeros((*mask.shape, 3), np.uint8), mask)
    depth = np.where(mask, near, wall_scene.WALL)
    assert (coverage.pixels_in_front(wall, depth, reference, hidden) == mask).all()
    front = wall_scene.rectangle_gaussians(near, wall_scene.HALF, wall_scene.HALF, wall_scene.wall_color)
    both = join_gaussians(wall, front)
    assert (
        coverage.pixels_in_front(both, depth, reference, hidden).sum() < 0.2 * mask.sum()
    )  # only the soft edge of the square is left
    assert not coverage.pixels_in_front(wall, depth, reference, mask).any()


def test_a_depth_map_that_is_unknown_outside_the_hole_adds_nothing_there():
    view = floor_view(0.0)
    depth, picture = render_floor(view)
    hole, unknown, nothing = np.zeros((3, *depth.shape), bool)
    hole[14:22, 16:30], unknown[:, :8] = True, True
    floor = sheet_gaussians(picture, depth, ~nothing, view, 1)
    reference = Reference(view, np.uint8(255 * picture), hole | unknown, np.where(unknown, np.nan, depth))
    _, estimate, _ = rules.estimate_depth(
        rasterizer.render(floor, reference.camera), reference, hole, nothing, np.zeros((0, 3)), CompletionSettings()
    )
    np.testing.assert_allclose(estimate, depth, rtol=0.02)
    assert not coverage.pixels_in_front(floor, estimate, reference, nothing).any()


def test_pixels_stained_by_an_edge_lie_beside_it_on_what_stays():
    depth, stays = np.full((9, 9), 2.0), np.full((9, 9), 2.0)
    depth[3:6, 3:6] = 1.0
    found = coverage.beside_depth_edges(depth, stays)
    ring = np.zeros((9, 9), bool)
    ring[2:7, 2:7] = True
    ring[3:6, 3:6] = False
    assert (found == ring).all()
    assert not coverage.beside_depth_edges(
        depth, stays + 1
    ).any()  # none where the depth is not that of the remaining scene
