"""What can be told of `personalize` before it runs."""

from __future__ import annotations

from reffusion.params.personalize import Params
from reffusion.weights import local

__all__ = ["Params", "needed_weights"]


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """What must lie on this machine, and what of it does not; `brings`: the keys of scene.yaml."""
    return [local.of_model(params.prior, params.dtype)]
