"""What can be told of `initialize` before it runs."""

from __future__ import annotations

from pathlib import Path

from reffusion.io import machine
from reffusion.params.initialize import Params
from reffusion.weights import local

__all__ = ["Params", "lacks", "needed_weights", "preview"]


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """What must be on this machine, and what of it is not; `brings`: the keys of scene.yaml."""
    return [local.of_model(params.depth.model, "float32")] if params.depth.model else []


def preview(params: Params, **_: Path | None) -> list[str]:
    """What the stage will do, as far as that is known before it looks."""
    if not (params.further and params.start == "reference"):
        return []
    return [f"completes up to {params.further} further views from patches of the photographs: what no reference shows"]


def lacks(params: Params) -> list[str]:
    """What this machine has not, and the stage needs on CUDA."""
    return machine.lacks(machine.machine())
