"""The stage `fit`: 3D Gaussians are fitted to the photographs, object included.

If the scene brings Gaussians, these are used as they are instead, except in the baseline that fits unmasked pixels.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from reffusion import trace
from reffusion.fit import few_views
from reffusion.fit.preparation import (
    collect_points,
    equalize_exposure,
    estimate_exposures,
    limit_gaussians,
    limit_sh_degree,
    make_gaussians,
    start_on_surfaces,
)
from reffusion.fit.reconstruction import fit
from reffusion.fit.step import REFIT_RATES
from reffusion.inpaint import classical
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_ignored, load_raw_masks, load_scene, load_views
from reffusion.params.fit import Params
from reffusion.splat import rasterizer
from reffusion.types import Scene


def run(params: Params, out: Path, *, poses: Path, raw_masks: Path | None = None) -> None:
    """Run the stage: fit Gaussians to the training views, without those that `params.holdout` reserves for evaluation.

    Writes gaussians.ply (normalized frame), trace.jsonl and, if exposures are fitted, exposures.json. An interrupted
    fit resumes from the checkpoint in `out`. If the scene brings Gaussians and `params.pixels` is "all", these become
    gaussians.ply and nothing is fitted.

    Args:
        out: folder of this stage.
        poses, raw_masks: folders of the stages of these names. `raw_masks` is only used for the baseline with
            `params.pixels` = "unmasked", which ignores masked pixels, and is None otherwise.
    """
    if (poses / "gaussians.ply").exists() and params.pixels == "all":
        save_ply(out / "gaussians.ply", load_ply(poses / "gaussians.ply"))
        return
    rasterizer.prepare(params.device)
    began, scene = time.monotonic(), load_scene(poses)
    params = limit_sh_degree(params, scene)
    held_out_names = scene.train[params.holdout // 2 :: params.holdout] if params.holdout else ()
    cameras = [scene.cameras[name] for name in scene.train if name not in held_out_names]
    images = load_views(poses, scene.train)
    hidden = load_ignored(poses, scene.train)
    if params.pixels == "unmasked":
        assert raw_masks is not None
        masks = load_hidden_pixels(raw_masks, scene)
        hidden |= {name: mask | hidden.get(name, mask) for name, mask in masks.items()}
    if hidden:
        hidden = {name: hidden.get(name, np.zeros(image.shape[:2], bool)) for name, image in images.items()}
    # Masked pixels are inpainted (Telea), because optical flow reads them although they do not supervise.
    images |= {name: classical.telea(images[name], mask) for name, mask in hidden.items()}
    gains = estimate_exposures(params, scene, cameras, images)
    equalized = images if gains is None else equalize_exposure(images, cameras, gains)
    params, initial = limit_gaussians(params, cameras), start_on_surfaces(params, scene, cameras, equalized, hidden)
    rates = None
    if initial is not None:
        params, rates = few_views.shorten_schedule(params), REFIT_RATES
    elif (out / trace.CHECKPOINT).exists():  # on a resume only the degree and the device of the initial ones matter
        initial = make_gaussians(params, scene.points, scene.point_colors)
    else:
        initial = make_gaussians(params, *collect_points(params, scene, cameras, equalized, hidden))
    views = (cameras, images, initial)
    weights = {name: ~mask for name, mask in hidden.items()}
    elapsed, with_steps = lambda: time.monotonic() - began, lambda steps: params.changed({"iterations": steps})
    same: dict[str, Any] = {"weights": weights, "rates": rates, "gains": gains}
    run_fit = lambda folder, steps: fit(*views, with_steps(steps), folder=folder, **same)
    steps = trace.steps_within_budget(out, params.iterations, params.seconds, elapsed, run_fit)
    held_out = [scene.cameras[name] for name in held_out_names]
    gaussians = fit(*views, with_steps(steps), folder=out, held_out=held_out, spent=elapsed(), **same)
    save_ply(out / "gaussians.ply", gaussians.map(lambda p: p.cpu()))
    trace.clear_checkpoint(out)


def load_hidden_pixels(raw_masks: Path, scene: Scene) -> dict[str, np.ndarray]:
    """Read the pixels that do not supervise in the baseline `pixels: unmasked`: the raw masks of the training views.

    Args:
        raw_masks: folder of the stage `raw_masks`.

    Returns:
        View name -> bool [H, W], True = the object, i.e. does not supervise. Views without a mask, and clean views
        (without the object), have no entry.

    Raises:
        ValueError: no view has a mask.
    """
    masks = load_raw_masks(raw_masks, [name for name in scene.train if name not in scene.clean])
    if not masks:
        raise ValueError(f"{raw_masks / 'masks'}: fit.pixels is 'unmasked', but the scene has no masks")
    return masks
