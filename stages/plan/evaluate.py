"""Facts about the stage `evaluate` that the runner needs before the stage runs; imports nothing heavy."""

from __future__ import annotations

from reffusion.params.evaluate import Params
from reffusion.weights import local, painters


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """Return the weights that the stage uses, each with what prevents its use on this machine (None if nothing)."""
    painting = painters.inpainter_needs(params.inpainter, "evaluate.inpainter") if params.inpaint else []
    return [local.lpips_need(), *painting]


def machine_facts(params: Params) -> dict[str, str]:
    """Return the facts of `painters.inpainter_facts`; no facts if nothing is inpainted in 2D."""
    return painters.inpainter_facts(params.inpainter) if params.inpaint else {}


def unavailable(params: Params) -> list[str]:
    """Return the names of scores that cannot be computed on this machine, e.g. because weights are missing.

    The stage runs again once they can be computed.
    """
    needs = {"LPIPS": local.lpips_need(), "the score of leftovers": local.segmenter_need()}
    return [name for name, need in needs.items() if need.problem]
