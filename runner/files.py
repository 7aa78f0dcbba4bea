"""Folders on the disk: their files, locks, swaps that survive a kill, and copies that people work with."""

import fcntl
import filecmp
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from runner import Refused, say

RECEIPT = "receipt.json"


def files_below(folder: Path) -> Iterator[Path]:
    """Files, sorted, links followed, hidden names left out."""
    seen = set()
    for place, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        folders[:] = [] if real in seen else sorted(f for f in folders if not f.startswith(".") and f != "__pycache__")
        seen.add(real)
        for name in sorted(names):
            if not name.startswith(".") and os.path.isfile(path := os.path.join(place, name)):
                yield Path(path)


def write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".writing")
    partial.write_text(json.dumps(content, indent=1) + "\n")
    os.replace(partial, path)


def read_json(path: Path) -> Any:
    """What a file holds; None where it is none, or not whole."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def shown(path: Path) -> str:
    """A path as people type it: from the current folder where it lies below."""
    return os.path.relpath(path) if path.is_relative_to(Path.cwd()) else str(path)


@contextmanager
def locked(runs: Path, name: str, shared: bool = False, wait: bool = True) -> Iterator[int]:
    """Hold `runs/.locks/<name>`; yields its file descriptor. The system frees it when all who hold it have ended."""
    path = runs / ".locks" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    mode = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    with open(path, "a+") as file:
        try:
            fcntl.flock(file, mode | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = f"{name} is in use by process {file.read().strip() or '?'}"
            if not wait:
                raise Refused(f"{holder}; stop it, or wait for its end") from None
            say(f"{holder}: waiting for its end")
            fcntl.flock(file, mode)
        if not shared:
            file.truncate(0)
            file.write(f"{os.getpid()}\n")
            file.flush()
        yield file.fileno()


def put_in_place(partial: Path, place: Path) -> None:
    """Swap a finished folder in. Killed between the two renamings, `recover` brings the old one back."""
    old = place.with_name(f".old-{place.name}")
    if place.exists():
        discard(old)
        place.rename(old)
    partial.rename(place)
    discard(old)


def recover(home: Path) -> None:
    """Undo or finish the swap in which a runner was killed."""
    for old in home.glob(".old-*"):
        place = home / old.name.removeprefix(".old-")
        if place.exists() or not (old / RECEIPT).exists():
            discard(old)
        else:
            old.rename(place)


def discard(folder: Path) -> None:
    """Delete a folder, its receipt first: what is left of it after a kill is never taken for an artifact."""
    if folder.exists():
        (folder / RECEIPT).unlink(missing_ok=True)
        shutil.rmtree(folder)


def hand_out(made: Path, before: Path, home: Path, names: tuple[str, ...]) -> Iterator[str]:
    """Copy the folders `names` of an artifact to `home`; yields what there is to say, a line each.

    A file that was handed out `before`, of the artifact that is replaced, and is no longer `made` goes; one that a
    person changed or added stays as it is."""
    for name in names:
        for path in list(files_below(home / name)):
            twins = [artifact / path.relative_to(home) for artifact in (before, made)]
            if any(twin.is_file() and filecmp.cmp(path, twin, shallow=False) for twin in twins):
                path.unlink()
        kept = [path.relative_to(home) for path in files_below(home / name)]
        for path in files_below(made / name):
            relative = path.relative_to(made)
            if relative not in kept:
                (home / relative).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(path, home / relative)
        yield from (f"{home.name}/{relative} was changed by hand: kept" for relative in kept)
