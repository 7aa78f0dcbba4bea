"""What can be told of `initialize` before it runs."""

from __future__ import annotations

from pathlib import Path

from reffusion.io import machine
from reffusion.params.initialize import Params
from reffusion.weights import local, painters
from reffusion.weights.published import DEPTH_ANYTHING, PAINTERS

__all__ = ["Params", "lacks", "needed_weights", "preview"]


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """What must be on this machine, and what of it is not; `brings`: the keys of scene.yaml."""
    found = [local.of_model(params.depth.model, "float32")] if params.depth.model else []
    painted = params.extra_views and params.inpainter in PAINTERS
    return found + ([painters.of_painter(params.inpainter, param="initialize.inpainter")] if painted else [])


def optional_weights(params: Params) -> list[local.Need]:
    """What the stage could work with instead."""
    return [] if params.depth.model else [local.of_model(DEPTH_ANYTHING, "float32")]


def machine_facts(params: Params) -> dict[str, str]:
    """What the result depends on beside the parameters: which inpainter, and the content of its file."""
    return painters.inpainter_facts(params.inpainter) if params.extra_views else {}


def preview(params: Params, **_: Path | None) -> list[str]:
    """What the stage will do, as far as that is known before it looks."""
    if not (params.extra_views and params.start == "reference"):
        return []
    kind = painters.resolve_inpainter(params.inpainter)
    how = f"by {PAINTERS[kind].name}" if kind in PAINTERS else "from patches of the photographs"
    return [f"completes up to {params.extra_views} extra views {how}: what no reference shows"]


def lacks(params: Params) -> list[str]:
    """What this machine has not, and the stage needs on CUDA."""
    return machine.lacks(machine.machine())
