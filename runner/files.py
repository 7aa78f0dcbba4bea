"""Files on disk: listing, atomic writes, receipts, locks, and exported copies for users."""

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
from runner.text import display_path

RECEIPT = "receipt.json"
RECEIPT_KEYS = {"key", "params", "needs", "weights", "code", "output", "files"}  # keys that every receipt has
MACHINE = platform.node()


def list_files(folder: Path) -> Iterator[Path]:
    """Yield the paths of all files below a folder, each beginning with `folder`; nothing if there is no such folder.

    The files of a folder come first, sorted by name, and then those of its subfolders. Links are followed; a folder
    that a link reaches again yields its own files, but not those of its subfolders. Hidden files and folders,
    __pycache__ and broken links are left out.

    Raises:
        Refused: there is a pipe or a device.
    """
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
    """Write a UTF-8 text file atomically, and create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.writing")
    try:
        partial.write_text(text, encoding="utf-8")
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_json(path: Path, content: Any) -> None:
    """Write a JSON file atomically, and create its folder."""
    write_text(path, json.dumps(content, indent=1) + "\n")


def read_text(path: Path) -> str:
    """Read a text file, stripped of white space at both ends; "" if it cannot be read or is not UTF-8 text."""
    try:
        return path.read_text(encoding="utf-8").strip()
    except (OSError, ValueError):
        return ""


def read_json(path: Path) -> Any:
    """Read a JSON file; None if the file does not exist, cannot be read or is not valid JSON."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def read_receipt(artifact: Path) -> dict[str, Any] | None:
    """Read the receipt in the folder of an artifact.

    Returns None if the receipt is missing, is not valid JSON, or lacks one of `RECEIPT_KEYS`.
    """
    found = read_json(artifact / RECEIPT)
    return found if isinstance(found, dict) and found.keys() >= RECEIPT_KEYS else None


@contextmanager
def hold_lock(runs: Path, name: str, shared: bool = False, wait: bool = True) -> Iterator[int]:
    """Hold the lock `runs/.locks/<name>` inside the context.

    If this process is killed, the operating system releases the lock when all processes that hold it have ended.

    Args:
        runs: folder of all results.
        name: name of the folder in runs/ that is locked.
        shared: True allows other processes to hold the lock at the same time, if they ask for it as shared too.
        wait: True waits until other processes release the lock; False raises Refused instead.

    Yields:
        The file descriptor of the lock.

    Raises:
        Refused: another process holds the lock and `wait` is False, or the file system has no locks.
    """
    path = runs / ".locks" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a+") as file:
        _lock(file.fileno(), name, fcntl.LOCK_SH if shared else fcntl.LOCK_EX, wait)
        _, host = _holder(file.fileno())
        if host not in ("", MACHINE):
            say(f"{name} was last in use on {host}; is it still? Only one at a time may work in {display_path(runs)}")
        if not shared:
            _sign(file.fileno(), f"{os.getpid()} {MACHINE}\n")
        try:
            yield file.fileno()
        finally:
            if not shared:
                _sign(file.fileno(), "")


def _lock(lock: int, name: str, mode: int, wait: bool) -> None:
    """Acquire a lock (see `hold_lock`) of the given `mode`, fcntl.LOCK_SH or fcntl.LOCK_EX."""
    try:
        fcntl.flock(lock, mode | fcntl.LOCK_NB)
    except BlockingIOError:
        process, host = _holder(lock)
        on = f" on {host}" if host not in ("", MACHINE) else ""
        holder = f"{name} is in use by process {process or '?'}{on}"
        if not wait:
            raise Refused(f"{holder}; stop it, or wait for its end") from None
        say(f"{holder}: waiting for its end")
        fcntl.flock(lock, mode)
    except OSError as error:
        raise Refused(f"no locks where results go ({error.strerror}): runs=FOLDER puts them on another disk") from None


def lock_holder(runs: Path, name: str) -> tuple[str, str] | None:
    """Return the process id and the machine that hold the lock `runs/.locks/<name>`; None if nobody holds it.

    Shared holders are not seen, because they do not write into the lock's file.
    """
    with suppress(OSError), open(runs / ".locks" / name) as file:
        holder = _holder(file.fileno())
        try:
            if holder[0]:
                fcntl.flock(file.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)  # succeeds if the holder was killed
        except BlockingIOError:
            return holder
    return None


def _holder(lock: int) -> tuple[str, str]:
    """Return the process id and machine of a lock's last holder from its file; both are "" if it released the lock."""
    process, _, host = os.pread(lock, 999, 0).decode(errors="replace").strip().partition(" ")
    return process, host  # a killed holder leaves them in the file


def _sign(lock: int, text: str) -> None:
    """Write the holder of a lock into the lock's file."""
    with suppress(OSError):  # the disk may be full, and the holder only serves messages
        os.ftruncate(lock, 0)
        os.write(lock, text.encode())


def check_lock(lock: int) -> None:
    """Check that the file of a lock still exists. If it does not, another process may hold a new lock of this name.

    Args:
        lock: file descriptor of the lock.

    Raises:
        Failed: the file was removed.
    """
    if not os.fstat(lock).st_nlink:
        raise Failed("its lock in .locks was removed, so another process may be at work here; the same command goes on")


def export_folders(new: Path, old: Path, home: Path, names: tuple[str, ...]) -> None:
    """Copy folders of a new artifact to `home`, where people work with them.

    Earlier exported files that nobody changed are replaced, or removed if the new artifact does not have them. Files
    that a person changed or added are kept, and the new files of the same names are not copied; a message names them.

    Args:
        new: folder of the new artifact.
        old: folder of the artifact that `new` will replace.
        home: folder of the results of the scene, to which the folders are copied.
        names: names of the folders to copy, in `new` and in `home`.
    """
    for name in names:
        for path in list(list_files(home / name)):
            twins = [artifact / path.relative_to(home) for artifact in (old, new)]
            if any(twin.is_file() and filecmp.cmp(path, twin, shallow=False) for twin in twins):
                path.unlink()
            else:
                say(f"{home.name}/{path.relative_to(home)} was changed by hand: kept")
        for path in list_files(new / name):
            place = home / path.relative_to(new)
            if not place.exists():
                place.parent.mkdir(parents=True, exist_ok=True)
                partial = place.with_name(f".{place.name}.writing")
                shutil.copy2(path, partial)
                partial.replace(place)
