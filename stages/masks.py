"""The stage `masks`: raw masks vote on which Gaussians are the object, and the pixels of every view are classified.

The labelled Gaussians are rendered into each view, which gives its consistent mask C. Pixels of C behind which no other
photograph shows the background are unobserved (U). Pixels to be invented are the invent mask I, see
`reffusion.types.MaskSet`.
"""

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
    load_ignored,
    load_raw_masks,
    load_scene,
    load_views,
    load_warnings,
    save_mask_sets,
)  # fmt: skip
from reffusion.masks import consolidation, provided_gaussians, voting
from reffusion.masks.debris import find_debris
from reffusion.masks.regions import FillRequest, Region
from reffusion.masks.remnants import Remnant, find_remnants
from reffusion.masks.soft_shadow import SoftShadow, find_soft_shadow
from reffusion.params.masks import Params
from reffusion.types import Camera, Gaussians, Scene
from reffusion.workspace import SURFACES

TINT = (255, 0, 160)  # RGB color that marks a remnant (a part of the object that the masks leave out) in its picture
CHECKED_VIEWS = 8  # number of views in which Gaussians that the scene brings are compared with the photographs


def run(params: Params, out: Path, *, poses: Path, raw_masks: Path, fit: Path) -> None:
    """Run the stage: label the Gaussians to remove, and classify the pixels of every view.

    Writes:

    - labels.npy, bool [N]: the Gaussians to remove, which are the object's and debris;
    - debris.npy, bool [N]: Gaussians that the object had hidden and that no photograph supports (all False unless
      debris is searched), and scattered ones that a user deleted in an editor;
    - background.npz: planes and mirror planes around the object if the classes depend on them, and its soft shadow if
      one is found;
    - raw/, consistent/, unobserved/ and invent/<view>.png: the pixel classes;
    - facts.json;
    - warnings.json and remnants/<number>.png, if the masks seem to leave out parts of the object.

    Args:
        out: folder of this stage.
        poses, raw_masks, fit: folders of the stages of these names.

    Raises:
        ValueError: nothing says what is to be changed, or the Gaussians that the scene brings do not fit its cameras.
    """
    scene, gaussians = load_scene(poses), load_ply(fit / "gaussians.ply", device=params.device)
    train = [scene.cameras[name] for name in scene.train]
    check_frame(poses, fit, gaussians, train)
    region, (deleted, scattered) = load_region(raw_masks), load_deleted(poses, params.device)
    raw = {} if deleted is not None else collect_raw_masks(params, scene, gaussians, poses, raw_masks)
    fill = FillRequest(region, load_fill_masks(raw_masks)) if params.invent != "unobserved" else FillRequest(None, {})
    if deleted is None and not raw and region is None and not fill.masks and not scene.camera_only:
        raise ValueError(f"{raw_masks}: neither masks nor a region say what is to be changed: add masks, or a region")

    empty = {name: np.zeros((camera.height, camera.width), bool) for name, camera in scene.cameras.items()}
    ignored = load_ignored(poses, scene.train)
    ballots = {name: raw[name] for name in scene.train if name in raw}
    ballots |= {name: empty[name] for name in scene.clean} if raw else {}
    labels = (
        deleted
        if deleted is not None
        else consolidation.label_object(params, gaussians, train, ballots, ignored, region)
    )
    photo_of = lambda name: load_views(poses, [name])[name]
    labels, consistent, remnants = complete_object(params, scene, gaussians, labels, out, photo_of, bool(raw))
    if deleted is not None:
        labels = deleted | limit_extras(labels & ~deleted, deleted, "inside", out)
    hidden = {name: empty[name] if name in scene.clean else consistent[name] for name in scene.cameras}
    hidden |= {name: hidden[name] | mask for name, mask in ignored.items()}

    background = Background(render_depth_views(gaussians, train, hidden), {}, points=scene.points)
    needs_surfaces = params.shadows or consolidation.needs_unobserved(params, fill)
    if needs_surfaces:
        background = background.with_planes(gaussians, labels)
    if background.planes or params.debris:
        background = replace(background, photos=exposure.load_normalized_views(poses, fit, scene.train))
    shadow = find_shadow(params, background, gaussians.means[labels], scene)
    debris = torch.zeros_like(labels) if scattered is None else scattered
    if params.debris and (raw or deleted is not None):
        found = find_debris(gaussians, labels, background.views, hidden, background.photos) & ~debris
        debris = debris | (found if deleted is None else limit_extras(found, deleted, "behind", out))
    save_labels(out / "debris.npy", debris.cpu())
    labels = labels | debris
    remaining = gaussians.map(lambda p: p[~labels])
    if needs_surfaces:
        background = background.with_mirrors(remaining)

    sets = consolidation.classify_pixels(params, scene, remaining, raw, consistent, background, fill)
    sets |= consolidation.add_uncaptured_pixels(params, scene, gaussians, hidden, sets)
    repainted = (*scene.train, *scene.camera_only)
    share = consolidation.unobserved_share(sets, repainted)
    sets = consolidation.drop_negligible(params, sets, repainted, fill)
    save_labels(out / "labels.npy", labels.cpu())
    surfaces = surfaces_to_arrays(background) if needs_surfaces else {}
    save_arrays(out / SURFACES, surfaces | (shadow.to_arrays() if shadow else {}))
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
        "shadow": shadow and float(1 - np.exp(shadow.log_light.min())),
        "region": region and {"center": list(region.center), "size": list(region.size)},
    }
    save_json(out / "facts.json", facts)


