"""The stage `masks`: raw masks vote on which Gaussians are the object, and the pixels of every view are classified."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reffusion import morphology
from reffusion.background.model import surfaces_to_arrays
from reffusion.clicks.local_segmenter import load_local_segmenter
from reffusion.clicks.scene_masks import masks_from_clicks, refine_masks
from reffusion.fit import exposure
from reffusion.io.arrays import load_json, load_labels, save_arrays, save_json, save_labels
from reffusion.io.images import save_image
from reffusion.io.ply import load_ply
from reffusion.io.scene import (
    list_objects,
    load_fill_masks,
    load_ignored,
    load_raw_masks,
    load_scene,
    load_views,
    save_mask_sets,
    save_warnings,
)  # fmt: skip
from reffusion.masks import consolidation, provided_gaussians, voting
from reffusion.masks.classification import Classification, ObjectMarks, classify_scene
from reffusion.masks.regions import FillRequest, Region
from reffusion.masks.remnants import Remnant
from reffusion.params.masks import Params
from reffusion.types import Camera, Gaussians, Scene
from reffusion.workspace import SURFACES

TINT = (255, 0, 160)  # RGB color that marks a remnant (a part of the object that the masks leave out) in its picture
CHECKED_VIEWS = 8  # number of views in which Gaussians that the scene brings are compared with the photographs


def run(params: Params, out: Path, *, poses: Path, raw_masks: Path, fit: Path) -> None:
    """Run the stage: label the Gaussians to remove, and classify the pixels of every view.

    Writes:

    - labels.npy, bool [N]: the Gaussians to remove: the object's, parts of it that no mask covers and that would float,
      and debris;
    - debris.npy, bool [N]: Gaussians that the object had hidden and that no photograph supports (all False unless
      debris is searched), and scattered ones that a user deleted in an editor;
    - background.npz: planes and mirror planes around the object if the classes depend on them, and its soft shadow if
      one is found;
    - raw/, consistent/, unobserved/ and invent/<view>.png: the pixel classes;
    - facts.json;
    - warnings.json, if the masks seem to leave out parts of the object (drawn in remnants/<number>.png), or if splats
      stay in or behind a hole that a user cut in an editor.

    Args:
        out: folder of this stage.
        poses, raw_masks, fit: folders of the stages of these names.

    Raises:
        ValueError: nothing says what is to be changed, or the Gaussians that the scene brings do not fit its cameras.
    """
    scene, gaussians = load_scene(poses), load_ply(fit / "gaussians.ply", device=params.device)
    check_frame(poses, fit, gaussians, [scene.cameras[name] for name in scene.train])
    marks = load_marks(params, scene, gaussians, poses, raw_masks)
    load_photos = lambda: exposure.load_photos_in_scene_exposure(poses, fit, scene.train)
    found = classify_scene(params, scene, gaussians, marks, load_photos)
    messages = [*report_remnants(found.remnants, out, poses), *found.warnings]
    save_warnings(out, messages)
    save_labels(out / "debris.npy", found.debris.cpu())
    save_labels(out / "labels.npy", found.labels.cpu())
    save_arrays(out / SURFACES, collect_surfaces(found))
    save_mask_sets(out, found.sets)
    save_json(out / "facts.json", summarize(params, scene, marks, found, list_objects(raw_masks)))


def collect_surfaces(found: Classification) -> dict[str, np.ndarray]:
    """Return planes, mirrors and shadow as named arrays; none of the planes if the classes do not depend on them."""
    surfaces = surfaces_to_arrays(found.background) if found.has_surfaces else {}
    return surfaces | (found.shadow.to_arrays() if found.shadow else {})


def summarize(
    params: Params, scene: Scene, marks: ObjectMarks, found: Classification, objects: Sequence[str]
) -> dict[str, Any]:
    """Return the contents of facts.json.

    Args:
        objects: names of the objects that have masks of their own.
    """
    repainted = (*scene.train, *scene.camera_only)
    invent = {name: each.invent for name, each in found.sets.items()}
    region = marks.region
    return {
        "kept": [name for name in objects if params.remove is not None and name not in params.remove],
        "masked_gaussians": int(found.labels.sum()),
        "gaussians": len(found.labels),
        "voting_views": found.voting_views,
        "invent_pixels": consolidation.count_pixels("invent", found.sets, repainted),
        "consistent_pixels": consolidation.count_pixels("consistent", found.sets, repainted),
        "unobserved_share": found.unobserved_share,
        "invent_views": [name for name in repainted if invent[name].any()],
        "best_reference": voting.best_view(invent, scene.train),
        "remnants": [{"removed": each.would_float, "share": each.share, "view": each.view} for each in found.remnants],
        "shadow": found.shadow and found.shadow.strength,
        "region": region and {"center": list(region.center), "size": list(region.size)},
    }


def report_remnants(remnants: Sequence[Remnant], out: Path, poses: Path) -> list[str]:
    """Draw each remnant, a part of the object that the masks leave out, as remnants/<number>.png; return warnings.

    Args:
        remnants: the parts. Of those that would float in the air, the text says that they are removed.
        out: folder of this stage.
        poses: folder of the stage `poses`, which holds the photographs.
    """
    described: dict[bool, list[str]] = {True: [], False: []}  # would float -> texts
    for k, remnant in enumerate(remnants, start=1):
        photo, picture = load_views(poses, [remnant.view])[remnant.view].copy(), f"remnants/{k}.png"
        photo[remnant.mask] = photo[remnant.mask] // 2 + np.array(TINT) // 2
        save_image(out / picture, photo)
        described[remnant.would_float].append(f"{remnant.describe()}, see masks/{picture}")
    outcomes = {
        True: "parts of the object that no mask covers are removed, too, because they would float in the air (to keep "
        "them: `--set masks.remnants=false`)",
        False: "parts of the object seem to be left; if so, mark them in every view that shows them",
    }
    return [f"{outcomes[floats]}: {'; '.join(texts)}" for floats, texts in described.items() if texts]


def load_marks(params: Params, scene: Scene, gaussians: Gaussians, poses: Path, raw_masks: Path) -> ObjectMarks:
    """Load what says which pixels and Gaussians are the object.

    Args:
        poses, raw_masks: folders of the stages of these names.

    Raises:
        ValueError: nothing says what is to be changed.
    """
    region, (deleted, scattered) = load_region(raw_masks), load_deleted(poses, params.device)
    raw = {} if deleted is not None else collect_raw_masks(params, scene, gaussians, poses, raw_masks)
    fill = FillRequest(region, load_fill_masks(raw_masks)) if params.invent != "unobserved" else FillRequest(None, {})
    if deleted is None and not raw and region is None and not fill.masks and not scene.camera_only:
        raise ValueError(f"{raw_masks}: neither masks nor a region say what is to be changed: add masks, or a region")
    ignored = load_ignored(poses, scene.train)
    return ObjectMarks(raw, region, fill, ignored, deleted, scattered)


def load_region(raw_masks: Path) -> Region | None:
    """Read the region in space that the scene names, in the normalized frame; None if it names none."""
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


def collect_raw_masks(
    params: Params, scene: Scene, gaussians: Gaussians, poses: Path, raw_masks: Path
) -> dict[str, np.ndarray]:
    """Return the raw masks of the views, as a dict view name -> bool [H, W], True = the object.

    They are the masks that the scene brings for training views, united over the objects to remove (`params.remove`;
    None: all), and enlarged by `params.grow`. If `params.refine`, the segmentation network redraws them and makes masks
    for the other training views that show the object. Clicks, if there are any, give masks to the views without one,
    test views included. The dict is empty if the scene has neither masks nor clicks.

    Args:
        poses, raw_masks: folders of the stages of these names.

    Raises:
        ValueError: several objects have masks of their own, and no view has a mask of each.
    """
    raw = load_raw_masks(raw_masks, scene.train, params.remove)
    raw = {name: morphology.dilate(mask, params.grow) for name, mask in raw.items()}
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
        gaussians: in the normalized frame.
        train: the training views.

    Raises:
        ValueError: the Gaussians are elsewhere, or in another orientation or scale.
    """
    if not (poses / "gaussians.ply").exists():
        return
    some = train[:: max(1, len(train) // CHECKED_VIEWS)]
    photos = exposure.load_photos_in_scene_exposure(poses, fit, [camera.name for camera in some])
    if problem := provided_gaussians.explain_misplacement(gaussians, some, photos):
        raise ValueError(f"{poses / 'gaussians.ply'}: `gaussians` of scene.yaml: {problem}")
