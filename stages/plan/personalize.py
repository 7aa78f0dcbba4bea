"""What `plan` reports of the stage `personalize` before it runs."""

from __future__ import annotations

from collections.abc import Mapping

from reffusion.cost import estimate
from reffusion.io import machine
from reffusion.params.personalize import Params
from reffusion.weights import local

__all__ = ["Params", "cost", "lacks", "needed_weights"]


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """Weights that the stage needs, and whether they are here; `brings`: the keys of scene.yaml."""
    return [local.model_need(params.prior, params.dtype)]


def lacks(params: Params) -> list[str]:
    """What the stage needs on CUDA and this machine lacks."""
    return machine.find_missing(machine.detect(), params.memory_gb, splats=False, memory_param="personalize.memory_gb")


def cost(params: Params, gpu: str) -> Mapping[str, object] | None:
    """Estimated cost on a GPU ("": that of this machine). Raises ValueError for a GPU that is not in the table."""
    return estimate.format_estimate(gpu, params.device, estimate.personalize(params))
