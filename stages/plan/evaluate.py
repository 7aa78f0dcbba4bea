"""What can be told of `evaluate` before it runs."""

from __future__ import annotations

from reffusion.io import machine
from reffusion.params.evaluate import Params
from reffusion.weights import local, painters


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """The weights that the stage works with, and which of them are missing on this machine.

    Args:
        brings: the keys of scene.yaml.
    """
    painting = painters.weights_needs(params.inpainter, "evaluate.inpainter") if params.inpaint else []
    return [local.lpips_need(), *painting]


def machine_facts(params: Params) -> dict[str, str]:
    """What the result depends on beside the parameters: the content of the inpainter's file."""
    return painters.inpainter_facts(params.inpainter) if params.inpaint else {}


def unavailable(params: Params) -> list[str]:
    """The scores that cannot be computed on this machine; once they can, the stage runs again."""
    return ["LPIPS"] if local.lpips_need().problem else []


def lacks(params: Params) -> list[str]:
    """What this machine lacks and the stage needs on CUDA."""
    return machine.find_missing(machine.detect())
