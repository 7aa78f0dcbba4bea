"""The stage `evaluate`: test views are rendered from the fit, the initialization and the result.

Renders of the initialization and of the result are compared with ground truth if there is any.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.fit import exposure
from reffusion.inpaint import feedforward
from reffusion.io.arrays import load_json, save_json
from reffusion.io.ground_truth import load_ground_truth, load_object_mask, load_training_object_masks
from reffusion.io.images import save_image
from reffusion.io.ply import load_ply
from reffusion.io.scene import has_object_mask, load_scene
from reffusion.metrics import evaluation, image_metrics, leftovers, lpips, rows
from reffusion.metrics.consistency import RenderedView
from reffusion.metrics.view_renders import ViewRenderer, ViewRenders
from reffusion.params.evaluate import Params
from reffusion.types import Gaussians

FOLDERS = {"fit": "renders_fit", "initialize": "renders_initialize", "distill": "renders"}  # stage -> its renders


def run(
    params: Params,
    out: Path,
    *,
    poses: Path,
    raw_masks: Path,
    fit: Path,
    finish: Path,
    masks: Path | None = None,
    initialize: Path | None = None,
    distill: Path | None = None,
) -> None:
    """Run the stage: render and score the test views. A scene without test views gets renders of training views.

    Writes renders/<view>.png (the result), renders_fit/ and renders_initialize/ (the Gaussians of these stages),
    side_by_side/<view>.png, metrics.json (means), per_view.csv and a copy of scene.ply. The result and the
    initialization are rendered with the backdrop, if the stage `finish` added one.

    A test view without a picture, and a training view, is rendered but not scored. If the scene keeps one of several
    objects, nothing is scored, because the test photographs show no object at all.

    Args:
        out: folder of this stage.
        poses, raw_masks, fit, finish, masks, initialize, distill: folders of the stages of these names; the last three
            are None if the stage was skipped.
    """
    scene, facts = load_scene(poses), load_json(finish / "facts.json")
    names, kind = evaluation.views_to_render(scene)
    painter = feedforward.load_inpainter(params.inpainter, params.device) if params.inpaint else None
    exposures = exposure.view_exposures(fit, list(scene.cameras.values()))
    gaussians = load_stages(finish, {"fit": fit, "initialize": initialize, "distill": distill}, params.device)
    renderer = ViewRenderer(gaussians, facts["result"], painter, exposures)
    object_masks = load_training_object_masks(scene, raw_masks, masks) if scene.test else {}
    unseen = evaluation.unseen_by_training(scene, load_ply(fit / "gaussians.ply", device=params.device), object_masks)
    has_truth = kind == "test" and not (masks and load_json(masks / "facts.json").get("kept"))
    networks = {net: lpips.load(net) for net in ("vgg", "alex")}
    segmenter, no_segmenter = leftovers.load_segmenter()
    examined = names[:: -(-len(names) // leftovers.MOST_VIEWS)] if facts["result"] != "fit" else ()
    models = {net: model for net, (model, _) in networks.items() if model}
    scorer = evaluation.ViewScorer(models, reduced_side(params, raw_masks), segmenter, examined)

    def evaluate_view(name: str) -> tuple[RenderedView, dict[str, Any]]:
        picture = load_ground_truth(scene.cameras[name], poses) if has_truth else None
        renders = renderer.render(scene.cameras[name], load_object_mask(scene.cameras[name], raw_masks, masks), picture)
        save_renders(out, renders, picture)
        truth = rows.GroundTruth(picture, has_object_mask(raw_masks, masks, name), unseen.get(name))
        return renders.result, scorer.score(renders, truth)

    scored = evaluation.score_in_order(evaluate_view, names, params.device)
    (out / "per_view.csv").write_text(rows.to_csv(scored))
    shutil.copyfile(finish / "scene.ply", out / "scene.ply")
    summary = {
        **rows.summarize(scored),
        "reduced": rows.summarize_reduced(scored, scorer.longest),
        "imfine_bbox_v1": rows.summarize_imfine(scored),
        "leftovers": rows.summarize_leftovers(scored, no_segmenter),
        "rendered": f"{len(names)} {kind} views",
        "result": facts["result"],
        "backdrop": facts["backdrop"],
        # views that were kept although their photographs contradict their poses
        "suspects": [name for name in names if name in scene.suspects] or None,
        "consistency": rows.summarize_consistency(scored),
        **networks_used(painter.name if painter else None, distill),
        "exposure": exposure.PROTOCOL if exposures else None,
        "lpips_unavailable": "; ".join(reason for _, reason in networks.values() if reason) or None,
        "gaussians": facts["gaussians"],
        "protocol": rows.protocol(scored, models),
    }
    save_json(out / "metrics.json", summary)


def load_stages(finish: Path, folders: dict[str, Path | None], device: str) -> dict[str, Gaussians]:
    """Read the Gaussians that each stage made, with the backdrop of the stage `finish` if it added one to them.

    Args:
        finish: folder of the stage `finish`.
        folders: stage -> its folder; None if it was skipped.

    Returns:
        Stage -> Gaussians in the normalized frame, without the skipped stages.
    """
    gaussians = {}
    for stage, folder in folders.items():
        if folder:
            completed = finish / "completed" / f"{stage}.ply"
            path = completed if completed.exists() else folder / "gaussians.ply"
            gaussians[stage] = load_ply(path, device=device)
    return gaussians


def save_renders(out: Path, renders: ViewRenders, truth: np.ndarray | None) -> None:
    """Write the renders of a view to the folder of each stage, and fit, ground truth and result side by side.

    The result goes to renders/ whichever stage made it. The box of the object is drawn into the joined picture.

    Args:
        out: folder of this stage.
        truth: uint8 [H, W, 3]; None if there is no ground truth.
    """
    view = renders.result
    file = f"{view.camera.name}.png"
    pictures = {FOLDERS[stage]: picture for stage, picture in renders.by_stage.items()} | {"renders": view.picture}
    panels = [panel for panel in (renders.by_stage["fit"], truth, view.picture) if panel is not None]
    pictures["side_by_side"] = image_metrics.join_side_by_side(panels, image_metrics.mask_box(view.mask))
    for folder, picture in pictures.items():
        save_image(out / folder / file, picture)


def reduced_side(params: Params, raw_masks: Path) -> int:
    """Return the larger side in px to which pictures are reduced for a second set of scores; 0 for no second set.

    It is `params.longest`, or if that is None the larger side of the test masks' files, or 0 without test masks.

    Args:
        raw_masks: folder of the stage `raw_masks`.
    """
    if params.longest is not None:
        return params.longest
    facts = raw_masks / "facts.json"
    return load_json(facts)["test_masks_longest"] if facts.exists() else 0


def networks_used(painter: str | None, distill: Path | None) -> dict[str, str | None]:
    """Return the names of the networks that took part in the result.

    Args:
        painter: name of the 2D inpainter of this stage; None if it inpainted nothing.
        distill: folder of the stage `distill`; None if it was skipped.

    Returns:
        "inpainter" (of this stage, or else of the stage `lift`) and "perceptual" (the network of the perceptual
        distance in `distill`) -> name; None if no such network was used.
    """
    facts = distill / "facts.json" if distill else None
    said = load_json(facts) if facts and facts.exists() else {}
    return {"inpainter": painter or said.get("inpainter"), "perceptual": said.get("perceptual")}
