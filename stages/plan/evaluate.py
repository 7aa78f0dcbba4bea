"""What `evaluate` says before it runs."""

from __future__ import annotations

from reffusion.io import machine
from reffusion.params.evaluate import Params
from reffusion.weights import local


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """What must lie on this machine, and what of it does not; `brings`: the keys of scene.yaml."""
    return [local.of_lpips()]


def lacking(params: Params) -> list[str]:
    """What scores are missing here; where it comes later, they are made anew."""
    return ["LPIPS"] if local.of_lpips().problem else []


def lacks(params: Params) -> list[str]:
    """What this machine has not, and the stage needs on CUDA."""
    return machine.lacks(machine.machine())
