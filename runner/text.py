"""Formatting of errors, sizes, durations, names and paths as text for users."""

import difflib
import errno
import os
from collections.abc import Iterable
from pathlib import Path

from runner import Failed, Refused

# errno -> what the user can do about the error
REMEDIES = dict.fromkeys(
    (errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "make room, and the same command goes on from here"
) | dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "runs=FOLDER puts results elsewhere")


def format_error(error: BaseException) -> str:
    """Return the message of an error as one line, with a remedy if one is known.

    The type of the error is named, too, unless the message is meant for users (ValueError, Refused, Failed).
    """
    text = " ".join(str(error).split())
    if isinstance(error, OSError) and error.errno in REMEDIES:
        return f"{error.filename or 'a file'}: {error.strerror}; {REMEDIES[error.errno]}"
    return text if isinstance(error, ValueError | Refused | Failed) and text else f"{type(error).__name__}: {text}"


def format_bytes(count: int | None) -> str:
    """Format a number of bytes as bytes, kB, MB or GB; "size unknown" for None."""
    if count is None:
        return "size unknown"
    unit, size = next(((u, s) for u, s in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)) if count >= s), ("bytes", 1))
    return f"{count / size:.1f} {unit}" if unit == "GB" else f"{count / size:.0f} {unit}"


def format_seconds(seconds: float) -> str:
    """Format a duration as seconds, minutes or hours."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def join_names(names: Iterable[str]) -> str:
    """Return the first three names, separated by commas, and how many more there are; "" without names."""
    names = list(names)
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def display_path(path: Path) -> str:
    """Return a path as text: relative to the current folder if it lies inside this folder, else unchanged."""
    return os.path.relpath(path) if path.is_relative_to(Path.cwd()) else str(path)


def unknown_name(kind: str, name: str, known: Iterable[str]) -> str:
    """Return the message for an unknown name, with the most similar known name or else all known names.

    Args:
        kind: what is named, e.g. "stage".
        name: the unknown name.
        known: the known names.
    """
    near = difflib.get_close_matches(name, known, n=1)
    return f"unknown {kind} {name!r}; " + (f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}")
