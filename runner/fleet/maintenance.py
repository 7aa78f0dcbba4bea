"""The commands `verify`, which checks all artifacts of a scene by their hashes, and `clean`, which removes them.

Files that people added or changed are never removed.
"""

import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from reffusion.command import scene_name
from runner import Refused, say
from runner.artifacts import delete_folder, diff_artifact, recover_swap
from runner.files import RECEIPT, hold_lock, list_files, read_receipt, read_text
from runner.frames import FRAMES
from runner.keys import HASHES, Hashes
from runner.pipeline import NAME, Pipeline, find_scene, load_pipeline
from runner.resolve import Request, check_unique_name
from runner.text import display_path, join_names, unknown_name

# Files that the runner and report/ write to runs/<scene>/ besides artifacts.
RECORDS = ("profile", "source", "plan.json", "output.log", "turntable.webm", "before_after.webp", "check.png")
PAGES = (*(f"compare.{kind}" for kind in ("json", "csv", "html")),
         "compare/*.png", "study/index.html", "study/clips/*.webm", "study/clips/*.png", "study-key.json",
         "adapted/sheet.png", "adapted/*/*.png", "adapted/adapted.json",
         "sds-variance/sds_variance.json", "report.html", "report/index.html", "report/*.png",
         "frames/frames.json", "frames/frames.csv", "frames/images/frame_*.jpg",
         "patch/patched.ply", "patch/new.ply",
         "export/scene.ply", "export/scene.compressed.ply", "export/scene.spz", "export/scene.glb",
         "export/scene.sog", "export/scene.html",
         "export/with_object.ply", "export/lora/pytorch_lora_weights.safetensors",
         "export/cameras/transforms.json", "export/cameras/sparse_pc.ply", "export/cameras/sparse/0/*.bin",
         "export/cameras/images/*.png", "export/cameras.zip", "**/.*.writing")  # fmt: skip
# Folders that a killed runner may leave.
TEMPORARY = (".partial-*", ".copying-*", ".gone-*")


def verify(request: Request) -> int:
    """Hash the files of a scene and of all its artifacts, and compare the artifacts with their receipts.

    The artifacts are those of the scene's own run and of all variants, or of one variant if the request names it. The
    result is printed. The hashes are cached, so that the next run repeats the stages whose artifacts are damaged.

    Returns:
        Number of damaged artifacts (files are missing or changed, or the receipt cannot be read; added files are no
        damage), plus number of files of the scene whose content changed while size and time did not.

    Raises:
        Refused: the scene or the variant is unknown, or another process uses one of the folders.
    """
    cached, hashes = Hashes(request.runs / HASHES), Hashes(request.runs / HASHES)
    hashes.known.clear()  # so that each file is hashed again
    homes, damaged = _homes(request), 0
    for home in homes:
        with hold_lock(request.runs, home.name, shared=True, wait=False):
            for folder in sorted(path.parent for path in home.glob(f"*/{RECEIPT}")):
                diff = diff_artifact(folder, hashes) if read_receipt(folder) else None
                damaged += not diff or bool(diff.missing or diff.changed)
                message = ", ".join(diff.describe()) if diff else f"{RECEIPT} cannot be read"
                say(f"{display_path(folder)}: {message or 'as it was made'}")
    scenes = {request.root / source for home in homes if (source := read_text(home / "source"))}
    corrupt = [path for scene in scenes for path in list_files(scene) if cached.file(path) != hashes.file(path)]
    for path in corrupt:
        say(f"{display_path(path)}: its content changed, its size and time did not")
    hashes.known = cached.known | hashes.known
    hashes.save()
    if damaged + len(corrupt):
        say(f"`make scene={request.scene} all` makes again what is missing or changed; keep=1: what is missing")
    return damaged + len(corrupt)


