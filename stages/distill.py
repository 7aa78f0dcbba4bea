"""distill: optimises the initialization by reconstruction, score distillation and a critic (RefFusion section 4)."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from reffusion import trace
from reffusion.depth import monocular
from reffusion.depth.background_depth import Completion
from reffusion.distill import depth_estimator, perceptual
from reffusion.distill.loop import distill
from reffusion.distill.terms.sds import views_near_references
from reffusion.distill.train_view import ReferenceHole, TrainView
from reffusion.fit import exposure
from reffusion.io.arrays import load_json, load_labels, save_json, save_labels
from reffusion.io.images import load_mask
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_mask_sets, load_references, load_scene, load_views
from reffusion.params.distill import Params
from reffusion.prior import diffusion, lora, memory
from reffusion.prior.crops import PROMPTS
from reffusion.prior.model import Prior, drop_text_encoders, enable_checkpointing, load_prior
from reffusion.splat import rasterizer
from reffusion.types import Gaussians, Scene

MEMORY_PARAM = "distill.memory_gb"  # the parameter that out-of-memory errors name


def run(
    params: Params,
    out: Path,
    *,
    poses: Path,
    fit: Path,
    masks: Path,
    reference: Path,
    personalize: Path | None,
    initialize: Path,
    lift: Path | None = None,
) -> None:
    rasterizer.prepare(params.device)
    began = time.monotonic()
    params, sds_decision = resolve_sds(params, initialize)
    scene = load_scene(poses)
    initial, masked, references = load_initialization(params, scene, reference, initialize)
    prior, text = load_adapted_prior(params, personalize)
    estimator = build_depth_estimator(params, scene.points) if params.depth.weight > 0 else None
    views = load_train_views(params, scene, poses, fit, masks, lift, initialize)
    distance_name, distance = load_lift_distance(params)
    if params.sds.is_on and params.sds.max_angle < 180:
        print(describe_sds_views(params, initial.means[masked], views, references), flush=True)
    with memory.explain_oom(MEMORY_PARAM, params.memory_gb):
        if prior is not None:
            prior = memory.fit_to_memory(prior, params.memory_gb, MEMORY_PARAM, memory.encode_one_sample)
        inputs = initial, masked, views, references, prior, text

        def distill_for(folder: Path, steps: int) -> tuple[Gaussians, Tensor]:
            return distill(*inputs, params.model_copy(update={"iterations": steps}), folder, estimator, distance)

        elapsed = lambda: time.monotonic() - began
        steps = trace.steps_within_budget(out, params.iterations, params.seconds, elapsed, distill_for)
        gaussians, masked = distill_for(out, steps)
    save_ply(out / "gaussians.ply", gaussians.map(lambda p: p.cpu()))
    save_labels(out / "labels.npy", masked.cpu())
    inpainter = load_json(lift / "facts.json")["inpainter"] if lift else None
    save_json(out / "facts.json", {"inpainter": inpainter, "perceptual": distance_name, "sds": sds_decision})
    trace.clear_checkpoint(out)


def resolve_sds(params: Params, initialize: Path) -> tuple[Params, str]:
    """Decides whether SDS runs: the parameters, with `sds.weight` 0 if it does not, and the decision in words."""
    if params.sds.weight == 0 or params.sds.run == "always":
        return params, "runs" if params.sds.weight else "weight 0"
    never = {"sds_reason": "distill.sds.run is never"}
    facts = load_json(initialize / "facts.json") if params.sds.run == "auto" else never
    if facts.get("sds_may_gain"):
        return params, f"runs: {facts['sds_reason']}"
    decision = f"left out: {facts['sds_reason']}"
    print(f"SDS {decision}", flush=True)
    return params.model_copy(update={"sds": params.sds.model_copy(update={"weight": 0.0})}), decision


def load_initialization(
    params: Params, scene: Scene, reference: Path, initialize: Path
) -> tuple[Gaussians, Tensor, list[ReferenceHole]]:
    """The initialization's Gaussians and labels, and the references with their holes, on the device."""
    initial = load_ply(initialize / "gaussians.ply").map(lambda p: p.to(params.device))
    masked = load_labels(initialize / "labels.npy").to(params.device)
    to_device = lambda array: torch.from_numpy(array).to(params.device)
    found = load_references(reference, scene)
    references = [ReferenceHole(each.camera, to_device(each.image) / 255, to_device(each.mask)) for each in found]
    return initial, masked, references


