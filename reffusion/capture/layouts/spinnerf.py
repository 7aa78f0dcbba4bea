"""SPIn-NeRF's published scenes: which are in a folder, and what each of them lacks.

Sorted by name the first 40 views are test views, photographs without the object; the last 60 are training views. Poses,
lens (SIMPLE_RADIAL) and points belong to the full size, `images`; masks lie beside the quarter size, `images_4`.
"""

from __future__ import annotations

from pathlib import Path

from reffusion.capture.layouts.capture import find_pictures
from reffusion.capture.layouts.colmap import find_model
from reffusion.capture.load import load_capture
from reffusion.capture.roles import load_roles
from reffusion.io.files import BadInput, is_file
from reffusion.io.images import image_size

SCENES = ("1", "2", "3", "4", "7", "9", "10", "12", "book", "trash")
TRAIN, TEST = 60, 40
PARTS = {  # what a scene holds, and what is lost without it
    "images_4": "its pictures",
    "images_4/label": "no masks, so nothing is removed",
    "images_4/test_label": "no test views, so nothing is scored",
    "poses_bounds.npy": "near and far; the COLMAP model stands for the rest",
    "sparse/0": "the lens's distortion and the points",
    "images": "full size: the scene stays at that of images_4",
}  # what a scene holds, and what is lost without it


def scene_folders(data: Path) -> list[Path]:
    """The published scenes in a folder; where there is none of these, every folder with the same layout."""
    folders = sorted(p for p in data.iterdir() if p.is_dir() and p.name[0] not in "._") if data.is_dir() else []
    return [p for p in folders if p.name in SCENES] or [p for p in folders if (p / "images_4").is_dir()]


def summarize_scenes(data: Path) -> list[str]:
    """A line per scene: what it holds, what it lacks, or that it is missing. ValueError where there is no scene."""
    folders = scene_folders(data)
    if not folders:
        raise ValueError(f"{data}: no scenes of SPIn-NeRF there; expected the folders {', '.join(SCENES)}")
    names = [path.name for path in folders]
    absent = [name for name in SCENES if name not in names] if set(names) & set(SCENES) else []
    return [*(f"{path.name}: {summarize_scene(path)}" for path in folders), *(f"{name}: not there" for name in absent)]


def summarize_scene(folder: Path) -> str:
    """What a scene holds and lacks, in a line."""
    missing = [f"{part} ({loss})" for part, loss in PARTS.items() if not _has(folder, part)]
    lacks = f"lacks {'; '.join(missing)}" if missing else ""
    try:
        capture = load_capture(folder, "llff")
        roles = load_roles(folder, capture)
    except BadInput as error:
        return f"cannot be run: {lacks or error}"
    counts = f"{len(roles.train)} training and {len(roles.test)} test views"
    expected = "" if (len(roles.train), len(roles.test)) == (TRAIN, TEST) else f" (published: {TRAIN} and {TEST})"
    sizes = [_size(folder / part) for part in ("images_4", "images") if _has(folder, part)]
    return "; ".join(filter(None, [counts + expected, ", ".join(sizes) + " px", lacks]))


def _has(folder: Path, part: str) -> bool:
    if part == "sparse/0":
        return find_model(folder) is not None
    path = folder / part
    return is_file(path) if path.suffix else path.is_dir() and bool(find_pictures(path))


def _size(folder: Path) -> str:
    width, height = image_size(next(iter(find_pictures(folder).values())))
    return f"{folder.name} {width}x{height}"
