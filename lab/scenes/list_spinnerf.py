"""Print a line for each of SPIn-NeRF's scenes in a folder: `python -m lab.scenes.list_spinnerf --data FOLDER`.

A line has the numbers of views and the parts that the scene lacks, or says that a published scene is missing.

In each scene, in order of names, the first 40 views are test views (photographs without the object) and the last 60 are
training views. Poses, lens (SIMPLE_RADIAL) and points are for the full size, in `images`. The masks lie beside the
quarter size, in `images_4`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from reffusion.capture.layouts.capture import find_pictures
from reffusion.capture.layouts.colmap import find_model
from reffusion.capture.load import load_capture
from reffusion.capture.roles import assign_roles
from reffusion.io.files import BadInput, is_file
from reffusion.io.images import image_size
from report import cli

SCENES = ("1", "2", "3", "4", "7", "9", "10", "12", "book", "trash")
TRAIN, TEST = 60, 40
PARTS = {  # file or folder of a scene -> what the scene lacks without it
    "images_4": "its pictures",
    "images_4/label": "no masks, so nothing is removed",
    "images_4/test_label": "no test views, so nothing is scored",
    "poses_bounds.npy": "near and far; the COLMAP model stands for the rest",
    "sparse/0": "the lens's distortion and the points",
    "images": "full size: the scene stays at that of images_4",
}


def scene_folders(data: Path) -> list[Path]:
    """Return the folders of the published scenes in `data`, sorted.

    If there are none, the result is all folders in `data` that have an `images_4`.
    """
    folders = sorted(p for p in data.iterdir() if p.is_dir() and p.name[0] not in "._") if data.is_dir() else []
    return [p for p in folders if p.name in SCENES] or [p for p in folders if (p / "images_4").is_dir()]


def summarize_scenes(data: Path) -> list[str]:
    """Return a line for each of the `scene_folders`, with the numbers of its views and the parts that it lacks.

    If some of them are published scenes, a line for each missing published scene says that it is not there.

    Raises:
        ValueError: `data` holds no scene at all.
    """
    folders = scene_folders(data)
    if not folders:
        raise ValueError(f"{data}: no scenes of SPIn-NeRF there; expected the folders {', '.join(SCENES)}")
    names = [path.name for path in folders]
    absent = [name for name in SCENES if name not in names] if set(names) & set(SCENES) else []
    return [*(f"{path.name}: {summarize_scene(path)}" for path in folders), *(f"{name}: not there" for name in absent)]


def summarize_scene(folder: Path) -> str:
    """Return a line about a scene: numbers of views, sizes of pictures, and missing parts; or why it cannot be run."""
    missing = [f"{part} ({loss})" for part, loss in PARTS.items() if not _has(folder, part)]
    lacks = f"lacks {'; '.join(missing)}" if missing else ""
    try:
        capture = load_capture(folder, "llff")
        roles = assign_roles(folder, capture)
    except BadInput as error:
        return f"cannot be run: {lacks or error}"
    counts = f"{len(roles.train)} training and {len(roles.test)} test views"
    expected = "" if (len(roles.train), len(roles.test)) == (TRAIN, TEST) else f" (published: {TRAIN} and {TEST})"
    sizes = [_size(folder / part) for part in ("images_4", "images") if _has(folder, part)]
    return "; ".join(filter(None, [counts + expected, ", ".join(sizes) + " px", lacks]))


def _has(folder: Path, part: str) -> bool:
    """Return whether a scene has a part, which is a key of `PARTS`."""
    if part == "sparse/0":
        return find_model(folder) is not None
    path = folder / part
    return is_file(path) if path.suffix else path.is_dir() and bool(find_pictures(path))


def _size(folder: Path) -> str:
    """Return the name of a folder of pictures and the size of its first picture: `images_4 <width>x<height>`."""
    width, height = image_size(next(iter(find_pictures(folder).values())))
    return f"{folder.name} {width}x{height}"


@cli.command
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="the folder that holds the scenes")
    print("\n".join(summarize_scenes(parser.parse_args().data.expanduser())), flush=True)


if __name__ == "__main__":
    main()
