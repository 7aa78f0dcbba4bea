"""masks: votes label the object's Gaussians; rendered back they give each view's consistent, unobserved and invent
mask."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from reffusion.background.model import Background, surfaces_to_arrays
from reffusion.background.visibility import render_depth_views
from reffusion.clicks.local_segmenter import load_local_segmenter
from reffusion.clicks.scene_masks import masks_from_clicks, refine_masks
from reffusion.fit import exposure
from reffusion.io.arrays import load_json, load_labels, save_arrays, save_json, save_labels
from reffusion.io.images import save_image
from reffusion.io.ply import load_ply
from reffusion.io.scene import (
    WARNINGS,
    list_objects,
    load_fill_masks,
    load_raw_masks,
    load_scene,
    load_views,
    save_mask_sets,
)  # fmt: skip
from reffusion.masks import consolidation, frame_check, voting
from reffusion.masks.debris import find_debris
from reffusion.masks.regions import FillRequest, Region
from reffusion.masks.remnants import Remnant, find_remnants
from reffusion.params.masks import Params
from reffusion.types import Camera, Gaussians, Scene
from reffusion.workspace import SURFACES

TINT = (255, 0, 160)  # of remnants in their pictures
CHECKED_VIEWS = 8  # views in which Gaussians that the scene brings are compared with photographs


def run(params: Params, out: Path, *, poses: Path, raw_masks: Path, fit: Path) -> None:
    """Write labels.npy, debris.npy, background.npz, facts.json, and raw/, consistent/, unobserved/ and
    invent/<view>.png; warnings.json and remnants/ where the masks seem to leave out a part of the object."""
    scene, gaussians = load_scene(poses), load_ply(fit / "gaussians.ply", device=params.device)
    train = [scene.cameras[name] for name in scene.train]
    check_frame(poses, fit, gaussians, train)
    region = load_region(raw_masks)
    deleted = load_deleted(poses, params.device)
    raw = {} if deleted is not None else collect_raw_masks(params, scene, gaussians, poses, raw_masks)
    empty = {name: np.zeros((camera.height, camera.width), bool) for name, camera in scene.cameras.items()}
    ballots = {name: raw[name] for name in scene.train if name in raw}
    ballots |= {name: empty[name] for name in scene.clean} if raw else {}
    fill = FillRequest(region, load_fill_masks(raw_masks)) if params.invent != "unobserved" else FillRequest(None, {})
    if deleted is None and not raw and region is None and not fill.masks and not scene.blank:
        raise ValueError(f"{raw_masks}: neither masks nor a region say what is to be changed: add masks, or a region")

    labels = deleted if deleted is not None else consolidation.label_object(params, gaussians, train, ballots, region)
    consistent = consolidation.render_consistent_masks(params, gaussians, labels, scene.cameras)
    # What lies inside the mask in (almost) every view can only be the object, whatever the votes say.
    dirty = {name: consistent[name] for name in scene.train if name not in scene.clean}
    labels = labels | voting.hidden_inside(gaussians, train, dirty, share=params.inside_share)
    remnants = (
        find_remnants(gaussians, labels, [c for c in train if c.name in dirty]) if params.remnants and raw else []
    )
    report_remnants(remnants, out, lambda name: load_views(poses, [name])[name])
    for remnant in (each for each in remnants if each.would_float):
        labels = labels | torch.as_tensor(remnant.members, device=labels.device)
        consistent = consolidation.render_consistent_masks(params, gaussians, labels, scene.cameras)
    hidden = {name: empty[name] if name in scene.clean else consistent[name] for name in scene.cameras}
    views = render_depth_views(gaussians, train, hidden)
    background = Background(views, {}, points=scene.points).with_planes(gaussians, labels)
    photos = exposure.load_normalized_views(poses, fit, scene.train) if background.planes or params.debris else {}
    background = replace(background, photos=photos)
    if params.debris and (raw or deleted is not None):
        debris = find_debris(gaussians, labels, views, hidden, photos)
        save_labels(out / "debris.npy", debris.cpu())
        labels = labels | debris
    remaining = gaussians.map(lambda p: p[~labels])
    background = background.with_mirrors(remaining)
    sets = consolidation.classify_pixels(params, scene, remaining, raw, consistent, background, fill)
    sets |= consolidation.add_uncaptured_pixels(params, scene, gaussians, hidden, sets)
    repainted = (*scene.train, *scene.blank)
    share = consolidation.unobserved_share(sets, repainted)
    sets = consolidation.drop_negligible(params, sets, repainted, fill)
    save_labels(out / "labels.npy", labels.cpu())
    save_arrays(out / SURFACES, surfaces_to_arrays(background))
    save_mask_sets(out, sets)
    invent = {name: each.invent for name, each in sets.items()}
    facts = {
        "kept": [name for name in list_objects(raw_masks) if params.remove is not None and name not in params.remove],
        "masked_gaussians": int(labels.sum()),
        "gaussians": len(gaussians),
        "voting_views": len(ballots),
        "invent_pixels": consolidation.count_pixels("invent", sets, repainted),
        "consistent_pixels": consolidation.count_pixels("consistent", sets, repainted),
        "unobserved_share": share,
        "invent_views": [name for name in repainted if invent[name].any()],
        "best_reference": voting.best_view(invent, scene.train),
        "remnants": [{"removed": each.would_float, "share": each.share, "view": each.view} for each in remnants],
        "region": region and {"center": list(region.center), "size": list(region.size)},
    }
    save_json(out / "facts.json", facts)


def report_remnants(remnants: Sequence[Remnant], out: Path, photo_of: Callable[[str], np.ndarray]) -> None:
    """Warn of parts of the object that the masks leave out, with a picture of each: remnants/<number>.png."""
    lines = []
    for k, remnant in enumerate(remnants, start=1):
        photo, picture = photo_of(remnant.view).copy(), out / "remnants" / f"{k}.png"
        photo[remnant.mask] = photo[remnant.mask] // 2 + np.array(TINT) // 2
        save_image(picture, photo)
        outcome = (
            "a part that the masks leave out would float in the air and is removed too (masks.remnants=false keeps it)"
            if remnant.would_float
            else "part of the object seems to be left; if so, mark it in that view and run again"
        )
        lines.append(f"{outcome}: {remnant.describe()}, see {picture.relative_to(out.parent)}")
        warnings.warn(lines[-1], stacklevel=1)
    if lines:
        save_json(out / WARNINGS, lines)


def load_region(raw_masks: Path) -> Region | None:
    path = raw_masks / "region.json"
    return Region(**load_json(path)) if path.exists() else None


def load_deleted(poses: Path, device: str) -> Tensor | None:
    """bool [N], what was deleted from the Gaussians that the scene brings, which stands for votes; None where nothing
    was."""
    path = poses / "deleted.npy"
    return load_labels(path).to(device) if path.exists() else None


def collect_raw_masks(
    params: Params, scene: Scene, gaussians: Gaussians, poses: Path, raw_masks: Path
) -> dict[str, np.ndarray]:
    """View name -> bool [H, W]: the masks that the scene brings, and those made from clicks."""
    raw = load_raw_masks(raw_masks, scene.train, params.remove)
    if list_objects(raw_masks) and not raw:
        raise ValueError(
            f"{raw_masks / 'masks'}: no view has a mask of each object; add empty ones where one is unseen"
        )
    if params.refine and any(mask.any() for mask in raw.values()):
        segmenter = load_local_segmenter(params.segmenter)
        assert segmenter is not None  # checked by the parameters and, for files, before any work
        raw = raw | refine_masks(scene, gaussians, poses, raw, segmenter)
    if not params.clicks:
        return raw
    return masks_from_clicks(scene, gaussians, poses, params.clicks, raw, load_local_segmenter(params.segmenter))


def check_frame(poses: Path, fit: Path, gaussians: Gaussians, train: list[Camera]) -> None:
    """ValueError where the Gaussians that the scene brings are not in the frame of its cameras."""
    if not (poses / "gaussians.ply").exists():
        return
    some = train[:: max(1, len(train) // CHECKED_VIEWS)]
    photos = exposure.load_normalized_views(poses, fit, [camera.name for camera in some])
    if problem := frame_check.explain_misplacement(gaussians, some, photos):
        raise ValueError(f"{poses / 'gaussians.ply'}: `gaussians` of scene.yaml: {problem}")
