"""Completion of one view in 2D, for a scene that brings no reference: the inpainter, its candidates, and the choice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from reffusion import trace
from reffusion.inpaint import command, exemplar, feedforward, moebius
from reffusion.inpaint.classical import Painter
from reffusion.io.images import load_image, replace_image
from reffusion.params.base import REFINED_FROM
from reffusion.params.inpainter import SEED_KINDS
from reffusion.params.reference import Params
from reffusion.prior import inpaint, memory, pipelines
from reffusion.prior.model import load_prior
from reffusion.references.view_ranking import painting_template
from reffusion.types import MaskSet, Reference
from reffusion.weights import painters
from reffusion.workspace import Workspace


@dataclass(frozen=True)
class Candidates:
    """Paintings of the hole of one view, and the chosen one.

    Attributes:
        images: uint8 [H, W, 3] each, the completed views.
        chosen: number of the chosen candidate, counted from 0 over all seeds, painted or not.
        image: uint8 [H, W, 3], the chosen candidate.
        facts: what is recorded about them: the scores, lower is better ("misfits" of patches, or visible "seams"), or
            the name of the "painter".
    """

    images: Sequence[np.ndarray]
    chosen: int
    image: np.ndarray
    facts: dict[str, Any]

    @classmethod
    def by_score(
        cls,
        images: Sequence[np.ndarray],
        numbers: Sequence[int],
        scores: Sequence[float],
        choose: int | None,
        facts: dict[str, Any],
    ) -> Candidates:
        """Choose the candidate with the lowest score; if `choose` is not None, the one whose number is `choose`."""
        index = int(np.argmin(scores)) if choose is None else list(numbers).index(choose)
        return cls(images, numbers[index], images[index], facts)


def complete_best_view(params: Params, space: Workspace, folder: Path) -> tuple[Reference, Candidates]:
    """Inpaint the view that the stage `masks` selected as the best one.

    Outside the consistent mask C the reference is the photograph. In C it is a rendering of the remaining Gaussians
    (those without the object). In the invent mask I it is the inpainter's picture. Except with the diffusion prior,
    this is also the case in narrow parts of C and along the edge of C next to I (`exemplar.mask_to_paint`).

    Args:
        params: parameters of the stage `reference`.
        space: results of the stages `poses`, `fit` and `masks`.
        folder: folder of candidates that take minutes. Candidates in it are not painted again.

    Returns:
        The reference, whose mask is I, and all candidates.

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
    masks, base = space.mask_sets[name], space.remove_object(name)
    if params.inpainter.kind == "diffusion":
        painted = _paint_by_prior(params, base, masks.invent)
    elif painter := feedforward.load_inpainter(params.inpainter, params.device):
        painted = _paint_once(painter, base, masks)
    elif params.inpainter.kind in SEED_KINDS:
        painted = _paint_by_seeds(params, base, masks, folder)
    else:
        painted = _paint_by_patches(params, base, masks, name, space)
    return Reference(space.scene.cameras[name], painted.image, masks.invent), painted


def _paint_by_patches(params: Params, base: np.ndarray, masks: MaskSet, name: str, space: Workspace) -> Candidates:
    """Fill the hole from patches of the photographs, once per seed."""
    hole = exemplar.mask_to_paint(masks.consistent, masks.invent)
    numbers = range(params.candidates)
    seeds = [params.seed + number for number in numbers]
    camera = space.scene.cameras[name]
    completions = exemplar.complete_view(base, hole, camera, masks.consistent, space.background, seeds)
    found = [next(completions) for _ in trace.progress(len(seeds), "reference")]
    misfits = [each.misfit for each in found]
    return Candidates.by_score([each.image for each in found], numbers, misfits, params.choose, {"misfits": misfits})


def _paint_by_prior(params: Params, base: np.ndarray, invent: np.ndarray) -> Candidates:
    """Inpaint the invent mask I by the diffusion prior, once per seed."""
    prior = load_prior(params.prior, params.device, params.dtype)
    prior = memory.fit_to_memory(prior, params.memory_gb, "reference.memory_gb")
    hole, numbers = torch.from_numpy(invent), range(params.candidates)
    with memory.explain_oom("reference.memory_gb", params.memory_gb):
        painted = inpaint.paint(
            prior,
            inpaint.to_input(base),
            hole,
            prompt=params.prompt,
            seeds=[params.seed + number for number in numbers],
            finest=REFINED_FROM,
            **params.sampler.model_dump(),
        ).cpu()
    seams = inpaint.seam_score(painted, hole).tolist()
    images = [inpaint.to_picture(each) for each in painted]
    return Candidates.by_score(images, numbers, seams, params.choose, {"seams": seams})


def _paint_by_seeds(params: Params, base: np.ndarray, masks: MaskSet, folder: Path) -> Candidates:
    """Fill the hole by Moebius, a pipeline or a program, once per seed; candidates that `folder` holds are kept."""
    hole = exemplar.mask_to_paint(masks.consistent, masks.invent)
    numbers = params.candidate_numbers
    files = [folder / f"{number}.png" for number in numbers]
    paint = None
    for index in trace.progress(len(files), "reference"):
        if not files[index].exists():
            paint = paint or load_seed_painter(params)
            replace_image(files[index], paint(base, hole, params.seed + numbers[index]))
    images = [load_image(file) for file in files]
    pictures = torch.stack([inpaint.to_input(each) for each in images])
    seams = inpaint.seam_score(pictures, torch.from_numpy(hole)).tolist()
    facts = {"seams": seams, "painter": painters.name_seed_painter(params.inpainter)}
    return Candidates.by_score(images, numbers, seams, params.choose, facts)


def _paint_once(painter: Painter, base: np.ndarray, masks: MaskSet) -> Candidates:
    """Fill the hole by an inpainter that has no seed."""
    image = painter.paint(base, exemplar.mask_to_paint(masks.consistent, masks.invent))
    return Candidates([image], 0, image, {"painter": painter.name})


def load_seed_painter(params: Params) -> Callable[[np.ndarray, np.ndarray, int], np.ndarray]:
    """Return the function by which Moebius, a pipeline or a program paints: (image, hole, seed) -> image.

    Raises:
        ValueError: the weights are missing, damaged or of another kind.
    """
    asked = params.inpainter
    if asked.kind == "moebius":
        return moebius.load(painters.find_moebius(asked), asked.steps, asked.guidance_scale)
    if asked.kind == "pipeline":
        return pipelines.load_painter(asked, params.prompt, params.device, params.dtype)
    program = str(asked.command)
    return lambda image, hole, seed: command.paint(program, painting_template(image, hole), hole, params.prompt, seed)
