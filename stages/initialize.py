"""initialize: masked Gaussians are removed, and the references' pixels, on estimated depth, added in their place."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.background.model import Background
from reffusion.depth import monocular
from reffusion.initialize import coverage
from reffusion.initialize.draft import Draft
from reffusion.initialize.draft_steps import add_random, refit_draft, restrict_invent_masks
from reffusion.initialize.extra_views import FLOATER_RATIO, complete_extra_views
from reffusion.initialize.fill import fill_references
from reffusion.initialize.relighting import remove_shadows
from reffusion.initialize.sds_gain import GainPrediction, predict_gain
from reffusion.inpaint import feedforward
from reffusion.io.arrays import load_json, save_json, save_labels
from reffusion.io.images import save_exr, save_image, save_mask
from reffusion.io.ply import save_ply
from reffusion.io.scene import load_references
from reffusion.masks import voting
from reffusion.params.initialize import Params
from reffusion.trace import Trace
from reffusion.types import MaskSet, Reference
from reffusion.workspace import Workspace

WARN_SHARE = 0.01  # uncovered share of C from which a view is named


def run(
    params: Params, out: Path, *, poses: Path, fit: Path, masks: Path, reference: Path | None, lift: Path | None = None
) -> None:
    """Write gaussians.ply, labels.npy (the new ones), facts.json, depth/<view>.exr, extra_views/<view>.png, and masks:
    shadows/ and invent/<view>.png."""
    space = Workspace(poses, fit, masks, params.device)
    draft, scene, sets = Draft.start(space.remaining), space.scene, space.mask_sets
    train = [scene.cameras[name] for name in scene.train]
    references = load_completed(params, space, reference, lift)
    if params.tidy and params.start != "nothing":  # where nothing takes their place, floaters are better than a hole
        unobserved = {camera.name: sets[camera.name].unobserved for camera in train}
        draft = draft.drop(voting.find_floaters(draft.gaussians, train, unobserved, FLOATER_RATIO))
    floaters = len(space.remaining) - len(draft.gaussians)
    is_method = bool(references) and params.start == "reference"  # not a baseline
    extra: list[Reference] = []
    trusted: list[Reference] = []
    if references:
        background = space.background
        network = monocular.load_network(params.depth.model, params.device) if params.depth.model else None
        best = space.facts["best_reference"]
        draft, depths = fill_references(params, draft, references, best, background, network, Trace(out))
        save_depths(out, depths)
    if is_method:
        restricted = restrict_invent_masks(draft, sets, background)
        sets = sets | restricted
        for name, pixels in restricted.items():
            save_mask(out / "invent" / f"{name}.png", pixels.invent)
        assert reference is not None
        trusted = trusted_references(reference, references, background)
        if params.refit_steps:
            trusted, background, shadows = remove_shadows(trusted, draft.gaussians, background)
            for name, mask in shadows.items():
                save_mask(out / "shadows" / f"{name}.png", mask)
        if params.extra_views:
            painter = feedforward.load_inpainter(params.inpainter, params.device)
            draft, extra, depths = complete_extra_views(params, draft, background, trusted, painter)
            save_depths(out, depths)
            for each in extra:
                save_image(out / "extra_views" / f"{each.camera.name}.png", each.image)
            trusted = [*trusted, *extra]
    if params.start == "random" and any(each.invent.any() for each in sets.values()):
        draft = add_random(draft, space)
    if is_method and params.refit_steps:
        work = out / ".refit"  # hidden: its trace holds seconds, which are no part of the artifact's content
        work.mkdir(exist_ok=True)
        has_exact_depth = all(each.depth is not None for each in references)
        draft = refit_draft(draft, params.refit_steps, scene, background, trusted, sets, has_exact_depth, work)
        shutil.rmtree(work)

    save_ply(out / "gaussians.ply", draft.gaussians)
    save_labels(out / "labels.npy", draft.is_new.cpu())
    photos = background.photos if is_method else None
    save_json(out / "facts.json", summarize(params, space, draft, floaters, sets, extra, trusted, photos))


def summarize(
    params: Params,
    space: Workspace,
    draft: Draft,
    floaters: int,
    sets: Mapping[str, MaskSet],
    extra: Sequence[Reference],
    trusted: Sequence[Reference],
    photos: Mapping[str, np.ndarray] | None,
) -> dict[str, Any]:
    """The stage's facts: what was added and removed, what nothing covers, and whether SDS may gain; warns of views with
    uncovered pixels.

    Args:
        photos: view -> uint8 [H, W, 3], without the shadows that were removed; None for a baseline.
    """
    train = [space.scene.cameras[name] for name in space.scene.train]
    uncovered = {
        each.name: coverage.uncovered_share(draft.gaussians, each, sets[each.name].consistent) for each in train
    }
    shares = {each.camera.name: float(each.mask.sum() / sets[each.camera.name].consistent.sum()) for each in extra}
    gain = GainPrediction(True, f"start is {params.start}", None)
    if photos is not None:
        gain = predict_gain(draft.gaussians, train, sets, photos, max(shares.values(), default=0.0))
    print(f"SDS {'may' if gain.may_gain else 'cannot'} gain: {gain.reason}")
    if named := [f"{name} ({share:.1%})" for name, share in uncovered.items() if share > WARN_SHARE]:
        print(
            f"uncovered in {len(named)} views: {', '.join(named)}: complete another view and add it to the references"
        )
    return {
        "new_gaussians": int(draft.is_new.sum()),
        "removed_gaussians": int(space.labels.sum()),
        "floaters": floaters,
        "completed": [each.camera.name for each in trusted],
        "uncovered": uncovered,
        "extra_views": shares,
        "sds_may_gain": gain.may_gain,
        "sds_reason": gain.reason,
        "psnr_beside": gain.psnr_beside,
        "uncovered_share": sum(uncovered.values()) / max(len(uncovered), 1),
    }


def load_completed(params: Params, space: Workspace, reference: Path | None, lift: Path | None) -> list[Reference]:
    """The completed views from which the hole is filled: the references, or a baseline's."""
    if params.start == "lift" and lift is None:
        raise ValueError("initialize.start is 'lift', but the stage lift was left out: set distill.lift.weight")
    folder = {"reference": reference, "lift": lift}.get(params.start)
    return load_references(folder, space.scene) if folder else []


def trusted_references(reference: Path, references: list[Reference], background: Background) -> list[Reference]:
    """The references with the pixels of which they know more than the Gaussians do: all of C where the scene brings the
    picture, what was invented where it was completed here."""
    facts = reference / "facts.json"
    given = load_json(facts)["given"] if facts.exists() else []
    extend = lambda each: replace(each, mask=each.mask | background.masks[each.camera.name])
    return [extend(each) if each.camera.name in given else each for each in references]


def save_depths(out: Path, depths: dict[str, np.ndarray]) -> None:
    for name, depth in depths.items():
        save_exr(out / "depth" / f"{name}.exr", depth.astype("float32"))
