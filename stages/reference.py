"""reference: views completed in 2D; the scene's own pictures taken over, or one view inpainted by the prior."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from reffusion.capture.lenses import load_lenses
from reffusion.capture.views import placed_views
from reffusion.fit import exposure
from reffusion.inpaint import exemplar, feedforward
from reffusion.inpaint.classical import Painter
from reffusion.io.arrays import load_json, load_labels, save_json, save_text
from reffusion.io.files import BadInput
from reffusion.io.images import save_image, save_mask
from reffusion.io.ply import load_ply
from reffusion.io.scene import has_photograph, load_mask_sets, load_object, load_scene, load_views, save_references
from reffusion.masks import shadows
from reffusion.params.base import REFINED_FROM
from reffusion.params.reference import Params
from reffusion.prior import inpaint, memory
from reffusion.prior.model import load_prior
from reffusion.references import agreement, color, registration, view_ranking
from reffusion.references.files import GivenReference, load_given
from reffusion.references.registration import Registration
from reffusion.references.undistort import load_straight, load_straight_depth
from reffusion.types import Camera, MaskSet, Reference, Scene
from reffusion.weights import painters
from reffusion.weights.published import PAINTERS

TO_PAINT, VIEWS_TO_PAINT = "to_paint", 4
MARGIN, BLEND = 0.01, 0.01  # of it: taken from a reference from elsewhere around the hole, and blended beyond
WHOLE = 0.9  # share of the hole that a reference from elsewhere must have
NEIGHBOURS = 4  # nearest views whose photographs a reference that fits its own is compared with


def run(params: Params, out: Path, *, scene: Path, poses: Path, fit: Path, masks: Path) -> None:
    """Write references/, masks/, depth/ and facts.json; to_paint/, unless scene.yaml names the references; and
    candidates.png and candidates.json, where it is painted here."""
    placed, given = load_scene(poses), load_given(scene, placed_views(poses), params.reference)
    if given:
        references, fits = taken_over(given, placed, poses, fit, masks)
    else:
        references, fits = [inpainted(params, out, placed, poses, fit, masks)], {}
    save_references(out, references)
    save_json(out / "facts.json", {"given": [each.camera.name for each in references] if given else [], "fits": fits})
    if params.reference is None:
        lay_out(out / TO_PAINT, [each.view for each in given], placed, poses, fit, masks)


def taken_over(
    given: list[GivenReference], scene: Scene, poses: Path, fit: Path, masks: Path
) -> tuple[list[Reference], dict[str, str]]:
    """The scene's own references, each standing for the invent mask of its view, of a clean one for the consistent
    mask, and exposed as its photograph is; and view name -> how well it fits its photograph, in words."""
    references, fits = [], {}
    for each in given:
        sets = load_mask_sets(masks, [each.view])[each.view]
        # A clean photograph shows what elsewhere has to be invented.
        sets = replace(sets, invent=sets.consistent) if each.view in scene.clean else sets
        if sets.invent.any() or each.view in scene.clean:  # one without a hole teaches the prior all the same
            reference, fits[each.view] = fitted(each, sets, scene, poses, fit, masks)
            references.append(reference)
        else:
            print(f"reference {each.view} is left out: nothing has to be invented in its view")
    if not references:
        raise ValueError(f"{given[0].path}: in no reference's view anything has to be invented; choose other views")
    refuse_contradictions(references, scene, fit, masks)
    return references, fits


def refuse_contradictions(references: list[Reference], scene: Scene, fit: Path, masks: Path) -> None:
    """ValueError where two show something else in the part of the hole that both see: a mixture would be learnt."""
    if len(references) < 2:
        return
    cameras, sets = [each.camera for each in references], load_mask_sets(masks, scene.train)
    keep = ~load_labels(masks / "labels.npy")
    remaining = load_ply(fit / "gaussians.ply").map(lambda p: p[keep])
    hidden = {camera.name: sets[camera.name].consistent for camera in cameras}
    holes = view_ranking.holes(remaining, cameras, hidden, {each.camera.name: each.mask for each in references})
    holes = agreement.as_drawn(holes, references, remaining, hidden)
    for first, second, unlike in agreement.contradicting(references, holes):
        raise ValueError(
            f"the references of '{first}' and '{second}' contradict each other: in what both show, colours differ by "
            f"{255 * unlike:.0f} of 255; make them alike, or give one of them"
        )


def fitted(
    given: GivenReference, sets: MaskSet, scene: Scene, poses: Path, fit: Path, masks: Path
) -> tuple[Reference, str]:
    """One of them, registered to its photograph: as it is where it is the photograph outside the object, else only the
    hole of it, its shadow and a blended rim; and how it fits."""
    lenses, upright = load_lenses(poses)
    camera, lens = scene.cameras[given.view], lenses[given.view]
    as_photographed = not given.painted and has_photograph(poses, given.view)
    views = load_views(poses, [given.view]) if as_photographed else exposure.load_views(poses, fit, [given.view])
    photo, hidden = views[given.view], sets.raw | sets.consistent | sets.invent
    image, inside = load_straight(given, lens, upright)
    found = registration.register(image, photo, hidden)
    if not found.fits and not given.undistorted:
        straight, _ = load_straight(replace(given, undistorted=True), lens, upright)
        if registration.register(straight, photo, hidden).fits:
            raise BadInput(
                f"{given.path}: fits the undistorted picture of its view '{given.view}', not the photograph; write "
                "`undistorted: true` beside it in scene.yaml"
            )
    if not found.untouched:
        found = check_reference(given, found, image, scene, poses, masks)
    print(f"reference {given.view}: {found}", flush=True)
    usual = 0.0
    if not found.untouched:
        image, inside = load_straight(given, lens, upright, found.moved)
        image = color.recolor(image, found.gain, found.offset)
        margin, blend = (share * camera.width for share in (MARGIN, BLEND))
        usual = shadows.redrawn_difference(image, photo, inside & ~hidden)
        hole = hidden | shadows.tainted(image, photo, hidden) & inside
        image = color.paste(image, photo, hole, inside, margin, blend)
    if sets.invent.any() and (share := inside[sets.invent].mean()) < WHOLE:
        raise ValueError(f"{given.path}: shows only {share:.0%} of the hole in '{given.view}'; crop less")
    drawn = sets.consistent | shadows.changed(image, photo, sets.invent, usual)
    image = image if given.painted else exposure.normalised(image, fit, given.view)
    depth = load_straight_depth(given, lens, upright, found.moved)
    if depth is not None:  # where it is in the scene's own unit, it is in this frame's now
        depth = depth * scene.similarity.scale
    return Reference(camera, image, sets.invent & inside & drawn, depth), str(found)


def check_reference(
    given: GivenReference, found: Registration, image: np.ndarray, scene: Scene, poses: Path, masks: Path
) -> Registration:
    """How the picture lies over its photograph; as it is, where it does not fit and scene.yaml trusts it.

    Raises:
        BadInput: it does not show its view, or shows another one better, and is not trusted.
    """
    others = [name for name in scene.train if name != given.view and has_photograph(poses, name)]
    others.sort(key=lambda name: view_distance(scene.cameras[name], scene.cameras[given.view]))
    others = others[:NEIGHBOURS] if found.fits else others
    loaded = ((name, load_views(poses, [name])[name], all_masks(masks, name)) for name in others)
    closer = registration.closer_view(image, found, loaded)
    if found.fits and closer is None:
        return found
    problem = f"{given.path}: does not fit its view '{given.view}': {found if found.fits else found.misfit}"
    problem += f"; it fits the view '{closer[0]}' better ({closer[1]:.0%})" if closer else ""
    if given.trust:
        warnings.warn(f"{problem}; taken all the same: scene.yaml says `trust: true`", stacklevel=1)
        return found if found.fits else replace(found, moved=None, gain=np.ones(3), offset=np.zeros(3))
    raise BadInput(f"{problem}; is it of another view, or of another scene? If it is right, {given.way_to_trust}")


def all_masks(masks: Path, view: str) -> np.ndarray:
    """bool [H, W], pixels of the view that may show the object."""
    sets = load_mask_sets(masks, [view])[view]
    return sets.raw | sets.consistent | sets.invent


def view_distance(a: Camera, b: Camera) -> float:
    """Of two views: between their centres, of the scene's extent, plus radians between their optical axes."""
    cosine = a.world_to_camera[2, :3] @ b.world_to_camera[2, :3]
    return float(np.linalg.norm(a.center - b.center) + np.arccos(np.clip(cosine, -1, 1)))


