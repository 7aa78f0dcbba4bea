"""The stage `finish`: the final Gaussians are continued beyond the capture, and are written as `scene.ply`."""

from __future__ import annotations

from pathlib import Path

from reffusion.background.backdrop import complete_scene
from reffusion.inpaint.plane_extension import extend_planes
from reffusion.io.arrays import save_json
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_scene
from reffusion.params.finish import Params


def run(
    params: Params,
    out: Path,
    *,
    poses: Path,
    fit: Path,
    reference: Path | None = None,
    initialize: Path | None = None,
    distill: Path | None = None,
) -> None:
    """Run the stage: write scene.ply, in the scene's own frame, and facts.json.

    The result is that of `distill`; if this stage was skipped, that of `initialize`; and if both were skipped, that of
    `fit`. With `params.backdrop`, planes go on beyond the training views, and a backdrop closes the scene. Gaussians
    that the scene brings get neither, because they may cover places that its views do not show. If they are added, the
    result with them is also written in the normalized frame, as completed/<name of the stage that made it>.ply, and the
    initialization with the same additions as completed/initialize.ply.

    Args:
        out: folder of this stage.
        poses, fit, reference, initialize, distill: folders of the stages of these names; the last three are None if the
            stage was skipped.
    """
    scene = load_scene(poses)
    folders = {"fit": fit, "initialize": initialize, "distill": distill}
    gaussians = {s: load_ply(f / "gaussians.ply", device=params.device) for s, f in folders.items() if f}
    result = list(gaussians)[-1]
    counts = {stage: len(each) for stage, each in gaussians.items()}
    has_backdrop = params.backdrop and not (poses / "gaussians.ply").exists()
    if has_backdrop:
        # If the stage `reference` ran, pixels were invented in camera-only views, so that these views count as
        # training views.
        views = (*scene.train, *scene.camera_only) if reference else scene.train
        stages = [stage for stage in dict.fromkeys((result, "initialize")) if stage in gaussians]
        cameras = [scene.cameras[name] for name in views]
        extension = extend_planes(gaussians[result], cameras)
        completed = complete_scene([gaussians[stage] for stage in stages], cameras, extension)
        gaussians |= dict(zip(stages, completed, strict=True))
        for stage in stages:
            save_ply(out / "completed" / f"{stage}.ply", gaussians[stage])
    save_ply(out / "scene.ply", gaussians[result], similarity=scene.similarity)
    save_json(out / "facts.json", {"result": result, "gaussians": counts, "backdrop": has_backdrop})
