"""What `plan` reports of the stage `masks` before it runs."""

from pathlib import Path

from reffusion.io import machine
from reffusion.params.masks import Params
from reffusion.weights import local
from reffusion.weights.segmenters import AUTO, NONE, segmenter_facts

__all__ = ["Params", "lacks", "needed_weights", "optional_weights", "preview"]


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """The network that refines masks."""
    return [local.segmenter_need()] if params.segmenter == AUTO and params.refine else []


def optional_weights(params: Params) -> list[local.Need]:
    """The network that makes masks from clicks."""
    return [local.segmenter_need()] if params.segmenter == AUTO and not params.refine else []


def machine_facts(params: Params) -> dict[str, str]:
    """What masks from clicks depend on besides the parameters: the network's files."""
    return segmenter_facts(params.segmenter) if params.clicks or params.refine else {}


def preview(params: Params, **_: Path | None) -> list[str]:
    """What the stage will do, as far as it is known in advance."""
    if not params.clicks or segmenter_facts(params.segmenter)["segmenter"] != NONE:
        return []
    return ["clicks are segmented by colours and surfaces; with the network of `make weights`, fewer clicks suffice"]


def lacks(params: Params) -> list[str]:
    """What the stage needs on CUDA and this machine lacks."""
    return machine.find_missing(machine.detect())
