"""What can be told of `fit` before it runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from reffusion.cost import estimate
from reffusion.io import machine
from reffusion.params.fit import Params

__all__ = ["Params", "cost", "lacks", "preview"]


def preview(params: Params, *, poses: Path | None) -> list[str]:
    given = poses is not None and (poses / "gaussians.ply").exists() and params.pixels == "all"
    return ["takes over the scene's gaussians.ply: no optimisation"] if given else []


def lacks(params: Params) -> list[str]:
    """What this machine has not, and the stage needs on CUDA."""
    return machine.lacks(machine.machine())


def cost(params: Params, card: str) -> Mapping[str, object] | None:
    """What it takes on a card; "": this machine's. ValueError for one that is not in the table."""
    return estimate.said(card, params.device, estimate.fit(params))
