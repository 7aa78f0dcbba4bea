"""Comparison of artifacts with their receipts, and replacement of artifacts so that a killed runner loses nothing.

The artifact of a stage is the folder runs/<scene>/<stage>/; its receipt.json has the hashes of all its files.
"""

import shutil
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from runner import say
from runner.files import RECEIPT, read_receipt, write_json
from runner.keys import NOT_CONTENT, Hashes, hash_listing
from runner.text import display_path, join_names

KEPT = "kept"  # folder in runs/<scene>/ for files that people had changed in artifacts that were then replaced


@dataclass(frozen=True)
class ArtifactDiff:
    """The differences between an artifact and its receipt, as names of files.

    Attributes:
        missing: files that are in the receipt only.
        changed: files whose content differs from the receipt.
        added: files that are not in the receipt.
        by_hand: files that people had changed or added, and that were then accepted into the receipt (`keep`). If such
            a file was changed or removed later, `changed` or `missing` has it, too.
    """

    missing: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    added: tuple[str, ...] = ()
    by_hand: tuple[str, ...] = ()

    def describe(self) -> list[str]:
        """Return a phrase such as "a.png, b.png changed" for each attribute that is not empty, `by_hand` included."""
        parts = (self.missing, "missing"), (self.changed, "changed"), (self.added, "added"), (self.by_hand, "by hand")
        return [f"{join_names(names)} {word}" for names, word in parts if names]


def diff_artifact(folder: Path, hashes: Hashes) -> ArtifactDiff:
    """Compare the artifact in a folder with its receipt. Hidden files are not compared.

    If the receipt is missing or cannot be read, all files count as added.
    """
    receipt, now = read_receipt(folder) or {"files": {}}, hash_contents(folder, hashes)["files"]
    then = receipt["files"]
    changed = tuple(name for name in then if now.get(name, then[name]) != then[name])
    missing, added = (tuple(name for name in one if name not in other) for one, other in ((then, now), (now, then)))
    return ArtifactDiff(missing, changed, added, tuple(receipt.get("by_hand", ())))


def hash_contents(folder: Path, hashes: Hashes) -> dict[str, Any]:
    """Return the part of a receipt that describes the contents of an artifact.

    Returns:
        "files": name relative to the folder -> hash, for all files but the receipt and hidden ones; "output": one hash
        of the files on which other stages may depend, i.e. without traces, warnings and checkpoints.
    """
    files = {name: file for name, file in hashes.listing(folder).items() if name != RECEIPT}
    return {"files": files, "output": hash_listing(files, NOT_CONTENT)}


def accept_changes(folder: Path, hashes: Hashes) -> None:
    """Accept the files that people changed or added in an artifact, so that it counts as undamaged.

    The receipt is rewritten with the present hashes of all files, and lists the accepted ones as `by_hand`. The key of
    the artifact stays as it is. Without changed or added files nothing is written.
    """
    diff = diff_artifact(folder, hashes)
    if diff.changed or diff.added:
        by_hand = sorted({*diff.by_hand, *diff.changed, *diff.added})
        receipt = (read_receipt(folder) or {}) | hash_contents(folder, hashes) | {"by_hand": by_hand}
        write_json(folder / RECEIPT, receipt)


def replace_artifact(partial: Path, place: Path, hashes: Hashes) -> None:
    """Replace the artifact at `place`, if there is one, by the finished folder `partial`, which is moved there.

    Files that people added to the old artifact are moved to the new one. Files that people changed are moved to
    kept/<stage>/ beside the artifacts. The rest of the old artifact is deleted. If the runner is killed meanwhile,
    `recover_swap` restores the old artifact or finishes the replacement.
    """
    old = place.with_name(f".old-{place.name}")
    if place.exists():
        place.rename(old)
    partial.rename(place)
    recover_swap(place.parent, hashes)


def recover_swap(home: Path, hashes: Hashes) -> None:
    """Finish or undo the replacements of artifacts that have begun, also by a killed runner, and finish deletions.

    If the new artifact is in place, the old one is deleted, after the files that people changed or added are moved out
    (`replace_artifact`); the names of changed ones are printed. Else the old artifact is restored.

    Args:
        home: folder of a scene or variant in runs/.
        hashes: the cache of hashes.
    """
    for gone in home.glob(".gone-*"):
        shutil.rmtree(gone)
    for old in home.glob(".old-*"):
        place = home / old.name.removeprefix(".old-")
        if place.exists():
            _rescue_files(old, place, hashes)
            delete_folder(old)
        else:
            old.rename(place)


def _rescue_files(old: Path, place: Path, hashes: Hashes) -> None:
    """Move the files that people changed or added out of an old artifact, which is replaced by that at `place`."""
    diff, kept = diff_artifact(old, hashes), place.parent / KEPT / place.name
    # Files that people changed, or that `keep` accepted, go to kept/<stage>/. Added files go to the new artifact,
    # or to kept/<stage>/ if it has a file of this name.
    targets = {name: kept / name for name in (*diff.by_hand, *diff.changed) if (old / name).exists()}
    targets |= {name: kept / name if (place / name).exists() else place / name for name in diff.added}
    for name, target in targets.items():
        candidates = (target.with_stem(f"{target.stem}-{number}") if number else target for number in count())
        free = next(path for path in candidates if not path.exists())
        free.parent.mkdir(parents=True, exist_ok=True)
        (old / name).rename(free)
    if moved := [name for name, target in targets.items() if kept in target.parents]:
        say(f"{place.name}: {join_names(moved)} was changed since it was made: now in {display_path(kept)}/")


def delete_folder(folder: Path) -> None:
    """Delete a folder with its contents, or a symbolic link without its target. A missing folder is no error.

    The folder is renamed first. So the remains that a killed runner may leave are never taken for an artifact.
    """
    gone = folder.with_name(f".gone-{folder.name}")
    if folder.is_symlink():
        folder.unlink()
    elif folder.exists():
        shutil.rmtree(gone, ignore_errors=True)
        folder.rename(gone)
        shutil.rmtree(gone)


def restore_from_attempt(folder: Path) -> None:
    """Restore `folder` from the newest attempt whose runner or machine was lost, if `folder` does not exist.

    The attempt's folder, <folder>.<suffix>, is copied and not renamed, because the lost attempt may still write to it.
    The folders of all attempts are removed, even if `folder` exists.
    """
    attempts = sorted(folder.parent.glob(f"{folder.name}.*"), key=lambda path: path.stat().st_mtime)
    for attempt in reversed(attempts):
        if not folder.exists():
            copy = folder.with_name(f".copying-{folder.name}")
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(attempt, copy, ignore=shutil.ignore_patterns("*.writing"))
            copy.rename(folder)
        shutil.rmtree(attempt, ignore_errors=True)