def clean(request: Request) -> None:
    """Remove everything that was computed for a scene and its variants, or for one variant if the request names it.

    Files that people added or changed are kept. The user is not asked.

    Raises:
        Refused: the scene or the variant is unknown, or another process uses one of the folders; nothing was removed.
    """
    homes, pipeline, hashes = _homes(request), load_pipeline(request.root), Hashes(request.runs / HASHES)
    with ExitStack() as locks:
        for home in homes:
            locks.enter_context(hold_lock(request.runs, home.name, wait=False))
        for home in homes:
            recover_swap(home, hashes)
            say(f"removing {display_path(home)}: {', '.join(sorted(p.parent.name for p in home.glob(f'*/{RECEIPT}')))}")
        for home in homes:
            for path in list(_find_artifact_files(home, pipeline, hashes)):
                path.unlink(missing_ok=True)
            for folder in (path for pattern in TEMPORARY for path in home.glob(pattern)):
                delete_folder(folder)
            remove_empty(home)
            if home.exists():
                kept = join_names(display_path(path) for path in list_files(home))
                say(f"kept, as it was not made by the runner: {kept}")
    if not homes:
        say(f"nothing was computed for {request.scene}")


def _homes(request: Request) -> list[Path]:
    """Return a scene's and its variants' folders in runs/, or the variant's; raises Refused if either is unknown."""
    name, runs = scene_name(Path(request.scene).expanduser()), request.runs
    existing = sorted(path.name for path in (runs.iterdir() if runs.is_dir() else ()) if is_home(path))
    scenes = list(dict.fromkeys(each.partition("@")[0] for each in existing))
    if not NAME.fullmatch(name):
        raise Refused(
            f"scene={request.scene}: no scene has such a name; in {display_path(runs)}: {', '.join(scenes) or 'none'}"
        )
    try:
        scene = find_scene(request.scene, request.root)
    except Refused:  # the folder of the scene itself may have been removed
        if name not in scenes:
            raise Refused(f"{display_path(runs)}: {unknown_name('scene', name, scenes)}") from None
    else:
        name = scene_name(scene)  # the name of a video in data/ has no ending
        base = runs / name
        check_unique_name(base, base / FRAMES if scene.is_file() else scene, request.root)
    variants = [each for each in existing if each.startswith(f"{name}@")]
    if request.variant and f"{name}@{request.variant}" not in variants:
        known = [each.partition("@")[2] for each in variants]
        raise Refused(f"{display_path(runs)}: {unknown_name('variant', request.variant, known)}")
    names = [f"{name}@{request.variant}"] if request.variant else [each for each in existing if each == name] + variants
    return [runs / each for each in names]


def is_home(folder: Path) -> bool:
    """Return whether the runner made this folder in runs/, which then has an artifact's receipt or a file `source`."""
    own = folder.is_dir() and not folder.is_symlink() and folder.name[0] != "."
    return own and ((folder / "source").is_file() or any(folder.glob(f"*/{RECEIPT}")))


def _find_artifact_files(home: Path, pipeline: Pipeline, hashes: Hashes) -> Iterator[Path]:
    """Yield the files in runs/<scene> that the runner or report/ wrote and nobody changed; some may not exist."""
    yield from (home / name for name in RECORDS)
    yield from (home / f"{stage}.log" for stage in pipeline.stages)
    yield from (path for pattern in PAGES for path in home.glob(pattern))
    for folder in sorted(path.parent for path in home.glob(f"*/{RECEIPT}")):
        if folder.is_symlink():  # a person made this link, and its target may belong to another scene
            yield folder
            continue
        listing = hashes.listing(folder)
        for name in pipeline.stages[folder.name].export if folder.name in pipeline.stages else ():
            twins = {path.relative_to(home): hashes.file(path) for path in list_files(home / name)}
            yield from (home / path for path, own in twins.items() if listing.get(str(path)) == own)
        yield from artifact_files(folder, hashes)  # the receipt comes last


def artifact_files(folder: Path, hashes: Hashes) -> Iterator[Path]:
    """Yield the files of an artifact that its stage wrote and nobody changed, and last the receipt.

    Files that people changed or added are left out even if they were accepted into the receipt (`keep`).
    """
    diff = diff_artifact(folder, hashes)
    by_people = {*diff.changed, *diff.added, *diff.by_hand}
    yield from (folder / name for name in hashes.listing(folder) if name not in by_people and name != RECEIPT)
    yield folder / RECEIPT


def remove_empty(home: Path) -> None:
    """Remove all folders at any depth in `home` that are empty or become so, and `home` itself if it is empty then."""
    for place, _, _ in os.walk(home, topdown=False):
        if not any(os.scandir(place)):
            os.rmdir(place)
