"""Unseen parts of an object from its mirror image, if the photographs agree: a vase and a box in analytic views."""

import cv2
import numpy as np
import pytest
import torch
from scenes.cameras import meet_box, orbit_camera, uneven_depth_view, world_rays
from scenes.gaussians import round_gaussians

from reffusion import geometry
from reffusion.background.continuation import find_planes
from reffusion.background.mirrors import Mirror, render_mirrors
from reffusion.background.symmetry import find_mirrors
from reffusion.background.unobserved import find_unobserved
from reffusion.background.visibility import DepthView
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

NO_POINTS = np.zeros((0, 3))
SIZE, FOCAL = 320, 330.0
WIDE, DEEP, HIGH = 0.4, 0.25, 0.7  # half axes of the vase, and its height
LOW, UPPER = np.array([-0.75, -0.75, 0.0]), np.array([-0.2, -0.3, 0.5])  # corners of the box before its left half
CENTER, RADIUS = (LOW + UPPER) / 2, 0.45


def vase_camera(name: str, azimuth: float, height: float = 1.3, away: float = 3.0) -> Camera:
    """Return a camera that looks at the vase; azimuth in degrees; the world's z axis is up."""
    return orbit_camera(name, azimuth, height, away, np.array([0, 0, 0.2]), SIZE, FOCAL)


def intersect_vase(rays: np.ndarray, center: np.ndarray, cut: bool) -> np.ndarray:
    """Return the distance [H, W] along the rays to the vase, an elliptic cylinder.

    Args:
        cut: whether an oblique cut removes the right part of the vase.
    """
    scale = np.array([1 / WIDE, 1 / DEEP])
    d, o = rays[..., :2] * scale, center[:2] * scale
    a, b, c = (d * d).sum(-1), (d * o).sum(-1), o @ o - 1
    root = np.sqrt(np.maximum(b * b - a * c, 0))
    near = np.where(b * b > a * c, (-b - root) / a, np.inf)
    top = (HIGH - center[2]) / rays[..., 2]
    at = lambda t: center + rays * np.where(np.isfinite(t), t, 0)[..., None]
    inside = lambda p: ((p[..., :2] * scale) ** 2).sum(-1) < 1
    side = np.where((at(near)[..., 2] > 0) & (at(near)[..., 2] < HIGH), near, np.inf)
    lid = np.where((top > 0) & inside(at(top)), top, np.inf)
    if cut:
        slant, end = np.array([1.0, 0.0, 0.7]), WIDE
        side, lid = (np.where(at(t) @ slant > end, np.inf, t) for t in (side, lid))
        face = (end - center @ slant) / (rays @ slant)
        visible = (face > 0) & inside(at(face)) & (at(face)[..., 2] > 0) & (at(face)[..., 2] < HIGH)
        side = np.minimum(side, np.where(visible, face, np.inf))
    return np.minimum(side, lid)


