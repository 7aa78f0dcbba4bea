"""masks: votes label the object's Gaussians; rendered back they give every view's consistent, undecided and
invent mask."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from reffusion import trace
from reffusion.background import training_coverage, unobserved, visibility
from reffusion.background.continuation import planes_around
from reffusion.background.mirrors import Mirror
from reffusion.background.plane import Plane
from reffusion.background.symmetry import mirrors_around
from reffusion.background.visibility import Witness
from reffusion.capture.click_coordinates import to_views
from reffusion.capture.views import check_outliers
from reffusion.clicks import all_views
from reffusion.clicks.marks import Clicks
from reffusion.fit import exposure
from reffusion.io.arrays import load_json, load_labels, save_json, save_labels
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_fill, load_raw_masks, load_scene, load_views, objects_of, save_mask_sets
from reffusion.kernels.compiled import side_by_side
from reffusion.masks import frame_check, regions, voting
from reffusion.masks.regions import Filled, Region
from reffusion.masks.voting import Votes, extent
from reffusion.params.masks import Params
from reffusion.types import Camera, Gaussians, MaskSet, Scene

BURIED = 0.1  # blending weight in all views up to which a Gaussian votes by where it stands
SPECK, GAP = 0.01, 0.02  # of the image's width: islands of a mask below this diameter go, holes in it close
MOST_AT_ONCE = 4  # views, each with its pixels as points in memory
SEED = 0  # of the draws that find planes
LOOKED_AT = 8  # views, with which Gaussians that the scene brings are compared


def run(params: Params, out: Path, *, poses: Path, raw_masks: Path, fit: Path) -> None:
    scene, gaussians = load_scene(poses), load_ply(fit / "gaussians.ply").map(lambda p: p.to(params.device))
    train = [scene.cameras[name] for name in scene.train]
    check_brought(poses, fit, gaussians, train)
    region = load_region(raw_masks)
    deleted = deleted_from(poses, params.device)  # stands for votes
    raw = {} if deleted is not None else collect_raw_masks(params, scene, gaussians, poses, raw_masks)
    empty = {name: np.zeros((camera.height, camera.width), bool) for name, camera in scene.cameras.items()}
    ballots = {name: raw[name] for name in scene.train if name in raw} | {name: empty[name] for name in scene.clean}
    fill = Filled(region, load_fill(raw_masks)) if params.invent != "undecided" else Filled(None, {})
    if deleted is None and not raw and region is None and not fill.masks and not scene.blank:
        raise ValueError(f"{raw_masks}: neither masks nor a region say what is to be changed: add masks, or a region")

    # Observation outside the masks is measured by weight, whatever the votes count.
    seen = voting.cast_votes(gaussians, train, ballots or empty, mode="weight")
    if deleted is not None:
        labels = deleted.clone()
    elif raw:
        labels = voted(params, gaussians, train, ballots, seen)
    elif region is None:
        labels = torch.zeros(len(gaussians), dtype=torch.bool, device=params.device)
    else:
        labels = regions.inside(gaussians, region) & region.holds
    consistent = drawn(params, gaussians, labels, scene.cameras)
    # What stands where (almost) every view sees the object can only be the object, whatever it was painted with.
    labels |= voting.hidden_inside(
        gaussians, train, {n: consistent[n] for n in scene.train if n not in scene.clean}, share=params.hull
    )
    hidden = {name: empty[name] if name in scene.clean else consistent[name] for name in scene.cameras}
    views = visibility.witnesses(gaussians, train, hidden)
    planes = continuations(gaussians, labels, views, scene.points)
    photos = exposure.load_views(poses, fit, scene.train) if planes or params.debris else {}
    if params.debris and (raw or deleted is not None):
        debris = visibility.debris(gaussians, labels, views, hidden, photos)
        save_labels(out / "debris.npy", debris.cpu())
        labels |= debris
    remaining = gaussians.map(lambda p: p[~labels])
    mirrors = mirrors_around(remaining, *extent(gaussians.means[labels]), views, planes, photos) if planes else []
    sets = classified(params, scene, remaining, raw, consistent, views, planes, mirrors, fill)
    sets |= of_blank_views(params, scene, gaussians, hidden, sets)
    distilled = (*scene.train, *scene.blank)
    unobserved_share = share_undecided(sets, distilled)
    if params.invent != "consistent" and not fill and unobserved_share <= params.negligible:
        sets = {name: replace(each, invent=empty[name]) for name, each in sets.items()}
    save_labels(out / "labels.npy", labels.cpu())
    save_mask_sets(out, sets)
    invents = {name: each.invent for name, each in sets.items()}
    facts = {
        "kept": [name for name in objects_of(raw_masks) if params.remove is not None and name not in params.remove],
        "masked_gaussians": int(torch.count_nonzero(labels)),
        "gaussians": len(gaussians),
        "voting_views": len(ballots),
        "invent_pixels": pixels_of("invent", sets, distilled),
        "consistent_pixels": pixels_of("consistent", sets, distilled),
        "undecided_share": unobserved_share,
        "invent_views": [name for name in distilled if invents[name].any()],
        "best_reference": voting.best_view(invents, scene.train),
        "region": region and {"center": list(region.center), "size": list(region.size)},
    }
    save_json(out / "facts.json", facts)


def load_region(raw_masks: Path) -> Region | None:
    path = raw_masks / "region.json"
    return Region(**load_json(path)) if path.exists() else None


def collect_raw_masks(
    params: Params, scene: Scene, gaussians: Gaussians, poses: Path, raw_masks: Path
) -> dict[str, np.ndarray]:
    """View -> bool [H, W], the raw masks: those that the scene brings, and what clicks make of them."""
    raw = load_raw_masks(raw_masks, scene.train, params.remove)
    if objects_of(raw_masks) and not raw:
        raise ValueError(
            f"{raw_masks / 'masks'}: no view has a mask of each object; add empty ones where one is unseen"
        )
    return clicked(params, scene, gaussians, poses, raw) if params.clicks else raw


def clicked(
    params: Params, scene: Scene, gaussians: Gaussians, poses: Path, given: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Masks of all training views, and of test views that show the object, by clicks and those masks that are given.

    Raises:
        ValueError: the clicks lie where undistorted views show nothing, or on nothing that the Gaussians show.
    """
    check_outliers("clicks", params.clicks, scene.outliers)
    clicks = {name: Clicks(*points) for name, points in to_views(poses, params.clicks).items()}
    image_of = lambda name: load_views(poses, [name])[name]
    show_it = {name: scene.cameras[name] for name in scene.train if name in given or name not in scene.clean}
    found = all_views.solved(gaussians, all_views.neighbours(gaussians), show_it, image_of, clicks, given)
    if not found.labels.any():
        raise ValueError("scene.yaml: clicks: the views show nothing there; click in the middle of the object")
    names, masks = [name for name in (*scene.train, *scene.test) if name not in {*given, *scene.clean}], dict(given)
    for k in trace.progress(len(names), "masks from clicks"):
        name, camera, image = names[k], scene.cameras[names[k]], image_of(names[k])
        mask = all_views.shown(gaussians, found.labels, camera, image, clicks.get(name))
        if name in scene.train or all_views.there(gaussians, camera, image, mask):
            masks[name] = mask
    return masks


