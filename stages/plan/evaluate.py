"""What `evaluate` says before it runs."""

from __future__ import annotations

from reffusion.io import machine
from reffusion.params.evaluate import Params
from reffusion.weights import local, painters
from reffusion.weights.published import PAINTERS


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """What must lie on this machine, and what of it does not; `brings`: the keys of scene.yaml."""
    painted = params.inpaint and params.inpainter in PAINTERS
    return [
        local.lpips_need(),
        *([painters.inpainter_need(params.inpainter, param="evaluate.inpainter")] if painted else []),
    ]


def machine_facts(params: Params) -> dict[str, str]:
    """What the result depends on beside the parameters: the content of the inpainter's file."""
    return painters.inpainter_facts(params.inpainter) if params.inpaint else {}


def unavailable(params: Params) -> list[str]:
    """What scores are missing here; where it comes later, they are made anew."""
    return ["LPIPS"] if local.lpips_need().problem else []


def lacks(params: Params) -> list[str]:
    """What this machine has not, and the stage needs on CUDA."""
    return machine.find_missing(machine.detect())
