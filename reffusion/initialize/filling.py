"""Initialization of a scene without its object.

The hole is filled from references, extra views close gaps, and a refit corrects the result.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from reffusion.background.model import Background
from reffusion.depth import monocular
from reffusion.initialize.draft import Draft
from reffusion.initialize.draft_operations import add_random, refit_draft, restrict_invent_masks
from reffusion.initialize.extra_views import complete_extra_views
from reffusion.initialize.fill import fill_references
from reffusion.initialize.warped_views import warp_references
from reffusion.inpaint import feedforward
from reffusion.masks import voting
from reffusion.params.initialize import Params
from reffusion.shadows.reference_shadows import remove_shadows
from reffusion.trace import Trace
from reffusion.types import MaskSet, Reference
from reffusion.workspace import Workspace


@dataclass(frozen=True)
class Filling:
    """A scene without its object whose hole is filled, and what is known of it.

    Attributes:
        draft: the Gaussians, the new ones among them.
        floaters: number of Gaussians that were removed as floaters.
        depths, extra_depths: view name -> [H, W], the depth at which each reference and each extra view was added.
        restricted: view name -> pixel classes with a restricted invent mask, see `restrict_invent_masks`.
        shadows: view name -> bool [H, W], the object's shadow.
        extra: the views that were completed besides the references. A view may occur more than once, with different
            masks.
        trusted: all completed views that supervise a refit: references and extra views.
        background: the surfaces around the object, without its shadow; None for a baseline, or without a reference.
    """

    draft: Draft
    floaters: int
    depths: Mapping[str, np.ndarray] = field(default_factory=dict)
    extra_depths: Mapping[str, np.ndarray] = field(default_factory=dict)
    restricted: Mapping[str, MaskSet] = field(default_factory=dict)
    shadows: Mapping[str, np.ndarray] = field(default_factory=dict)
    extra: Sequence[Reference] = ()
    trusted: Sequence[Reference] = ()
    background: Background | None = None


def initialize_scene(
    params: Params, space: Workspace, references: Sequence[Reference], given: Collection[str], work: Path, log: Trace
) -> Filling:
    """Remove the object, fill the hole according to `params.start`, and refit.

    Args:
        params: parameters of the stage `initialize`.
        space: results of the stages `poses`, `fit` and `masks`.
        references: the completed views; none if nothing is filled.
        given: names of the references that the scene brings, see `extend_given_masks`.
        work: folder of the refit's trace and checkpoints, which is deleted in the end.
        log: receives the traces of the depth solvers.

    Returns:
        The filled scene. Without references nothing is filled. With `params.start` "random", random Gaussians take the
        place of the Gaussians that the references would add, about as many.
    """
    draft = Draft.start(space.remaining)
    if params.tidy and params.start != "nothing":  # if nothing is filled in, floaters look better than a hole
        train = [space.scene.cameras[name] for name in space.scene.train]
        unobserved = {camera.name: space.mask_sets[camera.name].unobserved for camera in train}
        draft = draft.drop(voting.find_floaters(draft.gaussians, train, unobserved))
    nothing = Filling(draft, len(space.remaining) - len(draft.gaussians))
    if not references:
        return nothing
    filled = fill_hole(params, nothing, space, references, given, log)
    if params.start == "random":
        return replace(nothing, draft=add_random(draft, space, int(filled.draft.is_new.sum())))
    if params.start == "reference" and params.refit_steps:
        return replace(filled, draft=_refit(params, filled, space, references, work))
    return filled


def fill_hole(
    params: Params,
    filling: Filling,
    space: Workspace,
    references: Sequence[Reference],
    given: Collection[str],
    log: Trace,
) -> Filling:
    """Fill the hole from the references, and from extra views where the references leave gaps.

    With `params.refit_steps`, the photographs are also relit without the object's shadow (`remove_shadows`).

    Args:
        filling: the scene without the object, not yet filled.
        space, references, given, log: as for `initialize_scene`. A picture of the stage `lift` (`params.start`) is
            unprojected only.
    """
    background = space.background if params.uses_surfaces else space.background_views
    network = monocular.load_network(params.depth.model, params.device) if params.depth.model else None
    best = space.facts["best_reference"]
    draft, depths = fill_references(params, filling.draft, references, best, background, network, log)
    if params.start == "lift":
        return replace(filling, draft=draft, depths=depths)
    restricted = restrict_invent_masks(draft, space.mask_sets, background)
    trusted = extend_given_masks(references, given, background)
    shadows: Mapping[str, np.ndarray] = {}
    if params.refit_steps:
        trusted, background, shadows = remove_shadows(trusted, draft.gaussians, background)
    extra: list[Reference] = []
    extra_depths: dict[str, np.ndarray] = {}
    if params.extra_views:
        painter = feedforward.load_inpainter(params.inpainter, params.device)
        draft, extra, extra_depths = complete_extra_views(params, draft, background, trusted, painter)
    return Filling(
        draft, filling.floaters, depths, extra_depths, restricted, shadows, extra, [*trusted, *extra], background
    )


def _refit(params: Params, filled: Filling, space: Workspace, references: Sequence[Reference], work: Path) -> Draft:
    """Refit a filled scene to photographs, completed views, and references warped to other views; delete `work`."""
    assert filled.background is not None
    work.mkdir(exist_ok=True)
    has_exact_depth = all(each.depth is not None for each in references)
    warped = warp_references(filled.draft, filled.trusted, filled.depths, filled.background.cameras)
    completed, sets = [*filled.trusted, *warped], space.mask_sets | filled.restricted
    draft = refit_draft(
        filled.draft, params.refit_steps, space.scene, filled.background, completed, sets, has_exact_depth, work
    )
    shutil.rmtree(work)
    return draft


def extend_given_masks(
    references: Sequence[Reference], given: Collection[str], background: Background
) -> list[Reference]:
    """Return all references; the masks of those that the scene brings (`given`) are extended by the consistent mask C.

    A reference that the scene brings shows all of C better than the Gaussians do. A reference that was completed here
    is trusted only where it was invented, so its mask stays as it is.

    Args:
        background: holds C of each view as its masks.
    """
    extend = lambda each: replace(each, mask=each.mask | background.masks[each.camera.name])
    return [extend(each) if each.camera.name in given else each for each in references]
