"""Facts about the stage `distill` that the runner needs before the stage runs; imports nothing heavy."""

from __future__ import annotations

from reffusion.io import machine
from reffusion.params.distill import Params
from reffusion.weights import local

__all__ = ["Params", "lacks", "needed_weights"]


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """Return the weights that the stage needs, each with what prevents its use on this machine (None if nothing).

    Args:
        brings: the keys of scene.yaml and the names of the scene's folders; not used here.
    """
    needs = [local.model_need(params.prior, params.dtype)] if params.needs_prior else []
    if params.depth.weight > 0 and params.depth.model:
        needs.append(local.model_need(params.depth.model, "float32"))
    return needs


def lacks(params: Params) -> list[str]:
    """Return what the stage needs on CUDA and this machine lacks, one line each with the remedy."""
    return machine.find_missing(machine.detect(), params.memory_gb, splats=True, memory_param="distill.memory_gb")
