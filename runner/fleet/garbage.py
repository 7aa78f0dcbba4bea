"""The command `gc`, which lists and removes artifacts that no plan uses any more."""

import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from reffusion.command import scene_name
from runner import Refused, say
from runner.artifacts import delete_folder, recover_swap
from runner.files import RECEIPT, hold_lock, list_files, read_json, read_receipt, read_text
from runner.fleet.maintenance import artifact_files, is_home, remove_empty
from runner.frames import FRAME_FILES, FRAMES
from runner.keys import HASHES, Hashes
from runner.pipeline import find_scene, load_pipeline
from runner.plan import plan
from runner.resolve import Request, resolve
from runner.text import display_path, format_bytes


@dataclass(frozen=True)
class Unused:
    """An artifact that no plan uses.

    Attributes:
        folder: its folder.
        size: size in bytes of the files that may be removed, i.e. without those that people changed or added.
        why: the reason why no plan uses it.
    """

    folder: Path
    size: int
    why: str


def collect_garbage(request: Request, yes: bool) -> None:
    """List the artifacts that no plan uses, with their sizes, and remove them after confirmation.

    The plans are those of all scenes and variants in runs/ (or of one scene and its variants, if the request names it)
    with the current scene.yaml, pipeline.yaml and options. An artifact that only differs by its code counts as used.
    Only files that agree with receipts are removed, so files that people added or changed are kept. Artifacts of a
    scene whose folder does not exist, or that cannot be planned, are kept too.

    Args:
        request: the options.
        yes: True removes the artifacts without asking. False asks the user if the input is a terminal, and else removes
            nothing.

    Raises:
        Refused: the request names a scene for which nothing was computed.
    """
    hashes = Hashes(request.runs / HASHES)
    found = list(_unused(request, hashes))
    for each in found:
        say(f"{format_bytes(each.size):>9}  {display_path(each.folder)}: {each.why}")
    if not found:
        say("nothing that no plan uses")
        return
    say(f"{format_bytes(sum(each.size for each in found)):>9}  together, in {len(found)} artifacts")
    if not yes and not (sys.stdin.isatty() and input("remove them? [y/N] ").strip().lower() in ("y", "yes")):
        say("nothing was removed; yes=1 removes them")
        return
    for each in found:
        _remove(request.runs, each.folder, hashes)
    hashes.save()


def _unused(request: Request, hashes: Hashes) -> Iterator[Unused]:
    """Yield what `collect_garbage` lists, and print which scenes it keeps; raises Refused if the scene never ran."""
    homes = sorted(path for path in request.runs.glob("*") if is_home(path)) if request.runs.is_dir() else []
    name = Path(request.scene).name
    with suppress(Refused):  # the scene may have been removed
        name = scene_name(find_scene(request.scene, request.root))
    scenes = dict.fromkeys(home.name.partition("@")[0] for home in homes)
    if name and name not in scenes:
        raise Refused(
            f"{display_path(request.runs)}: nothing was computed for {name}; there are {', '.join(scenes) or 'none'}"
        )
    for scene in scenes if not name else [name]:
        scene_homes = [home for home in homes if home.name.partition("@")[0] == scene]
        used: set[Path] = set()
        reasons: dict[Path, str] = {}
        try:
            for home in scene_homes:
                used |= _planned(request, home, reasons, hashes)
        except Refused as error:
            say(f"{scene}: kept, as it cannot be planned: {error}")
            continue
        for folder in (path.parent for home in scene_homes for path in sorted(home.glob(f"*/{RECEIPT}"))):
            if folder not in used and not folder.is_symlink() and read_receipt(folder):
                size = sum(path.stat().st_size for path in artifact_files(folder, hashes) if path.exists())
                yield Unused(folder, size, reasons.get(folder, "no plan uses it"))


def _planned(request: Request, home: Path, reasons: dict[Path, str], hashes: Hashes) -> set[Path]:
    """Return the artifact folders that a run's plan uses or may use; add why it leaves out the others to `reasons`."""
    name, _, variant = home.name.partition("@")
    pipeline = load_pipeline(request.root)
    receipts = [path.parent for path in home.glob(f"*/{RECEIPT}")]
    if variant and variant not in pipeline.variants:
        reasons |= dict.fromkeys(receipts, f"there is no variant {variant} any more")
        return set()
    source = request.root / (read_text(home / "source") or read_text(home.with_name(name) / "source"))
    if source == home.with_name(name) / FRAMES:  # frames of the video that is the scene
        source = request.root / (read_json(source / FRAME_FILES[0]) or {}).get("video", "")
    if source == request.root or not source.exists():
        raise Refused("its scene is not there")
    planned = replace(request, scene=str(source), variant=variant or None, trust=True)
    job = resolve(planned, hashes)
    decisions, used = plan(job, list(pipeline.stages)), set()
    for stage, decision in decisions.items():
        if decision.status in ("cached", "provided", "stale", "pending", "missing"):
            used |= {decision.path} if decision.path else {home / stage, job.base / stage}
        else:
            what = "left out" if decision.status == "skip" else "to be made again"
            reasons[home / stage] = f"{what}: {decision.reason}"
        if decision.path and decision.path != home / stage:
            reasons.setdefault(home / stage, f"{display_path(decision.path)} is the same")
    unknown = [folder for folder in receipts if folder.name not in decisions]
    reasons |= {folder: f"there is no stage {folder.name} any more" for folder in unknown}
    return used


def _remove(runs: Path, folder: Path, hashes: Hashes) -> None:
    """Remove an artifact's files that agree with its receipt, and empty folders; keep an artifact that is in use."""
    try:
        with hold_lock(runs, folder.parent.name, wait=False):
            recover_swap(folder.parent, hashes)
            for path in list(artifact_files(folder, hashes)):
                path.unlink(missing_ok=True)
            remove_empty(folder)
            if folder.exists():
                kept = next(list_files(folder), None)
                say(
                    f"{display_path(folder)}: kept what was not made by the runner" + (f": {kept.name}" if kept else "")
                )
            with suppress(OSError):
                if not any(folder.parent.iterdir()):
                    delete_folder(folder.parent)
    except Refused as error:
        say(f"{display_path(folder)}: kept: {error}")
