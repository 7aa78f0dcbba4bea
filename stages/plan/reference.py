"""What `reference` reads, checks, needs and announces before it runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from reffusion.capture.views import load_placed_views
from reffusion.cost import estimate
from reffusion.io import machine
from reffusion.params.inpainter import Inpainter
from reffusion.params.reference import Params, reference_list
from reffusion.references.files import PAINTED, describe_references, list_paintings, load_reference_files
from reffusion.weights import local, painters
from reffusion.weights.published import PAINTERS


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """The weights that the stage needs, and what of them is missing; `brings`: the keys of scene.yaml, and its
    folders."""
    given = params.reference is not None or PAINTED in brings
    if given:
        return []
    if params.inpainter.kind == "diffusion":
        return [local.model_need(params.prior, params.dtype)]
    return painters.weights_needs(params.inpainter, "reference.inpainter")


def optional_weights(params: Params) -> list[local.Need]:
    """The weights that `inpainter: auto` would use."""
    return [need for kind in PAINTERS for need in painters.weights_needs(Inpainter(kind=kind))]


def machine_facts(params: Params) -> dict[str, str]:
    """What the result depends on beside the parameters: the inpainter, and the content of its file."""
    return painters.inpainter_facts(params.inpainter)


def scene_files(params: Params, scene: Path, files: list[Path]) -> list[Path]:
    """The scene's files that this stage reads, and those that it reads elsewhere."""
    named = {scene / name for each in reference_list(params.reference) for name in (each.image, each.depth) if name}
    return sorted({path for path in named if path.is_file()} | {p for p in files if p.parent == scene / PAINTED})


def preview(params: Params, *, scene: Path, poses: Path | None = None, **_: Path | None) -> list[str]:
    """What the stage will do. ValueError where it would refuse a reference for its name, file or view, as far as that
    can be checked: against the views that `poses` placed (before it has run, `poses` checks them against the
    capture's)."""
    if reference_list(params.reference) or list_paintings(scene):
        views = (
            describe_references(load_reference_files(scene, load_placed_views(poses), params.reference))
            if poses
            else ""
        )
        return [f"takes over the scene's reference{views and ' ' + views}: no diffusion here"]
    if params.inpainter.kind == "diffusion":
        return []
    unread = f"; the prompt '{params.prompt}' is not read, reference.inpainter=diffusion would" if params.prompt else ""
    how = "puts the reference together from patches of the photographs"
    if (kind := painters.resolve_inpainter(params.inpainter).kind) in PAINTERS:
        how = f"completes the reference by {PAINTERS[kind].name}, one picture"
    return [f"{how}: no diffusion here{unread}"]


def lacks(params: Params) -> list[str]:
    """What this machine lacks for the stage on CUDA."""
    return machine.find_missing(machine.detect(), params.memory_gb, splats=False, memory_param="reference.memory_gb")


def cost(params: Params, gpu: str) -> Mapping[str, object] | None:
    """The stage's cost on a GPU; "" is this machine's. ValueError for a GPU that is not in the table."""
    return estimate.format_estimate(gpu, params.device, estimate.reference(params))
