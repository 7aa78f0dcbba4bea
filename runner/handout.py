"""Folders of an artifact that people work with: copies beside the artifacts, in which nothing of theirs is lost."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

from runner.keys import files_below


def hand_out(made: Path, before: Path, home: Path, names: tuple[str, ...]) -> Iterator[str]:
    """Copy the folders `names` of an artifact to `home`; yields what there is to say, a line each.

    A file that was handed out before and is no longer made goes; one that a person changed or added stays as it is.

    Args:
        made: the new artifact.
        before: the artifact that it replaces, there or not: what was handed out of it.
        home: runs/<scene>.
    """
    for name in names:
        for path in list(files_below(home / name)):
            relative = path.relative_to(home / name)
            if _same(path, before / name / relative) or _same(path, made / name / relative):
                path.unlink()
        kept = [path.relative_to(home / name) for path in files_below(home / name)]
        for path in files_below(made / name):
            relative = path.relative_to(made / name)
            if relative not in kept:
                (home / name / relative).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(path, home / name / relative)
        yield from (f"{home.name}/{name}/{relative} was changed by hand: kept" for relative in kept)


def _same(one: Path, other: Path) -> bool:
    return other.is_file() and one.stat().st_size == other.stat().st_size and one.read_bytes() == other.read_bytes()
