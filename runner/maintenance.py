"""Looking after what was made: `verify` hashes it all, `clean` removes it, and nothing else."""

import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from runner import Refused, say
from runner.artifacts import discard, listed, recover, wear
from runner.files import RECEIPT, files_below, locked, read_receipt, read_text, shown
from runner.keys import HASHES, Hashes
from runner.pipeline import NAME, Pipeline, find_scene, load_pipeline, scene_name, unknown
from runner.resolve import FRAMES, Request, one_folder_a_name

RECORDS = ("profile", "source", "plan.json", "output.log", "turntable.webm", "check.png")
PAGES = (*(f"compare.{kind}" for kind in ("json", "csv", "md", "html")), "compare-runs.csv", "compare-runs.md",
         "compare/*.png", "study/index.html", "study/clips/*.webm", "study/clips/*.png", "study-key.json",
         "adapted/sheet.png", "adapted/*/*.png", "adapted/adapted.json",
         "sds-variance/sds_variance.json", "report.html", "report/index.html", "report/*.png",
         "frames/frames.json", "frames/frames.csv", "frames/images/frame_*.jpg",
         "patch/patched.ply", "patch/new.ply",
         "export/scene.ply", "export/scene.compressed.ply", "export/lora/pytorch_lora_weights.safetensors",
         "export/cameras/transforms.json", "export/cameras/sparse_pc.ply", "export/cameras/sparse/0/*.bin",
         "export/cameras/images/*.png", "**/.*.writing")  # fmt: skip
WORKING = (".partial-*", ".copying-*", ".gone-*")


def verify(request: Request) -> int:
    """Hash every file of a scene's artifacts, of its variants' and of the scene; how many are not as they were.

    What is found is remembered, so that the next run makes again what is missing or changed."""
    hashes, homes, worse = Hashes(request.runs / HASHES, afresh=True), _homes(request), 0
    for home in homes:
        with locked(request.runs, home.name, shared=True, wait=False):
            for folder in sorted(path.parent for path in home.glob(f"*/{RECEIPT}")):
                worn = wear(folder, hashes) if read_receipt(folder) else None
                worse += not worn or bool(worn.missing or worn.changed)
                said = ", ".join(worn.words()) if worn else f"{RECEIPT} cannot be read"
                say(f"{shown(folder)}: {said or 'as it was made'}")
    del hashes.rotten[:]  # receipts told of them
    for scene in {request.root / source for home in homes if (source := read_text(home / "source"))}:
        hashes.folder(scene)
    for path in hashes.rotten:
        say(f"{shown(path)}: its content changed, its size and time did not")
    hashes.save()
    if worse + len(hashes.rotten):
        say(f"`make scene={request.scene} all` makes again what is missing or changed; keep=1: what is missing")
    return worse + len(hashes.rotten)


def clean(request: Request) -> None:
    """Remove what was computed for a scene with its variants, or for one variant; nothing that people put there."""
    homes, pipeline, hashes = _homes(request), load_pipeline(request.root), Hashes(request.runs / HASHES)
    with ExitStack() as held:
        for home in homes:
            held.enter_context(locked(request.runs, home.name, wait=False))
        for home in homes:
            recover(home, hashes)
            say(f"removing {shown(home)}: {', '.join(sorted(p.parent.name for p in home.glob(f'*/{RECEIPT}')))}")
        for home in homes:
            for path in list(_made(home, pipeline, hashes)):
                path.unlink(missing_ok=True)
            for folder in (path for pattern in WORKING for path in home.glob(pattern)):
                discard(folder)
            remove_empty(home)
            if home.exists():
                say(f"kept, as it was not made by the runner: {listed(shown(path) for path in files_below(home))}")
    if not homes:
        say(f"nothing was computed for {request.scene}")


def _homes(request: Request) -> list[Path]:
    """The folders that the runner made for a scene and its variants, or for one variant; none for a scene that is
    there and was not run. The scene may be gone."""
    name, runs = scene_name(Path(request.scene).expanduser()), request.runs
    made = sorted(path.name for path in (runs.iterdir() if runs.is_dir() else ()) if is_home(path))
    scenes = list(dict.fromkeys(each.partition("@")[0] for each in made))
    if not NAME.fullmatch(name):
        raise Refused(
            f"scene={request.scene}: no scene has such a name; in {shown(runs)}: {', '.join(scenes) or 'none'}"
        )
    try:
        scene = find_scene(request.scene, request.root)
    except Refused:
        if name not in scenes:
            raise Refused(f"{shown(runs)}: {unknown('scene', name, scenes)}") from None
    else:
        base = runs / scene_name(scene)
        one_folder_a_name(base, base / FRAMES if scene.is_file() else scene, request.root)
    variants = [each for each in made if each.startswith(f"{name}@")]
    if request.variant and f"{name}@{request.variant}" not in variants:
        known = [each.partition("@")[2] for each in variants]
        raise Refused(f"{shown(runs)}: {unknown('variant', request.variant, known)}")
    names = [f"{name}@{request.variant}"] if request.variant else [each for each in made if each == name] + variants
    return [runs / each for each in names]


def is_home(folder: Path) -> bool:
    """Is there anything that says that the runner made it?"""
    own = folder.is_dir() and not folder.is_symlink() and folder.name[0] != "."
    return own and ((folder / "source").is_file() or any(folder.glob(f"*/{RECEIPT}")))


def _made(home: Path, pipeline: Pipeline, hashes: Hashes) -> Iterator[Path]:
    """The files of a scene's results that are as the runner or a page's maker left them; an artifact's receipt last."""
    yield from (home / name for name in RECORDS)
    yield from (home / f"{stage}.log" for stage in pipeline.stages)
    yield from (path for pattern in PAGES for path in home.glob(pattern))
    for folder in sorted(path.parent for path in home.glob(f"*/{RECEIPT}")):
        if folder.is_symlink():  # a person's: what it leads to may be another scene's
            yield folder
            continue
        listing = hashes.listing(folder)
        for name in pipeline.stages[folder.name].hands_out if folder.name in pipeline.stages else ():
            twins = {path.relative_to(home): hashes.file(path) for path in files_below(home / name)}
            yield from (home / path for path, own in twins.items() if listing.get(str(path)) == own)
        yield from made_of(folder, hashes)


def made_of(folder: Path, hashes: Hashes) -> Iterator[Path]:
    """The files of an artifact that are as its receipt says, and that last."""
    worn = wear(folder, hashes)
    theirs = {*worn.changed, *worn.added, *worn.by_hand}
    yield from (folder / name for name in hashes.listing(folder) if name not in theirs and name != RECEIPT)
    yield folder / RECEIPT


def remove_empty(home: Path) -> None:
    for place, _, _ in os.walk(home, topdown=False):
        if not any(os.scandir(place)):
            os.rmdir(place)
