"""What can be told of `distill` before it runs."""

from __future__ import annotations

from collections.abc import Mapping

from reffusion.cost import estimate
from reffusion.io import machine
from reffusion.params.distill import Params
from reffusion.weights import local

__all__ = ["Params", "cost", "lacks", "needed_weights"]


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """What must lie on this machine, and what of it does not; `brings`: the keys of scene.yaml."""
    asked = (params.sds.weight > 0 and params.sds.run != "never") or params.depth.weight > 0
    found = [local.of_model(params.prior, params.dtype)] if asked else []
    estimates = params.depth.weight > 0 and params.depth.model
    return found + ([local.of_model(params.depth.model, "float32")] if estimates else [])


def lacks(params: Params) -> list[str]:
    """What this machine has not, and the stage needs on CUDA."""
    return machine.lacks(machine.machine(), params.memory_gb, splats=True, memory_param="distill.memory_gb")


def cost(params: Params, card: str) -> Mapping[str, object] | None:
    """What it takes on a card; "": this machine's. ValueError for one that is not in the table."""
    return estimate.said(card, params.device, estimate.distill(params))
