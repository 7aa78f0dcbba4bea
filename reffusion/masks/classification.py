"""Classification of a scene: which Gaussians are the object, and the class of every pixel of every view.

Raw masks vote on which Gaussians are the object. The labeled Gaussians are rendered into each view, which gives its
consistent mask C. Pixels of C whose background too few other photographs show are unobserved (U). Pixels to be
invented are the invent mask I, see `reffusion.types.MaskSet`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from reffusion.background.model import Background, build_background
from reffusion.background.visibility import DepthView
from reffusion.masks import consolidation, voting
from reffusion.masks.debris import find_debris
from reffusion.masks.regions import FillRequest, Region
from reffusion.masks.remnants import Remnant, find_remnants
from reffusion.params.masks import Params
from reffusion.shadows.soft_detection import find_soft_shadow
from reffusion.shadows.soft_shadow import SoftShadow
from reffusion.types import Gaussians, MaskSet, Scene


@dataclass(frozen=True)
class ObjectMarks:
    """What the scene says about the object and the pixels to fill.

    Attributes:
        raw: view name -> bool [H, W], the raw masks, True = the object.
        region: the region of space in which the object is; None if none is named.
        fill: the pixels to fill whatever photographs show there.
        ignored: training view -> bool [H, W], pixels that cast no votes and show nothing.
        deleted: bool [N], Gaussians that a user deleted in a splat editor, which leave a hole: the object's labels
            instead of votes. None unless the scene brings edited Gaussians.
        scattered: bool [N], deleted Gaussians that stood alone: they are removed, and leave no hole. None unless the
            scene brings edited Gaussians.
    """

    raw: Mapping[str, np.ndarray]
    region: Region | None
    fill: FillRequest
    ignored: Mapping[str, np.ndarray]
    deleted: Tensor | None
    scattered: Tensor | None


@dataclass(frozen=True)
class Classification:
    """The object's Gaussians, and the class of every pixel.

    Attributes:
        labels: bool [N], the Gaussians to remove: the object's and debris.
        debris: bool [N], Gaussians that the object had hidden and that no photograph supports, and scattered ones.
        sets: view name -> pixel classes.
        background: the surfaces around the object.
        has_surfaces: whether planes and mirrors were searched, because the classes depend on them.
        shadow: the object's soft shadow; None if none is found.
        remnants: the parts of the object that the masks leave out. Those that would float in the air are labeled.
        voting_views: number of views that voted.
        unobserved_share: share of the pixels of C that are unobserved, before negligible ones are dropped.
        warnings: sentences about deleted Gaussians.
    """

    labels: Tensor
    debris: Tensor
    sets: dict[str, MaskSet]
    background: Background
    has_surfaces: bool
    shadow: SoftShadow | None
    remnants: Sequence[Remnant]
    voting_views: int
    unobserved_share: float
    warnings: Sequence[str]


def classify_scene(
    params: Params,
    scene: Scene,
    gaussians: Gaussians,
    marks: ObjectMarks,
    load_photos: Callable[[], Mapping[str, np.ndarray]],
) -> Classification:
    """Label the Gaussians to remove, and classify the pixels of every view.

    Args:
        params: parameters of the stage `masks`.
        scene: the cameras and the roles of the views.
        gaussians: the N Gaussians of the fit.
        marks: what says which pixels and Gaussians are the object.
        load_photos: returns view name -> uint8 [H, W, 3], the photographs of the training views in the exposure of the
            Gaussians; called only if surfaces or debris are searched.
    """
    train, deleted = [scene.cameras[name] for name in scene.train], marks.deleted
    empty = {name: np.zeros((camera.height, camera.width), bool) for name, camera in scene.cameras.items()}
    ballots = {name: marks.raw[name] for name in scene.train if name in marks.raw}
    ballots |= {name: empty[name] for name in scene.clean} if marks.raw else {}
    labels = deleted
    if labels is None:
        labels = consolidation.label_object(params, gaussians, train, ballots, dict(marks.ignored), marks.region)
    labels, consistent, depths, remnants = complete_object(params, scene, gaussians, labels, bool(marks.raw))
    warnings: list[str] = []
    if deleted is not None:
        labels = deleted | limit_extras(labels & ~deleted, deleted, "inside", warnings)
    hidden = {name: empty[name] if name in scene.clean else consistent[name] for name in scene.cameras}
    hidden |= {name: hidden[name] | mask for name, mask in marks.ignored.items()}

    needs_surfaces = params.shadows or consolidation.needs_unobserved(params, marks.fill)
    photos = load_photos() if needs_surfaces or params.debris else {}
    views = [DepthView.from_depth(camera, depths[camera.name], hidden[camera.name]) for camera in train]
    background = build_background(scene, views, photos)
    debris = torch.zeros_like(labels) if marks.scattered is None else marks.scattered
    if params.debris and (marks.raw or deleted is not None):
        found = find_debris(gaussians, labels, views, hidden, photos) & ~debris
        debris = debris | (found if deleted is None else limit_extras(found, deleted, "behind", warnings))
    object_means, labels = gaussians.means[labels], labels | debris
    remaining = gaussians.map(lambda p: p[~labels])
    if needs_surfaces:
        background = background.with_surfaces(object_means, remaining)
    shadow = find_shadow(params, background, object_means, scene)

    sets = consolidation.classify_pixels(params, scene, remaining, dict(marks.raw), consistent, background, marks.fill)
    sets |= consolidation.add_uncaptured_pixels(params, scene, gaussians, hidden, sets)
    repainted = (*scene.train, *scene.camera_only)
    share = consolidation.unobserved_share(sets, repainted)
    sets = consolidation.drop_negligible(params, sets, repainted, marks.fill)
    return Classification(
        labels, debris, sets, background, needs_surfaces, shadow, remnants, len(ballots), share, warnings
    )


def complete_object(
    params: Params, scene: Scene, gaussians: Gaussians, labels: Tensor, has_masks: bool
) -> tuple[Tensor, dict[str, np.ndarray], dict[str, np.ndarray], list[Remnant]]:
    """Extend the labels of an object by what can only belong to it, and by remnants that would float in the air.

    A Gaussian whose center lies inside C in (almost) every view can only belong to the object, whatever its votes.

    Args:
        labels: bool [N], the Gaussians that won the vote.
        has_masks: whether the scene brings masks, which alone can leave out parts.

    Returns:
        The labels, bool [N]; of every view the consistent mask C, view name -> bool [H, W], and the depth with the
        object, view name -> float32 [H, W]; and all remnants.
    """
    train = [scene.cameras[name] for name in scene.train]
    consistent, depths = consolidation.render_consistent_masks(params, gaussians, labels, scene.cameras)
    dirty = {name: consistent[name] for name in scene.train if name not in scene.clean}
    labels = labels | voting.hidden_inside(gaussians, train, dirty, share=params.inside_share)
    if not (params.remnants and has_masks):
        return labels, consistent, depths, []
    remnants = find_remnants(gaussians, labels, [camera for camera in train if camera.name in dirty])
    floating = [torch.as_tensor(each.members, device=labels.device) for each in remnants if each.would_float]
    if floating:
        labels = torch.stack([labels, *floating]).any(0)
        consistent, depths = consolidation.render_consistent_masks(params, gaussians, labels, scene.cameras)
    return labels, consistent, depths, remnants


def find_shadow(params: Params, background: Background, object_means: Tensor, scene: Scene) -> SoftShadow | None:
    """Find the object's soft shadow, which no mask contains, and print a line if there is one.

    Args:
        background: with the photographs and the planes around the object.
        object_means: [N, 3], the centers of the object's Gaussians.
        scene: names the views that were photographed without the object, and so without its shadow.

    Returns:
        None if `params.shadows` is False, if the background has no planes, or if no shadow is found.
    """
    if not params.shadows or not background.planes:
        return None
    with_object = {name: photo for name, photo in background.photos.items() if name not in scene.clean}
    shadow = find_soft_shadow(replace(background, photos=with_object), object_means)
    if shadow:
        line = f"the object's shadow, up to {shadow.strength:.0%} darker, is removed (masks.shadows=false keeps it)"
        print(line, flush=True)
    return shadow


def limit_extras(extras: Tensor, deleted: Tensor, where: str, warnings: list[str]) -> Tensor:
    """Return `extras`, or no Gaussians if the extras outnumber those that a user deleted in an editor.

    An object may hide some Gaussians, which an editor does not show. If the hidden Gaussians outnumber the object's
    own, the hole is probably no object's, and what the user left in the scene stays.

    Args:
        extras: bool [N], True for Gaussians to remove that the user did not delete.
        deleted: bool [N], True for Gaussians that the user deleted.
        where: where the extras are, "inside" or "behind" the hole, for the warning.
        warnings: receives a sentence if the extras stay.
    """
    if (count := int(extras.sum())) <= int(deleted.sum()):
        return extras
    warnings.append(
        f"{count} splats {where} the hole stay, because they are more than the {int(deleted.sum())} that were deleted "
        "there; if they belong to the object, delete them too"
    )
    return torch.zeros_like(extras)
