"""The visibility of surfaces behind an object: a box on a table with free space below, in analytic views."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scenes.cameras import meet_box, orbit_camera, uneven_depth_view, world_rays

from reffusion import geometry
from reffusion.background.continuation import find_planes
from reffusion.background.plane import CELLS, Plane
from reffusion.background.unobserved import _continues_surroundings, find_unobserved
from reffusion.background.visibility import (
    DepthView,
    count_views,
    depth_range,
    is_seen,
)
from reffusion.gaussians.surfels import surface_gaussians
from reffusion.masks.debris import count_color_mismatches
from reffusion.morphology import remove_slivers
from reffusion.shadows import light, reference_shadows
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

NO_POINTS = np.zeros((0, 3))
TOP, FLOOR, EDGE, BOX, HIGH = 0.0, -1.0, 1.0, 0.3, 0.5  # z of table top and floor; half sides; height of the box
CORNERS = (-BOX, -BOX, 0.0), (BOX, BOX, HIGH)
SIZE, FOCAL = 160, 150.0


def table_camera(name: str, azimuth: float, height: float, away: float = 3.5) -> Camera:
    """Return a camera that looks at the middle of the table; azimuth in degrees; the world's z axis is up."""
    return orbit_camera(name, azimuth, height, away, np.zeros(3), SIZE, FOCAL)


