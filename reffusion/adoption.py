"""Adopts references that a scene brings: aligns each with its photograph, and decides which of its pixels to use."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from reffusion.capture.lens import Lens
from reffusion.io.files import BadInput
from reffusion.masks import shadows
from reffusion.references import agreement, color, registration, view_ranking
from reffusion.references.files import GivenReference
from reffusion.references.registration import Registration
from reffusion.references.undistort import load_straight, load_straight_depth
from reffusion.types import Camera, Gaussians, MaskSet, Reference, Scene

PASTE_MARGIN, PASTE_BLEND = 0.01, 0.01  # of the width: kept of a reference around the hole, then blended over beyond
LEAST_HOLE_SHARE = 0.9  # share of the invent mask that a reference must cover after alignment
NEIGHBOURS = 4  # nearest views that a matching reference is compared with, in case it shows one of them better


@dataclass(frozen=True)
class SceneViews:
    """The views of a scene that references belong to. Pictures, masks and Gaussians are loaded when they are needed.

    Attributes:
        scene: cameras, roles of the views, and the similarity from the scene's own frame.
        lenses: view name -> lens of its photograph, at the size of the undistorted view.
        upright: the orientation tags of the scene's pictures are obeyed.
        load_masks: view name -> its pixel classes.
        has_photograph: view name -> does the scene bring its photograph? Otherwise a render stands for it.
        load_photograph: view name -> uint8 [H, W, 3], the undistorted photograph as its camera exposed it.
        load_normalized: view name -> uint8 [H, W, 3], the view in the scene's common exposure; a render where there is
            no photograph.
        remove_exposure: picture uint8 [H, W, 3] exposed like the photograph of a view, view name -> the picture in the
            scene's common exposure.
        load_remaining: -> the Gaussians without the object's.
    """

    scene: Scene
    lenses: Mapping[str, Lens]
    upright: bool
    load_masks: Callable[[str], MaskSet]
    has_photograph: Callable[[str], bool]
    load_photograph: Callable[[str], np.ndarray]
    load_normalized: Callable[[str], np.ndarray]
    remove_exposure: Callable[[np.ndarray, str], np.ndarray]
    load_remaining: Callable[[], Gaussians]


def adopt_references(files: Sequence[GivenReference], views: SceneViews) -> tuple[list[Reference], dict[str, str]]:
    """Align the references with their views, and drop those in whose view nothing has to be invented.

    The mask of a reference is the invent mask of its view. In a clean view, whose photograph shows what other views
    have to invent, it is the consistent mask.

    Returns:
        the references, and view name -> how well each fits its photograph, in words.

    Raises:
        BadInput: a reference does not show its view, and scene.yaml does not trust it.
        ValueError: no reference is left, one covers too little of the hole, or two contradict each other.
    """
    references, fits = [], {}
    for file in files:
        masks, is_clean = views.load_masks(file.view), file.view in views.scene.clean
        masks = replace(masks, invent=masks.consistent) if is_clean else masks
        if masks.invent.any() or is_clean:  # a clean view without a hole still teaches the prior
            reference, fits[file.view] = adopt_reference(file, masks, views)
            references.append(reference)
        else:
            print(f"reference {file.view} is left out: nothing has to be invented in its view")
    if not references:
        raise ValueError(f"{files[0].path}: in no reference's view anything has to be invented; choose other views")
    check_agreement(references, views)
    return references, fits


def adopt_reference(file: GivenReference, masks: MaskSet, views: SceneViews) -> tuple[Reference, str]:
    """Align one reference with its photograph.

    A picture that equals the photograph outside the object is used as it is. Of any other picture only the hole, the
    object's shadow and a blended rim are pasted into the photograph.

    Args:
        masks: pixel classes of its view; the reference is used within `masks.invent`.

    Returns:
        the reference in the scene's common exposure, and how well it fits, in words.

    Raises:
        BadInput: it does not show its view, and scene.yaml does not trust it.
        ValueError: it covers less than `LEAST_HOLE_SHARE` of the hole.
    """
    camera, lens = views.scene.cameras[file.view], views.lenses[file.view]
    keeps_exposure = not file.painted and views.has_photograph(file.view)
    photo = views.load_photograph(file.view) if keeps_exposure else views.load_normalized(file.view)
    hidden = object_pixels(masks)
    image, inside = load_straight(file, lens, views.upright)
    found = registration.register(image, photo, hidden)
    if not found.fits and not file.undistorted:
        straight, _ = load_straight(replace(file, undistorted=True), lens, views.upright)
        if registration.register(straight, photo, hidden).fits:
            raise BadInput(
                f"{file.path}: fits the undistorted picture of its view '{file.view}', not the photograph; write "
                "`undistorted: true` beside it in scene.yaml"
            )
    if not found.untouched:
        found = check_match(file, found, image, views)
    print(f"reference {file.view}: {found}", flush=True)
    usual = 0.0
    if not found.untouched:
        image, inside = load_straight(file, lens, views.upright, found.moved)
        image = color.recolor(image, found.gain, found.offset)
        margin, blend = (share * camera.width for share in (PASTE_MARGIN, PASTE_BLEND))
        usual = shadows.redrawn_difference(image, photo, inside & ~hidden)
        hole = hidden | shadows.tainted(image, photo, hidden) & inside
        image = color.paste(image, photo, hole, inside, margin, blend)
    if masks.invent.any() and (share := inside[masks.invent].mean()) < LEAST_HOLE_SHARE:
        raise ValueError(f"{file.path}: shows only {share:.0%} of the hole in '{file.view}'; crop less")
    differs = masks.consistent | shadows.changed(image, photo, masks.invent, usual)
    image = image if file.painted else views.remove_exposure(image, file.view)
    depth = load_straight_depth(file, lens, views.upright, found.moved)
    if depth is not None:  # a depth map in the scene's own unit is now in that of the normalised frame
        depth = depth * views.scene.similarity.scale
    return Reference(camera, image, masks.invent & inside & differs, depth), str(found)


def check_match(file: GivenReference, found: Registration, image: np.ndarray, views: SceneViews) -> Registration:
    """The registration, where the picture shows its view and shows no other view better.

    If scene.yaml trusts a picture that does not match, a warning replaces the error, and the picture is used without
    alignment.

    Args:
        found: how the picture lies over the photograph of its own view.
        image: uint8 [H, W, 3], the undistorted picture before alignment.

    Raises:
        BadInput: it does not show its view, or shows another one better, and is not trusted.
    """
    scene = views.scene
    others = [name for name in scene.train if name != file.view and views.has_photograph(name)]
    others.sort(key=lambda name: view_distance(scene.cameras[name], scene.cameras[file.view]))
    others = others[:NEIGHBOURS] if found.fits else others
    loaded = ((name, views.load_photograph(name), object_pixels(views.load_masks(name))) for name in others)
    closer = registration.closer_view(image, found, loaded)
    if found.fits and closer is None:
        return found
    problem = f"{file.path}: does not fit its view '{file.view}': {found if found.fits else found.misfit}"
    problem += f"; it fits the view '{closer[0]}' better ({closer[1]:.0%})" if closer else ""
    if file.trust:
        warnings.warn(f"{problem}; taken all the same: scene.yaml says `trust: true`", stacklevel=1)
        return found if found.fits else replace(found, moved=None, gain=np.ones(3), offset=np.zeros(3))
    raise BadInput(f"{problem}; is it of another view, or of another scene? If it is right, {file.way_to_trust}")


def check_agreement(references: Sequence[Reference], views: SceneViews) -> None:
    """ValueError where two references show different things in the part of the hole that both see: training would
    average them."""
    if len(references) < 2:
        return
    cameras = [each.camera for each in references]
    remaining = views.load_remaining()
    hidden = {camera.name: views.load_masks(camera.name).consistent for camera in cameras}
    holes = view_ranking.holes(remaining, cameras, hidden, {each.camera.name: each.mask for each in references})
    holes = agreement.as_drawn(holes, references, remaining, hidden)
    for first, second, unlike in agreement.contradicting(references, holes):
        raise ValueError(
            f"the references of '{first}' and '{second}' contradict each other: in what both show, colours differ by "
            f"{255 * unlike:.0f} of 255; make them alike, or give one of them"
        )


def object_pixels(masks: MaskSet) -> np.ndarray:
    """bool [H, W], the pixels of a view that may show the object."""
    return masks.raw | masks.consistent | masks.invent


def view_distance(a: Camera, b: Camera) -> float:
    """How differently two cameras look: the distance of their centres, in units of the normalised frame, plus the angle
    between their optical axes in radians."""
    cosine = a.world_to_camera[2, :3] @ b.world_to_camera[2, :3]
    return float(np.linalg.norm(a.center - b.center) + np.arccos(np.clip(cosine, -1, 1)))
