"""Run the stages before the stage under test, on the wall with a square before it (`scenes.wall_scene`)."""

from __future__ import annotations

from pathlib import Path

from reffusion.io.scene import load_mask_sets, save_references
from reffusion.trace import read_trace
from reffusion.types import Reference
from scenes import wall_scene
from stages import initialize, masks


def run_masks(poses: Path, fit: Path, out: Path, params: masks.Params | None = None) -> Path:
    """Run the stage `masks` on the folders that `wall_scene.write_poses_and_fit` wrote; return `out`."""
    out.mkdir(parents=True, exist_ok=True)
    masks.run(params or masks.Params(), out, poses=poses, raw_masks=poses.with_name("raw_masks"), fit=fit)
    return out


def run_through_masks(home: Path, square_at: float) -> dict[str, Path]:
    """Write the scene, and run `masks`; return stage name -> folder, for `poses`, `fit` and `masks`."""
    poses, fit, _ = wall_scene.write_poses_and_fit(home, square_at)
    return {"poses": poses, "fit": fit, "masks": run_masks(poses, fit, home / "masks")}


def write_true_references(folder: Path, masks_folder: Path, *names: str) -> Path:
    """Write references of these views that show the wall without the square; return the folder."""
    sets = load_mask_sets(masks_folder, names)
    cameras = [wall_scene.CAMERAS[name] for name in names]
    save_references(folder, [Reference(view, wall_scene.photo(view), sets[view.name].invent) for view in cameras])
    return folder


def run_through_initialize(home: Path, square_at: float) -> dict[str, Path]:
    """Write the scene and a true reference of view a2, and run `masks` and `initialize`.

    Returns:
        Stage name -> folder, for `poses`, `fit`, `masks`, `reference` and `initialize`.
    """
    folders = run_through_masks(home, square_at)
    folders["reference"] = write_true_references(home / "reference", folders["masks"], "a2")
    (home / "initialize").mkdir()
    initialize.run(initialize.Params(), home / "initialize", **folders)
    return folders | {"initialize": home / "initialize"}


def trace_lines(folder: Path) -> list[dict]:
    """Return the lines of a stage's trace without their run times."""
    return [{k: v for k, v in line.items() if k != "seconds"} for line in read_trace(folder / "trace.jsonl")]
