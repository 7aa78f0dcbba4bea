"""What `plan` reports of the stage `initialize` before it runs."""

from __future__ import annotations

from pathlib import Path

from reffusion.io import machine
from reffusion.params.initialize import Params
from reffusion.weights import local, painters
from reffusion.weights.published import DEPTH_ANYTHING, PAINTERS

__all__ = ["Params", "lacks", "needed_weights", "preview"]


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """Weights that the stage needs, and whether they are here; `brings`: the keys of scene.yaml."""
    needs = [local.model_need(params.depth.model, "float32")] if params.depth.model else []
    return needs + (painters.weights_needs(params.inpainter, "initialize.inpainter") if params.extra_views else [])


def optional_weights(params: Params) -> list[local.Need]:
    """Weights that the stage could use instead."""
    return [] if params.depth.model else [local.model_need(DEPTH_ANYTHING, "float32")]


def machine_facts(params: Params) -> dict[str, str]:
    """What the result depends on besides the parameters: the inpainter, and the content of its file."""
    return painters.inpainter_facts(params.inpainter) if params.extra_views else {}


def preview(params: Params, **_: Path | None) -> list[str]:
    """What the stage will do, as far as it is known in advance."""
    if not (params.extra_views and params.start == "reference"):
        return []
    kind = painters.resolve_inpainter(params.inpainter).kind
    how = f"by {PAINTERS[kind].name}" if kind in PAINTERS else "from patches of the photographs"
    return [f"completes up to {params.extra_views} extra views {how}: what no reference shows"]


def lacks(params: Params) -> list[str]:
    """What the stage needs on CUDA and this machine lacks."""
    return machine.find_missing(machine.detect())
