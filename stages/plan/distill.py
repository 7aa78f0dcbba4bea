"""Facts about the stage `distill` that the runner needs before the stage runs; imports nothing heavy."""

from __future__ import annotations

from reffusion.params.distill import Params
from reffusion.weights import local


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """Return the weights that the stage needs, each with what prevents its use on this machine (None if nothing)."""
    needs = [local.model_need(params.prior, params.dtype)] if params.needs_prior else []
    if params.depth.weight > 0 and params.depth.model:
        needs.append(local.model_need(params.depth.model, "float32"))
    return needs
