"""Consistent masks and pixel classes: label the object's Gaussians, render the labels, and classify each view's pixels.

The pixel classes of a view (`MaskSet`) are: C, the consistent mask, where the view shows the object; U, the pixels of C
whose background too few other photographs show; I, the pixels to be invented. A *clean* view was photographed without
the object.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from reffusion import morphology, trace
from reffusion.background import training_coverage
from reffusion.background.model import Background
from reffusion.background.unobserved import find_unobserved
from reffusion.background.visibility import opaque_depth
from reffusion.kernels.compiled import map_in_threads, views_at_once
from reffusion.masks import regions, voting
from reffusion.masks.regions import FillRequest, Region
from reffusion.params.masks import Params
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, MaskSet, Scene

UNSEEN_WEIGHT = 0.1  # px, total blending weight in all views up to which a Gaussian is labeled by its position


def label_object(
    params: Params,
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    ballots: Mapping[str, np.ndarray],
    ignored: Mapping[str, np.ndarray],
    region: Region | None,
) -> Tensor:
    """Label the Gaussians of the object: by votes of the raw masks, or without masks by a region in space.

    Gaussians that hardly any view sees are also labeled by their position: they belong to the object if they project
    into the masks of more than half of the views (`voting.hidden_inside`).

    Args:
        params: parameters of the stage `masks`.
        gaussians: the N Gaussians of the whole scene.
        cameras: the training views.
        ballots: view name -> bool [H, W], raw masks of the views that vote, True at pixels of the object. Empty if the
            scene has no masks.
        ignored: view name -> bool [H, W], pixels that do not vote; a view without an entry has none.
        region: region of space that the scene names; None if it names none.

    Returns:
        bool [N], True for the Gaussians of the object. All are False if there are neither masks nor a region that holds
        the object.

    Raises:
        ValueError: as `voting.cast_votes`.
    """
    if not ballots:
        if region is None or not region.holds:
            return torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
        return regions.inside_region(gaussians, region)
    # Blending weights tell whether a Gaussian is seen at all, also if the votes are counts.
    cast = partial(voting.cast_votes, gaussians, cameras, ballots, ignored=ignored)
    weights = cast(mode="weight")
    votes = weights if params.vote == "weight" else cast(mode=params.vote)
    labels = voting.label_gaussians(votes, params.tau)
    # Gaussians that hardly any view sees, e.g. inside the object or in the wall behind the object, are labeled by
    # their position. PAPER leaves open: the ratio of votes 0 / 0 of Gaussians that no view sees.
    unseen = weights.masked + weights.unmasked <= (UNSEEN_WEIGHT if params.tidy else 0)
    return labels | (unseen & voting.hidden_inside(gaussians, cameras, ballots))


def render_consistent_masks(
    params: Params, gaussians: Gaussians, labels: Tensor, cameras: Mapping[str, Camera]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Render the consistent mask C of each view, the pixels where the rendered labels exceed tau', and its depth.

    Small islands are then removed, and small holes filled (`clean_mask`).

    Args:
        params: sets the threshold tau' (`tau_rendered`), and whether masks are cleaned (`tidy`).
        gaussians: the N Gaussians of the whole scene.
        labels: bool [N], True for the Gaussians of the object.
        cameras: view name -> camera.

    Returns:
        View name -> bool [H, W], C; and view name -> float32 [H, W], the depth of the whole scene
        (`visibility.opaque_depth`).
    """
    masks, depths = {}, {}
    for name, camera in cameras.items():
        rendering = voting.render_with_labels(gaussians, labels, camera)
        masks[name] = clean_mask(params, rendering.features[..., 0].cpu().numpy() > params.tau_rendered)
        depths[name] = opaque_depth(rendering)
    return masks, depths


def clean_mask(params: Params, mask: np.ndarray) -> np.ndarray:
    """Remove small islands from a mask, bool [H, W], and fill small holes.

    If `params.tidy` is False, the mask is returned unchanged.
    """
    island, gap = morphology.ISLAND * mask.shape[1], morphology.GAP * mask.shape[1]
    return morphology.remove_small_parts(mask, island, gap) if params.tidy else mask


def needs_unobserved(params: Params, fill: FillRequest) -> bool:
    """Return whether the pixel classes depend on what other photographs show.

    The result is False if all of C is invented (`params.invent` "consistent") and the scene asks to fill nothing else.
    """
    return params.invent != "consistent" or bool(fill)


