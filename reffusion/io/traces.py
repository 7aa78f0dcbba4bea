"""The schema of `trace.jsonl`, in which a stage records its error against run time, and reading of such files.

A trace has one JSON object per line, see docs/development.md#traces. Its keys are "seconds" (work time since the stage
began), "iteration" (number of finished steps), and quantities, such as "psnr". A trace may hold several series, e.g.
one per solver and view; the key "series" then names the series of a line. The last line of a series may have the key
"reason".
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

REASONS = ("finished", "converged", "settled")  # values of "reason", which the last line of a series may have


@dataclass(frozen=True)
class Quantity:
    """The meaning of a key in a trace.

    Attributes:
        unit: "dB", "count", or "1" for a number without unit. "" means that values of different scenes cannot be
            compared.
        better: "more" if larger values are better, "less" if smaller ones are, "" if neither is better.
        label: text for the axis of a chart.
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

MAIN = {  # stage -> candidates for the quantity that is shown as its error: the first one that its trace has is taken
    "fit": ("psnr_held_out", "psnr"),
    "personalize": ("photo_psnr", "hole_psnr"),
    "distill": ("reference_psnr",),
    "initialize": ("disparity_error", "residual"),
}


def read_trace(path: Path) -> list[dict[str, Any]]:
    """Read the lines of a `trace.jsonl` as dicts, without checking them against the schema.

    A line that is not valid JSON is skipped, because a killed process may leave an incomplete line. A missing file
    raises FileNotFoundError.
    """
    return [record for _, record in _read_numbered_records(path)]


def _read_numbered_records(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the number, counted from 1, and the content of each line that is valid JSON."""
    for number, line in enumerate(path.read_text().splitlines(), 1):
        with suppress(json.JSONDecodeError):
            yield number, json.loads(line)


def load_trace(path: Path, stage: str) -> dict[str, list[dict[str, Any]]]:
    """Read a stage's trace and check each line against the schema (docs/development.md#traces).

    Lines that are not valid JSON are skipped, as in `read_trace`.

    Args:
        stage: name of the stage; `distill` may have quantities that are not in `QUANTITIES` (its loss terms).

    Returns:
        Name of the series -> its lines in order. Lines without the key "series" are under "".

    Raises:
        ValueError: the file does not exist, or a line violates the schema. The message names the file, the line and the
            violation.
    """
    if not path.exists():
        raise ValueError(f"{path}: no such file")
    series: dict[str, list[dict[str, Any]]] = {}
    seconds = 0.0
    for number, line in _read_numbered_records(path):
        own = series.setdefault(str(line.get("series", "")), [])
        if wrong := _find_violation(line, own[-1] if own else None, seconds, stage):
            raise ValueError(f"{path}: line {number}: {wrong}")
        own.append(line)
        seconds = line["seconds"]
    return series


def _find_violation(line: dict[str, Any], before: dict[str, Any] | None, seconds: float, stage: str) -> str | None:
    """Return how a line of a trace violates the schema, in words; None if it does not."""
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
    # `seconds` is that of the previous line of any series, and `before` the previous line of the same series.
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