def load_adapted_prior(params: Params, personalize: Path | None) -> tuple[Prior | None, Tensor | None]:
    """The personalized prior without its text encoder, and the prompts' embeddings; (None, None) if no term uses it."""
    if not params.needs_prior:
        return None, None
    prior = load_prior(params.prior, device=params.device, dtype=getattr(torch, params.dtype))
    prior = prior if personalize is None else lora.merge(prior, personalize)
    with torch.no_grad():
        text = diffusion.embed_text(prior, list(PROMPTS) if params.prompts == "sks" else [""] * len(PROMPTS))
    prior = drop_text_encoders(prior)
    return enable_checkpointing(prior) if params.checkpointing else prior, text


def load_train_views(
    params: Params,
    scene: Scene,
    poses: Path,
    fit: Path,
    masks: Path,
    lift: Path | None = None,
    initialize: Path | None = None,
) -> list[TrainView]:
    """The training views with the pixels that may supervise, those to repaint, and their images inpainted in 2D.

    Where `initialize` found pixels that the object shadows, these do not supervise; where it reduced a view's invent
    mask, the reduced one counts.
    """
    photos, sets = exposure.load_views(poses, fit, scene.train), load_mask_sets(masks, (*scene.train, *scene.blank))
    to_device = lambda array: torch.from_numpy(array).to(params.device)
    inpainted = load_views(lift, [n for n in scene.train if (lift / "images" / f"{n}.png").exists()]) if lift else {}
    find_masks = lambda folder: {path.stem: path for path in (initialize / folder).glob("*.png")} if initialize else {}
    shadows = find_masks("shadows")
    sets |= {name: replace(sets[name], invent=load_mask(path)) for name, path in find_masks("invent").items()}
    views = []
    for name in (*scene.train, *scene.blank):
        clean, pixels = name in scene.clean, sets[name]
        hidden = pixels.consistent | pixels.invent  # a region to fill is part of the paper's mask m
        repaint = (pixels.invent if params.repaint == "invent" else hidden) & (not clean)
        # C shows the object. Where I reaches beyond C, it is the place of an object to be inserted.
        supervises = (~hidden | clean) & (name not in scene.blank)
        if name in shadows:
            supervises &= ~load_mask(shadows[name])
        lifted = to_device(inpainted[name]) / 255 if name in inpainted else None
        photo = to_device(photos.get(name, np.zeros((*repaint.shape, 3), np.uint8)))
        views.append(TrainView(scene.cameras[name], photo, to_device(supervises), to_device(repaint), clean, lifted))
    return views


def describe_sds_views(params: Params, means: Tensor, views: list[TrainView], references: list[ReferenceHole]) -> str:
    """A sentence that says how many of the views with a hole are distilled. `means`: [M, 3] of masked Gaussians."""
    with_hole = [view for view in views if view.repaint.any()]
    near = views_near_references(with_hole, [each.camera for each in references], means, params.sds.max_angle)
    degrees = f"{params.sds.max_angle:g} degrees"
    return f"SDS in {len(near)} of {len(with_hole)} views: those within {degrees} of a reference"


def load_lift_distance(params: Params) -> tuple[str | None, perceptual.Distance | None]:
    """The name of the perceptual distance for lifted images, and the distance; (None, None) if none is used.

    Raises:
        ValueError: LPIPS weights exist but are broken.
    """
    if not params.lift.weight or params.lift.loss == "mse":
        return None, None
    name, distance = perceptual.load(params.device)
    print(f"perceptual distance: {name}", flush=True)
    return name, distance


def build_depth_estimator(params: Params, points: np.ndarray) -> depth_estimator.DepthEstimator:
    """The depth term's estimator: by a network if one is named, else the scene's own depth continued.

    Args:
        points: [P, 3], the scene's sparse points.
    """
    # PAPER leaves open: whether an estimate is aligned by least squares or robustly on known pixels; least squares.
    how = Completion(robust=False, seed=params.seed)
    if not params.depth.model:
        return depth_estimator.continuation_estimator(points, how)
    network = monocular.load_network(params.depth.model, params.device)
    return depth_estimator.network_estimator(partial(monocular.predict_disparity, network), how)
