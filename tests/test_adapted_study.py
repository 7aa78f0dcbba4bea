"""The study of the personalized prior paints holes before and after personalization, with equal views and noise."""

from __future__ import annotations

import numpy as np
import pytest
from scenes.distill_scene import write_initialized_run
from scenes.networks import small_prior

from lab.studies import adapted, scene_priors
from reffusion.io.arrays import save_labels
from reffusion.io.images import load_image, save_image
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_scene, save_references
from reffusion.types import Reference

pytestmark = pytest.mark.integration

HOLE = np.zeros((36, 48), bool)
HOLE[10:24, 12:30] = True


def write_reference_run(home):
    """Write an initialized run with photographs, a fit without masked Gaussians, and a reference of view `a`."""
    run = write_initialized_run(home, HOLE)
    wall = load_ply(run / "initialize" / "gaussians.ply")
    save_ply(run / "fit" / "gaussians.ply", wall)
    save_labels(run / "masks" / "labels.npy", np.zeros(len(wall), bool))
    scene = load_scene(run / "poses")
    for name in scene.cameras:
        save_image(run / "poses" / "images" / f"{name}.png", np.full((*HOLE.shape, 3), 90, np.uint8))
    save_references(run / "reference", [Reference(scene.cameras["a"], np.full((*HOLE.shape, 3), 90, np.uint8), HOLE)])
    return run


def test_same_views_same_noise_and_holes_alone_are_painted(tmp_path):
    prior, run = small_prior(), write_reference_run(tmp_path / "run")
    views = adapted.save_sheet({"before": prior, "after": prior}, run, 3, 2, tmp_path / "out")
    # The prior was trained on the reference of view `a`; view `c` is clean (photographed without the object).
    assert views == ["b"]
    pictures = {path.stem: load_image(path) for path in (tmp_path / "out/b").glob("*.png")}
    assert sorted(pictures) == ["adapted", "as-it-is", "as-it-is-no-prompt", "to-paint"]
    assert (pictures["adapted"] == pictures["as-it-is"]).all()  # both priors are the same here
    assert (pictures["adapted"][~HOLE] == pictures["to-paint"][~HOLE]).all()
    assert (pictures["adapted"][HOLE] != pictures["to-paint"][HOLE]).any()
    assert load_image(tmp_path / "out/sheet.png").shape[1] > 4 * HOLE.shape[1]


def test_missing_inputs_are_named(tmp_path):
    with pytest.raises(ValueError, match="make scene=nowhere personalize"):
        adapted.load_holes(tmp_path / "nowhere", 3)


def test_a_device_that_is_not_there_is_refused(tmp_path, monkeypatch):
    import torch

    (tmp_path / "run/personalize").mkdir(parents=True)
    parser = scene_priors.study_parser("", "all stages", "adapted")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for typed, message in ((["--device", "cuda"], "no CUDA device"), (["--dtype", "float16"], "for device=cuda")):
        with pytest.raises(ValueError, match=message):
            scene_priors.load_priors(parser.parse_args(["--run", str(tmp_path / "run"), *typed]))
    assert scene_priors.peak_mb("cpu") > 10
