"""The object's soft shadow, found without a reference: a box on a tiled floor, in analytic views."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes.cameras import meet_box, orbit_camera, uneven_depth_view, world_rays

from reffusion.background.model import Background
from reffusion.background.visibility import DepthView
from reffusion.shadows.soft_detection import find_soft_shadow
from reffusion.shadows.soft_shadow import SoftShadow
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians

CORNERS = (-0.3, -0.3, 0.0), (0.3, 0.3, 0.5)
MEANS = torch.rand((500, 3), generator=torch.Generator().manual_seed(0)) * 0.6 - torch.tensor([0.3, 0.3, 0.0])
LEAVES = 0.4  # share of the light that is left in the middle of the shadow
GRAY = np.array([0.55, 0.5, 0.45])


def tiles(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the colors of a floor of tiles whose brightness varies, with dark joints, [..., 3]."""
    brightness = np.random.default_rng(0).uniform(0.85, 1.15, (64, 64))
    row, column = (np.floor(4 * each).astype(int) % 64 for each in (x, y))
    joint = np.minimum(4 * x % 1, 4 * y % 1) < 0.08
    return (brightness[row, column] * np.where(joint, 0.5, 1.0))[..., None] * GRAY


def soft_shadow(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the share of the light that a soft shadow beside the box leaves, [..., 1]."""
    return (1 - (1 - LEAVES) * np.exp(-((np.hypot((x + 0.5) / 0.6, y / 0.45)) ** 4)))[..., None]


def floor_view(number: int, color: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> tuple[DepthView, np.ndarray]:
    """Return a view of the floor with the box's mask, and its photograph."""
    camera = orbit_camera(f"v{number}", 30 * number, 1.6, 3.0, np.zeros(3), 200, 190.0)
    rays = world_rays(camera)
    depth = np.where(rays[..., 2] < -0.05, -camera.center[2] / np.minimum(rays[..., 2], -0.05), 0.0)
    at = camera.center + rays * depth[..., None]
    photo = (255 * color(at[..., 0], at[..., 1]).clip(0, 1)).round().astype(np.uint8)
    return uneven_depth_view(camera, depth, meet_box(camera, *CORNERS)[1] & (depth > 0)), photo


def background(color: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Background:
    """Return the background of twelve views of a floor of the given colors."""
    pairs = [floor_view(number, color) for number in range(12)]
    photos = {view.camera.name: photo for view, photo in pairs}
    nothing = Gaussians(torch.zeros(0, 3), *(torch.zeros(0, n) for n in (4, 3)), torch.zeros(0), torch.zeros(0, 1, 3))
    return Background([view for view, _ in pairs], photos).with_surfaces(MEANS, nothing)


@pytest.fixture(scope="module")
def shaded() -> Background:
    return background(lambda x, y: tiles(x, y) * soft_shadow(x, y))


@pytest.fixture(scope="module")
def shadow(shaded: Background) -> SoftShadow:
    found = find_soft_shadow(shaded, MEANS)
    assert found is not None
    return found


def floor_light(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Return the share of the light that the soft shadow leaves in a view, [H, W]."""
    at = camera.center + world_rays(camera) * depth[..., None]
    return soft_shadow(at[..., 0], at[..., 1])[..., 0]


def test_a_soft_shadow_is_removed_and_the_rest_stays(shaded, shadow):
    before, after, outside = [], [], []
    for view in shaded.views[::3]:
        photo = shaded.photos[view.camera.name]
        truth = floor_view(int(view.camera.name[1:]), tiles)[1]
        light = np.where(view.masked | (view.depth <= 0), np.nan, floor_light(view.camera, view.depth))
        log_error = lambda picture, truth=truth: np.abs(np.log((picture + 8.0) / (truth + 8.0))).mean(-1)
        errors = log_error(shadow.remove_from_photo(photo, view.camera, view.depth))
        before.append(log_error(photo)[light < 0.95])
        after.append(errors[light < 0.95])
        outside.append(errors[light > 0.999])
    before, after, outside = (float(np.concatenate(each).mean()) for each in (before, after, outside))
    assert before > 0.3 and after < before / 3 and outside < 0.02


def test_gaussians_become_as_bright_as_photographs(shaded, shadow):
    view = shaded.views[0]
    points = view.camera.center + world_rays(view.camera) * view.depth[..., None].astype(np.float64)
    rows, columns = np.nonzero((view.depth > 0) & ~view.masked)
    photo = shaded.photos["v0"]
    means = torch.from_numpy(points[rows, columns]).float()
    sh = ((torch.from_numpy(photo[rows, columns]) / 255 - 0.5) / SH0).float()[:, None]
    count = len(means)
    floor = Gaussians(means, torch.zeros(count, 4), torch.zeros(count, 3), torch.zeros(count), sh)
    colors = 255 * (0.5 + SH0 * shadow.remove_from_gaussians(floor).sh[:, 0].numpy())
    lit = shadow.remove_from_photo(photo, view.camera, view.depth)[rows, columns]
    assert np.abs(colors.clip(0, 255) - lit).max() < 1.0


def test_a_shadow_is_read_as_it_was_written(shadow):
    again = SoftShadow.from_arrays(shadow.to_arrays())
    points = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    assert (again.log_light_at(points) == shadow.log_light_at(points)).all()
    assert SoftShadow.from_arrays({}) is None


def rug(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the colors of the floor with a dark rug that reaches below the box."""
    return tiles(x, y) * np.where((np.abs(x + 0.5) < 0.5) & (np.abs(y) < 0.4), 0.4, 1.0)[..., None]


def stain(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the colors of the floor with a stain of soft borders, which changes red less than blue."""
    return tiles(x, y) * soft_shadow(x, y) ** np.array([0.6, 1.0, 1.4])


def far_shadow(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the colors of the floor with the shadow of something that stands elsewhere."""
    return tiles(x, y) * soft_shadow(x - 1.0, y - 1.0)


@pytest.mark.parametrize("color", [tiles, rug, stain, far_shadow], ids=lambda color: color.__name__)
def test_what_is_no_shadow_of_the_object_stays(color):
    assert find_soft_shadow(background(color), MEANS) is None


def test_without_photographs_there_is_no_shadow(shaded):
    assert find_soft_shadow(replace(shaded, photos={}), MEANS) is None


def test_a_plane_that_no_view_shows_has_no_shadow(shaded):
    nothing = [replace(view, depth=np.zeros_like(view.depth)) for view in shaded.views]
    assert find_soft_shadow(replace(shaded, views=nothing), MEANS) is None