def lay_out(folder: Path, painted: list[str], scene: Scene, poses: Path, fit: Path, masks: Path) -> None:
    """Write what people can paint: <view>.png and <view>_mask.png of the views that cover most of what has to be
    invented, those painted already first, and ranked.txt."""
    sets = load_mask_sets(masks, scene.train)
    keep = ~load_labels(masks / "labels.npy")
    remaining = load_ply(fit / "gaussians.ply").map(lambda p: p[keep])
    hidden, invent = ({n: getattr(each, kind) for n, each in sets.items()} for kind in ("consistent", "invent"))
    holes = view_ranking.holes(remaining, [scene.cameras[name] for name in scene.train], hidden, invent)
    views = view_ranking.ranked(holes, painted, VIEWS_TO_PAINT)
    for name in (each.view for each in views):
        photo = exposure.load_views(poses, fit, [name])[name]
        known = inpaint.background(remaining, scene.cameras[name], photo, hidden[name])
        save_image(folder / f"{name}.png", view_ranking.to_paint(known, invent[name]))
        save_mask(folder / f"{name}_mask.png", invent[name])
    if views:
        save_text(folder / "ranked.txt", view_ranking.words(views, painted))
        names = ", ".join(f"{each.view} ({each.share:.0%})" for each in views)
        print(f"to be painted by hand, and what each covers more: {names}; see {TO_PAINT}/ranked.txt", flush=True)


