"""What distillation starts from: whether SDS runs, the initialization, the adapted prior, and the training views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from reffusion.distill.train_view import ReferenceHole, TrainView
from reffusion.io.arrays import load_json, load_labels
from reffusion.io.images import load_mask
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_references, load_views
from reffusion.params.distill import Params
from reffusion.prior import diffusion, lora
from reffusion.prior.crops import PROMPTS
from reffusion.prior.model import Prior, drop_text_encoders, enable_checkpointing, load_prior
from reffusion.types import Gaussians, Scene
from reffusion.workspace import Workspace


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
    return params.changed({"sds.weight": 0.0}), decision


def load_initialization(
    params: Params, scene: Scene, reference: Path, initialize: Path
) -> tuple[Gaussians, Tensor, list[ReferenceHole]]:
    """The initialization's Gaussians and labels, and the references with their holes, on the device."""
    initial = load_ply(initialize / "gaussians.ply", device=params.device)
    masked = load_labels(initialize / "labels.npy").to(params.device)
    to_device = lambda array: torch.from_numpy(array).to(params.device)
    found = load_references(reference, scene)
    return initial, masked, [ReferenceHole(r.camera, to_device(r.image) / 255, to_device(r.mask)) for r in found]


def load_adapted_prior(params: Params, personalize: Path | None) -> tuple[Prior | None, Tensor | None]:
    """The personalized prior without its text encoder, and the prompts' embeddings; (None, None) if no term uses it."""
    if not params.needs_prior:
        return None, None
    prior = load_prior(params.prior, params.device, params.dtype)
    prior = prior if personalize is None else lora.merge(prior, personalize)
    with torch.no_grad():
        text = diffusion.embed_text(prior, list(PROMPTS) if params.prompts == "sks" else [""] * len(PROMPTS))
    prior = drop_text_encoders(prior)
    return enable_checkpointing(prior) if params.checkpointing else prior, text


def load_train_views(
    params: Params, space: Workspace, initialize: Path | None = None, lift: Path | None = None
) -> list[TrainView]:
    """The training views with the pixels that may supervise, those to repaint, and their images inpainted in 2D.

    Where `initialize` found pixels that the object shadows, these do not supervise; where it reduced a view's invent
    mask, the reduced one counts.
    """
    scene, sets, photos = space.scene, dict(space.mask_sets), space.load_photos(space.scene.train)
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
