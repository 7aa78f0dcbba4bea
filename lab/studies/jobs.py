"""Jobs that studies run, and parameters of their stages."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

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
