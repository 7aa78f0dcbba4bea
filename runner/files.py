"""Files on the disk: written whole or not at all, locks, and copies that people work with."""

import errno
import fcntl
import filecmp
import json
import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from runner import Failed, Refused, say

RECEIPT = "receipt.json"
WHOLE = {"key", "params", "needs", "weights", "code", "output"}  # what a receipt holds at least
MACHINE = platform.node()
CURES = dict.fromkeys(
    (errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "make room, and the same command goes on from here"
) | dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "runs=FOLDER puts results elsewhere")


def files_below(folder: Path) -> Iterator[Path]:
    """Files, sorted, links followed, hidden names left out."""
    seen = set()
    for place, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        folders[:] = [] if real in seen else sorted(f for f in folders if not f.startswith(".") and f != "__pycache__")
        seen.add(real)
        for name in sorted(names):
            path = os.path.join(place, name)
            if not name.startswith(".") and os.path.isfile(path):
                yield Path(path)
            elif not name.startswith(".") and os.path.exists(path):
                raise Refused(f"{path}: neither a file nor a folder, but a pipe or a device; remove it")


def write_text(path: Path, text: str) -> None:
    """At once or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.writing")
    try:
        partial.write_text(text, encoding="utf-8")
        os.replace(partial, path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise


def write_json(path: Path, content: Any) -> None:
    write_text(path, json.dumps(content, indent=1) + "\n")


def read_text(path: Path) -> str:
    """What a file says, stripped; nothing where it is none, or no text."""
    try:
        return path.read_text(encoding="utf-8").strip()
    except (OSError, ValueError):
        return ""


def read_json(path: Path) -> Any:
    """What a file holds; None where it is none, or not whole."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def read_receipt(artifact: Path) -> dict[str, Any] | None:
    """None where there is none, or not a whole one."""
    found = read_json(artifact / RECEIPT)
    return found if isinstance(found, dict) and found.keys() >= WHOLE else None


def shown(path: Path) -> str:
    """A path as people type it: from the current folder where it lies below."""
    return os.path.relpath(path) if path.is_relative_to(Path.cwd()) else str(path)


def told(error: BaseException) -> str:
    """What went wrong, in one line."""
    text = " ".join(str(error).split())
    if isinstance(error, OSError) and error.errno in CURES:
        return f"{error.filename or 'a file'}: {error.strerror}; {CURES[error.errno]}"
    return text if isinstance(error, ValueError | Refused | Failed) and text else f"{type(error).__name__}: {text}"


@contextmanager
def locked(runs: Path, name: str, shared: bool = False, wait: bool = True) -> Iterator[int]:
    """Hold `runs/.locks/<name>`; yields its file descriptor. The system frees it when all who hold it have ended."""
    path = runs / ".locks" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a+") as file:
        _lock(file.fileno(), name, fcntl.LOCK_SH if shared else fcntl.LOCK_EX, wait)
        _, host = _holder(file.fileno())
        if host not in ("", MACHINE):
            say(f"{name} was last in use on {host}; is it still? One machine at a time may work in {shown(runs)}")
        if not shared:
            _sign(file.fileno(), f"{os.getpid()} {MACHINE}\n")
        yield file.fileno()
        if not shared:
            _sign(file.fileno(), "")


def _lock(lock: int, name: str, mode: int, wait: bool) -> None:
    try:
        fcntl.flock(lock, mode | fcntl.LOCK_NB)
    except BlockingIOError:
        process, host = _holder(lock)
        holder = f"{name} is in use by process {process or '?'}" + (f" on {host}" if host not in ("", MACHINE) else "")
        if not wait:
            raise Refused(f"{holder}; stop it, or wait for its end") from None
        say(f"{holder}: waiting for its end")
        fcntl.flock(lock, mode)
    except OSError as error:
        raise Refused(f"no locks where results go ({error.strerror}): runs=FOLDER puts them on another disk") from None


def _holder(lock: int) -> tuple[str, str]:
    """Process and machine, as the one that holds a lock, or that was killed while it did, has written them into it."""
    process, _, host = os.pread(lock, 999, 0).decode(errors="replace").strip().partition(" ")
    return process, host


def _sign(lock: int, text: str) -> None:
    with suppress(OSError):  # a full disk: who holds a lock is good to know, no more
        os.ftruncate(lock, 0)
        os.write(lock, text.encode())


def refuse_lost(lock: int) -> None:
    """Failed where the file of a lock was removed: another process may hold a new one of the same name."""
    if not os.fstat(lock).st_nlink:
        raise Failed("its lock in .locks was removed, so another process may be at work here; the same command goes on")


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
                partial = (home / relative).with_name(f".{relative.name}.writing")
                shutil.copy2(path, partial)
                partial.replace(home / relative)
        yield from (f"{home.name}/{relative} was changed by hand: kept" for relative in kept)