def complete_object(
    params: Params,
    scene: Scene,
    gaussians: Gaussians,
    labels: Tensor,
    out: Path,
    photo_of: Callable[[str], np.ndarray],
    has_masks: bool,
) -> tuple[Tensor, dict[str, np.ndarray], list[Remnant]]:
    """Extend the labels of an object by what can only belong to it, and by remnants that would float in the air.

    A Gaussian whose center lies inside C in (almost) every view can only belong to the object, whatever its votes.
    Remnants are reported.

    Args:
        labels: bool [N], the Gaussians that won the vote.
        out: folder of this stage.
        photo_of: view name -> uint8 [H, W, 3].
        has_masks: whether the scene brings masks, which alone can leave out parts.

    Returns:
        The labels, bool [N]; the consistent mask C of every view, view name -> bool [H, W]; and all remnants.
    """
    train = [scene.cameras[name] for name in scene.train]
    consistent = consolidation.render_consistent_masks(params, gaussians, labels, scene.cameras)
    dirty = {name: consistent[name] for name in scene.train if name not in scene.clean}
    labels = labels | voting.hidden_inside(gaussians, train, dirty, share=params.inside_share)
    if not (params.remnants and has_masks):
        return labels, consistent, []
    remnants = find_remnants(gaussians, labels, [camera for camera in train if camera.name in dirty])
    report_remnants(remnants, out, photo_of)
    for remnant in (each for each in remnants if each.would_float):
        labels = labels | torch.as_tensor(remnant.members, device=labels.device)
        consistent = consolidation.render_consistent_masks(params, gaussians, labels, scene.cameras)
    return labels, consistent, remnants


def find_shadow(params: Params, background: Background, object_means: Tensor, scene: Scene) -> SoftShadow | None:
    """Find the object's soft shadow, which no mask contains, and print a line if there is one.

    Args:
        background: with the photographs and the planes around the object.
        object_means: [N, 3], the centers of the object's Gaussians.
        scene: names the views that were photographed without the object, and so without its shadow.
    """
    if not params.shadows or not background.planes:
        return None
    with_object = {name: photo for name, photo in background.photos.items() if name not in scene.clean}
    shadow = find_soft_shadow(replace(background, photos=with_object), object_means)
    if shadow:
        darkest = 1 - np.exp(shadow.log_light.min())
        print(f"the object's shadow, up to {darkest:.0%} darker, is removed (masks.shadows=false keeps it)", flush=True)
    return shadow


def report_remnants(remnants: Sequence[Remnant], out: Path, photo_of: Callable[[str], np.ndarray]) -> None:
    """Warn of remnants, the parts of the object that the masks leave out, and draw each as remnants/<number>.png.

    The warnings are also written to warnings.json.

    Args:
        remnants: the parts. Of those that would float in the air, the text says that they are removed; the caller
            removes them.
        out: folder of this stage.
        photo_of: view name -> uint8 [H, W, 3].
    """
    described: dict[bool, list[str]] = {True: [], False: []}  # would float -> texts
    for k, remnant in enumerate(remnants, start=1):
        photo, picture = photo_of(remnant.view).copy(), f"remnants/{k}.png"
        photo[remnant.mask] = photo[remnant.mask] // 2 + np.array(TINT) // 2
        save_image(out / picture, photo)
        described[remnant.would_float].append(f"{remnant.describe()}, see masks/{picture}")
    outcomes = {
        True: "parts of the object that no mask covers are removed, too, because they would float in the air (to keep "
        "them: `--set masks.remnants=false`)",
        False: "parts of the object seem to be left; if so, mark them in these views and run again",
    }
    lines = [f"{outcomes[floats]}: {'; '.join(texts)}" for floats, texts in described.items() if texts]
    for line in lines:
        warnings.warn(line, stacklevel=1)
    if lines:
        save_json(out / WARNINGS, lines)


