"""The stage `reference`: one or more views completed in 2D, which guide the filling of the hole.

The references are pictures that the scene brings, or else one view that is inpainted here.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from reffusion import trace
from reffusion.capture.views import load_placed_views
from reffusion.inpaint import command, exemplar, feedforward, moebius
from reffusion.io.arrays import load_json, save_json, save_text
from reffusion.io.images import load_image, replace_image, save_image, save_mask
from reffusion.io.scene import save_references, save_teaching
from reffusion.params.base import REFINED_FROM
from reffusion.params.inpainter import SEED_KINDS
from reffusion.params.reference import Params
from reffusion.prior import inpaint, memory, pipelines
from reffusion.prior.model import load_prior
from reffusion.references import view_ranking
from reffusion.references.adoption import adopt_references
from reffusion.references.files import list_teaching_files, load_reference_files
from reffusion.types import MaskSet, Reference
from reffusion.weights import painters
from reffusion.workspace import Workspace

CANDIDATES, CANDIDATES_RECORD = "candidates.png", "candidates.json"
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
        references, fits = [inpaint_reference(params, out, space)], {}
    save_references(out, references)
    save_teaching(out, {path.stem: load_image(path) for path in list_teaching_files(scene, params.teach)})
    save_json(out / "facts.json", {"given": [each.camera.name for each in references] if files else [], "fits": fits})
    if params.reference is None:
        save_views_to_paint(out / TO_PAINT, [each.view for each in files], space)
    if not files:
        print(describe_choice(load_json(out / CANDIDATES_RECORD)), flush=True)


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


def inpaint_reference(params: Params, out: Path, space: Workspace) -> Reference:
    """Inpaint the view that the stage `masks` selected as the best one, and return it as a reference.

    Outside the consistent mask C the reference is the photograph. In C it is a rendering of the remaining Gaussians
    (those without the object). In the invent mask I it is the inpainter's picture. Except with the diffusion prior,
    this is also the case in narrow parts of C and along the edge of C next to I. The mask of the reference is I.

    Args:
        out: folder of this stage, for the candidates.
        space: results of the stages `poses`, `fit` and `masks`.

    Raises:
        ValueError: only views without a photograph have pixels to invent, or `params.choose` is not the number of a
            candidate.
    """
    name = space.facts["best_reference"]
    if name is None:
        raise ValueError(
            "only views without a photograph have pixels to invent, and they cannot be completed here; name a training "
            "view as `reference` in scene.yaml"
        )
    if params.choose is not None and params.choose >= params.candidates:
        raise ValueError(f"reference.choose is {params.choose}, but candidates are counted 0..{params.candidates - 1}")
    camera, masks = space.scene.cameras[name], space.mask_sets[name]
    base = space.remove_object(name)
    if params.inpainter.kind == "diffusion":
        image = inpaint_by_prior(params, out, base, name, masks)
    elif painter := feedforward.load_inpainter(params.inpainter, params.device):
        image = painter.paint(base, exemplar.mask_to_paint(masks.consistent, masks.invent))
        save_candidates(out, [image], {"view": name, "painter": painter.name, "chosen": 0})
    elif params.inpainter.kind in SEED_KINDS:
        image = inpaint_by_seeds(params, out, base, name, masks)
    else:
        image = inpaint_by_patches(params, out, base, name, space)
    return Reference(camera, image, masks.invent)


def inpaint_by_patches(params: Params, out: Path, base: np.ndarray, name: str, space: Workspace) -> np.ndarray:
    """Fill the hole of a view from patches of the photographs, once per seed, and return the chosen candidate.

    The hole is the invent mask I, with narrow parts of the consistent mask C and the edge of C next to it. The
    candidate of least misfit is chosen, unless `params.choose` is the number of another one. All candidates are
    written.

    Args:
        out: folder of this stage, for the candidates.
        base: uint8 [H, W, 3], the view without the object.
        name: name of the view.
        space: results of the stages `poses`, `fit` and `masks`.

    Returns:
        uint8 [H, W, 3].
    """
    camera, masks = space.scene.cameras[name], space.mask_sets[name]
    hole = exemplar.mask_to_paint(masks.consistent, masks.invent)
    seeds = [params.seed + index for index in range(params.candidates)]
    completions = exemplar.complete_view(base, hole, camera, masks.consistent, space.background, seeds)
    found = [next(completions) for _ in trace.progress(len(seeds), "reference")]
    misfits = [each.misfit for each in found]
    chosen = int(np.argmin(misfits)) if params.choose is None else params.choose
    save_candidates(out, [each.image for each in found], {"view": name, "misfits": misfits, "chosen": chosen})
    return found[chosen].image


def inpaint_by_prior(params: Params, out: Path, base: np.ndarray, name: str, masks: MaskSet) -> np.ndarray:
    """Inpaint the invent mask I of a view by the diffusion prior, once per seed, and return the chosen candidate.

    The candidate with the least visible seam is chosen, unless `params.choose` is the number of another one. All
    candidates are written.

    Args:
        out: folder of this stage, for the candidates.
        base: uint8 [H, W, 3], the view without the object.
        name: name of the view.
        masks: pixel classes of the view.

    Returns:
        uint8 [H, W, 3].
    """
    prior = load_prior(params.prior, params.device, params.dtype)
    prior = memory.fit_to_memory(prior, params.memory_gb, "reference.memory_gb")
    hole = torch.from_numpy(masks.invent)
    with memory.explain_oom("reference.memory_gb", params.memory_gb):
        candidates = inpaint.paint(
            prior,
            inpaint.to_input(base),
            hole,
            prompt=params.prompt,
            seeds=[params.seed + index for index in range(params.candidates)],
            finest=REFINED_FROM,
            **params.sampler.model_dump(),
        ).cpu()
    seams = inpaint.seam_score(candidates, hole)
    chosen = int(seams.argmin()) if params.choose is None else params.choose
    images = [inpaint.to_picture(each) for each in candidates]
    save_candidates(out, images, {"view": name, "seams": seams.tolist(), "chosen": chosen})
    return images[chosen]


def inpaint_by_seeds(params: Params, out: Path, base: np.ndarray, name: str, masks: MaskSet) -> np.ndarray:
    """Fill the hole of a view by Moebius, a pipeline or a program, once per seed, and return the chosen candidate.

    The hole is that of `inpaint_by_patches`, and the choice that of `inpaint_by_prior`. Each candidate is written when
    it is done, and is not painted again if its file exists.

    Args:
        out: folder of this stage, for the candidates.
        base: uint8 [H, W, 3], the view without the object.
        name: name of the view.
        masks: pixel classes of the view.

    Returns:
        uint8 [H, W, 3].
    """
    hole = exemplar.mask_to_paint(masks.consistent, masks.invent)
    files = [out / "candidates" / f"{number}.png" for number in params.candidate_numbers]
    paint = None
    for index in trace.progress(len(files), "reference"):
        if not files[index].exists():
            paint = paint or load_seed_painter(params)
            replace_image(files[index], paint(base, hole, params.seed + params.candidate_numbers[index]))
    images = [load_image(file) for file in files]
    seams = inpaint.seam_score(torch.stack([inpaint.to_input(each) for each in images]), torch.from_numpy(hole))
    best = int(seams.argmin())
    facts = {"painter": painters.name_seed_painter(params.inpainter), "seams": seams.tolist()}
    save_candidates(out, images, {"view": name, **facts, "chosen": params.candidate_numbers[best]})
    return images[best]


def load_seed_painter(params: Params) -> Callable[[np.ndarray, np.ndarray, int], np.ndarray]:
    """Return the function by which Moebius, a pipeline or a program paints: (image, hole, seed) -> image."""
    asked = params.inpainter
    if asked.kind == "moebius":
        return moebius.load(painters.find_moebius(asked), asked.steps, asked.guidance_scale)
    if asked.kind == "pipeline":
        return pipelines.load_painter(asked, params.prompt, params.device, params.dtype)
    template, program = view_ranking.painting_template, str(asked.command)
    return lambda image, hole, seed: command.paint(program, template(image, hole), hole, params.prompt, seed)


def describe_choice(record: dict) -> str:
    """Return a line that names the sheet of candidates and says how to take another one.

    Args:
        record: the content of candidates.json.
    """
    count = len(record.get("seams") or record.get("misfits") or [0])
    where = f"the painting of view {record['view']}: reference/{CANDIDATES}"
    if count == 1:
        return f"{where}; if it is wrong, save your own as painted/{record['view']}.png in the scene's folder"
    return (
        f"{where}, {count} candidates from left to right; number {record['chosen']} (counted from 0) is taken, "
        'set="reference.choose=NUMBER" takes another'
    )


def save_candidates(out: Path, images: list[np.ndarray], facts: dict) -> None:
    """Write all candidates side by side as candidates.png, and `facts` about them as candidates.json."""
    save_image(out / CANDIDATES, np.concatenate(images, 1))
    save_json(out / CANDIDATES_RECORD, facts)
