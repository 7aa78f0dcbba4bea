"""Consistent masks: label the object's Gaussians, render them, and split each view's mask into pixel classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from reffusion import morphology, trace
from reffusion.background import training_coverage
from reffusion.background.model import Background
from reffusion.background.unobserved import find_unobserved
from reffusion.kernels.compiled import side_by_side
from reffusion.masks import regions, voting
from reffusion.masks.regions import FillRequest, Region
from reffusion.masks.voting import Votes
from reffusion.params.masks import Params
from reffusion.types import Camera, Gaussians, MaskSet, Scene

UNSEEN_WEIGHT = 0.1  # blending weight over all views up to which a Gaussian is labelled by its position
ISLAND, GAP = 0.01, 0.02  # of the image's width: smaller islands of a mask are dropped, smaller holes filled
MAX_PARALLEL = 4  # views, each with its pixels as points in memory


def label_object(
    params: Params,
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    ballots: Mapping[str, np.ndarray],
    region: Region | None,
) -> Tensor:
    """bool [N], the Gaussians of the object: by votes of the masks; without masks by the region that holds it.

    Args:
        cameras: the training views. ballots: view name -> bool [H, W], raw masks of the views that vote.
    """
    if not ballots:
        if region is None or not region.holds:
            return torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
        return regions.inside_region(gaussians, region)
    # Whether a Gaussian is seen at all is measured by weight, whatever the votes count.
    weights = voting.cast_votes(gaussians, cameras, ballots, mode="weight")
    votes = weights if params.vote == "weight" else voting.cast_votes(gaussians, cameras, ballots, mode=params.vote)
    labels = voting.label_gaussians(votes, params.tau)
    # What hardly any view sees, inside the object or in the wall behind it, is labelled by its position. PAPER leaves
    # open: the ratio of 0 to 0, of Gaussians that no view sees.
    unseen = _total(weights) <= (UNSEEN_WEIGHT if params.tidy else 0)
    return labels | (unseen & voting.hidden_inside(gaussians, cameras, ballots))


def _total(votes: Votes) -> Tensor:
    return votes.masked + votes.unmasked


def render_consistent_masks(
    params: Params, gaussians: Gaussians, labels: Tensor, cameras: Mapping[str, Camera]
) -> dict[str, np.ndarray]:
    """View name -> bool [H, W], the consistent mask C: where the rendered labels exceed tau'."""
    shares = {name: voting.render_labels(gaussians, labels, camera) for name, camera in cameras.items()}
    return {name: clean_mask(params, share > params.tau_rendered) for name, share in shares.items()}


def clean_mask(params: Params, mask: np.ndarray) -> np.ndarray:
    """The mask, bool [H, W], without small islands and holes, if `params.tidy`."""
    width = mask.shape[1]
    return morphology.remove_small_parts(mask, ISLAND * width, GAP * width) if params.tidy else mask


def classify_pixels(
    params: Params,
    scene: Scene,
    remaining: Gaussians,
    raw: Mapping[str, np.ndarray],
    consistent: Mapping[str, np.ndarray],
    background: Background,
    fill: FillRequest,
) -> dict[str, MaskSet]:
    """View name -> its pixel classes: what other views show behind the object is observed, and not invented."""
    names = list(scene.cameras)

    def classify(name: str) -> MaskSet:
        camera, mask, is_dirty = scene.cameras[name], consistent[name], name not in scene.clean
        found = find_unobserved(remaining, camera, mask, background.views, background.planes, background.mirrors)
        unobserved = clean_mask(params, found.unobserved) & mask & is_dirty
        invent = mask & is_dirty if params.invent == "consistent" else unobserved
        invent = invent | fill.render(camera, found.depth)
        return MaskSet(raw.get(name, np.zeros_like(mask)), mask, unobserved, invent)

    with closing(side_by_side(classify, names, MAX_PARALLEL if params.device == "cpu" else 1)) as found:
        return {names[k]: next(found) for k in trace.progress(len(names), "masks")}


def add_uncaptured_pixels(
    params: Params, scene: Scene, gaussians: Gaussians, hidden: Mapping[str, np.ndarray], sets: Mapping[str, MaskSet]
) -> dict[str, MaskSet]:
    """View name -> the pixel classes of the views without a photograph: what they show and no photograph does is
    unobserved, and invented."""
    if not scene.blank:
        return {}
    seen_by = training_coverage.render_coverage_views(gaussians, [scene.cameras[name] for name in scene.train], hidden)
    found = {}
    for name in scene.blank:
        unseen = clean_mask(params, training_coverage.unseen_pixels(gaussians, scene.cameras[name], seen_by))
        each = sets[name]
        found[name] = MaskSet(each.raw, each.consistent | unseen, each.unobserved | unseen, each.invent | unseen)
    return found


def drop_negligible(
    params: Params, sets: Mapping[str, MaskSet], names: Sequence[str], fill: FillRequest
) -> dict[str, MaskSet]:
    """The pixel classes with nothing to invent where the unobserved share of C over the views `names` is negligible."""
    if params.invent == "consistent" or fill or unobserved_share(sets, names) > params.negligible:
        return dict(sets)
    return {name: replace(each, invent=np.zeros_like(each.invent)) for name, each in sets.items()}


def count_pixels(kind: str, sets: Mapping[str, MaskSet], names: Sequence[str]) -> int:
    """Pixels of a class, e.g. "invent", over the views `names`."""
    return int(sum(np.count_nonzero(getattr(sets[name], kind)) for name in names))


def unobserved_share(sets: Mapping[str, MaskSet], names: Sequence[str]) -> float:
    """Share of the consistent masks' pixels behind which no photograph shows the background, over the views `names`."""
    return count_pixels("unobserved", sets, names) / max(count_pixels("consistent", sets, names), 1)
