"""What the plan says of the stage `distill` before it runs: weights, missing hardware, cost."""

from __future__ import annotations

from collections.abc import Mapping

from reffusion.cost import estimate
from reffusion.io import machine
from reffusion.params.distill import Params
from reffusion.weights import local

__all__ = ["Params", "cost", "lacks", "needed_weights"]


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """The weights that the stage needs, each with what of it is missing on this machine.

    Args:
        brings: the keys of scene.yaml.
    """
    needs = [local.model_need(params.prior, params.dtype)] if params.needs_prior else []
    if params.depth.weight > 0 and params.depth.model:
        needs.append(local.model_need(params.depth.model, "float32"))
    return needs


def lacks(params: Params) -> list[str]:
    """What the stage needs on CUDA and this machine lacks."""
    return machine.find_missing(machine.detect(), params.memory_gb, splats=True, memory_param="distill.memory_gb")


def cost(params: Params, gpu: str) -> Mapping[str, object] | None:
    """The estimated cost on a GPU, by name; "" is this machine's. ValueError if the name is not in the table."""
    return estimate.format_estimate(gpu, params.device, estimate.distill(params))
