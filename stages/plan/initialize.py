"""Facts about the stage `initialize` that the runner needs before the stage runs; imports nothing heavy."""

from __future__ import annotations

from pathlib import Path

from reffusion.params.initialize import Params
from reffusion.params.inpainter import SEED_KINDS
from reffusion.weights import local, painters
from reffusion.weights.published import DEPTH_ANYTHING, PAINTERS


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """Return the weights that the stage needs, each with what prevents its use on this machine (None if nothing)."""
    needs = [local.model_need(params.depth.model, "float32")] if params.depth.model else []
    return needs + (painters.inpainter_needs(params.inpainter, "initialize.inpainter") if _paints(params) else [])


def optional_weights(params: Params) -> list[local.Need]:
    """Return the weights of a depth network that the stage could use; an empty list if the parameters name one."""
    return [] if params.depth.model else [local.model_need(DEPTH_ANYTHING, "float32")]


def machine_facts(params: Params) -> dict[str, str]:
    """Return the facts of `painters.inpainter_facts`; no facts if no extra views are completed."""
    return painters.inpainter_facts(params.inpainter) if _paints(params) else {}


def _paints(params: Params) -> bool:
    """Return whether the inpainter completes extra views; those of `SEED_KINDS` leave them to patches."""
    return bool(params.extra_views) and params.inpainter.kind not in SEED_KINDS


def preview(params: Params, **_: Path | None) -> list[str]:
    """Say how many extra views the stage may complete, and how; an empty list if it completes none."""
    if not (params.extra_views and params.start == "reference"):
        return []
    kind = painters.resolve_inpainter(params.inpainter).kind
    how = f"by {PAINTERS[kind].name}" if kind in PAINTERS else "from patches of the photographs"
    return [f"completes up to {params.extra_views} extra views {how}: what no reference shows"]
