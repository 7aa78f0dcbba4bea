"""Camera refinement corrects wrong cameras, and does not change exact cameras or cameras without constraints."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from scenes.cameras import make_camera, project_points, world_rays
from scipy.spatial.transform import Rotation

from reffusion.capture import refine
from reffusion.types import Camera

pytestmark = pytest.mark.integration

WIDTH, HEIGHT, FOCAL = 216, 162, 200.0


def tilted_camera(name: str, x: float, y: float, z: float, turn: float) -> Camera:
    """Return a camera at (x, y, -1 + z), rotated by `turn` radians about y and by 0.3 of this angle about x."""
    rotation = Rotation.from_rotvec((0.3 * turn, turn, 0.0)).as_matrix()
    return make_camera(name, (WIDTH, HEIGHT), FOCAL, (x, y, z - 1.0), rotation)


RNG = np.random.default_rng(4)
EXACT = [
    tilted_camera(f"v{k}", 0.05 * (k % 3) - 0.05, 0.05 * (k // 3) - 0.05, z, turn)
    for k, (z, turn) in enumerate(zip(RNG.uniform(-0.03, 0.03, 9), RNG.uniform(-0.05, 0.05, 9), strict=True))
]
WAVES = RNG.normal(0, 1, (80, 2)), RNG.uniform(0, 6.3, (80, 3))


def paint_two_walls(view: Camera) -> np.ndarray:
    """Render two textured walls as the camera sees them, uint8 [H, W, 3].

    The far wall is at z = 4. The near wall at z = 0.6 covers x < 0.
    """
    rays = world_rays(view)
    near, far = (view.center + rays * ((z - view.center[2]) / rays[..., 2:]) for z in (0.6, 4.0))
    paint = lambda at, scale: np.sin((at[..., :2] @ (scale * WAVES[0]).T)[..., None] + WAVES[1]).sum(2) / 80**0.5
    field = np.where((near[..., :1] < 0), paint(near, 25.0), paint(far, 8.0))
    return (127 + 70 * field).clip(0, 255).astype(np.uint8)


PHOTOS = {view.name: paint_two_walls(view) for view in EXACT}


def perturb_cameras(shift: float, turn: float) -> list[Camera]:
    """Return cameras with errors of about `shift` px in the principal point and `turn` degrees in the rotation."""
    rng, views = np.random.default_rng(5), []
    for view in EXACT:
        pose = view.world_to_camera.copy()
        wrong = Rotation.from_rotvec(np.radians(turn) * rng.normal(size=3)).as_matrix()
        pose[:3] = wrong @ pose[:3]
        dx, dy = shift * rng.normal(size=2)
        views.append(replace(view, cx=view.cx + dx, cy=view.cy + dy, world_to_camera=pose))
    return views


@pytest.fixture(autouse=True)
def limit_tracks(monkeypatch):
    monkeypatch.setattr(refine, "TRACKS", 3000)


@cache
def refine_perturbed(shift: float, turn: float) -> refine.Refinement:
    return refine.refine_cameras(perturb_cameras(shift, turn), PHOTOS)


def test_exact_cameras_are_left_as_they_are():
    found = refine.refine_cameras(EXACT, PHOTOS)
    assert found.after is None and found.before < refine.GOOD_RESIDUAL
    assert all(found.cameras[view.name] is view for view in EXACT)


@pytest.mark.parametrize(("shift", "turn"), [(1.5, 0.0), (0.0, 0.2), (1.0, 0.15)])
def test_perturbed_cameras_are_corrected(shift, turn):
    views, found = perturb_cameras(shift, turn), refine_perturbed(shift, turn)
    assert found.before > 2 * refine.GOOD_RESIDUAL and found.after < 0.12
    # The error is measured at points between the near and the far wall, projected with the found and the true cameras.
    points = np.random.default_rng(6).uniform((-0.3, -0.25, 0.6), (0.3, 0.25, 4.0), (400, 3))

    def spread(cameras) -> float:
        """Return the mean reprojection error in px against the true cameras, without the part common to all views."""
        errors = np.array([project_points(points, cameras[view.name]) - project_points(points, view) for view in EXACT])
        return float(np.abs(errors - errors.mean(0)).mean())

    assert spread(found.cameras) < 0.35 * spread({view.name: view for view in views})


def test_the_frame_stays_where_it_was():
    found = refine_perturbed(1.5, 0.0)
    centers = np.array([found.cameras[view.name].center for view in EXACT])
    exact = np.array([view.center for view in EXACT])
    assert np.abs(centers.mean(0) - exact.mean(0)).max() < 1e-9
    assert np.abs(centers - exact).max() < 0.1 * np.ptp(exact, 0).max()


def test_a_view_that_shares_nothing_stays_and_hinders_nothing():
    alone = replace(tilted_camera("w", 0.0, 0.0, 0.0, np.pi), width=WIDTH)
    found = refine.refine_cameras([*perturb_cameras(1.5, 0.0), alone], PHOTOS | {"w": PHOTOS["v0"]})
    assert found.after < 0.12
    moved = found.cameras["w"]
    assert (moved.cx, moved.cy) == (alone.cx, alone.cy) and np.linalg.norm(moved.center - alone.center) < 0.05


def test_a_principal_point_beyond_reason_is_not_followed():
    cameras = perturb_cameras(0.5, 0.0)
    cameras[4] = replace(cameras[4], cx=cameras[4].cx + 0.1 * WIDTH)  # an unrecorded crop
    found = refine.refine_cameras(cameras, PHOTOS)
    assert abs(found.cameras["v4"].cx - cameras[4].cx) < 1e-9


def test_the_same_pictures_give_the_same_cameras():
    first, second = refine_perturbed(1.5, 0.0).cameras, refine.refine_cameras(perturb_cameras(1.5, 0.0), PHOTOS).cameras
    for name in first:
        assert np.array_equal(first[name].world_to_camera, second[name].world_to_camera)
        assert (first[name].cx, first[name].cy) == (second[name].cx, second[name].cy)


def test_inexplicable_matches_move_no_camera():
    """No camera changes if cameras cannot explain the residuals, as for leaves in the wind or a rolling shutter.

    The cameras are exact, and each picture is distorted differently, by about half a pixel.
    """
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    rng, pictures = np.random.default_rng(7), {}
    for name, picture in PHOTOS.items():
        fields = [0.0, 0.0]
        for axis in (0, 1):
            for k in rng.normal(0, 2 * np.pi / 90, (4, 2)):
                fields[axis] = fields[axis] + 0.45 * np.sin(k[0] * x + k[1] * y + rng.uniform(0, 6.3))
        bent = cv2.remap(picture, x + fields[0].astype(np.float32), y + fields[1].astype(np.float32), cv2.INTER_CUBIC)
        pictures[name] = bent
    found = refine.refine_cameras(EXACT, pictures)
    assert found.before > refine.GOOD_RESIDUAL and found.after is None
    assert all(found.cameras[view.name] is view for view in EXACT)