def render_table(view: Camera, notched: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the depth [H, W] of table and floor, the box's mask, and the mask that the table has without the box.

    Args:
        notched: whether a quarter of the table is missing, up to the middle of the box.
    """
    rays = world_rays(view)
    to = lambda z: (z - view.center[2]) / rays[..., 2]
    at = lambda t: view.center + rays * t[..., None]
    table, floor = to(TOP), to(FLOOR)
    on_table = (table > 0) & (np.abs(at(table)[..., :2]) <= EDGE).all(-1)
    on_table &= ~(notched & (at(table)[..., :2] > 0).all(-1))
    floor = np.where(floor > 0, floor, 20.0)
    depth = np.where(on_table & (table < floor), table, floor)
    enter, meets = meet_box(view, *CORNERS)
    return depth, meets & (enter < depth), on_table & (table < floor)


def table_depth_view(view: Camera, notched: bool = False) -> DepthView:
    return uneven_depth_view(view, *render_table(view, notched)[:2])


@pytest.fixture(scope="module")
def table_views():
    above = [table_depth_view(table_camera(f"a{k}", 30 * k, 1.6)) for k in range(12)]
    return above + [
        table_depth_view(table_camera(f"l{k}", 60 * k, -0.5)) for k in range(6)
    ]  # these cameras look under the table


def test_a_point_is_seen_on_its_surface_only(table_views):
    points = np.array([[0.7, 0.7, 0.0], [0.7, 0.7, 0.4], [0.7, 0.7, -0.5], [0.0, 0.0, 0.25], [0.0, 0.0, 0.0]])
    counts = count_views(points, table_views)
    assert counts.seen[0] >= 6 and counts.free[0] == 0, "the table's top"
    assert counts.free[1] >= 6 and counts.seen[1] == 0, "the air above it"
    assert counts.seen[2] == 0 and counts.free[2] >= 2, "under the table low views look through"
    assert counts.seen[3] == counts.free[3] == 0 and counts.masked[3] == len(table_views), "within the box nobody knows"
    above = count_views(points, table_views, np.tile([0.0, 0.0, 1.0], (5, 1)))
    assert above.seen[4] == 0 and above.free[4] == 0, "nor, from above, what it stands on"


def test_a_surface_does_not_face_views_from_its_other_side(table_views):
    point = np.array([[0.7, 0.7, 0.0]])
    up, down = (count_views(point, table_views, np.array([[0.0, 0.0, z]])).seen[0] for z in (1.0, -1.0))
    assert up + down == count_views(point, table_views).seen[0]
    assert up >= 6 and down >= 1, "the thin top is seen from both"


def test_the_table_goes_on_under_the_box_and_ends_at_its_edge(table_views):
    planes = find_planes(np.array([0.0, 0.0, HIGH / 2]), 0.45, table_views, NO_POINTS)
    table = max(planes, key=lambda plane: abs(plane.normal[2]) - abs(plane.offset))
    assert abs(table.normal[2]) > 0.999 and abs(table.offset) < 0.01
    view = table_camera("new", 15.0, 1.6)
    depth, _, on_table = render_table(view)
    at = table.depth(view)
    goes_on = table.pixels_on(table.continued, at, view, np.ones_like(on_table))
    place = geometry.unproject(np.where(np.isfinite(at), at, 1.0), view)
    footprint = on_table & (np.abs(place[..., :2]) < BOX - 0.05).all(-1)
    beyond = ~(np.abs(place[..., :2]) < EDGE + 0.05).all(-1)
    assert goes_on[footprint].mean() > 0.95
    assert not (goes_on & beyond).any()
    np.testing.assert_allclose(at[footprint], depth[footprint], rtol=0.01)


def test_a_table_is_seen_from_above_though_what_stands_beside_it_is_lower(table_views):
    above = [view for view in table_views if view.camera.name.startswith("a")]
    planes = find_planes(np.array([0.0, 0.0, -0.2]), 0.45, above, NO_POINTS)
    table = max(planes, key=lambda plane: abs(plane.normal[2]) - abs(plane.offset))
    assert table.contains(table.seen, np.array([[0.7, 0.7, 0.0]]))[0]


@pytest.mark.parametrize(("wide", "through"), [(0.15, False), (0.4, True)])
def test_a_speck_that_views_see_through_is_no_hole(wide, through):
    """A spot of the table has too large a depth in all views. Only the larger spot (`wide` = 0.4) is a hole."""
    views = []
    for turn in range(0, 360, 30):
        view = table_depth_view(table_camera(f"a{turn}", turn, 1.6))
        rays = world_rays(view.camera)
        place = view.camera.center - rays * (view.camera.center[2] / rays[..., 2])[..., None]
        spot = (np.abs(place[..., :2] - [BOX + wide, 0]) < wide / 2).all(-1)
        views.append(replace(view, depth=np.where(spot, 2 * view.depth, view.depth)))
    planes = find_planes(np.array([0.0, 0.0, HIGH / 2]), 0.45, views, NO_POINTS)
    table = max(planes, key=lambda plane: abs(plane.normal[2]) - abs(plane.offset))
    middle = np.array([[BOX + wide, 0.0, 0.0]])
    assert table.contains(table.free, middle)[0] == through


def test_borders_that_are_visible_go_on_under_the_box():
    """The box hides the inner corner of an L-shaped table.

    Cells beyond the straight line between the table's visible edges are free, although the convex hull contains them.
    """
    views = [table_depth_view(table_camera(f"a{k}", 30 * k, 1.6), notched=True) for k in range(12)]
    planes = find_planes(np.array([0.0, 0.0, HIGH / 2]), 0.45, views, NO_POINTS)
    table = max(planes, key=lambda plane: abs(plane.normal[2]) - abs(plane.offset))
    steps = (np.arange(len(table.continued)) + 0.5 - len(table.continued) / 2) * table.cell_size
    points = table.origin + steps[:, None, None] * table.axes[0] + steps[None, :, None] * table.axes[1]
    across, under = points[..., :2].sum(-1), (np.abs(points[..., :2]) < 0.9 * BOX).all(-1)
    assert table.continued[under & (across < 0.7 * BOX)].mean() > 0.95
    assert table.continued[under & (across > 1.3 * BOX)].mean() < 0.05
    assert table.enclosed[under & (across > 1.3 * BOX)].mean() < 0.05


def plinth_depth_view(view: Camera) -> DepthView:
    """Return a view of rough ground and a plinth's upright face behind the box; the face ends where the box begins."""
    rays = world_rays(view)
    ground, face = -view.center[2] / rays[..., 2], (0.5 - view.center[1]) / rays[..., 1]
    place = view.center + rays * face[..., None]
    upright = (face > 0) & (place[..., 0] < -BOX) & (place[..., 0] > -1.5) & (place[..., 2] > 0) & (place[..., 2] < 0.7)
    depth = np.where(upright, face, np.where(ground > 0, ground, 20.0))
    return uneven_depth_view(view, depth, meet_box(view, *CORNERS)[1], tolerance=0.06)


def test_a_wall_does_not_go_on_along_the_ground_where_it_was_never_seen():
    """Close to the wall's plane, rough ground looks like seen cells of this plane, on both sides of the box."""
    views = [plinth_depth_view(table_camera(f"a{k}", 200 + 12 * k, 1.4)) for k in range(12)]
    planes = find_planes(np.array([0.0, 0.0, HIGH / 2]), 0.45, views, NO_POINTS)
    face = max(planes, key=lambda plane: abs(plane.normal[1]))
    assert abs(face.normal[1]) > 0.99
    right = face.cell_centers[..., 0] > -0.8 * BOX
    assert not (face.continued & right).any()
    assert (face.seen & ~right).sum() > 5 * (face.seen & right).sum()
    ground = max(planes, key=lambda plane: abs(plane.normal[2]))
    under = (np.abs(ground.cell_centers[..., :2]) < 0.8 * BOX).all(-1)
    assert ground.continued[under].mean() > 0.95


def test_gaussians_beneath_the_table_are_not_the_surface_behind_the_box(table_views):
    """A fit whose depth is wrong in one view leaves floaters beneath the table."""
    camera = table_views[0].camera
    rays = world_rays(camera)
    beneath = np.clip((-0.2 - camera.center[2]) / np.minimum(rays[..., 2], -1e-3), 0, 20)
    gray = np.full((SIZE, SIZE, 3), 128, np.uint8)
    floaters = surface_gaussians(gray, beneath, np.ones((SIZE, SIZE), bool), camera, sh_count=1, spread=0.6)
    hidden = render_table(camera)[1] & render_table(camera)[2]

    def shows_it(view):
        rays = world_rays(view.camera)
        depth = (-0.2 - view.camera.center[2]) / np.minimum(rays[..., 2], -1e-3)
        return DepthView.from_range(view.camera, depth, (depth, depth), view.masked)

    above = table_views[:12]
    others = count_views(geometry.unproject(beneath, camera)[hidden], above[4:]).occluded
    region = np.zeros_like(hidden)
    region[hidden] = others > 3
    rendering = rasterizer.render(floaters, camera)
    one = find_unobserved(rendering, camera, hidden, [shows_it(above[3]), *above[4:]], [])
    all_of_them = find_unobserved(rendering, camera, hidden, [*map(shows_it, above)], [])
    assert region.sum() > 100
    assert one.unobserved[region].mean() > 0.75 and all_of_them.unobserved[region].mean() < 0.1


def test_objects_in_front_of_a_plane_do_not_refute_it():
    """In half of the patch's surroundings an object is nearer than the wall. A farther object would refute the wall."""
    view, everywhere, nowhere = table_camera("v", 0, 0.0), np.ones((CELLS, CELLS), bool), np.zeros((CELLS, CELLS), bool)
    wall = Plane(
        np.array([1.0, 0, 0]), 0.0, np.zeros(3), np.eye(3)[1:], 0.05, nowhere, everywhere, nowhere, nowhere, nowhere
    )
    at = wall.depth(view)
    patch = np.zeros((SIZE, SIZE), bool)
    patch[60:100, 60:100] = True
    half, full = np.arange(SIZE) < 78, np.ones(SIZE, bool)
    agrees = lambda rate, where: _continues_surroundings(patch, wall, at, view, np.where(where, rate * at, at), ~patch)
    assert agrees(0.7, half) and not agrees(1.4, half)
    assert not agrees(0.7, full)  # the wall is seen nowhere around the patch


def test_slivers_go_and_patches_stay():
    mask = np.zeros((100, 200), bool)
    mask[20:22, 10:190] = True
    mask[50:80, 50:90] = True
    found = remove_slivers(mask, 0.01)
    assert not found[:40].any() and found[52:78, 52:88].all() and not (found & ~mask).any()


def test_an_object_that_hides_its_far_side_does_not_refute_it(table_views):
    """Half of the views look at the box's side from behind, where the box itself is nearer."""
    exact = lambda depth: (depth, (depth, depth))
    whole = [
        DepthView.from_range(v.camera, *exact(render_box_depth(v.camera)), np.zeros_like(v.masked))
        for v in table_views[:12]
    ]
    point, side = np.array([[BOX, 0.0, 0.25]]), np.array([[1.0, 0.0, 0.0]])
    plain, faced = count_views(point, whole), count_views(point, whole, side)
    assert plain.occluded[0] >= 4 and faced.occluded[0] == 0 and faced.seen[0] >= 3


def render_box_depth(view: Camera) -> np.ndarray:
    """Return the depth [H, W] of table, floor and box."""
    depth, hidden, _ = render_table(view)
    return np.where(hidden, meet_box(view, *CORNERS)[0], depth)


def test_a_shadow_beside_the_mask_is_found_and_carried_into_other_views(table_views):
    view, other = table_views[0], table_views[1]
    depth, hidden, on_table = render_table(view.camera)
    place = geometry.unproject(depth, view.camera)
    shadow = on_table & ~hidden & (np.hypot(place[..., 0] - 0.5, place[..., 1] - 0.5) < 0.3)
    grain = np.random.default_rng(0).integers(-12, 13, (SIZE, SIZE, 1))
    truth = np.clip(np.full((SIZE, SIZE, 3), 140) + grain, 0, 255).astype(np.uint8)
    photo = np.where(shadow[..., None], (truth * 0.6).astype(np.uint8), truth)
    photo[5:25, 5:25] = 40  # another difference, far from the mask
    found = reference_shadows.detect_shadow(truth, photo, hidden)
    assert (found & shadow).sum() > 0.9 * (shadow & ~view.masked).sum() and not found[5:25, 5:25].any()
    assert not reference_shadows.detect_shadow(truth, truth, hidden).any()
    points = geometry.unproject(render_table(other.camera)[0], other.camera)
    same = render_table(other.camera)[2] & (np.hypot(points[..., 0] - 0.5, points[..., 1] - 0.5) < 0.25) & ~other.masked
    carried, own_light = reference_shadows.project_shadow(
        found, light.measure_log_gain(truth, photo), depth, view.camera, [other]
    )["a1"]
    assert carried[same].mean() > 0.9 and not carried[~render_table(other.camera)[2]].mean() > 0.02
    lit = np.clip(np.full((SIZE, SIZE, 3), 140) + np.random.default_rng(1).integers(-12, 13, (SIZE, SIZE, 1)), 0, 255)
    core = render_table(other.camera)[2] & (np.hypot(points[..., 0] - 0.5, points[..., 1] - 0.5) < 0.2) & ~other.masked
    again = light.relight((lit * 0.6).astype(np.uint8), own_light)
    assert np.abs(again[core].astype(float) - lit[core]).mean() < 4 and np.abs(lit[core] * 0.4).mean() > 50
    outside = ~cv2.dilate(carried.astype(np.uint8), np.ones((9, 9))).astype(bool)
    assert (again[outside] == (lit * 0.6).astype(np.uint8)[outside]).all(), "where nothing is known it stays as it is"


def test_gaussians_of_other_colors_than_gravel_are_debris():
    """Before rough ground nearly all Gaussians count as seen. The teal ones, remains of the object, must be found."""
    view = table_camera("v", 0, 2.0)
    depth, _, _ = render_table(view)
    rough = (depth * (1 + 0.1 * np.random.default_rng(0).random(depth.shape))).astype(np.float32)
    witness = DepthView.from_range(view, rough, depth_range(rough), np.zeros_like(rough, bool))
    photo = np.random.default_rng(1).integers(90, 160, (*rough.shape, 3)).astype(np.uint8)
    place = geometry.unproject(rough.astype(float), view)[80:84, 80]
    sh = torch.zeros(4, 1, 3)
    sh[2:, 0] = torch.tensor([-1.2, 0.6, 0.6])  # teal; the others are gray
    parts = torch.tensor(place).float(), torch.zeros(4, 4), torch.full((4, 3), -4.0), torch.zeros(4), sh
    assert count_color_mismatches(Gaussians(*parts), [witness], {"v": photo}).tolist() == [0, 0, 1, 1]
    smooth = DepthView.from_range(view, depth, depth_range(np.full_like(depth, depth[80, 80])), witness.masked)
    assert not count_color_mismatches(Gaussians(*parts), [smooth], {"v": photo}).any()


def test_visibility_of_points_follows_the_formulas(table_views):
    """Points lie on, before, behind and beside the surfaces, behind cameras, and at non-finite positions.

    Visibility is computed with and without a normal.
    """
    noise = np.random.default_rng(0)
    points = noise.uniform(-1.5, 1.5, (3000, 3)) * (1, 1, 0.7)
    points[:1000, 2], points[1000:1500, 2], points[-2], points[-1] = TOP, FLOOR, (9, 0, 0.5), np.nan
    normals = noise.normal(size=points.shape)
    for sides in (None, normals):
        counts, expected = count_views(points, table_views, sides), np.zeros((4, len(points)), int)
        for view in table_views:
            uv, z = geometry.project(points, view.camera)
            maps = (view.masked, view.nearest, view.farthest)
            (hidden, inside), (nearest, _), (farthest, _) = (geometry.sample_nearest(each, uv) for each in maps)
            faced = True if sides is None else ((view.camera.center - points) * sides).sum(-1) > 0
            visible = inside & ~hidden & (z > 0) & (nearest > 0)
            on = (z > nearest * (1 - geometry.SAME_SURFACE)) & (z < farthest * (1 + geometry.SAME_SURFACE))
            behind_it = z > farthest * (1 + geometry.SAME_SURFACE)
            free = nearest > z * (1 + geometry.OTHER_SURFACE)
            expected += [visible & on & faced, visible & free, visible & behind_it & faced, inside & hidden & (z > 0)]
            assert (is_seen(view, points) == (visible & on)).all()
        for name, count in zip(("seen", "free", "occluded", "masked"), expected, strict=True):
            assert (getattr(counts, name) == count).all() and count.any(), name
