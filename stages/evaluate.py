"""Render every test view with the result and with the initialization, and score both where there is ground truth."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from reffusion import trace
from reffusion.background import backdrop, training_coverage
from reffusion.background.visibility import OPAQUE
from reffusion.fit import exposure
from reffusion.inpaint import feedforward
from reffusion.inpaint.classical import Painter
from reffusion.io.arrays import load_json, save_json
from reffusion.io.images import load_image, load_mask, save_image
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import has_object_mask, load_raw_masks, load_scene
from reffusion.kernels.compiled import side_by_side
from reffusion.metrics import consistency, image_metrics, lpips, rows
from reffusion.metrics.consistency import Shown
from reffusion.morphology import dilate
from reffusion.params.evaluate import Params
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Scene

FOLDERS = {"fit": "renders_fit", "initialize": "renders_initialize", "distill": "renders"}
MOST_AT_ONCE = 4  # views, each with all its pictures in memory
LEAST_UNSEEN = 0.005  # mean share of a test view's pixels from which the scene is closed by a backdrop


class Work(NamedTuple):
    """What every view is drawn with and compared with.

    Attributes:
        out, poses, raw_masks, masks: folders; masks may be None.
        gaussians: stage -> what is rendered of it.
        result: the stage whose Gaussians are the result.
        painter: what inpaints the rendered views; None where nothing does.
        tested: the views are test views, and scored where they have a picture.
        unseen: test view -> bool [H, W], pixels that no training view saw.
        exposures: view -> [3, 4], how it is exposed; none where the photographs' were not fitted.
    """

    out: Path
    poses: Path
    raw_masks: Path
    masks: Path | None
    gaussians: dict[str, Gaussians]
    result: str
    painter: Painter | None
    tested: bool
    unseen: dict[str, np.ndarray]
    exposures: dict[str, np.ndarray]


def run(
    params: Params,
    out: Path,
    *,
    poses: Path,
    raw_masks: Path,
    fit: Path,
    masks: Path | None = None,
    reference: Path | None = None,
    personalize: Path | None = None,
    lift: Path | None = None,
    initialize: Path | None = None,
    distill: Path | None = None,
) -> None:
    """Write renders*/, side_by_side/, metrics.json, per_view.csv and scene.ply.

    The result and the initialization are completed beyond the capture; the fit is not, and says which pixels were
    seen. The result is what `distill` made, else `initialize`, else `fit` (nothing to remove). Training views
    and test views without a picture are rendered and not scored. `reference`, `personalize` and `lift` give their
    seconds only.
    """
    needs = {"poses": poses, "raw_masks": raw_masks, "fit": fit, "masks": masks, "reference": reference}
    needs |= {"personalize": personalize, "lift": lift, "initialize": initialize, "distill": distill}
    scene = load_scene(poses)
    loaded = {net: lpips.load(net) for net in ("vgg", "alex")}
    models = {net: model for net, (model, _) in loaded.items() if model}
    names, kind = views_of(scene)
    longest = reduced_side(params, raw_masks)
    work, counts = prepared(params, scene, out, needs, tested=kind == "test")
    scored, before = [], None
    looked = lambda name: evaluate_view(work, scene.cameras[name], models, longest)
    at_once = MOST_AT_ONCE if params.device == "cpu" else 1
    with closing(side_by_side(looked, names, at_once)) as views:
        for _ in trace.progress(len(names), "evaluate"):
            shown, row = next(views)
            if before:
                rows.add_consistency(scored[-1], before, shown)
            before = shown
            scored.append(row)

    (out / "per_view.csv").write_text(rows.table(scored))
    save_ply(out / "scene.ply", work.gaussians[work.result], similarity=scene.similarity)
    summary = {
        **rows.summary(scored),
        "reduced": rows.summarize_reduced(scored, longest),
        "rendered": f"{len(names)} {kind} views",
        "result": work.result,
        "suspects": [name for name in names if name in scene.suspects] or None,  # their photographs contradict poses
        "consistency": rows.consistency_of(scored),
        **used(work.painter and work.painter.name, distill),
        "exposure": exposure.PROTOCOL if work.exposures else None,
        "lpips_unavailable": "; ".join(reason for _, reason in loaded.values() if reason) or None,
        "gaussians": counts,
        "seconds": seconds(needs),
        "protocol": rows.protocol(scored, models),
    }
    save_json(out / "metrics.json", summary)


def prepared(
    params: Params, scene: Scene, out: Path, needs: dict[str, Path | None], tested: bool
) -> tuple[Work, dict[str, int]]:
    """What the views are drawn with, and how many Gaussians each stage left."""
    poses, raw_masks, masks = needs["poses"], needs["raw_masks"], needs["masks"]
    made = [stage for stage in FOLDERS if needs[stage]]
    gaussians = {s: load_ply(needs[s] / "gaussians.ply").map(lambda p: p.to(params.device)) for s in made}
    result, captured, counts = made[-1], gaussians["fit"], {stage: len(value) for stage, value in gaussians.items()}
    unseen = unseen_in(scene, captured, raw_masks, masks) if tested else {}
    # Brought Gaussians may know more than these views do.
    hidden = {name: mask_of(scene.cameras[name], raw_masks, masks) for name in unseen}
    if params.beyond and reaches_beyond(unseen, hidden) and not (poses / "gaussians.ply").exists():
        # What was made up in views without pixels is as good as seen.
        views = (*scene.train, *scene.blank) if needs["reference"] else scene.train
        gaussians |= finished([scene.cameras[name] for name in views], gaussians, result)
    painter = feedforward.load_by_name(params.inpainter, params.device) if params.inpaint else None
    exposures = exposure.view_exposures(needs["fit"], list(scene.cameras.values()))
    return Work(out, poses, raw_masks, masks, gaussians, result, painter, tested, unseen, exposures), counts


def evaluate_view(work: Work, camera: Camera, models: dict, longest: int) -> tuple[Shown, dict[str, Any]]:
    """The view as the result shows it, saved with all that goes with it; and its row of scores."""
    truth = truth_for(work, camera)
    shown, pictures = rendered(work, camera, exposure_of(work, camera, truth.picture))
    save_side_by_side(work.out, pictures["fit"], truth.picture, shown)
    return shown, rows.row_of(shown, pictures.get("initialize"), truth, models, longest)


@torch.no_grad()
def exposure_of(work: Work, camera: Camera, photo: np.ndarray | None) -> np.ndarray | None:
    """[3, 4], how the view is drawn, see `exposure.PROTOCOL`; None where the photographs are exposed alike."""
    told = work.exposures.get(camera.name)
    if told is None or photo is None:
        return told
    drawn = rasterizer.render(work.gaussians["fit"], camera)
    color, there = exposure.apply_exposure(drawn.color, told).cpu().numpy(), drawn.alpha.cpu().numpy() > OPAQUE
    outside = ~dilate(mask_of(camera, work.raw_masks, work.masks), rows.OUTSIDE_MARGIN)
    return exposure.match_exposure(told, color, photo, outside & there)


def rendered(work: Work, camera: Camera, how: np.ndarray | None) -> tuple[Shown, dict[str, np.ndarray]]:
    """The view, exposed so, as the result shows it, saved; and stage -> uint8 [H, W, 3], its own rendering, saved."""
    file = f"{camera.name}.png"
    drawings = {s: drawn(each, camera, work.out / FOLDERS[s] / file, how) for s, each in work.gaussians.items()}
    pictures = {stage: picture for stage, (picture, _) in drawings.items()}
    shown = Shown(camera, *drawings[work.result], mask_of(camera, work.raw_masks, work.masks), how)
    if work.painter:
        picture = work.painter.paint(shown.picture, shown.mask)
        shown = shown._replace(picture=picture, depth=consistency.depth_through(shown.depth, shown.mask))
    if work.painter or FOLDERS[work.result] != "renders":  # else it lies there
        save_image(work.out / "renders" / file, shown.picture)
    return shown, pictures


def truth_for(work: Work, camera: Camera) -> rows.Truth:
    """What the view is compared with; its photograph shows the object where it has a mask among the training views'.

    Nothing where an object is kept: test photographs show none.
    """
    kept = work.masks and load_json(work.masks / "facts.json").get("kept")
    picture = truth_of(camera, work.poses) if work.tested and not kept else None
    with_object = has_object_mask(work.raw_masks, work.masks, camera.name)
    return rows.Truth(picture, with_object, work.unseen.get(camera.name))


def save_side_by_side(out: Path, fit: np.ndarray, truth: np.ndarray | None, shown: Shown) -> None:
    panels = [p for p in (fit, truth, shown.picture) if p is not None]
    picture = image_metrics.side_by_side(panels, image_metrics.mask_box(shown.mask))
    save_image(out / "side_by_side" / f"{shown.camera.name}.png", picture)


def reduced_side(params: Params, raw_masks: Path) -> int:
    """Larger side in px at which boxes are scored beside their own size; 0: at none."""
    if params.longest is not None:
        return params.longest
    facts = raw_masks / "facts.json"
    return load_json(facts)["test_masks_longest"] if facts.exists() else 0


def views_of(scene: Scene) -> tuple[tuple[str, ...], str]:
    """The test views; without any, every 8th training view (all of them where that leaves fewer than 8)."""
    if scene.test:
        return scene.test, "test"
    eighth = scene.train[::8]
    return (eighth, "training, every 8th") if len(eighth) >= 8 else (scene.train, "training")


def unseen_in(scene: Scene, captured: Gaussians, raw_masks: Path, masks: Path | None) -> dict[str, np.ndarray]:
    """Test view -> bool [H, W], pixels that show what no training view saw."""
    seen_by = training_coverage.seen_views(*captured_by(scene, captured, raw_masks, masks))
    return {name: training_coverage.unseen(captured, scene.cameras[name], seen_by) for name in scene.test}


def reaches_beyond(unseen: dict[str, np.ndarray], hidden: dict[str, np.ndarray]) -> bool:
    """Do the test views show enough that no training view saw for a backdrop to be worth it? Without any: perhaps.

    Not counted is where they show the object (`hidden`), which no training view shows beside its mask."""
    return not unseen or float(np.mean([(each & ~hidden[name]).mean() for name, each in unseen.items()])) > LEAST_UNSEEN


def finished(cameras: list[Camera], gaussians: dict[str, Gaussians], result: str) -> dict[str, Gaussians]:
    """Stage -> its Gaussians completed by what lies beyond the capture: of the result, and of the initialization."""
    stages = list(dict.fromkeys(stage for stage in (result, "initialize") if stage in gaussians))
    return dict(zip(stages, backdrop.completed([gaussians[stage] for stage in stages], cameras), strict=True))


def captured_by(
    scene: Scene, captured: Gaussians, raw_masks: Path, masks: Path | None
) -> tuple[Gaussians, list[Camera], dict[str, np.ndarray]]:
    """What `sight.seen_views` takes: the fit, the training views, and where those show the object."""
    cameras = [scene.cameras[name] for name in scene.train]
    hidden = {camera.name: mask_of(camera, raw_masks, masks) for camera in cameras if camera.name not in scene.clean}
    return captured, cameras, hidden


def drawn(
    gaussians: Gaussians, camera: Camera, path: Path, exposed: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Render to `path`, and give back what the file holds: scores are of the 8-bit picture that anyone can open; and
    the depth, [H, W] float64, 0 where hardly anything is, for the comparison with a view's neighbour."""
    with torch.no_grad():
        drawing = rasterizer.render(gaussians, camera)
    save_image(path, exposure.apply_exposure(drawing.color, exposed).clamp(0, 1).cpu().numpy())
    depth, alpha = drawing.depth.double().cpu().numpy(), drawing.alpha.cpu().numpy()
    return load_image(path), np.where(alpha > consistency.SOLID, depth, 0.0)


