"""The stage `initialize`: the object's Gaussians are removed, and the pixels of the references become new Gaussians.

A pixel of a reference is unprojected at its estimated depth.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.background.model import Background
from reffusion.depth import monocular
from reffusion.initialize.draft import Draft
from reffusion.initialize.draft_operations import add_random, refit_draft, restrict_invent_masks
from reffusion.initialize.extra_views import FLOATER_RATIO, complete_extra_views
from reffusion.initialize.fill import fill_references
from reffusion.initialize.origins import ORIGINS, OriginMap, find_origins
from reffusion.initialize.relighting import remove_shadows
from reffusion.initialize.warped_views import warp_references
from reffusion.inpaint import feedforward
from reffusion.io.arrays import load_json, save_json, save_labels
from reffusion.io.images import save_exr, save_image, save_mask
from reffusion.io.ply import save_ply
from reffusion.io.scene import load_references
from reffusion.kernels.compiled import side_by_side, views_at_once
from reffusion.masks import voting
from reffusion.params.initialize import Params
from reffusion.trace import Trace
from reffusion.types import MaskSet, Reference
from reffusion.workspace import Workspace

LEAST_INVENTED_SHARE = 0.1  # share of the hole that no picture shows, above which a view is worth painting
WARN_SHARE = 0.01  # share of uncovered pixels of C above which a view is named in a message


def run(
    params: Params, out: Path, *, poses: Path, fit: Path, masks: Path, reference: Path | None, lift: Path | None = None
) -> None:
    """Run the stage: remove the object, fill the hole from the references, and refit.

    Writes:

    - gaussians.ply, and labels.npy, bool [N]: True for the new Gaussians;
    - facts.json;
    - depth/<view>.exr: the depth at which each reference and each extra view was unprojected;
    - extra_views/<view>.png: views that were completed besides the references, because gaps were left;
    - origins/<view>.png: the origin of what each view shows in C: other photographs (green), photographs in conflict
      with the scene (white), a reference (blue), patches in an extra view (orange), nothing (red);
    - shadows/<view>.png: masks of the object's shadow in all views, if a reference shows the scene without it;
    - invent/<view>.png: the invent masks I that reach beyond C (where the scene asks to fill a region), restricted
      there to pixels that show new Gaussians;
    - trace.jsonl: the convergence of the depth solvers.

    Args:
        out: folder of this stage.
        poses, fit, masks, reference, lift: folders of the stages of these names; `reference` and `lift` are None if the
            stage was skipped.
    """
    space = Workspace(poses, fit, masks, params.device)
    draft, scene, sets = Draft.start(space.remaining), space.scene, space.mask_sets
    train = [scene.cameras[name] for name in scene.train]
    references = load_completed(params, space, reference, lift)
    if params.tidy and params.start != "nothing":  # if nothing is filled in, floaters look better than a hole
        unobserved = {camera.name: sets[camera.name].unobserved for camera in train}
        draft = draft.drop(voting.find_floaters(draft.gaussians, train, unobserved, FLOATER_RATIO))
    floaters = len(space.remaining) - len(draft.gaussians)
    is_method = bool(references) and params.start == "reference"  # else this is a baseline, or nothing is invented
    filled = Filling(draft)
    if references:
        filled = fill_hole(params, draft, space, references, reference if params.start != "lift" else None, Trace(out))
    if params.start == "random":
        draft = add_random(draft, space, int(filled.draft.is_new.sum())) if references else draft
    else:
        draft, sets = filled.draft, sets | filled.restricted
        save_filling(out, filled)
    if is_method and params.refit_steps:
        assert filled.background is not None
        work = out / ".refit"  # a hidden folder, because its trace holds run times, which must not enter the hash
        work.mkdir(exist_ok=True)
        has_exact_depth = all(each.depth is not None for each in references)
        warped = warp_references(draft, filled.trusted, filled.depths, filled.background.cameras)
        completed = [*filled.trusted, *warped]
        draft = refit_draft(draft, params.refit_steps, scene, filled.background, completed, sets, has_exact_depth, work)
        shutil.rmtree(work)

    save_ply(out / "gaussians.ply", draft.gaussians)
    save_labels(out / "labels.npy", draft.is_new.cpu())
    compared = filled.background if is_method else None
    photos = compared.photos if compared else None
    extra, trusted = (filled.extra, filled.trusted) if is_method else ([], [])
    find = lambda name: find_origins(draft, scene.cameras[name], sets[name], compared)
    origins = dict(zip(scene.train, side_by_side(find, scene.train, views_at_once(params.device)), strict=True))
    for name, origin in origins.items():
        save_image(out / "origins" / f"{name}.png", origin.picture)
    save_json(out / "facts.json", summarize(params, space, draft, floaters, sets, origins, extra, trusted, photos))


@dataclass(frozen=True)
class Filling:
    """A draft that the references have filled, and what is known of it.

    Attributes:
        draft: the draft with the new Gaussians; of the start "random" only their number is used.
        depths, extra_depths: view name -> [H, W], the depth at which each reference and each extra view was added.
        restricted: view name -> pixel classes with a restricted invent mask, see `restrict_invent_masks`.
        shadows: view name -> bool [H, W], the object's shadow.
        extra: the views that were completed besides the references.
        trusted: all completed views that supervise a refit.
        background: the surfaces around the object, without its shadow; None if there is no reference.
    """

    draft: Draft
    depths: Mapping[str, np.ndarray] = field(default_factory=dict)
    extra_depths: Mapping[str, np.ndarray] = field(default_factory=dict)
    restricted: Mapping[str, MaskSet] = field(default_factory=dict)
    shadows: Mapping[str, np.ndarray] = field(default_factory=dict)
    extra: Sequence[Reference] = ()
    trusted: Sequence[Reference] = ()
    background: Background | None = None


def fill_hole(
    params: Params, draft: Draft, space: Workspace, references: list[Reference], folder: Path | None, log: Trace
) -> Filling:
    """Fill the hole from the references, and from extra views where these leave gaps.

    Args:
        draft: the scene without the object.
        space: results of the stages `poses`, `fit` and `masks`.
        references: the completed views.
        folder: folder of the stage `reference`; None for a picture of the stage `lift`, which is unprojected only.
        log: receives the traces of the depth solvers.
    """
    background = space.background if params.uses_surfaces else space.background_views
    network = monocular.load_network(params.depth.model, params.device) if params.depth.model else None
    best = space.facts["best_reference"]
    draft, depths = fill_references(params, draft, references, best, background, network, log)
    if folder is None:
        return Filling(draft, depths, background=background)
    restricted = restrict_invent_masks(draft, space.mask_sets, background)
    trusted = trusted_references(folder, references, background)
    shadows: Mapping[str, np.ndarray] = {}
    if params.refit_steps:
        trusted, background, shadows = remove_shadows(trusted, draft.gaussians, background)
    extra: list[Reference] = []
    extra_depths: dict[str, np.ndarray] = {}
    if params.extra_views:
        painter = feedforward.load_inpainter(params.inpainter, params.device)
        draft, extra, extra_depths = complete_extra_views(params, draft, background, trusted, painter)
    return Filling(draft, depths, extra_depths, restricted, shadows, extra, [*trusted, *extra], background)


def save_filling(out: Path, filled: Filling) -> None:
    """Write the depths, restricted invent masks, shadows and extra views of a filling."""
    save_depths(out, filled.depths)
    save_depths(out, filled.extra_depths)
    for name, pixels in filled.restricted.items():
        save_mask(out / "invent" / f"{name}.png", pixels.invent)
    for name, mask in filled.shadows.items():
        save_mask(out / "shadows" / f"{name}.png", mask)
    for each in filled.extra:
        save_image(out / "extra_views" / f"{each.camera.name}.png", each.image)


def summarize(
    params: Params,
    space: Workspace,
    draft: Draft,
    floaters: int,
    sets: Mapping[str, MaskSet],
    origins: Mapping[str, OriginMap],
    extra: Sequence[Reference],
    trusted: Sequence[Reference],
    photos: Mapping[str, np.ndarray] | None,
) -> dict[str, Any]:
    """Compute the contents of facts.json: counts of Gaussians, uncovered pixels, and where pixels come from.

    A pixel of C is uncovered if the initialization shows no surface there. The names of views with many such pixels are
    printed.

    Args:
        space: results of the stages `poses`, `fit` and `masks`.
        draft: the initialized scene.
        floaters: number of Gaussians that were removed as floaters.
        sets: view name -> pixel classes.
        origins: view name -> origin of the pixels of C.
        extra: the extra views that were completed. A view may occur more than once, with different masks.
        trusted: all completed views that supervise: references and extra views.
        photos: view name -> uint8 [H, W, 3], the photographs, without the object's shadow if one was found; None for a
            baseline, or if there is no reference.
    """
    uncovered = {name: each.uncovered_share for name, each in origins.items()}
    shown = [each.shares for name, each in origins.items() if sets[name].consistent.any()]
    mean_shares = {key: sum(each[key] for each in shown) / max(len(shown), 1) for key in ORIGINS[1:]}
    patches: dict[str, np.ndarray] = {}
    for each in extra:  # a view may have been completed more than once
        patches[each.camera.name] = patches.get(each.camera.name, False) | each.mask
    shares = {name: float(mask.sum() / sets[name].consistent.sum()) for name, mask in patches.items()}
    invented_shares = {name: each.shares["patches"] + each.shares["nothing"] for name, each in origins.items()}
    invented_pixels = lambda name: invented_shares[name] * np.count_nonzero(origins[name].classes)
    worst = max(origins, key=invented_pixels, default=None)
    print("what the object hid, mean over views: " + ", ".join(f"{mean_shares[key]:.0%} {key}" for key in mean_shares))
    if worst and photos is not None and invented_shares[worst] > LEAST_INVENTED_SHARE:
        share = invented_shares[worst]
        print(
            f"worth painting next: {worst}; no photograph or reference shows {share:.0%} of what the object hid there"
        )
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
        "origins": mean_shares,
        "invented_shares": invented_shares,
        "uncovered_share": sum(uncovered.values()) / max(len(uncovered), 1),
    }


def load_completed(params: Params, space: Workspace, reference: Path | None, lift: Path | None) -> list[Reference]:
    """Read the completed views from which the hole is filled, according to `params.start`.

    Args:
        space: results of the stages `poses`, `fit` and `masks`.
        reference: folder of the stage `reference`, for the starts "reference" and "random" (which adds as many
            Gaussians as the references would); None if it was skipped.
        lift: folder of the stage `lift`, for the baseline with start "lift"; None if it was skipped.

    Returns:
        The references; empty for the start "nothing".

    Raises:
        ValueError: the stage that the start "lift" or "random" needs was skipped, and something has to be invented.
    """
    if params.start == "lift" and lift is None:
        raise ValueError("initialize.start is 'lift', but the stage lift was left out: set distill.lift.weight")
    if params.start == "random" and reference is None and any(each.invent.any() for each in space.mask_sets.values()):
        raise ValueError(
            "initialize.start is 'random', but the stage reference, whose Gaussians it counts, was left out"
        )
    folder = {"reference": reference, "random": reference, "lift": lift}.get(params.start)
    return load_references(folder, space.scene) if folder else []


def trusted_references(reference: Path, references: list[Reference], background: Background) -> list[Reference]:
    """Return all references; the masks of those that the scene brings are extended by the consistent mask C.

    A reference that the scene brings shows all of C better than the Gaussians do. A reference that the stage
    `reference` completed is trusted only where it was invented, so its mask stays as it is.

    Args:
        reference: folder of the stage `reference`.
        background: holds C of each view as its masks.
    """
    facts = reference / "facts.json"
    given = load_json(facts)["given"] if facts.exists() else []
    extend = lambda each: replace(each, mask=each.mask | background.masks[each.camera.name])
    return [extend(each) if each.camera.name in given else each for each in references]


def save_depths(out: Path, depths: Mapping[str, np.ndarray]) -> None:
    """Write depth maps, view name -> [H, W] camera z, as out/depth/<view>.exr in float32."""
    for name, depth in depths.items():
        save_exr(out / "depth" / f"{name}.exr", depth.astype("float32"))
