"""Steps of the initialization that work on a whole draft: restricted invent masks, random Gaussians, and the refit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from reffusion import seeding
from reffusion.background.model import Background
from reffusion.initialize import random_init
from reffusion.initialize.draft import Draft
from reffusion.initialize.refit import Supervision, refit
from reffusion.masks import regions, voting
from reffusion.types import MaskSet, Reference, Scene
from reffusion.workspace import Workspace

SEED = 0  # of the refit, and of random Gaussians


def restrict_invent_masks(draft: Draft, sets: Mapping[str, MaskSet], background: Background) -> dict[str, MaskSet]:
    """View name -> its masks with I where the references drew something; only of views whose I reaches beyond C."""
    restricted = {}
    for camera in background.cameras:
        each = sets[camera.name]
        if (each.invent & ~each.consistent).any():
            share = voting.render_labels(draft.gaussians, draft.is_new, camera)
            invent = regions.restrict_to_new(each.invent, each.consistent, share)
            restricted[camera.name] = replace(each, invent=invent)
    return restricted


def add_random(draft: Draft, space: Workspace) -> Draft:
    """The draft with random Gaussians in the region of the hole: around the removed ones, or in the box that the scene
    names."""
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
    count = max(len(removed), random_init.MIN_GAUSSIANS)
    places = seeding.generator(SEED, "initialize", "random")
    points = random_init.sample_points(box, count, train, holes, places)
    colors = seeding.generator(SEED, "initialize", "random colours")
    added = random_init.random_gaussians(points, draft.gaussians.sh.shape[1], draft.gaussians.antialiased, colors)
    return draft.add(added.map(lambda p: p.to(draft.gaussians.means)))


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
    """The draft after `steps` steps of reconstruction.

    Args:
        trusted: completed views, with the pixels that supervise.
        has_exact_depth: new Gaussians lie where depth that the scene brings puts them, and hardly move.
        folder: for the trace and checkpoints of these steps.
    """
    invented = lambda name: sets[name].invent & (name not in scene.clean)  # drawn where no photograph shows it
    views = [view for view in background.views if view.camera.name not in scene.blank]
    hidden = {view.camera.name: view.masked | invented(view.camera.name) for view in views}
    completed = [each for each in trusted if each.mask.any()]
    supervision = Supervision([view.camera for view in views], background.photos, hidden, completed)
    placed = draft.is_new & has_exact_depth
    return Draft(refit(draft.gaussians, placed, supervision, steps, SEED, folder), draft.is_new)
