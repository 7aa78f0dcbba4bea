"""The stage `reference` before it runs: its files and weights, checks of given references, and notes of `plan`."""

from __future__ import annotations

from pathlib import Path

from reffusion.capture.views import load_placed_views
from reffusion.params.inpainter import SEED_KINDS, Inpainter
from reffusion.params.reference import Params, reference_list
from reffusion.references.files import (
    PAINTED,
    describe_references,
    list_paintings,
    list_teaching_files,
    load_reference_files,
)
from reffusion.weights import local, painters
from reffusion.weights.published import PAINTERS


def needed_weights(params: Params, brings: frozenset[str]) -> list[local.Need]:
    """Return the weights that the stage needs, each with what prevents its use on this machine (None if nothing).

    A scene that brings references needs none.

    Args:
        brings: the keys of scene.yaml and the names of the scene's folders.
    """
    given = params.reference is not None or PAINTED in brings
    if given:
        return []
    if params.inpainter.kind == "diffusion":
        return [local.model_need(params.prior, params.dtype)]
    return painters.inpainter_needs(params.inpainter, "reference.inpainter", params.dtype)


def optional_weights(params: Params) -> list[local.Need]:
    """Return the weights of all inpainters from which `inpainter: auto` selects, whatever the parameters are."""
    return [need for kind in PAINTERS for need in painters.inpainter_needs(Inpainter(kind=kind))]


def machine_facts(params: Params) -> dict[str, str]:
    """Return the facts of `painters.inpainter_facts`."""
    return painters.inpainter_facts(params.inpainter)


def scene_files(params: Params, scene: Path, files: list[Path]) -> list[Path]:
    """Return the sorted files that the stage reads: those of the references and their depth maps.

    scene.yaml may name files outside the scene's folder.

    Args:
        scene: folder of the scene.
        files: all files of the scene.
    """
    named = {scene / name for each in reference_list(params.reference) for name in (each.image, each.depth) if name}
    named |= {scene / name for name in params.teach}
    return sorted({path for path in named if path.is_file()} | {p for p in files if p.parent == scene / PAINTED})


def preview(params: Params, *, scene: Path, poses: Path | None = None, **_: Path | None) -> list[str]:
    """Describe what the stage will do, a sentence each, and check the references that the scene brings.

    Args:
        scene: folder of the scene.
        poses: folder of the stage `poses`. None if it has not run; then nothing is checked here, and the preview of
            `poses` checks references against the views of the capture.

    Raises:
        ValueError: the stage would refuse a reference because of its name, file or view.
    """
    list_teaching_files(scene, params.teach)
    if reference_list(params.reference) or list_paintings(scene):
        views = (
            describe_references(load_reference_files(scene, load_placed_views(poses), params.reference))
            if poses
            else ""
        )
        return [f"takes over the scene's reference{views and ' ' + views}: no diffusion here"]
    if params.inpainter.kind == "diffusion":
        has_effect = params.prompt or not params.sampler.guidance
        return [] if has_effect else ["reference.prompt is empty: reference.sampler.guidance has no effect"]
    if params.inpainter.kind in SEED_KINDS:
        command = params.inpainter.command
        is_blind = params.inpainter.kind == "moebius" or (command is not None and "{prompt}" not in command)
        note = f"; the prompt '{params.prompt}' is not read" if params.prompt and is_blind else ""
        name, count = painters.name_seed_painter(params.inpainter), len(params.candidate_numbers)
        return [f"paints the reference by {name}, {count} candidate{'s' if count > 1 else ''}{note}"]
    unread = f"; the prompt '{params.prompt}' is not read, reference.inpainter=diffusion would" if params.prompt else ""
    how = "puts the reference together from patches of the photographs"
    if (kind := painters.resolve_inpainter(params.inpainter).kind) in PAINTERS:
        how = f"completes the reference by {PAINTERS[kind].name}, one picture"
    return [f"{how}: no diffusion here{unread}"]
