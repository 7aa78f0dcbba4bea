"""Sections of the report on parameters that differ from their defaults, and on the command that repeats the job."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from report import page
from report.job_data import JobFiles


def flatten_parameters(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted name, value) of all parameters in nested groups, e.g. ("lora.rank", 8) of {"lora": {"rank": 8}}.

    Args:
        prefix: text to put before each name.
    """
    for name, value in values.items():
        if isinstance(value, dict):
            yield from flatten_parameters(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def default_parameters(stage: str) -> dict[str, Any]:
    """Return {dotted name: default value} of a stage's parameters; empty for a stage that this code does not know."""
    try:
        params = import_module(f"reffusion.params.{stage}").Params()
    except ModuleNotFoundError:
        return {}
    return dict(flatten_parameters(params.model_dump(mode="json")))


def command_line_parameters(job: JobFiles) -> dict[str, Any]:
    """Return {"stage.parameter": value used} for the parameters that `set=` or `budget=` changed on the command line.

    Only stages that are done are considered. The result is empty if no plan was recorded.
    """
    unset = {stage: dict(flatten_parameters(values)) for stage, values in job.unset.items()}
    return {
        f"{stage}.{name}": value
        for stage, receipt in job.receipts.items()
        for name, value in flatten_parameters(receipt.get("params", {}))
        if stage in unset and unset[stage].get(name, value) != value
    }


def parameters_section(job: JobFiles) -> list[str]:
    """Return HTML parts with the parameters that differ from their defaults.

    Parameters changed on the command line get a table of their own, which comes first.
    """
    overrides, override_rows, rows = command_line_parameters(job), [], []
    for stage, receipt in job.receipts.items():
        defaults = default_parameters(stage)
        for name, value in flatten_parameters(receipt.get("params", {})):
            if name not in defaults or defaults[name] != value:
                rows.append([f"{stage}.{name}", _short(value), _short(defaults.get(name))])
            if f"{stage}.{name}" in overrides:
                instead = dict(flatten_parameters(job.unset[stage])).get(name)
                override_rows.append([f"{stage}.{name}", _short(value), _short(instead), _short(defaults.get(name))])
    if not rows:
        return [page.paragraph("None.")]
    parts = (
        [page.table(["set by hand", "value", "instead of", "default"], override_rows, text=(1, 2, 3))]
        if override_rows
        else []
    )
    table = page.table(["", "value", "default"], rows, text=(1, 2))
    who = "by profile, scene.yaml, variant or hand"
    return [*parts, f"<details><summary>all {len(rows)}, {who}</summary>{table}</details>"]


def _short(value: Any) -> str:
    """Return a value as JSON, but a string as it is, cut to 60 characters."""
    text = json.dumps(value, ensure_ascii=False) if not isinstance(value, str) else value
    return text if len(text) <= 60 else f"{text[:57]}..."


def reproduce_section(job: JobFiles) -> list[str]:
    """Return HTML parts with the command that repeats the job."""
    name, _, variant = job.home.name.partition("@")
    source = job.home.with_name(name) / "source"
    scene = load_scene_argument(source, name)
    profile = next((receipt["profile"] for receipt in job.receipts.values()), "")
    words = [f"scene={shlex.quote(scene)}", f"profile={profile}", *([f"variant={variant}"] if variant else [])]
    if overrides := command_line_parameters(job):
        text = " ".join(shlex.quote(f"{key}={json.dumps(value)}") for key, value in overrides.items())
        words.append(f"set={shlex.quote(text)}")
    line = " ".join(["make", *words, "all"])
    return [page.code(line)]


def load_scene_argument(path: Path, name: str) -> str:
    """Return the value of `scene=` on the command line that runs the scene.

    This is the name of a folder in data/, the path of another folder, or the path of a video.

    Args:
        path: file that records the path of the scene's folder; if it does not exist, the result is `name`.
        name: name of the scene.
    """
    source = path.read_text(encoding="utf-8").strip() if path.is_file() else name
    record = path.parent / "frames" / "frames.json"
    if record.is_file() and Path(source).name == "frames":
        return json.loads(record.read_text(encoding="utf-8"))["video"]
    return name if source == f"data/{name}" else source
