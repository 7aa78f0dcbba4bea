"""Render every test view with the result and with the initialization, and score both where there is ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    import numpy as np

    from reffusion.types import Camera, Gaussians, Scene

FOLDERS = {"fit": "renders_fit", "initialize": "renders_initialize", "distill": "renders"}


class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    box_dilation: float = Field(
        0.1, ge=0.0, description="each side of the mask's box moves outwards by this share of the box's extent"
    )
    lpips_weights: str | None = Field(
        None,
        description="folder with LPIPS weights, looked into before ~/.cache/reffusion/lpips and torch hub's cache",
        json_schema_extra={"weights": True},
    )
    device: Literal["cpu", "cuda"] = Field("cpu", description="where the views are rendered")


def needed_weights(params: Params, brings: frozenset[str]) -> list:
    """What must lie on this machine, and what of it does not; `brings`: the keys of scene.yaml."""
    from reffusion import weights

    return weights.of_lpips(params.lpips_weights)


def run(
    params: Params,
    out: Path,
    *,
    poses: Path,
    fit: Path,
    masks: Path | None = None,
    reference: Path | None = None,
    personalize: Path | None = None,
    initialize: Path | None = None,
    distill: Path | None = None,
) -> None:
    """Write renders*/, side_by_side/, metrics.json, per_view.csv and scene.ply.

    The result is what `distill` made, else `initialize`, else `fit` (a scene with nothing to remove). Training views
    and test views without a picture are rendered and not scored. `reference` and `personalize` give their seconds only.
    """
    from reffusion import io, lpips, metrics, trace

    needs = {"poses": poses, "fit": fit, "masks": masks, "reference": reference, "personalize": personalize}
    needs |= {"initialize": initialize, "distill": distill}
    scene = io.load_scene(poses)
    loaded = {net: lpips.load(net, params.lpips_weights) for net in ("vgg", "alex")}
    models = {net: model for net, (model, _) in loaded.items() if model}
    gaussians = {
        stage: io.load_ply(needs[stage] / "gaussians.ply").map(lambda p: p.to(params.device))
        for stage in FOLDERS
        if needs[stage]
    }
    result = list(gaussians)[-1]

    names, kind = views_of(scene)
    rows = []
    for index in trace.progress(len(names), "evaluate"):
        camera, file = scene.cameras[names[index]], f"{names[index]}.png"
        pictures = {stage: drawn(gaussians[stage], camera, out / FOLDERS[stage] / file) for stage in gaussians}
        io.save_image(out / "renders" / file, pictures[result])
        truth = truth_of(camera, poses) if kind == "test" else None
        box = metrics.mask_box(mask_of(camera, poses, masks), params.box_dilation)
        panels = [p for p in (pictures["fit"], truth, pictures[result]) if p is not None]
        io.save_image(out / "side_by_side" / file, metrics.side_by_side(panels, box))
        row = {"view": camera.name, "width": camera.width, "height": camera.height}
        row |= dict(zip(("left", "top", "right", "bottom"), box or (None,) * 4, strict=True))
        if truth is not None:
            row |= metrics.score_view(pictures[result], truth, box, models)
            if initialize:
                scores = metrics.score_view(pictures["initialize"], truth, box, models)
                row |= {f"initialize_{column}": value for column, value in scores.items()}
        rows.append(row)

    (out / "per_view.csv").write_text(metrics.table(rows))
    io.save_ply(out / "scene.ply", gaussians[result], similarity=scene.similarity)
    summary = {
        **metrics.summary(rows),
        "rendered": f"{len(names)} {kind} views",
        "result": result,
        "lpips_unavailable": "; ".join(reason for _, reason in loaded.values() if reason) or None,
        "gaussians": {stage: len(value) for stage, value in gaussians.items()},
        "seconds": seconds(needs),
        "protocol": {
            **metrics.PROTOCOL,
            "box_dilation": params.box_dilation,
            "resolution": sorted({f"{row['width']}x{row['height']}" for row in rows}),
            "lpips_weights": {name: digest for model in models.values() for name, digest in model.files.items()},
            "versions": metrics.versions(),
        },
    }
    io.save_json(out / "metrics.json", summary)


def views_of(scene: Scene) -> tuple[tuple[str, ...], str]:
    """The test views; without any, every 8th training view (all of them where that leaves fewer than 8)."""
    if scene.test:
        return scene.test, "test"
    eighth = scene.train[::8]
    return (eighth, "training, every 8th") if len(eighth) >= 8 else (scene.train, "training")


def drawn(gaussians: Gaussians, camera: Camera, path: Path) -> np.ndarray:
    """Render to `path`, and give back what the file holds: scores are of the 8-bit picture that anyone can open."""
    import torch

    from reffusion import io, splat

    with torch.no_grad():
        io.save_image(path, splat.render(gaussians, camera).color.cpu().numpy())
    return io.load_image(path)


def truth_of(camera: Camera, poses: Path) -> np.ndarray | None:
    """uint8 [H, W, 3], the view's own picture; None where the scene has none. ValueError where its size is wrong."""
    from reffusion import io

    path = poses / "images" / f"{camera.name}.png"
    if not path.exists():
        return None
    image = io.load_image(path)
    if image.shape[:2] != (camera.height, camera.width):
        raise ValueError(
            f"{path}: {image.shape[1]}x{image.shape[0]} px, its camera {camera.width}x{camera.height}; run poses again"
        )
    return image


def mask_of(camera: Camera, poses: Path, masks: Path | None) -> np.ndarray:
    """bool [H, W]: the view's test mask, else its consistent mask, else empty."""
    import numpy as np

    from reffusion import io

    size, given = (camera.height, camera.width), poses / "test_masks" / f"{camera.name}.png"
    if given.exists():
        return io.load_mask(given, size)
    return io.load_mask(masks / "consistent" / f"{camera.name}.png", size) if masks else np.zeros(size, bool)


def seconds(needs: dict[str, Path | None]) -> dict[str, float]:
    """Stage -> seconds of its run, from the receipts that are there."""
    from reffusion import io

    receipts = {stage: folder / "receipt.json" for stage, folder in needs.items() if folder}
    return {stage: io.load_json(path).get("seconds") for stage, path in receipts.items() if path.exists()}
