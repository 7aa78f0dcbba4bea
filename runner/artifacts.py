"""Artifacts and their receipts: what is as it was made, and swaps that survive a kill."""

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from runner import say
from runner.files import RECEIPT, read_receipt, shown, write_json
from runner.keys import Hashes, content

KEPT = "kept"  # in runs/<scene>/: what people had changed in artifacts that were made again


@dataclass(frozen=True)
class Wear:
    """How an artifact differs from its receipt: names of files. by_hand: those that were accepted as people left
    them, and differ no more."""

    missing: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    added: tuple[str, ...] = ()
    by_hand: tuple[str, ...] = ()

    def words(self) -> list[str]:
        parts = (self.missing, "missing"), (self.changed, "changed"), (self.added, "added"), (self.by_hand, "by hand")
        return [f"{listed(names)} {word}" for names, word in parts if names]


def wear(folder: Path, hashes: Hashes) -> Wear:
    """Where there is no receipt all files are `added`; where it is an old one, with one hash for all, all `changed`."""
    receipt, now = read_receipt(folder), contents(folder, hashes)
    if not receipt:
        return Wear(added=tuple(now["files"]))
    older = now["files"] if receipt["output"] == now["output"] else dict.fromkeys(now["files"], "")
    then = receipt.get("files", older)
    return Wear(
        tuple(name for name in then if name not in now["files"]),
        tuple(name for name in then if now["files"].get(name, then[name]) != then[name]),
        tuple(name for name in now["files"] if name not in then),
        tuple(receipt.get("by_hand", ())),
    )


def contents(folder: Path, hashes: Hashes) -> dict[str, Any]:
    """For a receipt: the hash of each file, and one of all that other stages may read."""
    files = {name: file for name, file in hashes.listing(folder).items() if name != RECEIPT}
    return {"files": files, "output": content(files)}


def accept(folder: Path, hashes: Hashes) -> None:
    """Let the receipt say that what people changed is as it should be."""
    worn = wear(folder, hashes)
    if worn.changed or worn.added:
        by_hand = sorted({*worn.by_hand, *worn.changed, *worn.added})
        write_json(folder / RECEIPT, (read_receipt(folder) or {}) | contents(folder, hashes) | {"by_hand": by_hand})


def listed(said: Iterable[str], most: int = 3) -> str:
    said = list(said)
    rest = f" and {len(said) - most} more" if len(said) > most else ""
    return ", ".join(said[:most]) + rest


def put_in_place(partial: Path, place: Path, hashes: Hashes) -> None:
    """Swap a finished folder in. Killed between the two renamings, `recover` brings the old one back."""
    old = place.with_name(f".old-{place.name}")
    if place.exists():
        place.rename(old)
    partial.rename(place)
    _retire(old, place, hashes)


def recover(home: Path, hashes: Hashes) -> None:
    """Undo or finish the swap in which a runner was killed."""
    for gone in home.glob(".gone-*"):
        shutil.rmtree(gone)
    for old in home.glob(".old-*"):
        place = home / old.name.removeprefix(".old-")
        if place.exists():
            _retire(old, place, hashes)
        else:
            old.rename(place)


def _retire(old: Path, place: Path, hashes: Hashes) -> None:
    """Discard an artifact that `place` replaces, but nothing that a person put into it, which goes there too, or
    changed in it, which goes to kept/."""
    if not old.exists():
        return
    worn, kept = wear(old, hashes), place.parent / KEPT / place.name
    theirs = {name: kept / name for name in (*worn.by_hand, *worn.changed) if (old / name).exists()}
    theirs |= {name: kept / name if (place / name).exists() else place / name for name in worn.added}
    for name, to in theirs.items():
        names = (to.with_stem(f"{to.stem}-{number}") if number else to for number in count())
        free = next(path for path in names if not path.exists())
        free.parent.mkdir(parents=True, exist_ok=True)
        (old / name).rename(free)
    if moved := [name for name, to in theirs.items() if kept in to.parents]:
        say(f"{place.name}: {listed(moved)} was changed since it was made: now in {shown(kept)}/")
    discard(old)


def discard(folder: Path) -> None:
    """Delete a folder, under a name that says so: what is left of it after a kill is never taken for an artifact."""
    gone = folder.with_name(f".gone-{folder.name}")
    if folder.is_symlink():
        folder.unlink()
    elif folder.exists():
        shutil.rmtree(gone, ignore_errors=True)
        folder.rename(gone)
        shutil.rmtree(gone)
