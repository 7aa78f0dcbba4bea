"""What `plan` reports of the stage `lift` before it runs."""

from __future__ import annotations

from reffusion.io import machine
from reffusion.params.lift import Params
from reffusion.weights import local, painters


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """Weights that the stage needs, and whether they are here; `brings`: the keys of scene.yaml."""
    if params.inpainter.kind == "diffusion":
        return [local.model_need(params.prior, "float32")]
    return painters.weights_needs(params.inpainter, "lift.inpainter")


def machine_facts(params: Params) -> dict[str, str]:
    """What the result depends on besides the parameters: the content of the inpainter's file."""
    return painters.inpainter_facts(params.inpainter)


def lacks(params: Params) -> list[str]:
    """What the stage needs on CUDA and this machine lacks."""
    return machine.find_missing(machine.detect(), splats=False)
