"""`gc`: artifacts that no plan of today uses any more are listed with their sizes, and removed."""

import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from runner import Refused, say
from runner.artifacts import discard, recover
from runner.files import RECEIPT, files_below, locked, read_receipt, read_text, shown
from runner.keys import HASHES, Hashes
from runner.pipeline import load_pipeline
from runner.plan import amount, plan
from runner.resolve import Request, resolve
from runner.maintenance import is_home, made_of, remove_empty


@dataclass(frozen=True)
class Unused:
    """An artifact that no plan uses: its folder, bytes that its receipt vouches for, why."""

    folder: Path
    size: int
    why: str


def sweep(request: Request, yes: bool) -> None:
    """Say what no plan of the scenes in runs/ uses (of one scene and its variants, where one is named), and remove it
    where `yes`, or where who sits at the terminal says so.

    Plans are those of today's scene.yaml, pipeline.yaml and options; what only older code made counts as used. Removed
    are files as their receipts say. What has no receipt, what people changed, and what belongs to a scene that is not
    there stay."""
    hashes = Hashes(request.runs / HASHES)
    found = list(_unused(request, hashes))
    for each in found:
        say(f"{amount(each.size):>9}  {shown(each.folder)}: {each.why}")
    if not found:
        say("nothing that no plan uses")
        return
    say(f"{amount(sum(each.size for each in found)):>9}  together, in {len(found)} artifacts")
    if not yes and not (sys.stdin.isatty() and input("remove them? [y/N] ").strip().lower() in ("y", "yes")):
        say("nothing was removed; yes=1 removes them")
        return
    for each in found:
        _remove(request.runs, each.folder, hashes)
    hashes.save()


def _unused(request: Request, hashes: Hashes) -> Iterator[Unused]:
    homes = sorted(path for path in request.runs.glob("*") if is_home(path)) if request.runs.is_dir() else []
    name = Path(request.scene).name
    scenes = dict.fromkeys(home.name.partition("@")[0] for home in homes)
    if name and name not in scenes:
        raise Refused(
            f"{shown(request.runs)}: nothing was computed for {name}; there are {', '.join(scenes) or 'none'}"
        )
    for scene in scenes if not name else [name]:
        there = [home for home in homes if home.name.partition("@")[0] == scene]
        used: set[Path] = set()
        whys: dict[Path, str] = {}
        try:
            for home in there:
                used |= _planned(request, home, whys, hashes)
        except Refused as error:
            say(f"{scene}: kept, as it cannot be planned: {error}")
            continue
        for folder in (path.parent for home in there for path in sorted(home.glob(f"*/{RECEIPT}"))):
            if folder not in used and not folder.is_symlink() and read_receipt(folder):
                size = sum(path.stat().st_size for path in made_of(folder, hashes) if path.exists())
                yield Unused(folder, size, whys.get(folder, "no plan uses it"))


def _planned(request: Request, home: Path, whys: dict[Path, str], hashes: Hashes) -> set[Path]:
    """The artifacts that a run's plan uses, or may yet; `whys` gets why it does not use its own others."""
    name, _, variant = home.name.partition("@")
    pipeline = load_pipeline(request.root)
    receipts = [path.parent for path in home.glob(f"*/{RECEIPT}")]
    if variant and variant not in pipeline.variants:
        whys |= dict.fromkeys(receipts, f"there is no variant {variant} any more")
        return set()
    source = request.root / (read_text(home / "source") or read_text(home.with_name(name) / "source"))
    if source == request.root or not source.exists():
        raise Refused("its scene is not there")
    asked = replace(request, scene=str(source), variant=variant or None, trust=True)
    job = resolve(asked, hashes)
    decisions, used = plan(job, list(pipeline.stages)), set()
    for stage, decision in decisions.items():
        if decision.word in ("cached", "provided", "stale", "undecided", "missing"):
            used |= {decision.path} if decision.path else {home / stage, job.base / stage}
        else:
            whys[home / stage] = f"{'left out' if decision.word == 'skip' else 'to be made again'}: {decision.reason}"
        if decision.path and decision.path != home / stage:
            whys.setdefault(home / stage, f"{shown(decision.path)} is the same")
    whys |= {folder: f"there is no stage {folder.name} any more" for folder in receipts if folder.name not in decisions}
    return used


def _remove(runs: Path, folder: Path, hashes: Hashes) -> None:
    try:
        with locked(runs, folder.parent.name, wait=False):
            recover(folder.parent, hashes)
            for path in list(made_of(folder, hashes)):
                path.unlink(missing_ok=True)
            remove_empty(folder)
            if folder.exists():
                kept = next(files_below(folder), None)
                say(f"{shown(folder)}: kept what was not made by the runner" + (f": {kept.name}" if kept else ""))
            with suppress(OSError):
                if not any(folder.parent.iterdir()):
                    discard(folder.parent)
    except Refused as error:
        say(f"{shown(folder)}: kept: {error}")