def load_region(raw_masks: Path) -> Region | None:
    """Read the region in space that the scene names, in the normalised frame; None if it names none."""
    path = raw_masks / "region.json"
    return Region(**load_json(path)) if path.exists() else None


def load_deleted(poses: Path, device: str) -> tuple[Tensor | None, Tensor | None]:
    """Read which of the Gaussians that the scene brings were deleted by the user in a splat editor.

    Args:
        poses: folder of the stage `poses`.
        device: device of the result.

    Returns:
        deleted: bool [N], True for deleted Gaussians that leave a hole. They are the object's labels instead of votes.
        scattered: bool [N], True for deleted Gaussians that stood alone: they are removed, and leave no hole.
        Both are None if the scene has no such file.
    """
    if not (poses / "deleted.npy").exists():
        return None, None
    deleted, path = load_labels(poses / "deleted.npy").to(device), poses / "scattered.npy"
    scattered = load_labels(path).to(device) if path.exists() else torch.zeros_like(deleted)
    return deleted & ~scattered, scattered


def limit_extras(extras: Tensor, deleted: Tensor, where: str, out: Path) -> Tensor:
    """Return the Gaussians to remove besides those that a user deleted in an editor, or none if they outnumber these.

    An object may hide some Gaussians, which an editor does not show. If they outnumber the object's own, the hole is
    probably no object's, and what the user left in the scene stays. A warning then goes to warnings.json.

    Args:
        extras: bool [N], True for Gaussians to remove that the user did not delete.
        deleted: bool [N], True for Gaussians that the user deleted.
        where: where the extras are, "inside" or "behind" the hole, for the warning.
        out: folder of this stage.
    """
    if (count := int(extras.sum())) <= int(deleted.sum()):
        return extras
    lines = [
        *load_warnings(out),
        f"{count} splats {where} the hole stay, because they are more than the {int(deleted.sum())} that were deleted "
        "there; if they belong to the object, delete them too",
    ]
    warnings.warn(lines[-1], stacklevel=1)
    save_json(out / WARNINGS, lines)
    return torch.zeros_like(extras)


def collect_raw_masks(
    params: Params, scene: Scene, gaussians: Gaussians, poses: Path, raw_masks: Path
) -> dict[str, np.ndarray]:
    """Return the raw masks of the views, as a dict view name -> bool [H, W], True = the object.

    They are the masks that the scene brings for training views, united over the objects to remove (`params.remove`;
    None: all). If `params.refine`, the segmentation network redraws them and makes masks for the other training views
    that show the object. Clicks, if there are any, give masks to the views without one, test views included. The dict
    is empty if the scene has neither masks nor clicks.

    Args:
        poses, raw_masks: folders of the stages of these names.

    Raises:
        ValueError: several objects have masks of their own, and no view has a mask of each.
    """
    raw = load_raw_masks(raw_masks, scene.train, params.remove)
    if list_objects(raw_masks) and not raw:
        raise ValueError(
            f"{raw_masks / 'masks'}: no view has a mask of each object; add empty ones where one is unseen"
        )
    if params.refine and any(mask.any() for mask in raw.values()):
        segmenter = load_local_segmenter(params.segmenter)
        assert segmenter is not None  # `refine` requires a network, and missing files are reported before the run
        raw = raw | refine_masks(scene, gaussians, poses, raw, segmenter)
    if not params.clicks:
        return raw
    return masks_from_clicks(scene, gaussians, poses, params.clicks, raw, load_local_segmenter(params.segmenter))


def check_frame(poses: Path, fit: Path, gaussians: Gaussians, train: list[Camera]) -> None:
    """Check that the Gaussians that the scene brings are in the frame of its cameras.

    Renderings of some training views are compared with the photographs. A scene whose Gaussians were fitted here is not
    checked.

    Args:
        poses, fit: folders of the stages of these names.
        gaussians: in the normalised frame.
        train: the training views.

    Raises:
        ValueError: the Gaussians are elsewhere, or in another orientation or scale.
    """
    if not (poses / "gaussians.ply").exists():
        return
    some = train[:: max(1, len(train) // CHECKED_VIEWS)]
    photos = exposure.load_normalized_views(poses, fit, [camera.name for camera in some])
    if problem := provided_gaussians.explain_misplacement(gaussians, some, photos):
        raise ValueError(f"{poses / 'gaussians.ply'}: `gaussians` of scene.yaml: {problem}")