def truth_of(camera: Camera, poses: Path) -> np.ndarray | None:
    """uint8 [H, W, 3], the view's own picture; None where the scene has none. ValueError where its size is wrong."""
    path = poses / "images" / f"{camera.name}.png"
    if not path.exists():
        return None
    image = load_image(path)
    if image.shape[:2] != (camera.height, camera.width):
        raise ValueError(
            f"{path}: {image.shape[1]}x{image.shape[0]} px, its camera {camera.width}x{camera.height}; run poses again"
        )
    return image


def mask_of(camera: Camera, raw_masks: Path, masks: Path | None) -> np.ndarray:
    """bool [H, W]: the view's test mask, else its consistent mask, else (a variant without the stage masks) its raw
    mask, else empty. Where there are test masks, every variant is so scored in the same box."""
    size, file = (camera.height, camera.width), f"{camera.name}.png"
    given = [raw_masks / "test_masks" / file, *([masks / "consistent" / file] if masks else [])]
    found = [path for path in given if path.exists()]
    raw = {} if found else load_raw_masks(raw_masks, [camera.name])
    return load_mask(found[0], size) if found else raw.get(camera.name, np.zeros(size, bool))


def used(painter: str | None, distill: Path | None) -> dict[str, str | None]:
    """{"inpainter", "perceptual"}: what painted in 2D and what compared patches, None where nothing did."""
    facts = distill / "facts.json" if distill else None
    said = load_json(facts) if facts and facts.exists() else {}
    return {"inpainter": painter or said.get("inpainter"), "perceptual": said.get("perceptual")}


def seconds(needs: dict[str, Path | None]) -> dict[str, float]:
    """Stage -> seconds of its run, from the receipts that are there."""
    receipts = {stage: folder / "receipt.json" for stage, folder in needs.items() if folder}
    return {stage: load_json(path).get("seconds") for stage, path in receipts.items() if path.exists()}