def deleted_from(poses: Path, device: str) -> Tensor | None:
    """bool [N], what someone deleted from the Gaussians that the scene brings; None where nobody did."""
    path = poses / "deleted.npy"
    return load_labels(path).to(device) if path.exists() else None


def check_brought(poses: Path, fit: Path, gaussians: Gaussians, train: list[Camera]) -> None:
    """ValueError where the Gaussians that the scene brings are not in the frame of its cameras."""
    if not (poses / "gaussians.ply").exists():
        return
    some = train[:: max(1, len(train) // LOOKED_AT)]
    photos = {camera.name: exposure.load_views(poses, fit, [camera.name])[camera.name] for camera in some}
    if wrong := frame_check.misplaced(gaussians, some, photos):
        raise ValueError(f"{poses / 'gaussians.ply'}: `gaussians` of scene.yaml: {wrong}")


def voted(
    params: Params, gaussians: Gaussians, train: list[Camera], ballots: dict[str, np.ndarray], seen: Votes
) -> Tensor:
    """Labels [N] bool by the masks of the views that vote; `seen`: the votes by weight."""
    votes = seen if params.vote == "weight" else voting.cast_votes(gaussians, train, ballots, mode=params.vote)
    labels = voting.label_gaussians(votes, params.tau)
    # What hardly any view sees (buried in the object, or in the wall behind it) votes by where it stands. PAPER leaves
    # open: the ratio of 0 to 0, what no view sees at all.
    unseen = seen.masked + seen.unmasked <= (BURIED if params.tidy else 0)
    return labels | (unseen & voting.hidden_inside(gaussians, train, ballots))


def drawn(params: Params, gaussians: Gaussians, labels: Tensor, cameras: dict[str, Camera]) -> dict[str, np.ndarray]:
    """The labels rendered back into each view: its consistent mask C, bool [H, W]."""
    shares = {name: voting.label_view(gaussians, labels, camera) for name, camera in cameras.items()}
    return {name: tidied(params, share > params.tau_rendered) for name, share in shares.items()}


def classified(
    params: Params,
    scene: Scene,
    remaining: Gaussians,
    raw: dict[str, np.ndarray],
    consistent: dict[str, np.ndarray],
    views: list[Witness],
    planes: list[Plane],
    mirrors: list[Mirror],
    fill: Filled,
) -> dict[str, MaskSet]:
    """The masks of each view: what other views show behind the object is decided, and is not invented."""
    names = list(scene.cameras)

    def masks_of(name: str) -> MaskSet:
        camera = scene.cameras[name]
        found = unobserved.behind(remaining, camera, consistent[name], views, planes, mirrors)
        unknown = tidied(params, found.undecided) & consistent[name] & (name not in scene.clean)
        invent = consistent[name] & (name not in scene.clean) if params.invent == "consistent" else unknown
        invent = invent | fill.shown(camera, found.depth)
        return MaskSet(raw.get(name, np.zeros_like(unknown)), consistent[name], unknown, invent)

    with closing(side_by_side(masks_of, names, MOST_AT_ONCE if params.device == "cpu" else 1)) as found:
        return {names[k]: next(found) for k in trace.progress(len(names), "masks")}


def of_blank_views(
    params: Params, scene: Scene, gaussians: Gaussians, hidden: dict[str, np.ndarray], sets: dict[str, MaskSet]
) -> dict[str, MaskSet]:
    """The masks of views without pixels: what they show and no photograph does is unknown, and to be made up."""
    if not scene.blank:
        return {}
    seen_by = training_coverage.seen_views(gaussians, [scene.cameras[name] for name in scene.train], hidden)
    found = {
        name: tidied(params, training_coverage.unseen(gaussians, scene.cameras[name], seen_by)) for name in scene.blank
    }
    union = lambda name, mask: MaskSet(
        sets[name].raw, sets[name].consistent | mask, sets[name].undecided | mask, sets[name].invent | mask
    )
    return {name: union(name, mask) for name, mask in found.items()}


def continuations(gaussians: Gaussians, labels: Tensor, views: list[Witness], points: np.ndarray) -> list[Plane]:
    """The planes around the object; none where there is none."""
    return planes_around(*extent(gaussians.means[labels]), views, points, SEED) if labels.any() else []


def tidied(params: Params, mask: np.ndarray) -> np.ndarray:
    return voting.tidy(mask, SPECK * mask.shape[1], GAP * mask.shape[1]) if params.tidy else mask


def pixels_of(kind: str, sets: dict[str, MaskSet], names: Sequence[str]) -> int:
    return int(sum(np.count_nonzero(getattr(sets[name], kind)) for name in names))


def share_undecided(sets: dict[str, MaskSet], names: Sequence[str]) -> float:
    """Of the consistent masks' pixels, those behind which no photograph tells what is to be seen."""
    return pixels_of("undecided", sets, names) / max(pixels_of("consistent", sets, names), 1)
