"""distill: reconstruction, multi-scale score distillation and a critic, each confined (RefFusion section 4)."""

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
from reffusion.distill import depth_term, perceptual
from reffusion.distill.confinement import TrainView
from reffusion.distill.optimization import distill
from reffusion.distill.steps import near_a_reference
from reffusion.fit import exposure
from reffusion.io.arrays import load_json, load_labels, save_json, save_labels
from reffusion.io.images import load_mask
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_mask_sets, load_references, load_scene, load_views
from reffusion.params.distill import Params
from reffusion.prior import diffusion, lora, memory
from reffusion.prior.crops import PROMPTS
from reffusion.prior.model import Prior, load_prior, recomputing, without_text
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Scene

MEMORY = "distill.memory_gb"  # what an error names
Hole = tuple[Camera, Tensor, Tensor]  # of a reference: camera, image [H, W, 3] in [0, 1], hole [H, W] bool


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
    params, said = without_sds(params, initialize)
    scene = load_scene(poses)
    initial, masked, holes = start(params, scene, reference, initialize)
    prior, text = adapted_prior(params, personalize)
    estimator = depth_estimator(params, scene.points) if params.depth.weight > 0 else None
    views = train_views(params, scene, poses, fit, masks, lift, initialize)
    named, distance = lift_distance(params)
    if params.sds.weight > 0 and params.sds.within < 180:
        print(within(params, initial.means[masked], views, holes), flush=True)
    with memory.blamed(MEMORY, params.memory_gb):
        if prior is not None:
            prior = memory.fitted(prior, params.memory_gb, MEMORY, memory.encoding)
        given = initial, masked, views, holes, prior, text

        def made(folder: Path, steps: int) -> tuple[Gaussians, Tensor]:
            return distill(*given, params.model_copy(update={"iterations": steps}), folder, estimator, distance)

        steps = trace.affordable(out, params.iterations, params.seconds, lambda: time.monotonic() - began, made)
        gaussians, masked = made(out, steps)
    save_ply(out / "gaussians.ply", gaussians.map(lambda p: p.cpu()))
    save_labels(out / "labels.npy", masked.cpu())
    painted = load_json(lift / "facts.json")["inpainter"] if lift else None
    save_json(out / "facts.json", {"inpainter": painted, "perceptual": named, "sds": said})
    trace.clear_checkpoint(out)


def without_sds(params: Params, initialize: Path) -> tuple[Params, str]:
    """The parameters, of SDS the weight 0 where it is not to run, and in words whether it runs."""
    if params.sds.weight == 0 or params.sds.run == "always":
        return params, "runs" if params.sds.weight else "weight 0"
    never = {"sds_reason": "distill.sds.run is never"}
    told = load_json(initialize / "facts.json") if params.sds.run == "auto" else never
    if told.get("sds_may_gain"):
        return params, f"runs: {told['sds_reason']}"
    said = f"left out: {told['sds_reason']}"
    print(f"SDS {said}", flush=True)
    return params.model_copy(update={"sds": params.sds.model_copy(update={"weight": 0.0})}), said


def start(params: Params, scene: Scene, reference: Path, initialize: Path) -> tuple[Gaussians, Tensor, list[Hole]]:
    """The initialization's Gaussians and labels, and the holes of the references, on the device."""
    initial = load_ply(initialize / "gaussians.ply").map(lambda p: p.to(params.device))
    masked = load_labels(initialize / "labels.npy").to(params.device)
    place = lambda array: torch.from_numpy(array).to(params.device)
    holes = [(r.camera, place(r.image) / 255, place(r.mask)) for r in load_references(reference, scene)]
    return initial, masked, holes


def adapted_prior(params: Params, personalize: Path | None) -> tuple[Prior | None, Tensor | None]:
    """The prior with what it learnt, without its text encoder, and the prompts' embeddings; None, None if unused."""
    if not (params.sds.weight > 0 or params.depth.weight > 0):
        return None, None
    prior = load_prior(params.prior, device=params.device, dtype=getattr(torch, params.dtype))
    prior = prior if personalize is None else lora.merged(prior, personalize)
    with torch.no_grad():
        text = diffusion.embed_text(prior, list(PROMPTS) if params.prompts == "sks" else [""] * len(PROMPTS))
    prior = without_text(prior)
    return recomputing(prior) if params.checkpointing else prior, text


def train_views(
    params: Params,
    scene: Scene,
    poses: Path,
    fit: Path,
    masks: Path,
    lift: Path | None = None,
    initialize: Path | None = None,
) -> list[TrainView]:
    """The training views with the pixels that may supervise, those to repaint, and their pictures inpainted in 2D.

    `initialize` may know of pixels that the object had shadowed, which may not supervise, and of fewer to repaint.
    """
    photos, sets = exposure.load_views(poses, fit, scene.train), load_mask_sets(masks, (*scene.train, *scene.blank))
    place = lambda array: torch.from_numpy(array).to(params.device)
    painted = load_views(lift, [n for n in scene.train if (lift / "images" / f"{n}.png").exists()]) if lift else {}
    known = lambda folder: {path.stem: path for path in (initialize / folder).glob("*.png")} if initialize else {}
    shadowed = known("shadows")
    sets |= {name: replace(sets[name], invent=load_mask(path)) for name, path in known("invent").items()}
    views = []
    for name in (*scene.train, *scene.blank):
        clean, pixels = name in scene.clean, sets[name]
        drawn = pixels.consistent | pixels.invent  # a region that is filled is part of the paper's m
        repaint = (pixels.invent if params.repaint == "invent" else drawn) & (not clean)
        # C shows the object; I, where it reaches beyond C, the place of one that is to be drawn there.
        supervises = (~drawn | clean) & (name not in scene.blank)
        if name in shadowed:
            supervises &= ~load_mask(shadowed[name])
        lifted = place(painted[name]) / 255 if name in painted else None
        photo = place(photos.get(name, np.zeros((*repaint.shape, 3), np.uint8)))
        views.append(TrainView(scene.cameras[name], photo, place(supervises), place(repaint), clean, lifted))
    return views


def within(params: Params, means: Tensor, views: list[TrainView], holes: list[Hole]) -> str:
    """How many of the views that could be distilled are."""
    painted = [view for view in views if view.repaint.any()]
    near = near_a_reference(painted, [camera for camera, _, _ in holes], means, params.sds.within)
    return f"SDS in {len(near)} of {len(painted)} views: those within {params.sds.within:g} degrees of a reference"


def lift_distance(params: Params) -> tuple[str | None, perceptual.Distance | None]:
    """The perceptual distance of lifted pictures, its name first; None, None where none is used.

    Raises ValueError where LPIPS weights are there but broken.
    """
    if not params.lift.weight or params.lift.loss == "mse":
        return None, None
    name, distance = perceptual.load(params.device)
    print(f"perceptual distance: {name}", flush=True)
    return name, distance


def depth_estimator(params: Params, points: np.ndarray) -> depth_term.Estimator:
    """The depth term's estimator: by a network where one is named, else the scene's own depth continued."""
    # PAPER leaves open: whether an estimate is aligned plainly or robustly on known pixels; plainly, by squared error.
    how = Completion(robust=False, seed=params.seed)
    if not params.depth.model:
        return depth_term.by_continuation(points, how)
    network = monocular.load_network(params.depth.model, params.device)
    return depth_term.by_network(partial(monocular.disparity, network), how)
