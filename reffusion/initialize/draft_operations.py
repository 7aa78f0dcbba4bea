"""Steps of the initialization that work on a whole draft (the scene while it is filled).

These are the restriction of invent masks, the random Gaussians of an ablation, and the refit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from reffusion import seeding
from reffusion.background.model import Background
from reffusion.initialize import random_init
from reffusion.initialize.draft import RANDOM, Draft
from reffusion.initialize.refit import Supervision, refit
from reffusion.masks import regions, voting
from reffusion.types import MaskSet, Reference, Scene
from reffusion.workspace import Workspace

SEED = 0  # seed of the refit and of the random Gaussians


def restrict_invent_masks(draft: Draft, sets: Mapping[str, MaskSet], background: Background) -> dict[str, MaskSet]:
    """Return pixel classes whose invent mask I is restricted outside C to the pixels that show new Gaussians.

    The new Gaussians are those of the references.

    C is the consistent mask (the removed object's pixels). I reaches beyond C where the scene asks to fill a region.
    There the photographs are right wherever the references added nothing. Inside C, I stays as it is.

    Args:
        draft: the scene with the references' Gaussians.
        sets: view name -> pixel classes.
        background: its cameras are the views to examine.

    Returns:
        View name -> pixel classes with the restricted I, for the views whose I reaches beyond C.
    """
    restricted = {}
    for camera in background.cameras:
        each = sets[camera.name]
        if (each.invent & ~each.consistent).any():
            share = voting.render_labels(draft.gaussians, draft.is_new, camera)
            invent = regions.restrict_to_new(each.invent, each.consistent, share)
            restricted[camera.name] = replace(each, invent=invent)
    return restricted


def add_random(draft: Draft, space: Workspace, count: int) -> Draft:
    """Return the draft with up to `count` random Gaussians added where a box projects into the invent masks.

    The box is the one that scene.yaml names (`region`), or else the bounding box of the object's Gaussians. Fewer
    Gaussians are added if the box hardly meets the invent masks (`random_init.sample_points`).

    Raises:
        ValueError: there is neither a region nor an object, or the box does not meet the invent masks.
    """
    scene, region = space.scene, space.facts.get("region")
    removed = space.gaussians.map(lambda p: p[space.object_labels])
    if region:
        box = random_init.box_at(region["center"], region["size"])
    elif len(removed):
        box = random_init.bounding_box(removed.means.double().cpu().numpy())
    else:
        raise ValueError("initialize.start is 'random', but no Gaussian was removed: nothing says where the hole is")
    train = [scene.cameras[name] for name in scene.train]
    holes = {name: space.mask_sets[name].invent for name in scene.train if space.mask_sets[name].invent.any()}
    places = seeding.generator(SEED, "initialize", "random")
    points = random_init.sample_points(box, count, train, holes, places)
    colors = seeding.generator(SEED, "initialize", "random colours")
    added = random_init.random_gaussians(points, draft.gaussians.sh.shape[1], draft.gaussians.antialiased, colors)
    return draft.add(added.map(lambda p: p.to(draft.gaussians.means)), RANDOM)


def refit_draft(
    draft: Draft,
    steps: int,
    scene: Scene,
    background: Background,
    trusted: Sequence[Reference],
    sets: Mapping[str, MaskSet],
    has_exact_depth: bool,
    folder: Path,
) -> Draft:
    """Return the draft after a refit: `steps` steps of reconstruction, in which all Gaussians move (`refit.refit`).

    Photographs supervise outside the object, the given masks and the invent masks: what a given mask marks beyond the
    object is its border or its shadow more often than background. Completed views supervise inside their masks.

    Args:
        draft: the filled scene.
        steps: number of optimization steps, one view each.
        scene: tells which views are clean (the object is absent) and which have no photograph.
        background: holds the photographs and where they show the object.
        trusted: completed views; the mask of each marks the pixels that supervise. Empty masks are allowed.
        sets: view name -> pixel classes.
        has_exact_depth: True if each reference has a depth map of its own. Then the new Gaussians hardly move.
        folder: receives the trace and the checkpoints; a run that was interrupted resumes from its checkpoint.
    """
    invented = lambda name: sets[name].invent & (name not in scene.clean)  # no photograph shows these pixels
    views = [view for view in background.views if view.camera.name not in scene.camera_only]
    hidden = {name: view.masked | sets[name].raw | invented(name) for view in views if (name := view.camera.name)}
    completed = [each for each in trusted if each.mask.any()]
    supervision = Supervision([view.camera for view in views], background.photos, hidden, completed)
    placed = draft.is_new & has_exact_depth
    return Draft(refit(draft.gaussians, placed, supervision, steps, SEED, folder), draft.origin)
