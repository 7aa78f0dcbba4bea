"""Inputs of the stage `distill`: the initialization, the adapted prior, and the training views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from reffusion.distill.train_view import ReferenceHole, TrainView
from reffusion.io.arrays import load_labels
from reffusion.io.images import load_mask
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_references, load_views
from reffusion.params.distill import Params
from reffusion.prior import diffusion, lora
from reffusion.prior.model import Prior, drop_text_encoders, enable_checkpointing, load_prior
from reffusion.types import Gaussians, Scene
from reffusion.workspace import Workspace


def load_initialization(
    params: Params, scene: Scene, reference: Path, initialize: Path
) -> tuple[Gaussians, Tensor, list[ReferenceHole]]:
    """Load the Gaussians of the initialization, their labels, and the references, onto the device of the parameters.

    Args:
        params: Parameters of the stage `distill`.
        scene: The scene with its cameras.
        reference: The folder of the stage `reference`.
        initialize: The folder of the stage `initialize`.

    Returns:
        The Gaussians; the labels, bool [N], True for masked Gaussians (the new ones); and the references with their
            holes.
    """
    initial = load_ply(initialize / "gaussians.ply", device=params.device)
    masked = load_labels(initialize / "labels.npy").to(params.device)
    to_device = lambda array: torch.from_numpy(array).to(params.device)
    found = load_references(reference, scene)
    return initial, masked, [ReferenceHole(r.camera, to_device(r.image) / 255, to_device(r.mask)) for r in found]


def load_adapted_prior(params: Params, personalize: Path | None) -> tuple[Prior | None, Tensor | None]:
    """Load the prior, personalized if a LoRA is given, without its text encoder, and the embeddings of the prompts.

    Args:
        params: Parameters of the stage `distill`.
        personalize: The folder of the stage `personalize`, whose LoRA is merged into the prior. None if the prior is
            not adapted.

    Returns:
        The prior, and [3, L, D], the embeddings of the global, the local and the empty prompt. (None, None) if no term
            uses the prior.
    """
    if not params.needs_prior:
        return None, None
    prior = load_prior(params.prior, params.device, params.dtype)
    prior = prior if personalize is None else lora.merge(prior, personalize)
    with torch.no_grad():
        text = diffusion.embed_text(prior, params.prompts.texts)
    prior = drop_text_encoders(prior)
    return enable_checkpointing(prior) if params.checkpointing else prior, text


def load_train_views(
    params: Params, space: Workspace, initialize: Path | None = None, lift: Path | None = None
) -> list[TrainView]:
    """Load the training views, and after them the camera-only views, which supervise nothing.

    A view holds its photograph, the pixels that may supervise (those outside C and I, in a clean view all, without
    shadows and ignored pixels), the pixels to repaint (as `params.repaint` says; none in a clean view), and its lifted
    image. The photo of a camera-only view is black. If `initialize` reduced the invent mask of a view, the reduced mask
    is used.

    Args:
        params: Parameters of the stage `distill`.
        space: The results of the earlier stages.
        initialize: The folder of the stage `initialize`. None: there are no shadows and no reduced masks.
        lift: The folder of the stage `lift`, which inpaints training views in 2D. None: no view has a lifted image.
    """
    scene, sets, photos = space.scene, dict(space.mask_sets), space.load_photos(space.scene.train)
    to_device = lambda array: torch.from_numpy(array).to(params.device)
    inpainted = load_views(lift, [n for n in scene.train if (lift / "images" / f"{n}.png").exists()]) if lift else {}
    find_masks = lambda folder: {path.stem: path for path in (initialize / folder).glob("*.png")} if initialize else {}
    shadows = find_masks("shadows")
    sets |= {name: replace(sets[name], invent=load_mask(path)) for name, path in find_masks("invent").items()}
    views = []
    for name in (*scene.train, *scene.camera_only):
        clean, pixels = name in scene.clean, sets[name]
        hidden = pixels.consistent | pixels.invent  # a region to fill is part of the paper's mask m
        repaint = (pixels.invent if params.repaint == "invent" else hidden) & (not clean)
        # C shows the object. Pixels of I outside C are the place of an object to be inserted.
        supervises = (~hidden | clean) & (name not in scene.camera_only)
        if name in space.ignored:
            supervises &= ~space.ignored[name]
        if name in shadows:
            supervises &= ~load_mask(shadows[name])
        lifted = to_device(inpainted[name]) / 255 if name in inpainted else None
        photo = to_device(photos.get(name, np.zeros((*repaint.shape, 3), np.uint8)))
        views.append(TrainView(scene.cameras[name], photo, to_device(supervises), to_device(repaint), clean, lifted))
    return views
