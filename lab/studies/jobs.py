"""Jobs that studies run, parameters of their stages, and their test views."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.io.ground_truth import load_ground_truth, load_object_mask
from reffusion.io.scene import load_scene
from reffusion.types import Camera
from runner.pipeline import load_pipeline
from runner.resolve import variant_folder

ROOT = Path(__file__).resolve().parents[2]


def run_job(
    scene: Path, runs: Path, last: str = "all", profile: str = "", variant: str = "", settings: str = ""
) -> Path:
    """Run a stage of a scene and the stages that it needs, as far as they are not finished; return the run's folder.

    Args:
        scene: folder of the scene.
        runs: folder of runs.
        last: the stage; "all" for all stages.
        profile: name of the profile; "" for the default.
        variant: name of a variant; "" for the scene's own run.
        settings: parameters, as `set=` of the command line.

    Raises:
        ValueError: a stage failed.
    """
    command = ["run", last, "--scene", str(scene.resolve()), "--runs", str(runs.resolve())]
    command += ["--profile", profile] if profile else []
    command += ["--variant", variant, "--set", settings]
    if subprocess.run([sys.executable, "-m", "runner", *command], cwd=ROOT).returncode:
        raise ValueError(f"{scene.name}{variant and f', {variant}'}: the job failed; see above")
    return variant_folder(runs / scene.name, variant)


def load_test_views(run: Path, count: int) -> list[tuple[Camera, np.ndarray, np.ndarray]]:
    """Load up to `count` evenly spread test views of a run with ground truth and a mask that is not empty.

    Returns:
        Camera, truth uint8 [H, W, 3] and mask bool [H, W] of each.

    Raises:
        ValueError: there is no such view.
    """
    scene, views = load_scene(run / "poses"), []
    for name in scene.test:
        camera = scene.cameras[name]
        truth = load_ground_truth(camera, run / "poses")
        mask = load_object_mask(camera, run / "raw_masks", run / "masks")
        if truth is not None and mask.any():
            views.append((camera, truth, mask))
    if not views:
        raise ValueError(f"{run / 'poses'}: no test view shows the scene without the object; take another scene")
    return [views[place] for place in np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int)]


def profile_params(stage: str, profile: str, changes: Mapping[str, Any]) -> Any:
    """Return a profile's parameters of a stage, the `Params` of `reffusion.params`, with changes.

    Args:
        stage: name of the stage.
        profile: name of the profile.
        changes: dotted name of a parameter -> value.

    Raises:
        ValueError: a parameter does not exist, or a value is not allowed.
    """
    values = load_pipeline(ROOT).profiles[profile].get(stage, {})
    return importlib.import_module(f"reffusion.params.{stage}").Params(**values).changed(changes)
