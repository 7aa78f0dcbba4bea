"""Facts about the stage `lift` that the runner needs before the stage runs; imports nothing heavy."""

from __future__ import annotations

from reffusion.params.lift import Params
from reffusion.weights import local, painters


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """Return the weights that the stage needs, each with what prevents its use on this machine (None if nothing)."""
    if params.inpainter.kind == "diffusion":
        return [local.model_need(params.prior, "float32")]
    return painters.inpainter_needs(params.inpainter, "lift.inpainter")


def machine_facts(params: Params) -> dict[str, str]:
    """Return the facts of `painters.inpainter_facts`."""
    return painters.inpainter_facts(params.inpainter)
