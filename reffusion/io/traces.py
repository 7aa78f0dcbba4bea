"""The schema of `trace.jsonl`, error against run time, and reading it (docs/development.md#traces)."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

REASONS = ("finished", "converged")


@dataclass(frozen=True)
class Quantity:
    """The meaning of a key in a trace.

    Attributes:
        unit: "dB", "count", "1" for a ratio; "" where values can only be compared within a scene.
        better: "more" or "less"; "" where neither is.
        label: for an axis.
    """

    unit: str
    better: Literal["more", "less", ""]
    label: str


QUANTITIES = {
    "loss": Quantity("", "less", "reconstruction loss"),
    "psnr": Quantity("dB", "more", "PSNR of training views before their step"),
    "psnr_held_out": Quantity("dB", "more", "PSNR of held-out views"),
    "photo_psnr": Quantity("dB", "more", "unseen holes"),
    "hole_psnr": Quantity("dB", "more", "reference's hole"),
    "clean_latent_mse": Quantity("1", "less", "latent, whole view"),
    "crop_latent_mse": Quantity("1", "less", "latent, crop"),
    "target_mse": Quantity("1", "less", "squared error of the UNet's target"),
    "reference_psnr": Quantity("dB", "more", "PSNR in the references' holes"),
    "reconstruction": Quantity("", "less", "reconstruction term"),
    "sds_gradient_mean": Quantity("1", "", "mean norm of the SDS gradient"),
    "sds_gradient_max": Quantity("1", "", "largest norm of the SDS gradient"),
    "residual": Quantity("1", "less", "relative residual"),
    "disparity_error": Quantity("1", "less", "relative disparity error"),
    "gaussians": Quantity("count", "", "Gaussians"),
    "masked_gaussians": Quantity("count", "", "masked Gaussians"),
}

MAIN = {  # stage -> the quantities that stand for its error, the first that a trace has
    "fit": ("psnr_held_out", "psnr"),
    "personalize": ("photo_psnr", "hole_psnr"),
    "distill": ("reference_psnr",),
    "initialize": ("disparity_error", "residual"),
}


def read_trace(path: Path) -> list[dict[str, Any]]:
    """The lines of a `trace.jsonl` as they are; a line cut off by a kill is ignored."""
    records = []
    for line in path.read_text().splitlines():
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return records


def load_trace(path: Path, stage: str) -> dict[str, list[dict[str, Any]]]:
    """The lines of a stage's trace by series (docs/development.md#traces), "" for those without a name.

    Raises:
        ValueError: naming file, line and what violates the schema; or the file does not exist.
    """
    if not path.exists():
        raise ValueError(f"{path}: no such file")
    series: dict[str, list[dict[str, Any]]] = {}
    seconds = 0.0
    for number, line in enumerate(read_trace(path), 1):
        own = series.setdefault(str(line.get("series", "")), [])
        if wrong := _find_violation(line, own[-1] if own else None, seconds, stage):
            raise ValueError(f"{path}: line {number}: {wrong}")
        own.append(line)
        seconds = line["seconds"]
    return series


def _find_violation(line: dict[str, Any], before: dict[str, Any] | None, seconds: float, stage: str) -> str | None:
    """What violates the schema in a line, given the one before it in its series and the last time."""
    if missing := [key for key in ("seconds", "iteration") if key not in line]:
        return f"no {missing[0]!r}"
    texts = {"series", "reason"} & line.keys()
    for key, value in line.items():
        number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not (isinstance(value, str) if key in texts else number):
            return f"{key} = {value!r}"
    known = {"seconds", "iteration", "series", *QUANTITIES, "reason"}
    if stage != "distill" and (strange := line.keys() - known):
        return f"unknown quantity {sorted(strange)[0]!r}"
    if line["seconds"] < seconds:
        return f"its seconds fell from {seconds} to {line['seconds']}"
    rises = before is None or line["iteration"] > before["iteration"]
    if line["iteration"] < 0 or not (rises or ("reason" in line and line["iteration"] == before["iteration"])):
        return f"iteration {line['iteration']} after {before['iteration'] if before else 'none'}"
    if before and "reason" in before:
        return "a line after the one with the reason of the end"
    if "reason" in line and line["reason"] not in REASONS:
        return f"an end for the reason {line['reason']!r}"
    return None
