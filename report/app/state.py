"""The state of a scene as the page shows it, read from the files of its job."""

from __future__ import annotations

import importlib.util
from functools import lru_cache
from pathlib import Path
from typing import Any

from reffusion.capture.load import detect_layout
from reffusion.capture.roles import describe_split
from reffusion.io.arrays import load_json
from reffusion.io.scene import load_warnings
from reffusion.weights.published import SEGMENTER_FILES
from reffusion.weights.segmenters import AUTO, segmenter_folder
from report import verdict
from report.app import painting, tasks
from report.app.jobs import Jobs, describe_missing_source
from report.app.scenes import OpenScene
from report.job_data import JobFiles, load_job
from report.sheet import stage_folder
from runner.plan import FINAL

LAYOUT_LABELS = {
    "llff": "LLFF",
    "transforms": "nerfstudio (transforms.json)",
    "colmap": "COLMAP",
    "polycam": "Polycam",
    "realitycapture": "RealityCapture",
    "opensfm": "OpenSfM",
    "bundler": "Bundler",
    "3dgs": "3D Gaussian Splatting (cameras.json)",
    "photos": "photographs",
}


def describe(scene: OpenScene, jobs: Jobs, export: tasks.Export) -> dict[str, Any]:
    """Return the state of a scene as plain JSON values: what was found, the plan, the job, and the result."""
    job, plan = jobs.state(scene), jobs.plan(scene)
    try:
        pictures, error = list(scene.pictures()), ""
    except ValueError as failure:
        pictures, error = [], str(failure)
    expected = jobs.expected_seconds(scene) if not error else {}
    return {
        "name": scene.name,
        "source": str(scene.source),
        "pictures": pictures,
        "version": _version(scene.home),
        "found": describe_capture(scene, plan.stages),
        "doubts": [error] if error else find_doubts(scene.home),
        "masks": count_masks(scene.home),
        "lacks_masks": plan.lacks_masks and not count_masks(scene.home),
        "brings_masks": bool(plan.stages) and not plan.error and not plan.lacks_masks,
        "has_unsaved_marks": scene.mask_step is not None and scene.mask_step.session.unsaved,
        "awaits_fit": scene.mask_step is not None and scene.mask_step.session.gaussians is None,
        "has_network": has_network(scene),
        "lost": "" if scene.source.exists() else describe_missing_source(scene),
        "has_poses": (scene.home / "raw_masks" / "receipt.json").is_file(),
        "plan": {
            "busy": plan.busy,
            "error": plan.error,
            "stages": [
                {"name": name, "word": entry["word"], "reason": entry["reason"], "seconds": expected.get(name)}
                for name, entry in plan.stages.items()
            ],
            "seconds": sum(expected.values()),
            "quality": jobs.quality(scene),
            "due": [name for name, entry in plan.stages.items() if entry["word"] not in FINAL],
        },
        "job": job,
        "has_viewer": importlib.util.find_spec("viser") is not None,
        "has_state": any((scene.home / stage / "receipt.json").is_file() for stage in ("fit", "initialize")),
        "result": describe_result(scene) if tasks.has_result(scene) else None,
        "to_paint": list_views_to_paint(scene),
        "export": export.describe() | {"files": tasks.list_exports(scene, export.unfinished)},
    }


def describe_capture(scene: OpenScene, stages: dict[str, dict[str, Any]]) -> list[str]:
    """Return what is known about the capture, a phrase each: layout, the plan's notes, poses, masks, test views."""
    words = []
    if scene.folder.is_dir():
        words.append(f"layout: {LAYOUT_LABELS[detect_layout(scene.folder)]}")
    frames, sfm = scene.home / "frames" / "frames.json", scene.home / "poses" / "sfm.json"
    words += [load_json(frames)["said"]] if frames.is_file() else []
    views = scene.views()
    if views:
        words.append(describe_split(len(views["train"]), len(views["test"])))
        words += [load_json(sfm)["summary"]] if sfm.is_file() else []
        count = count_masks(scene.home)
        words.append(f"{count} photograph{'s have' if count != 1 else ' has'} a mask" if count else "no mask yet")
    else:
        notes = [note for stage in ("poses", "raw_masks") for note in stages.get(stage, {}).get("notes", ())]
        words += list(dict.fromkeys(notes))
    return words


def find_doubts(home: Path) -> list[str]:
    """Return the warnings of the stages `poses`, `raw_masks` and `masks`."""
    return [line for stage in ("poses", "raw_masks", "masks") for line in load_warnings(home / stage)]


def has_network(scene: OpenScene) -> bool:
    """Return whether a network segments the object around a click; otherwise colors and surfaces do."""
    if scene.mask_step is not None:
        return scene.mask_step.session.segmenter is not None
    return all((segmenter_folder(AUTO) / name).is_file() for name in SEGMENTER_FILES)


def count_masks(home: Path) -> int:
    """Return the number of views that have a mask."""
    return len({path.stem for path in (home / "raw_masks" / "masks").rglob("*.png")})


def describe_result(scene: OpenScene) -> dict[str, Any]:
    """Return what the page shows of a finished scene.

    Returns:
        "verdict": sentences; "views": names of all views; "rendered": those that `evaluate` rendered; "has_fit": True
        if the scene with the object can be shown; "is_painted": True if the user gave the picture that fills the hole.
    """
    job = _load_job(scene.home, _version(scene.home))
    views, evaluate = scene.views(), scene.home / "evaluate"
    names = sorted({*views.get("train", ()), *views.get("test", ())} & {*scene.pictures()})
    return {
        "verdict": verdict.describe_result(job),
        "views": names,
        "rendered": sorted(path.stem for path in (evaluate / "renders").glob("*.png")),
        "has_fit": (stage_folder(scene.home, "fit") / "gaussians.ply").is_file(),
        "is_painted": verdict.is_reference_given(job),
    }


def list_views_to_paint(scene: OpenScene) -> list[dict[str, Any]]:
    """Return the views worth painting, see `painting.list_views`; none before the scene is finished."""
    return painting.list_views(scene, _load_job(scene.home, _version(scene.home))) if tasks.has_result(scene) else []


def _version(home: Path) -> int:
    """Return a number that changes whenever a stage finishes."""
    return max((path.stat().st_mtime_ns // 1000 for path in home.glob("*/receipt.json")), default=0)


@lru_cache(4)
def _load_job(home: Path, version: int) -> JobFiles:
    """Load the job of a scene; `version` is the result of `_version`, by which the job is cached."""
    return load_job(home)
