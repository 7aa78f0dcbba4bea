"""The stage `raw_masks`: the masks that a scene brings, undistorted like its views, and the region to change.

This stage is separate from `poses`, so that new masks do not repeat structure from motion and the work on cameras.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reffusion import trace
from reffusion.capture.checks.sanity import find_odd_masks
from reffusion.capture.lenses import load_lenses
from reffusion.capture.scene_folder import is_gaussians_only, read_scene
from reffusion.capture.undistort import save_undistorted_masks
from reffusion.capture.views import check_outliers, resolve_view
from reffusion.io.arrays import save_json
from reffusion.io.given_masks import mask_file_size
from reffusion.io.images import save_mask
from reffusion.io.scene import load_raw_masks, load_scene, save_warnings
from reffusion.masks import regions
from reffusion.params.raw_masks import Params
from reffusion.types import Scene

FACTS = "facts.json"


def run(params: Params, out: Path, *, scene: Path, poses: Path) -> None:
    """Run the stage: undistort the masks that the scene brings.

    Writes:

    - masks/<view>.png, or masks/<object>/<view>.png if several objects have masks of their own;
    - test_masks/<view>.png and fill/<view>.png (pixels to fill), if the scene has such masks;
    - region.json, if the scene names a region in space that holds the object or is to be filled. If everything outside
      a sphere is to be changed, it is drawn into the masks of the training views instead;
    - facts.json with the larger side of the test masks' files in px, if there are test masks;
    - warnings.json, if masks look wrong.

    Args:
        out: folder of this stage.
        scene: folder of the scene.
        poses: folder of the stage `poses`.
    """
    placed, lenses = load_scene(poses), load_lenses(poses)[0]
    notes: tuple[str, ...] = ()
    if not is_gaussians_only(params, scene):
        _, roles = read_scene(params, scene)
        names = sorted(lenses)
        for k in trace.progress(len(names), "masks"):
            save_undistorted_masks(out, names[k], roles, lenses[names[k]])
        notes = roles.warnings
        if roles.test_masks:
            save_json(
                out / FACTS, {"test_masks_longest": max(max(mask_file_size(p)) for p in roles.test_masks.values())}
            )
    if params.region is not None:
        _save_region(params, out, placed)
    notes = (*notes, *find_odd_masks(placed, load_raw_masks(out, placed.train)))
    save_warnings(out, notes)


def _save_region(params: Params, out: Path, scene: Scene) -> None:
    """Write the scene's region as region.json in the normalized frame, or as masks of all beyond it if `outside`."""
    region, scale = params.region, scene.similarity.scale
    if region.view is not None:
        check_outliers("region", [region.view], scene.outliers)
        center = regions.point_on_axis(
            scene.cameras[resolve_view(region.view, scene.cameras, "region")], region.distance * scale
        )
    else:
        center = scene.similarity.apply(np.asarray(region.center))
    if region.outside:
        given = load_raw_masks(out, scene.train)
        for name in scene.train:
            mask = regions.outside_sphere(center, region.radius * scale, scene.cameras[name])
            save_mask(out / "masks" / f"{name}.png", mask | given.get(name, mask))
        return
    size = [side * scale for side in region.size or [2 * region.radius] * 3]
    regions.check_region(regions.Region(center, size, region.size is None), scene)
    facts = {"center": center.tolist(), "size": size, "round": region.size is None}
    save_json(out / "region.json", {**facts, "holds": params.has_masks})  # holds the object, or is to be filled
