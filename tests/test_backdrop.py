"""The backdrop, a sphere of blurred colors behind the scene, and the pixels of a view that no training view saw."""

import numpy as np
import pytest
from scenes import wall_scene
from scenes.cameras import make_camera, yaw
from scenes.gaussians import join_gaussians

from reffusion import geometry
from reffusion.background import training_coverage
from reffusion.io.arrays import load_json
from reffusion.io.images import save_image
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene, save_scene
from reffusion.metrics import image_metrics
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

pytestmark = pytest.mark.integration

TRAIN = [wall_scene.CAMERAS[name] for name in wall_scene.TRAIN]


def wall_gaussians() -> Gaussians:
    return wall_scene.rectangle_gaussians(wall_scene.WALL, 2.0, 1.4, wall_scene.wall_color)


def panned_camera(degrees: float) -> Camera:
    """Return a camera at the origin, turned to the right about its vertical axis by `degrees`."""
    rotation = yaw(np.radians(degrees))
    return make_camera("t", (wall_scene.WIDTH, wall_scene.HEIGHT), wall_scene.FOCAL, rotation=rotation)


def coverage_views(scene: Gaussians, masks=None) -> list[training_coverage.CoverageView]:
    return training_coverage.render_coverage_views(scene, TRAIN, masks or {})


def test_a_view_that_everything_saw_has_nothing_unseen():
    scene = wall_gaussians()
    for name in wall_scene.TEST:
        assert not training_coverage.unseen_pixels(scene, wall_scene.CAMERAS[name], coverage_views(scene))[
            2:-2, 2:-2
        ].any()


def test_unseen_is_what_lies_outside_all_frames():
    scene = wall_scene.rectangle_gaussians(wall_scene.WALL, 4.0, 2.4, wall_scene.wall_color)
    aside = wall_scene.front_camera("aside", 1.0)
    x = wall_scene.wall_points(aside)[..., 0]
    edge = TRAIN[-1].center[0] + wall_scene.WALL * wall_scene.WIDTH / 2 / wall_scene.FOCAL
    found = training_coverage.unseen_pixels(scene, aside, coverage_views(scene))
    assert wall_scene.iou(found, x > edge) > 0.95
    assert 0.3 < found.mean() < 0.9


def test_unseen_is_what_all_training_views_hide_behind_something_or_under_masks():
    at = 1.0
    scene, _ = wall_scene.wall_and_square(at)
    full = wall_scene.rectangle_gaussians(wall_scene.WALL, 2.0, 1.4, wall_scene.wall_color)
    square = wall_scene.rectangle_gaussians(
        at, wall_scene.HALF, wall_scene.HALF, lambda x, y: np.full((*x.shape, 3), 0.5)
    )
    both = join_gaussians(full, square)
    aside = wall_scene.front_camera("aside", 0.9)
    points = wall_scene.wall_points(aside)
    framed = np.any([((uv >= 0) & (uv < (c.width, c.height))).all(-1) & ~wall_scene.is_behind_square(points, c, at)
                     for c in TRAIN for uv in [geometry.project(points, c)[0]]], 0)  # fmt: skip
    here = ~wall_scene.is_behind_square(points, aside, at)  # without the square's surface, which training views see
    assert (
        wall_scene.iou(training_coverage.unseen_pixels(both, aside, coverage_views(both)) & here, ~framed & here) > 0.85
    )
    hidden = {c.name: np.ones((c.height, c.width), bool) for c in TRAIN}
    assert training_coverage.unseen_pixels(scene, TRAIN[0], coverage_views(scene, hidden)).all()


# --- scores


def test_scores_of_seen_pixels_only():
    rng = np.random.default_rng(0)
    truth = rng.random((30, 40, 3))
    image, unseen, mask = truth.copy(), np.zeros((30, 40), bool), np.zeros((30, 40), bool)
    unseen[:, 30:], mask[:, :10] = True, True
    image[:, 30:] = 0.0
    image[:, 10:30] = np.clip(truth[:, 10:30] + 0.01, 0, 1)
    row = image_metrics.score_view(image, truth, None, mask=mask, unseen=unseen)
    assert row["unseen_share"] == pytest.approx(1 / 3)
    assert row["psnr_outside_seen"] == pytest.approx(image_metrics.psnr(image[:, 10:30], truth[:, 10:30]))
    assert row["psnr_outside"] < row["psnr_outside_seen"] - 20
    row = image_metrics.score_view(image, truth, None, mask=mask)
    assert row["psnr_outside_seen"] is None and row["unseen_share"] is None
    row = image_metrics.score_view(image, truth, None, mask=mask, unseen=np.zeros_like(mask))
    assert row["psnr_outside_seen"] == row["psnr_outside"] and row["unseen_share"] == 0


def test_evaluate_counts_the_unseen_apart_and_shows_no_black(tmp_path):
    from stages import evaluate, finish

    poses, fit, _ = wall_scene.write_poses_and_fit(tmp_path, 1.0)
    scene = load_scene(poses)
    aside = wall_scene.front_camera("t0", 1.0)
    cameras = scene.cameras | {"t0": aside}
    save_scene(poses, type(scene)(**{**scene.__dict__, "cameras": cameras}))
    save_image(poses / "images" / "t0.png", wall_scene.photo(aside))
    needs, raw_masks = {"poses": poses, "fit": fit}, poses.with_name("raw_masks")
    for name in ("on", "off"):
        for folder in (tmp_path / name, tmp_path / f"finish-{name}"):
            folder.mkdir()
        finish.run(finish.Params(backdrop=name == "on"), tmp_path / f"finish-{name}", **needs)
        others = {"raw_masks": raw_masks, "finish": tmp_path / f"finish-{name}"}
        evaluate.run(evaluate.Params(), tmp_path / name, **needs, **others)
    on, off = (load_json(tmp_path / name / "metrics.json") for name in ("on", "off"))
    assert on["mean"]["unseen_share"] == off["mean"]["unseen_share"] > 0.1
    assert on["mean"]["psnr_outside_seen"] > off["mean"]["psnr_outside_seen"] - 0.05
    assert "unseen_share" in (tmp_path / "on" / "per_view.csv").read_text().splitlines()[0]
    assert "unseen_share" in on["protocol"]["seen"]
    away = panned_camera(75)
    covered = [rasterizer.render(load_ply(tmp_path / name / "scene.ply"), away).alpha.min() for name in ("on", "off")]
    assert covered[0] > 0.9 and covered[1] < 0.01
