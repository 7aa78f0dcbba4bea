"""Facts about the stage `masks` that the runner needs before the stage runs; imports nothing heavy."""

from pathlib import Path

from reffusion.params.masks import Params
from reffusion.weights import local
from reffusion.weights.segmenters import AUTO, NONE, segmenter_facts


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """Return the segmentation network that refines masks, if the parameters ask for it; else an empty list."""
    return [local.segmenter_need()] if params.segmenter == AUTO and params.refine else []


def optional_weights(params: Params) -> list[local.Need]:
    """Return the segmentation network that makes masks from clicks; without it the stage still works.

    The list is empty if the parameters name another network, or if the network is among `needed_weights`.
    """
    return [local.segmenter_need()] if params.segmenter == AUTO and not params.refine else []


def machine_facts(params: Params) -> dict[str, str]:
    """Return facts about this machine on which masks from clicks and refined masks depend.

    The dict has "segmenter" -> hash of the network's files, or a name if there are no files. It is empty without such
    masks.
    """
    return segmenter_facts(params.segmenter) if params.clicks or params.refine else {}


def preview(params: Params, **_: Path | None) -> list[str]:
    """Say if clicks will be segmented without a network; else return an empty list."""
    if not params.clicks or segmenter_facts(params.segmenter)["segmenter"] != NONE:
        return []
    return ["clicks are segmented by colors and surfaces; with the network of `make weights`, fewer clicks suffice"]
