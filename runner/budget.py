"""A time budget, shared out over the stages whose length can follow it (docs/traces.md)."""

from __future__ import annotations

import re
from typing import Any

from runner.pipeline import Overrides, Pipeline, Refused

PARAM = "seconds"  # of a stage: its share
_UNITS = {"h": 3600.0, "m": 60.0, "s": 1.0}


def seconds_of(text: object, origin: str) -> float:
    """`5m`, `90s`, `1h30m`, `2.5m`, or plain seconds; Refused, naming `origin`, for anything else."""
    words = str(text).strip().lower()
    parts = re.findall(r"(\d+(?:\.\d+)?)([hms])", words)
    if re.fullmatch(r"\d+(\.\d+)?", words):
        seconds = float(words)
    elif parts and "".join(number + unit for number, unit in parts) == words:
        seconds = sum(float(number) * _UNITS[unit] for number, unit in parts)
    else:
        seconds = 0.0
    if seconds <= 0:
        raise Refused(f"{origin}: budget {text!r} is no time; write it like 5m, 90s or 1h30m")
    return seconds


def shared_out(pipeline: Pipeline, values: dict[str, dict[str, Any]], seconds: float) -> Overrides:
    """stage -> {"seconds": its share}. The shares of stages that a parameter leaves out go to the others.

    Args:
        values: the parameters as they were asked for, by which stages are left out.
    """
    if not pipeline.budget:
        raise Refused("pipeline.yaml: a budget is asked for, and there is no table `budget` that shares it out")
    named = lambda param: values.get(param.split(".", 1)[0], {}).get(param.split(".", 1)[1], ...)
    asks = lambda c: c.param is not None and all(named(param) == c.equals for param in c.params)
    stays = [name for name in pipeline.budget if not any(asks(c) for c in pipeline.stages[name].left_out)]
    if not stays:
        return {}
    scale = sum(pipeline.budget.values()) / sum(pipeline.budget[name] for name in stays)
    return {name: {PARAM: round(seconds * scale * pipeline.budget[name], 3)} for name in stays}
