"""Render every test view with the result and with the initialization, and score both where there is ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    import numpy as np

    from reffusion.score.consistency import Shown
    from reffusion.score.lpips import Lpips
    from reffusion.score.metrics import Box
    from reffusion.types import Camera, Gaussians, Scene

FOLDERS = {"fit": "renders_fit", "initialize": "renders_initialize", "distill": "renders"}
LEAST_UNSEEN = 0.005  # mean share of a test view's pixels from which the scene is closed by a backdrop
CONSISTENCY = ("consistency", "consistency_share")


class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    box_dilation: float = Field(
        0.1, ge=0.0, description="each side of the mask's box moves outwards by this share of the box's extent"
    )
    outside_margin: float = Field(
        0.01, ge=0, description="how much wider than the mask is left out of the scores outside it, / image width"
    )
    lpips_weights: str | None = Field(
        None,
        description="folder with LPIPS weights, looked into before ~/.cache/reffusion/lpips and torch hub's cache",
        json_schema_extra={"weights": True},
    )
    inpaint: bool = Field(False, description="a baseline: each rendered view is inpainted in 2D inside its mask")
    widen: float = Field(0.0, ge=0, description="how much wider than the mask it is inpainted, / image width")
    lama: str | None = Field(
        None,
        description="folder with LaMa's TorchScript file, for that; none: OpenCV's FSR, else Telea",
        json_schema_extra={"weights": True},
    )
    beyond: bool = Field(True, description="what no training view saw is closed by a soft backdrop, scene.ply's too")
    device: Literal["cpu", "cuda"] = Field("cpu", description="where the views are rendered")


def needed_weights(params: Params, brings: frozenset[str]) -> list:
    """What must lie on this machine, and what of it does not; `brings`: the keys of scene.yaml."""
    from reffusion.weights import local

    return local.of_lpips(params.lpips_weights)


def run(
    params: Params,
    out: Path,
    *,
    poses: Path,
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
    from reffusion import trace
    from reffusion.io.arrays import save_json
    from reffusion.io.images import save_image
    from reffusion.io.ply import load_ply, save_ply
    from reffusion.io.scene import load_scene
    from reffusion.paint import paint2d
    from reffusion.score import consistency, lpips, metrics

    needs = {"poses": poses, "fit": fit, "masks": masks, "reference": reference, "personalize": personalize}
    needs |= {"lift": lift, "initialize": initialize, "distill": distill}
    scene = load_scene(poses)
    loaded = {net: lpips.load(net, params.lpips_weights) for net in ("vgg", "alex")}
    models = {net: model for net, (model, _) in loaded.items() if model}
    made = [stage for stage in FOLDERS if needs[stage]]
    gaussians = {s: load_ply(needs[s] / "gaussians.ply").map(lambda p: p.to(params.device)) for s in made}
    result, captured, counts = made[-1], gaussians["fit"], {stage: len(value) for stage, value in gaussians.items()}
    names, kind = views_of(scene)
    unseen = unseen_in(scene, captured, poses, masks) if kind == "test" else {}
    # Brought Gaussians may know more than these views do.
    if params.beyond and reaches_beyond(unseen) and not (poses / "gaussians.ply").exists():
        gaussians |= finished(scene, gaussians, result)
    painter = paint2d.load(params.lama, params.device) if params.inpaint else None

    rows, before = [], None
    for index in trace.progress(len(names), "evaluate"):
        camera, file = scene.cameras[names[index]], f"{names[index]}.png"
        pictures = {stage: drawn(gaussians[stage], camera, out / FOLDERS[stage] / file) for stage in gaussians}
        shown = view_of(gaussians[result], camera, pictures[result], mask_of(camera, poses, masks))
        if painter:
            wide = paint2d.widened(shown.mask, params.widen)
            depth = consistency.depth_through(shown.depth, wide)
            shown = shown._replace(picture=painter.paint(shown.picture, wide), depth=depth)
        save_image(out / "renders" / file, shown.picture)
        if before:
            rows[-1] |= dict(zip(CONSISTENCY, consistency.difference(before, shown), strict=True))
        before, truth = shown, truth_of(camera, poses) if kind == "test" else None
        box = metrics.mask_box(shown.mask, params.box_dilation)
        panels = [p for p in (pictures["fit"], truth, shown.picture) if p is not None]
        save_image(out / "side_by_side" / file, metrics.side_by_side(panels, box))
        margin = paint2d.widened(shown.mask, params.outside_margin)
        held_out = (poses / "masks" / file).exists()  # a test view whose photograph shows the object
        given = (truth, box, models, margin, held_out, unseen.get(camera.name))
        rows.append(row_of(shown, pictures.get("initialize"), *given))

    (out / "per_view.csv").write_text(metrics.table(rows))
    save_ply(out / "scene.ply", gaussians[result], similarity=scene.similarity)
    summary = {
        **metrics.summary(rows),
        "rendered": f"{len(names)} {kind} views",
        "result": result,
        "consistency": consistency_of(rows),
        **used(painter and painter.name, distill),
        "lpips_unavailable": "; ".join(reason for _, reason in loaded.values() if reason) or None,
        "gaussians": counts,  # as the stages left them
        "seconds": seconds(needs),
        "protocol": protocol(params, rows, models),
    }
    save_json(out / "metrics.json", summary)


def row_of(
    shown: Shown,
    initial: np.ndarray | None,
    truth: np.ndarray | None,
    box: Box | None,
    models: dict[str, Lpips],
    margin: np.ndarray,
    held_out: bool,
    unseen: np.ndarray | None,
) -> dict[str, Any]:
    """A view's line of per_view.csv: its box, and its scores and the initialization's where there is a truth; see
    `metrics.score_view`, whose `mask`, `shows_object` and `unseen` the last three are."""
    from reffusion.score import metrics

    camera = shown.camera
    row = {"view": camera.name, "width": camera.width, "height": camera.height} | dict.fromkeys(CONSISTENCY)
    row |= dict(zip(("left", "top", "right", "bottom"), box or (None,) * 4, strict=True))
    if truth is not None:
        given = truth, box, models, margin, held_out, unseen
        row |= metrics.score_view(shown.picture, *given)
        if initial is not None:
            scores = metrics.score_view(initial, *given)
            row |= {f"initialize_{column}": value for column, value in scores.items()}
    return row


def consistency_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """{"consistency", "consistency_share"}: means over the pairs of neighbours; {"pairs"}: how many could be compared;
    {"protocol"}."""
    from reffusion.score import consistency, metrics

    difference, share = ([row[name] for row in rows] for name in CONSISTENCY)
    return {
        "consistency": metrics.mean(difference),
        "consistency_share": metrics.mean(share),
        "pairs": sum(value is not None for value in difference),
        "protocol": consistency.PROTOCOL,
    }


def protocol(params: Params, rows: list[dict[str, Any]], models: dict[str, Lpips]) -> dict[str, Any]:
    """All that the numbers depend on, in words and versions."""
    from reffusion.score import metrics, sight

    return {
        **metrics.PROTOCOL,
        "seen": sight.PROTOCOL,
        "box_dilation": params.box_dilation,
        "outside_margin": params.outside_margin,
        "resolution": sorted({f"{row['width']}x{row['height']}" for row in rows}),
        "lpips_weights": {name: digest for model in models.values() for name, digest in model.files.items()},
        "versions": metrics.versions(),
    }


def views_of(scene: Scene) -> tuple[tuple[str, ...], str]:
    """The test views; without any, every 8th training view (all of them where that leaves fewer than 8)."""
    if scene.test:
        return scene.test, "test"
    eighth = scene.train[::8]
    return (eighth, "training, every 8th") if len(eighth) >= 8 else (scene.train, "training")


def unseen_in(scene: Scene, captured: Gaussians, poses: Path, masks: Path | None) -> dict[str, np.ndarray]:
    """Test view -> bool [H, W], pixels that show what no training view saw."""
    from reffusion.score import sight

    seen_by = sight.witnesses(*captured_by(scene, captured, poses, masks))
    return {name: sight.unseen(captured, scene.cameras[name], seen_by) for name in scene.test}


def reaches_beyond(unseen: dict[str, np.ndarray]) -> bool:
    """Do the test views show enough that no training view saw for a backdrop to be worth it? Without any: perhaps."""
    import numpy as np

    return not unseen or float(np.mean([each.mean() for each in unseen.values()])) > LEAST_UNSEEN


def finished(scene: Scene, gaussians: dict[str, Gaussians], result: str) -> dict[str, Gaussians]:
    """Stage -> its Gaussians completed by what lies beyond the capture: of the result, and of the initialization."""
    from reffusion.score import beyond

    stages = [stage for stage in ("initialize", result) if stage in gaussians]
    cameras = [scene.cameras[name] for name in scene.train]
    return {stage: beyond.completed(gaussians[stage], cameras) for stage in dict.fromkeys(stages)}


def captured_by(
    scene: Scene, captured: Gaussians, poses: Path, masks: Path | None
) -> tuple[Gaussians, list[Camera], dict[str, np.ndarray]]:
    """What `sight.witnesses` takes: the fit, the training views, and where those show the object."""
    cameras = [scene.cameras[name] for name in scene.train]
    hidden = {camera.name: mask_of(camera, poses, masks) for camera in cameras if camera.name not in scene.clean}
    return captured, cameras, hidden


def drawn(gaussians: Gaussians, camera: Camera, path: Path) -> np.ndarray:
    """Render to `path`, and give back what the file holds: scores are of the 8-bit picture that anyone can open."""
    import torch

    from reffusion.io.images import load_image, save_image
    from reffusion.splat import rasterizer

    with torch.no_grad():
        save_image(path, rasterizer.render(gaussians, camera).color.cpu().numpy())
    return load_image(path)


def truth_of(camera: Camera, poses: Path) -> np.ndarray | None:
    """uint8 [H, W, 3], the view's own picture; None where the scene has none. ValueError where its size is wrong."""
    from reffusion.io.images import load_image

    path = poses / "images" / f"{camera.name}.png"
    if not path.exists():
        return None
    image = load_image(path)
    if image.shape[:2] != (camera.height, camera.width):
        raise ValueError(
            f"{path}: {image.shape[1]}x{image.shape[0]} px, its camera {camera.width}x{camera.height}; run poses again"
        )
    return image


