"""The study of settings of `distill`: each attempt is a valid setting; the scores equal those of the stage's output."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import wall_scene
from scenes.stage_runs import run_through_initialize

from lab.studies import attempts as benchmark
from reffusion.io.images import save_image, save_mask
from reffusion.io.ply import load_ply
from reffusion.metrics import image_metrics
from reffusion.splat import rasterizer
from stages import distill

pytestmark = [pytest.mark.integration, pytest.mark.slow]


ROOT = Path(__file__).resolve().parent.parent

NEAR = 1.7
NO_PRIOR = {"sds.weight": 0, "iterations": 4}


@pytest.fixture(scope="module")
def initialized_run(tmp_path_factory):
    """Return the folder of a small run up to the stage `initialize`; its test views have ground truth."""
    home = tmp_path_factory.mktemp("scene")
    poses = run_through_initialize(home, NEAR)["poses"]
    for name in wall_scene.TEST:
        save_image(poses / "images" / f"{name}.png", wall_scene.photo(wall_scene.CAMERAS[name]))
        save_mask(poses / "test_masks" / f"{name}.png", wall_scene.true_mask(wall_scene.CAMERAS[name], NEAR))
    return home


@pytest.mark.parametrize("name", benchmark.ATTEMPTS)
def test_every_attempt_is_a_setting_of_distill(name):
    changed = {key: value for key, value in benchmark.ATTEMPTS[name].items() if key != benchmark.BASE}
    params = benchmark.attempt_params(benchmark.ATTEMPTS[name])
    assert params == params.changed(changed)
    if changed:
        assert params != benchmark.attempt_params({})


def test_a_curve_begins_at_the_initialization_and_ends_where_the_stage_ends(initialized_run, tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark, "MEASURED_STEPS", (0, 4))
    views = benchmark.load_test_views(initialized_run)
    lines = benchmark.run_attempt(NO_PRIOR, initialized_run, initialized_run / "initialize", views)
    assert [line["iteration"] for line in lines] == [0, 4]
    needs = {name: initialized_run / name for name in benchmark.NEEDS}
    distill.run(benchmark.attempt_params(NO_PRIOR), tmp_path, personalize=None, **needs)
    for folder, line in ((initialized_run / "initialize", lines[0]), (tmp_path, lines[1])):
        expected = benchmark.score_views(load_ply(folder / "gaussians.ply"), views)
        assert {name: line[name] for name in benchmark.SCORES} == pytest.approx(expected, rel=1e-4)


def test_scores_are_those_of_the_box(initialized_run):
    gaussians = load_ply(initialized_run / "initialize" / "gaussians.ply")
    camera, truth, box = benchmark.load_test_views(initialized_run)[0]
    with torch.no_grad():
        picture = (rasterizer.render(gaussians, camera).color.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    expected = image_metrics.score_view(picture, truth, box, {}, np.zeros(truth.shape[:2], bool), False)
    found = benchmark.score_views(gaussians, [(camera, truth, box)])
    assert found == pytest.approx({name: expected[name] for name in benchmark.SCORES})


def test_a_scene_without_ground_truth_is_refused(initialized_run, tmp_path):
    poses, _, _ = wall_scene.write_poses_and_fit(tmp_path, NEAR)
    with pytest.raises(ValueError, match="take another scene"):
        benchmark.load_test_views(poses.parent)
