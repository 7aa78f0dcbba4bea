"""The origin of what a view shows in the hole: other photographs, a reference, patches of an extra view, or nothing."""

import numpy as np
import torch
from scenes import wall_scene

from reffusion import geometry
from reffusion.background.model import Background
from reffusion.background.visibility import render_depth_views
from reffusion.initialize.draft import EXTRA_VIEW, REFERENCE, REMAINING, Draft
from reffusion.initialize.origins import ORIGINS, find_origins
from reffusion.splat import rasterizer
from reffusion.types import MaskSet


def test_each_pixel_has_the_origin_of_its_surface():
    """The left half of a wall remains; a reference added the upper right quarter, an extra view the lower right."""
    camera = wall_scene.CAMERAS[wall_scene.TRAIN[0]]
    wall = wall_scene.wall_and_square(1.7)[0]
    wall = wall.map(lambda p: p[wall.means[:, 2] > wall.means[:, 2].max() - 1e-3])
    left, upper = wall.means[:, 0] < 0, wall.means[:, 1] < 0
    origin = torch.where(left, REMAINING, torch.where(upper, REFERENCE, EXTRA_VIEW)).to(torch.uint8)
    shape = camera.height, camera.width
    hidden, unobserved = np.zeros(shape, bool), np.zeros(shape, bool)
    hidden[10:-10, 10:-10] = True
    unobserved[10:20, 10:-10] = True
    found = find_origins(Draft(wall, origin), camera, MaskSet(hidden, hidden, unobserved, unobserved))
    named = lambda row, column: ORIGINS[found.classes[row, column]]
    assert named(40, 15) == "photographs" and named(14, 15) == "nothing"
    assert named(20, camera.width - 15) == "reference" and named(camera.height - 15, camera.width - 15) == "patches"
    assert named(2, 2) == "outside" and found.uncovered_share < 0.1
    assert abs(sum(found.shares.values()) - 1) < 1e-9 and found.picture.shape == (*shape, 3)


def test_a_gap_shows_nothing():
    camera = wall_scene.CAMERAS[wall_scene.TRAIN[0]]
    wall = wall_scene.wall_and_square(1.7)[0]
    faint = wall.map(lambda p: p[:1])
    everywhere = np.ones((camera.height, camera.width), bool)
    found = find_origins(Draft.start(faint), camera, MaskSet(everywhere, everywhere, ~everywhere, ~everywhere))
    assert found.uncovered_share > 0.9 and found.shares["nothing"] > 0.9
    none = find_origins(Draft.start(faint), camera, MaskSet(*[~everywhere] * 4))
    assert none.uncovered_share == 0 and set(none.shares.values()) == {0.0}


def test_surfaces_that_most_photographs_show_in_another_color_are_in_conflict():
    """The wall is as photographed on the left; on the right, where x > 0, the photographs are 60 levels darker."""
    cameras = [wall_scene.CAMERAS[name] for name in wall_scene.TRAIN]
    wall = wall_scene.wall_and_square(1.7)[0]
    wall = wall.map(lambda p: p[wall.means[:, 2] > wall.means[:, 2].max() - 1e-3])
    own, others = cameras[0], cameras[1:]
    nothing = {camera.name: np.zeros((camera.height, camera.width), bool) for camera in cameras}
    views, photos = render_depth_views(wall, others, nothing), {}
    for view in views:
        rendering = rasterizer.render(wall, view.camera)
        x = geometry.unproject(rendering.depth.double().numpy(), view.camera)[..., 0]
        shown = 255 * rendering.color.numpy() - 60 * (x > 0)[..., None]
        photos[view.camera.name] = shown.clip(0, 255).round().astype(np.uint8)
    everywhere = ~nothing[own.name]
    sets = MaskSet(everywhere, everywhere, ~everywhere, ~everywhere)
    found = find_origins(Draft.start(wall), own, sets, Background(views, photos))
    x = geometry.unproject(rasterizer.render(wall, own).depth.double().numpy(), own)[..., 0]
    seen = np.isin(found.classes, [ORIGINS.index("photographs"), ORIGINS.index("conflict")])
    clear = seen & (np.abs(x) > 0.1)
    assert clear.sum() > 0.5 * x.size
    assert (((found.classes == ORIGINS.index("conflict")) == (x > 0))[clear]).mean() > 0.95