def inpainted(params: Params, out: Path, scene: Scene, poses: Path, fit: Path, masks: Path) -> Reference:
    """A picture of the view that `masks` found best: the photo outside C, the remaining Gaussians' render in C where
    other views saw the background, the inpainter's own in I."""
    name = load_json(masks / "facts.json")["best_reference"]
    if params.choose is not None and params.choose >= params.candidates:
        raise ValueError(f"reference.choose is {params.choose}, but candidates are counted 0..{params.candidates - 1}")
    camera, pixels = scene.cameras[name], load_mask_sets(masks, [name])[name]
    keep = ~load_labels(masks / "labels.npy")
    remaining = load_ply(fit / "gaussians.ply").map(lambda p: p[keep])
    photo = exposure.load_views(poses, fit, [name])[name]
    base = inpaint.background(remaining, camera, photo, pixels.consistent)
    inpainter = painters.resolve_inpainter(params.inpainter)
    if inpainter == "exemplar":
        around = surfaces_around(scene, poses, fit, masks)
        return Reference(camera, from_photographs(params, out, base, pixels, camera, around), pixels.invent)
    if inpainter in PAINTERS:
        source = "" if params.inpainter == painters.AUTO else params.prior
        painter = feedforward.load(inpainter, source, params.device)
        return Reference(camera, from_network(painter, out, name, base, pixels), pixels.invent)
    return Reference(camera, from_prior(params, out, name, base, pixels.invent), pixels.invent)


def surfaces_around(scene: Scene, poses: Path, fit: Path, masks: Path) -> exemplar.Around:
    """What the photographs show around the object."""
    sets, train = load_mask_sets(masks, scene.train), [scene.cameras[name] for name in scene.train]
    hidden = {name: each.consistent & (name not in scene.clean) for name, each in sets.items()}
    photos = exposure.load_views(poses, fit, scene.train)
    gaussians, thing = load_ply(fit / "gaussians.ply"), load_object(masks)
    return exemplar.looked_around(gaussians, thing, train, hidden, photos, scene.points)


def from_photographs(
    params: Params, out: Path, base: np.ndarray, pixels: MaskSet, camera: Camera, around: exemplar.Around
) -> np.ndarray:
    """The picture [H, W, 3] uint8 with I put together from patches of the photographs; also writes the sheet of
    candidates."""
    hole = exemplar.to_paint(pixels.consistent, pixels.invent)
    seeds = [params.seed + index for index in range(params.candidates)]
    found = exemplar.completions(base, hole, camera, pixels.consistent, around, seeds)
    misfits = [each.misfit for each in found]
    chosen = int(np.argmin(misfits)) if params.choose is None else params.choose
    save_image(out / "candidates.png", np.concatenate([each.image for each in found], 1))
    save_json(out / "candidates.json", {"view": camera.name, "misfits": misfits, "chosen": chosen})
    return found[chosen].image


def from_network(painter: Painter, out: Path, name: str, base: np.ndarray, pixels: MaskSet) -> np.ndarray:
    """The picture [H, W, 3] uint8 with I painted in one pass by LaMa or MI-GAN; also written as the one candidate."""
    image = painter.paint(base, exemplar.to_paint(pixels.consistent, pixels.invent))
    save_image(out / "candidates.png", image)
    save_json(out / "candidates.json", {"view": name, "painter": painter.name, "chosen": 0})
    return image


def from_prior(params: Params, out: Path, name: str, base: np.ndarray, invent: np.ndarray) -> np.ndarray:
    """The picture [H, W, 3] uint8 with I painted by the prior; also writes the sheet of candidates."""
    prior = load_prior(params.prior, device=params.device, dtype=getattr(torch, params.dtype))
    prior = memory.fitted(prior, params.memory_gb, "reference.memory_gb")
    hole = torch.from_numpy(invent)
    with memory.blamed("reference.memory_gb", params.memory_gb):
        candidates = inpaint.paint(
            prior,
            inpaint.as_input(base),
            hole,
            prompt=params.prompt,
            seeds=[params.seed + index for index in range(params.candidates)],
            start=REFINED_FROM,
            **params.sampler.model_dump(),
        ).cpu()
    seams = inpaint.seam(candidates, hole)
    chosen = int(seams.argmin()) if params.choose is None else params.choose
    images = (candidates.permute(0, 2, 3, 1) + 1) / 2
    sheet = torch.cat([*images], dim=1).clamp(0, 1)
    save_image(out / "candidates.png", sheet.numpy())
    save_json(out / "candidates.json", {"view": name, "seams": seams.tolist(), "chosen": chosen})
    return inpaint.as_picture(candidates[chosen])