def render_vase(view: Camera, cut: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the depth [H, W] without the box, the box's mask, and the mask that the vase has without the box."""
    rays = world_rays(view)
    ground = np.where(rays[..., 2] < 0, -view.center[2] / np.minimum(rays[..., 2], -1e-9), 50.0).clip(0, 50)
    vase = intersect_vase(rays, view.center, cut)
    depth = np.minimum(ground, vase)
    enter, meets = meet_box(view, LOW, UPPER)
    return depth, meets & (enter < depth), vase < ground


def vase_depth_view(view: Camera, cut: bool = False) -> DepthView:
    return uneven_depth_view(view, *render_vase(view, cut)[:2])


def vase_color(points: np.ndarray, halved: bool) -> np.ndarray:
    """Return the vase's colors [..., 3], a pattern of bands; `halved` gives its two halves different colors."""
    bands = 0.5 + 0.3 * np.sin(9 * points[..., 2])
    half = np.where(points[..., 0] > 0, 1 - bands, bands) if halved else bands
    return np.stack([half, 0.8 * half, 0.5 * bands], -1)


def make_vase_scene(cut: bool = False, halved: bool = False):
    """Return depth views, photographs, and the Gaussians of all visible points of the vase and the ground."""
    views = [
        vase_depth_view(vase_camera(f"v{k}", azimuth), cut) for k, azimuth in enumerate(np.linspace(-150, -30, 11))
    ]
    photos, seen = {}, []
    for view in views:
        points = geometry.unproject(view.depth, view.camera)
        photos[view.camera.name] = (255 * vase_color(points, halved)).astype(np.uint8)
        seen.append(points[::2, ::2][(~view.masked & (view.depth < 6))[::2, ::2]])
    points = np.concatenate(seen)
    points = points[np.unique(np.floor(points / 0.02), axis=0, return_index=True)[1]]
    gaussians = round_gaussians(points, vase_color(points, halved), 0.012, 6.0)
    return views, photos, gaussians


def select_left_right_mirrors(mirrors: list[Mirror]) -> list[Mirror]:
    """Return the mirrors that exchange left and right; mirrors that exchange front and back are left out."""
    return [mirror for mirror in mirrors if abs(mirror.normal[0]) > 0.8]


@pytest.fixture(scope="module")
def vase_mirrors():
    views, photos, gaussians = make_vase_scene()
    planes = find_planes(CENTER, RADIUS, views, NO_POINTS)
    return views, gaussians, planes, find_mirrors(gaussians, CENTER, RADIUS, views, planes, photos)


def test_a_vase_is_its_own_mirror_image(vase_mirrors):
    _, _, _, mirrors = vase_mirrors
    found = select_left_right_mirrors(mirrors)
    assert len(found) == 1 and len(mirrors) <= 2  # front and back of the vase are symmetric, too
    assert abs(found[0].normal[0]) > 0.995 and abs(found[0].offset) < 0.02


def test_the_half_that_the_box_hides_stands_where_it_is(vase_mirrors):
    views, _, _, mirrors = vase_mirrors
    for view in views[::3]:
        true, hidden, vase = render_vase(view.camera)
        found = render_mirrors(mirrors, view.camera, hidden, views).plausible_depth
        behind_box = cv2.erode((hidden & vase).astype(np.uint8), np.ones((7, 7))) > 0
        if behind_box.sum() < 100:
            continue
        known = np.isfinite(found) & behind_box
        assert known.sum() > 0.5 * behind_box.sum()
        assert np.median(np.abs(found / true - 1)[known]) < 0.01
        wrong = np.isfinite(found) & ~(cv2.dilate(vase.astype(np.uint8), np.ones((9, 9))) > 0)
        assert wrong.sum() < 0.02 * behind_box.sum()


def test_mirrored_pixels_are_unobserved_and_have_its_depth(vase_mirrors):
    views, gaussians, planes, mirrors = vase_mirrors
    view = views[5]
    true, hidden, vase = render_vase(view.camera)
    supposed = np.isfinite(render_mirrors(mirrors, view.camera, hidden, views).plausible_depth) & vase
    inside = cv2.erode(supposed.astype(np.uint8), np.ones((9, 9))) > 0
    found = find_unobserved(rasterizer.render(gaussians, view.camera), view.camera, hidden, views, planes, mirrors)
    inside &= found.depth > 1.05 * true  # without the ground behind the vase, which other views show
    assert inside.sum() > 200 and found.unobserved[inside].mean() > 0.9
    assert np.median(np.abs(found.continued_depth / true - 1)[inside & found.unobserved]) < 0.01


@pytest.mark.parametrize("how", [{"cut": True}, {"halved": True}])
def test_an_asymmetric_object_has_no_mirror(how):
    views, photos, gaussians = make_vase_scene(**how)
    planes = find_planes(CENTER, RADIUS, views, NO_POINTS)
    assert not select_left_right_mirrors(find_mirrors(gaussians, CENTER, RADIUS, views, planes, photos))


def test_without_an_object_there_is_no_mirror():
    views, photos, gaussians = make_vase_scene()
    assert find_mirrors(gaussians, CENTER, RADIUS, views, [], photos) == []
    planes = find_planes(CENTER, RADIUS, views, NO_POINTS)
    assert find_mirrors(gaussians, CENTER, np.inf, views, planes, photos) == []


def test_a_camera_behind_the_mirror_shows_the_image_with_its_sides_swapped():
    draws, view = np.random.default_rng(3), vase_camera("v", -70)
    means = torch.tensor(draws.uniform(-0.4, 0.4, (60, 3)), dtype=torch.float32)
    colors = torch.tensor(draws.uniform(-1, 1, (60, 1, 3)), dtype=torch.float32)
    balls = Gaussians(means, torch.eye(4)[:1].repeat(60, 1), torch.full((60, 3), -3.0), torch.full((60,), 2.0), colors)
    normal = np.array([0.6, 0.64, 0.48])
    mirror = Mirror(balls, normal, 0.13)
    image = torch.tensor(mirror.reflect(means.double().numpy()), dtype=torch.float32)
    direct = rasterizer.render(balls.map(lambda p: image if p is means else p), view)
    across = rasterizer.render(balls, mirror.reflect_camera(view))
    assert torch.allclose(direct.color, across.color.flip(1), atol=2e-4)
    assert np.allclose(mirror.reflect(mirror.reflect(means.numpy())), means, atol=1e-6)
