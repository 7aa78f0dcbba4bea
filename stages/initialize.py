"""The stage `initialize`: the object's Gaussians are removed, and the pixels of the references become new Gaussians.

A pixel of a reference is unprojected at its estimated depth.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from reffusion.initialize.filling import Filling, initialize_scene
from reffusion.initialize.origins import find_origins
from reffusion.initialize.summary import summarize
from reffusion.io.arrays import load_json, save_json, save_labels
from reffusion.io.images import save_exr, save_image, save_mask
from reffusion.io.ply import save_ply
from reffusion.io.scene import load_references
from reffusion.kernels.compiled import map_in_threads, views_at_once
from reffusion.params.initialize import Params
from reffusion.trace import Trace
from reffusion.types import Reference
from reffusion.workspace import Workspace


def run(
    params: Params, out: Path, *, poses: Path, fit: Path, masks: Path, reference: Path | None, lift: Path | None = None
) -> None:
    """Run the stage: remove the object, fill the hole from the references, and refit.

    Writes:

    - gaussians.ply, and labels.npy, bool [N]: True for the new Gaussians;
    - facts.json;
    - depth/<view>.exr: the depth at which each reference and each extra view was unprojected;
    - extra_views/<view>.png: views that were completed besides the references, because gaps were left;
    - origins/<view>.png: the origin of what each view shows in C: other photographs (green), photographs in conflict
      with the scene (white), a reference (blue), patches in an extra view (orange), nothing (red);
    - shadows/<view>.png: masks of the object's shadow in all views, if a reference shows the scene without it;
    - invent/<view>.png: the invent masks I that reach beyond C (where the scene asks to fill a region), restricted
      there to pixels that show new Gaussians;
    - trace.jsonl: the convergence of the depth solvers.

    Args:
        out: folder of this stage.
        poses, fit, masks, reference, lift: folders of the stages of these names; `reference` and `lift` are None if the
            stage was skipped.
    """
    space = Workspace(poses, fit, masks, params.device)
    references, given = load_completed(params, space, reference, lift)
    # The refit works in a hidden folder, because its trace holds run times, which must not enter the hash.
    filled = initialize_scene(params, space, references, given, out / ".refit", Trace(out))
    save_filling(out, filled)
    sets, scene = space.mask_sets | filled.restricted, space.scene
    find = lambda name: find_origins(filled.draft, scene.cameras[name], sets[name], filled.background)
    origins = dict(zip(scene.train, map_in_threads(find, scene.train, views_at_once(params.device)), strict=True))
    for name, origin in origins.items():
        save_image(out / "origins" / f"{name}.png", origin.picture)
    save_json(out / "facts.json", summarize(space, filled, origins))


def save_filling(out: Path, filled: Filling) -> None:
    """Write the Gaussians, depths, restricted invent masks, shadows and extra views of a filling."""
    save_ply(out / "gaussians.ply", filled.draft.gaussians)
    save_labels(out / "labels.npy", filled.draft.is_new.cpu())
    save_depths(out, filled.depths)
    save_depths(out, filled.extra_depths)
    for name, pixels in filled.restricted.items():
        save_mask(out / "invent" / f"{name}.png", pixels.invent)
    for name, mask in filled.shadows.items():
        save_mask(out / "shadows" / f"{name}.png", mask)
    for each in filled.extra:
        save_image(out / "extra_views" / f"{each.camera.name}.png", each.image)


def load_completed(
    params: Params, space: Workspace, reference: Path | None, lift: Path | None
) -> tuple[list[Reference], list[str]]:
    """Read the completed views from which the hole is filled, according to `params.start`, and which are given.

    Args:
        space: results of the stages `poses`, `fit` and `masks`.
        reference: folder of the stage `reference`, for the starts "reference" and "random" (which adds as many
            Gaussians as the references would); None if it was skipped.
        lift: folder of the stage `lift`, for the baseline with start "lift"; None if it was skipped.

    Returns:
        The references, none for the start "nothing"; and the names of those that the scene brings.

    Raises:
        ValueError: the stage that the start "lift" or "random" needs was skipped, and something has to be invented.
    """
    if params.start == "lift" and lift is None:
        raise ValueError("initialize.start is 'lift', but the stage lift was left out: set distill.lift.weight")
    if params.start == "random" and reference is None and any(each.invent.any() for each in space.mask_sets.values()):
        raise ValueError(
            "initialize.start is 'random', but the stage reference, whose Gaussians it counts, was left out"
        )
    folder = {"reference": reference, "random": reference, "lift": lift}.get(params.start)
    if folder is None:
        return [], []
    facts = folder / "facts.json"
    given = load_json(facts)["given"] if folder == reference and facts.exists() else []
    return load_references(folder, space.scene), given


def save_depths(out: Path, depths: Mapping[str, np.ndarray]) -> None:
    """Write depth maps, view name -> [H, W] camera z, as out/depth/<view>.exr in float32."""
    for name, depth in depths.items():
        save_exr(out / "depth" / f"{name}.exr", depth.astype("float32"))