def mask_of(camera: Camera, poses: Path, masks: Path | None) -> np.ndarray:
    """bool [H, W]: the view's test mask, else its consistent mask, else (a variant without the stage masks) its raw
    mask, else empty. Where there are test masks, every variant is so scored in the same box."""
    import numpy as np

    from reffusion.io.images import load_mask

    size, file = (camera.height, camera.width), f"{camera.name}.png"
    given = [poses / "test_masks" / file, *([masks / "consistent" / file] if masks else []), poses / "masks" / file]
    found = [path for path in given if path.exists()]
    return load_mask(found[0], size) if found else np.zeros(size, bool)


def view_of(gaussians: Gaussians, camera: Camera, picture: np.ndarray, mask: np.ndarray) -> Shown:
    """The view with its rendered depth, for the comparison with its neighbour."""
    import numpy as np
    import torch

    from reffusion.score import consistency
    from reffusion.splat import rasterizer

    with torch.no_grad():
        drawing = rasterizer.render(gaussians, camera, sh_degree=0)
    depth, alpha = drawing.depth.double().cpu().numpy(), drawing.alpha.cpu().numpy()
    return consistency.Shown(camera, picture, np.where(alpha > consistency.SOLID, depth, 0.0), mask)


def used(painter: str | None, distill: Path | None) -> dict[str, str | None]:
    """{"inpainter", "perceptual"}: what painted in 2D and what compared patches, None where nothing did."""
    from reffusion.io.arrays import load_json

    facts = distill / "facts.json" if distill else None
    said = load_json(facts) if facts and facts.exists() else {}
    return {"inpainter": painter or said.get("inpainter"), "perceptual": said.get("perceptual")}


def seconds(needs: dict[str, Path | None]) -> dict[str, float]:
    """Stage -> seconds of its run, from the receipts that are there."""
    from reffusion.io.arrays import load_json

    receipts = {stage: folder / "receipt.json" for stage, folder in needs.items() if folder}
    return {stage: load_json(path).get("seconds") for stage, path in receipts.items() if path.exists()}
