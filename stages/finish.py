"""Write the deliverable `scene.ply`: the result of the last stage, closed by a backdrop where that is worth it."""

from __future__ import annotations

from pathlib import Path

from reffusion.background import training_coverage
from reffusion.background.backdrop import MIN_UNSEEN_SHARE, complete_scene
from reffusion.io.arrays import save_json
from reffusion.io.ground_truth import load_training_object_masks
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_scene
from reffusion.params.finish import Params
from reffusion.types import Gaussians, Scene


def run(
    params: Params,
    out: Path,
    *,
    poses: Path,
    raw_masks: Path,
    fit: Path,
    masks: Path | None = None,
    reference: Path | None = None,
    initialize: Path | None = None,
    distill: Path | None = None,
) -> None:
    """Write scene.ply, in the scene's own frame, and facts.json.

    The result is what `distill` made, else `initialize`, else `fit` (nothing to remove). Where it gets a backdrop,
    completed/<stage>.ply holds it in the normalised frame, and the initialization completed in the same way.
    """
    scene = load_scene(poses)
    folders = {"fit": fit, "initialize": initialize, "distill": distill}
    gaussians = {s: load_ply(f / "gaussians.ply", device=params.device) for s, f in folders.items() if f}
    result = list(gaussians)[-1]
    counts = {stage: len(each) for stage, each in gaussians.items()}
    share = None
    # Gaussians that the scene brings may know more than its views do.
    if params.backdrop and not (poses / "gaussians.ply").exists():
        share = unseen_share(scene, gaussians["fit"], raw_masks, masks)
    has_backdrop = share is not None and share > MIN_UNSEEN_SHARE
    if share is not None:
        which = "with a backdrop" if has_backdrop else "without a backdrop"
        print(f"{share:.1%} of a training view's pixels show what no other training view does: {which}", flush=True)
    if has_backdrop:
        # What was invented in views without photographs counts as seen.
        views = (*scene.train, *scene.blank) if reference else scene.train
        stages = [stage for stage in dict.fromkeys((result, "initialize")) if stage in gaussians]
        completed = complete_scene([gaussians[stage] for stage in stages], [scene.cameras[name] for name in views])
        gaussians |= dict(zip(stages, completed, strict=True))
        for stage in stages:
            save_ply(out / "completed" / f"{stage}.ply", gaussians[stage])
    save_ply(out / "scene.ply", gaussians[result], similarity=scene.similarity)
    facts = {"result": result, "gaussians": counts, "backdrop": has_backdrop, "unseen_in_other_views": share}
    save_json(out / "facts.json", facts)


def unseen_share(scene: Scene, fit: Gaussians, raw_masks: Path, masks: Path | None) -> float:
    """Mean share of a training view's pixels that no other training view saw, in [0, 1]."""
    cameras = [scene.cameras[name] for name in scene.train]
    views = training_coverage.render_coverage_views(fit, cameras, load_training_object_masks(scene, raw_masks, masks))
    return training_coverage.leave_one_out_unseen_share(fit, views)
