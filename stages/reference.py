"""The stage `reference`: one or more views completed in 2D, which guide the filling of the hole.

The references are pictures that the scene brings, or else one view that is inpainted here.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reffusion.capture.views import load_placed_views
from reffusion.clicks.sam_onnx import load_distilled_sam
from reffusion.io.arrays import save_json, save_text
from reffusion.io.images import load_image, save_image, save_mask
from reffusion.io.scene import save_references, save_teaching
from reffusion.params.reference import Params
from reffusion.references import view_ranking
from reffusion.references.added_things import find_added_thing
from reffusion.references.adoption import adopt_references
from reffusion.references.completion import Candidates, complete_best_view
from reffusion.references.files import list_teaching_files, load_reference_files
from reffusion.types import Reference
from reffusion.weights.local import segmenter_cache
from reffusion.workspace import Workspace

CANDIDATES = "candidates.png"
TO_PAINT, VIEWS_TO_PAINT = "to_paint", 4  # folder of templates for painting by hand, and the number of views in it


def run(params: Params, out: Path, *, scene: Path, poses: Path, fit: Path, masks: Path) -> None:
    """Run the stage: align the references that the scene brings, or inpaint one view.

    Writes references/<view>.png, masks/<view>.png (the pixels that the reference fills), depth/<view>.exr (for
    references with a depth map), teaching/ (pictures that only personalize the prior) and facts.json. Writes also
    to_paint/ (`save_views_to_paint`) unless scene.yaml names references, and candidates.png and candidates.json if a
    view is inpainted. Painters that take minutes also leave candidates/<number>.png; an interrupted run that goes on
    does not paint these again.

    Args:
        out: folder of this stage.
        scene: folder of the scene.
        poses, fit, masks: folders of the stages of these names.
    """
    space = Workspace(poses, fit, masks)
    files = load_reference_files(scene, load_placed_views(poses), params.reference)
    if files:
        references, fits = adopt_references(files, space)
    else:
        reference, candidates = complete_best_view(params, space, out / "candidates")
        references, fits = [reference], {}
        save_candidates(out, reference.camera.name, candidates)
    save_references(out, references)
    save_teaching(out, {path.stem: load_image(path) for path in list_teaching_files(scene, params.teach)})
    save_json(out / "facts.json", {"given": [each.camera.name for each in references] if files else [], "fits": fits})
    if params.reference is None:
        save_views_to_paint(out / TO_PAINT, [each.view for each in files], space)
    if not files:
        print(describe_choice(reference.camera.name, candidates), flush=True)
        is_patched = "misfits" in candidates.facts  # from photographs, which add nothing new
        if not is_patched and (warning := describe_added_thing(reference)):
            print(warning, flush=True)


def save_views_to_paint(folder: Path, painted: list[str], space: Workspace) -> None:
    """Write templates over which people can paint a reference.

    There is one for each training view in `painted` with something to invent, and for up to `VIEWS_TO_PAINT` others
    that show most of what earlier views do not show of the hole. A view's template is <view>.png, the view without the
    object and gray where it has to be invented, and <view>_mask.png, these pixels (its invent mask I). ranked.txt lists
    the views and how much of the hole each adds to those before it.

    Args:
        folder: where the files are written.
        painted: names of the views that have a reference already; they come first in the ranking.
        space: results of the stages `poses`, `fit` and `masks`.
    """
    train = space.scene.train
    consistent, invent = (
        {name: getattr(space.mask_sets[name], kind) for name in train} for kind in ("consistent", "invent")
    )
    holes = view_ranking.find_holes(space.remaining, [space.scene.cameras[name] for name in train], consistent, invent)
    views = view_ranking.rank_views(holes, painted, VIEWS_TO_PAINT)
    for name in (each.view for each in views):
        save_image(folder / f"{name}.png", view_ranking.painting_template(space.remove_object(name), invent[name]))
        save_mask(folder / f"{name}_mask.png", invent[name])
    if views:
        save_text(folder / "ranked.txt", view_ranking.format_ranking(views, painted))
        names = ", ".join(f"{each.view} ({each.share:.0%})" for each in views)
        print(f"to be painted by hand, and what each covers more: {names}; see {TO_PAINT}/ranked.txt", flush=True)


def describe_choice(view: str, candidates: Candidates) -> str:
    """Return a line that names the sheet of candidates of a view and says how to take another one."""
    where = f"the painting of view {view}: reference/{CANDIDATES}"
    if len(candidates.images) == 1:
        return f"{where}; if it is wrong, save your own as painted/{view}.png in the scene's folder"
    return (
        f"{where}, {len(candidates.images)} candidates from left to right; number {candidates.chosen} (counted from 0) "
        'is taken, set="reference.choose=NUMBER" takes another'
    )


def describe_added_thing(reference: Reference) -> str | None:
    """Return a warning if the painted hole of a reference shows a thing of its own; None if not, or without a network.

    The network is the distilled SAM of the click page. If its files cannot be read, the warning says so.
    """
    try:
        segmenter = load_distilled_sam(segmenter_cache())
    except ValueError as error:
        return f"warning: the painting was not searched for added things: {error}"
    if segmenter is None:
        return None
    thing = find_added_thing(segmenter, reference.image, reference.mask)
    if not thing.any():
        return None
    share = np.count_nonzero(thing & reference.mask) / np.count_nonzero(reference.mask)
    return (
        f"warning: the painting seems to add a thing to the hole of view {reference.camera.name} ({share:.0%} of the "
        "hole); look at it, and take another candidate or prompt if it does not belong there"
    )


def save_candidates(out: Path, view: str, candidates: Candidates) -> None:
    """Write all candidates side by side as candidates.png, and what is known of them as candidates.json."""
    save_image(out / CANDIDATES, np.concatenate(candidates.images, 1))
    save_json(out / "candidates.json", {"view": view, **candidates.facts, "chosen": candidates.chosen})