def classify_pixels(
    params: Params,
    scene: Scene,
    remaining: Gaussians,
    raw: Mapping[str, np.ndarray],
    consistent: Mapping[str, np.ndarray],
    background: Background,
    fill: FillRequest,
) -> dict[str, MaskSet]:
    """Split the consistent mask of each view into observed and unobserved pixels, and select the pixels to invent.

    Unobserved pixels are invented (with `params.invent` "consistent": all of C), as well as the pixels that the scene
    asks to fill. If nothing depends on them (`needs_unobserved`), unobserved pixels are not searched, and all of C
    counts as unobserved. In a clean view C stays, but no pixel of it is unobserved, and none is invented unless the
    scene asks to fill it.

    Args:
        params: parameters of the stage `masks`.
        remaining: the Gaussians of the scene without the removed ones.
        raw: view name -> bool [H, W], the given masks; views without a mask have no entry.
        consistent: view name -> bool [H, W], the consistent mask C of every view.
        background: the surroundings of the object.
        fill: the pixels that the scene asks to fill.

    Returns:
        View name -> pixel classes, for every view of the scene.
    """
    names = list(scene.cameras)

    def classify(name: str) -> MaskSet:
        camera, mask, is_dirty = scene.cameras[name], consistent[name], name not in scene.clean
        given = raw.get(name, np.zeros_like(mask))
        if not needs_unobserved(params, fill):
            return MaskSet(given, mask, mask & is_dirty, mask & is_dirty)
        rendering = rasterizer.render(remaining, camera, sh_degree=0)
        found = find_unobserved(rendering, camera, mask, background.views, background.planes, background.mirrors)
        unobserved = clean_mask(params, found.unobserved) & mask & is_dirty
        invent = mask & is_dirty if params.invent == "consistent" else unobserved
        invent = invent | fill.render(camera, found.depth)
        return MaskSet(given, mask, unobserved, invent)

    with closing(map_in_threads(classify, names, views_at_once(params.device))) as found:
        return {names[k]: next(found) for k in trace.progress(len(names), "masks")}


def add_uncaptured_pixels(
    params: Params, scene: Scene, gaussians: Gaussians, hidden: Mapping[str, np.ndarray], sets: Mapping[str, MaskSet]
) -> dict[str, MaskSet]:
    """Extend the pixel classes of the views without a photograph by the pixels that no photograph shows.

    These pixels are added to C, U and I, so they are invented.

    Args:
        params: parameters of the stage `masks`.
        gaussians: the Gaussians of the whole scene with the object.
        hidden: view name -> bool [H, W], True at pixels that show the object.
        sets: view name -> pixel classes, as `classify_pixels` returns them.

    Returns:
        View name -> extended pixel classes, for the camera-only views only.
    """
    if not scene.camera_only:
        return {}
    seen_by = training_coverage.render_coverage_views(gaussians, [scene.cameras[name] for name in scene.train], hidden)
    found = {}
    for name in scene.camera_only:
        unseen = clean_mask(params, training_coverage.unseen_pixels(gaussians, scene.cameras[name], seen_by))
        each = sets[name]
        found[name] = MaskSet(each.raw, each.consistent | unseen, each.unobserved | unseen, each.invent | unseen)
    return found


def drop_negligible(
    params: Params, sets: Mapping[str, MaskSet], names: Sequence[str], fill: FillRequest
) -> dict[str, MaskSet]:
    """Return the pixel classes of all views, with empty invent masks if the unobserved share of C is negligible.

    The share is that of `unobserved_share`, and `params.negligible` is its limit. Nothing is cleared if all of C is to
    be invented (`params.invent` "consistent"), or if the scene asks to fill pixels.

    Args:
        sets: view name -> pixel classes.
        names: the views over which the share is computed. The invent masks of all views in `sets` are cleared.
        fill: the pixels that the scene asks to fill.
    """
    if params.invent == "consistent" or fill or unobserved_share(sets, names) > params.negligible:
        return dict(sets)
    return {name: replace(each, invent=np.zeros_like(each.invent)) for name, each in sets.items()}


def count_pixels(kind: str, sets: Mapping[str, MaskSet], names: Sequence[str]) -> int:
    """Return the number of pixels of a class in the views `names`, all together.

    Args:
        kind: an attribute of `MaskSet`, e.g. "invent".
    """
    return int(sum(np.count_nonzero(getattr(sets[name], kind)) for name in names))


def unobserved_share(sets: Mapping[str, MaskSet], names: Sequence[str]) -> float:
    """Return the share of the consistent masks' pixels that are unobserved, in [0, 1], over the views `names` together.

    A pixel is unobserved if too few other photographs show the background there. The share is 0 if all consistent masks
    are empty.
    """
    return count_pixels("unobserved", sets, names) / max(count_pixels("consistent", sets, names), 1)
