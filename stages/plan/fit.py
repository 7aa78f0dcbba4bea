"""What `plan` reports of the stage `fit` before it runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from reffusion.cost import estimate
from reffusion.io import machine
from reffusion.params.fit import Params

__all__ = ["Params", "cost", "lacks", "preview"]


def preview(params: Params, *, poses: Path | None, **_: Path | None) -> list[str]:
    has_gaussians = poses is not None and (poses / "gaussians.ply").exists() and params.pixels == "all"
    return ["takes over the scene's gaussians.ply: no optimisation"] if has_gaussians else []


def lacks(params: Params) -> list[str]:
    """What the stage needs on CUDA and this machine lacks."""
    return machine.find_missing(machine.detect())


def cost(params: Params, gpu: str) -> Mapping[str, object] | None:
    """Estimated cost on a GPU ("": that of this machine). Raises ValueError for a GPU that is not in the table."""
    return estimate.format_estimate(gpu, params.device, estimate.fit(params))
