"""Facts about the stage `personalize` that the runner needs before the stage runs; imports nothing heavy."""

from __future__ import annotations

from reffusion.io import machine
from reffusion.params.personalize import Params
from reffusion.weights import local

__all__ = ["Params", "lacks", "needed_weights"]


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """Return the weights that the stage needs, each with what prevents its use on this machine (None if nothing).

    Args:
        brings: the keys of scene.yaml and the names of the scene's folders; not used here.
    """
    return [local.model_need(params.prior, params.dtype)]


def lacks(params: Params) -> list[str]:
    """Return what the stage needs on CUDA and this machine lacks, one line each with the remedy."""
    return machine.find_missing(machine.detect(), params.memory_gb, splats=False, memory_param="personalize.memory_gb")
