"""Facts about the stage `personalize` that the runner needs before the stage runs; imports nothing heavy."""

from __future__ import annotations

from reffusion.params.personalize import Params
from reffusion.weights import local


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """Return the weights that the stage needs, each with what prevents its use on this machine (None if nothing)."""
    return [local.model_need(params.prior, params.dtype)]
