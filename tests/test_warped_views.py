"""References, warped to other views: they show what those views would photograph, and keep fine lines whole."""

from dataclasses import replace

import numpy as np
import pytest
from scenes.cameras import look_at_camera

from reffusion import geometry
from reffusion.gaussians.sheets import sheet_gaussians
from reffusion.gaussians.surfels import surface_gaussians
from reffusion.initialize.draft import REFERENCE, Draft
from reffusion.initialize.refit import Supervision, refit
from reffusion.initialize.warped_views import MIN_SCALE, warp_references
from reffusion.splat import rasterizer
from reffusion.types import Camera, Reference

FINE = 5  # samples along each side of a pixel of a photograph


def camera_at(turn: float, distance: float = 2.0) -> Camera:
    """Return a camera 35 degrees above the floor y = 0, turned about the vertical by `turn` degrees."""
    a, b = np.radians(turn), np.radians(35)
    forward = np.array([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)])  # y points down
    return look_at_camera(
        f"{turn} {distance}", -distance * forward, (0.0, 0.0, 0.0), (72, 54), 100.0, up=(0.0, -1.0, 0.0)
    )


def floor_depth(view: Camera) -> np.ndarray:
    """Return [H, W], camera z of the floor."""
    rays, up = geometry.pixel_rays(view), view.world_to_camera[:3, 1]
    return (up @ view.world_to_camera[:3, 3]) / (rays @ up)


def photograph(view: Camera) -> np.ndarray:
    """Return a picture of the floor, uint8 [H, W, 3]: planks of changing tone with dark joints of half a pixel."""
    large = view.resized(FINE * view.width, FINE * view.height)
    x, _, z = np.moveaxis(geometry.unproject(floor_depth(large), large), -1, 0)
    across = 0.8 * x + 0.6 * z
    light = 0.6 + 0.1 * np.sin(3 * x) - 0.5 * (np.abs((across / 0.16) % 1 - 0.5) < 0.04)
    mean = light.reshape(view.height, FINE, view.width, FINE).mean((1, 3))
    return np.repeat((255 * mean).round().astype(np.uint8)[..., None], 3, 2)


def filled_floor(view: Camera) -> tuple[Draft, Reference, np.ndarray]:
    """Return a draft of new Gaussians only, which show the photograph of the floor, the reference, and its depth."""
    depth, whole = floor_depth(view), np.ones((view.height, view.width), bool)
    nothing = surface_gaussians(photograph(view), depth, ~whole, view, sh_count=1)
    added = sheet_gaussians(photograph(view), depth, whole, view, 1)
    return Draft.start(nothing).add(added, REFERENCE), Reference(view, photograph(view), whole), depth


def difference(picture: np.ndarray, view: Camera, mask: np.ndarray) -> float:
    """Return the root mean square difference of a picture in levels from the photograph, inside a mask."""
    return float(np.sqrt(((picture - photograph(view).astype(float))[mask] ** 2).mean()))


@pytest.mark.parametrize("turn", [15.0, 25.0, -40.0])
def test_a_warped_view_is_what_the_view_would_photograph(turn):
    own, other = camera_at(0.0), camera_at(turn)
    draft, reference, depth = filled_floor(own)
    (warped,) = warp_references(draft, [reference], {own.name: depth}, [own, other])
    uv, _ = geometry.project(geometry.unproject(floor_depth(other), other), own)
    shown = (uv > 3).all(-1) & (uv < (own.width - 3, own.height - 3)).all(-1)
    assert warped.camera == other and (warped.mask & shown).sum() > 0.8 * shown.sum()
    flat = np.full(warped.image.shape, photograph(other)[warped.mask].mean())
    assert difference(warped.image, other, warped.mask) < 0.45 * difference(flat, other, warped.mask)


def test_nothing_is_warped_where_the_reference_is_too_coarse_or_another_surface_shows():
    own = camera_at(0.0)
    draft, reference, depth = filled_floor(own)
    near = camera_at(10.0, 2.0 * MIN_SCALE * 0.7)
    assert not warp_references(draft, [reference], {own.name: depth}, [near])
    assert not warp_references(draft, [reference], {}, [camera_at(25.0)])
    raised = replace(draft.gaussians, means=draft.gaussians.means * 0.9)
    assert not warp_references(Draft(raised, 0 * draft.origin), [reference], {own.name: depth}, [camera_at(25.0)])


def test_warped_views_keep_fine_lines_whole_in_views_that_did_not_take_part(tmp_path):
    own, others, judge = camera_at(0.0), [camera_at(turn) for turn in (-60.0, -30.0, 30.0, 60.0)], camera_at(45.0)
    draft, reference, depth = filled_floor(own)
    warped = warp_references(draft, [reference], {own.name: depth}, others)
    (judged,) = warp_references(draft, [reference], {own.name: depth}, [judge])
    errors = []
    for number, completed in enumerate(([reference], [reference, *warped])):
        folder = tmp_path / str(number)
        folder.mkdir()
        supervision = Supervision([own], {own.name: reference.image}, {own.name: reference.mask}, completed)
        fitted = refit(draft.gaussians, draft.origin < 0, supervision, 150, 0, folder)
        rendering = 255 * rasterizer.render(fitted, judge).color.detach().numpy()
        errors.append(difference(rendering, judge, judged.mask))
    limit = difference(judged.image, judge, judged.mask)  # what the reference's pixels can show
    assert errors[1] < 1.1 * limit < 0.9 * errors[0]
