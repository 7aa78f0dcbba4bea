"""Artifacts and their receipts: finds files that differ, and replaces artifacts so that a kill loses nothing."""

import shutil
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from runner import say
from runner.files import RECEIPT, read_receipt, write_json
from runner.keys import Hashes, hash_listing
from runner.text import display_path, join_names

KEPT = "kept"  # folder in runs/<scene>/: files that people had changed in artifacts that were made again


@dataclass(frozen=True)
class ArtifactDiff:
    """Names of the files in which an artifact differs from its receipt.

    `by_hand` names files that people changed and that were accepted later: they agree with the receipt.
    """

    missing: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    added: tuple[str, ...] = ()
    by_hand: tuple[str, ...] = ()

    def describe(self) -> list[str]:
        """A phrase for each kind of difference."""
        parts = (self.missing, "missing"), (self.changed, "changed"), (self.added, "added"), (self.by_hand, "by hand")
        return [f"{join_names(names)} {word}" for names, word in parts if names]


def diff_artifact(folder: Path, hashes: Hashes) -> ArtifactDiff:
    """Compare an artifact with its receipt. Without a receipt all its files are `added`."""
    receipt, now = read_receipt(folder), hash_contents(folder, hashes)["files"]
    if not receipt:
        return ArtifactDiff(added=tuple(now))
    then = receipt["files"]
    return ArtifactDiff(
        tuple(name for name in then if name not in now),
        tuple(name for name in then if now.get(name, then[name]) != then[name]),
        tuple(name for name in now if name not in then),
        tuple(receipt.get("by_hand", ())),
    )


def hash_contents(folder: Path, hashes: Hashes) -> dict[str, Any]:
    """The part of a receipt on contents: `files`, the hash of each file, and `output`, one hash of what other stages
    may read."""
    files = {name: file for name, file in hashes.listing(folder).items() if name != RECEIPT}
    return {"files": files, "output": hash_listing(files)}


def accept_changes(folder: Path, hashes: Hashes) -> None:
    """Update the receipt of an artifact to what people changed in it."""
    diff = diff_artifact(folder, hashes)
    if diff.changed or diff.added:
        by_hand = sorted({*diff.by_hand, *diff.changed, *diff.added})
        receipt = (read_receipt(folder) or {}) | hash_contents(folder, hashes) | {"by_hand": by_hand}
        write_json(folder / RECEIPT, receipt)


def replace_artifact(partial: Path, place: Path, hashes: Hashes) -> None:
    """Rename a finished folder into place. After a kill between the two renames `recover_swap` restores the old one."""
    old = place.with_name(f".old-{place.name}")
    if place.exists():
        place.rename(old)
    partial.rename(place)
    _retire(old, place, hashes)


def recover_swap(home: Path, hashes: Hashes) -> None:
    """Undo or finish the replacement during which a runner was killed."""
    for gone in home.glob(".gone-*"):
        shutil.rmtree(gone)
    for old in home.glob(".old-*"):
        place = home / old.name.removeprefix(".old-")
        if place.exists():
            _retire(old, place, hashes)
        else:
            old.rename(place)


def _retire(old: Path, place: Path, hashes: Hashes) -> None:
    """Delete an artifact that `place` replaces. Files that people added move to `place`, those that they changed to
    kept/."""
    if not old.exists():
        return
    diff, kept = diff_artifact(old, hashes), place.parent / KEPT / place.name
    targets = {name: kept / name for name in (*diff.by_hand, *diff.changed) if (old / name).exists()}
    targets |= {name: kept / name if (place / name).exists() else place / name for name in diff.added}
    for name, target in targets.items():
        candidates = (target.with_stem(f"{target.stem}-{number}") if number else target for number in count())
        free = next(path for path in candidates if not path.exists())
        free.parent.mkdir(parents=True, exist_ok=True)
        (old / name).rename(free)
    if moved := [name for name, target in targets.items() if kept in target.parents]:
        say(f"{place.name}: {join_names(moved)} was changed since it was made: now in {display_path(kept)}/")
    delete_folder(old)


def delete_folder(folder: Path) -> None:
    """Delete a folder, renamed first: what a kill leaves of it is never taken for an artifact."""
    gone = folder.with_name(f".gone-{folder.name}")
    if folder.is_symlink():
        folder.unlink()
    elif folder.exists():
        shutil.rmtree(gone, ignore_errors=True)
        folder.rename(gone)
        shutil.rmtree(gone)
