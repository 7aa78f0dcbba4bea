"""Hashes of everything that an artifact depends on: contents of folders, code, parameters and weights."""

import ast
import hashlib
import json
import os
import threading
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reffusion.command import is_installed
from runner import Refused
from runner.files import RECEIPT, list_files, read_json, write_text

CODE_PACKAGES = ("reffusion", "stages")  # modules of these packages that a stage imports are part of its code
HASHES = ".hashes.json"  # file in runs/ with the cache of hashes
# files of an artifact on which other stages do not depend
NOT_CONTENT = (RECEIPT, "trace.jsonl", "warnings.json", "checkpoint.pt", "checkpoint.pt.writing")
NOT_WEIGHTS = (".md", ".py", ".png", ".jpg")  # endings of a model's card, pictures and training scripts
_PARSING = threading.Lock()  # CPython 3.11 raises SystemError where two threads build syntax trees at once


def digest(*parts: str) -> str:
    """Hash a sequence of texts to 20 hexadecimal digits."""
    encoded = [part.encode() for part in parts]
    lengths = (len(part).to_bytes(8, "little") + part for part in encoded)
    return hashlib.blake2b(b"".join(lengths), digest_size=10).hexdigest()


def _hash_content(path: Path) -> str:
    """Hash the content of a file to 20 hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=10)).hexdigest()


def hash_listing(listing: dict[str, str], exclude: tuple[str, ...] = ()) -> str:
    """Hash a listing of files to one hash, which depends on the order of the listing, too.

    Args:
        listing: name of each file, relative to a folder -> hash of its content.
        exclude: names of files and folders, directly in the folder, that are left out.
    """
    kept = {name: file for name, file in listing.items() if name.partition("/")[0] not in exclude}
    return digest(*(part for item in kept.items() for part in item))


class Hashes:
    """A cache of the hashes of files, kept in a JSON file.

    A cached hash is valid while device, inode, size and modification time of the file stay the same. The cache also
    holds the answers of stages to questions about their parameters (`resolve.resolve_all`).

    Attributes:
        path: the JSON file.
        known: the entries of the cache.
    """

    LIMIT = 100_000  # number of entries that are saved, the newest ones; a demo scene and its results have 1,000

    def __init__(self, path: Path):
        """Load the cache from `path`; it starts empty if there is no such file."""
        found = read_json(path)
        self.path, self.known = path, found if isinstance(found, dict) else {}
        self._saved, self._saving = self.known.copy(), threading.Lock()
        self._imports: dict[tuple[Path, str], list[Path]] = {}  # (module, fingerprint) -> see `module`

    def _remember(self, kind: str, path: Path, compute: Any) -> Any:
        """Return the cached value of a `kind` ("file" or "module") for a file, or compute it by `compute(path)`."""
        stat = os.stat(path)
        name = f"{kind} {stat.st_dev} {stat.st_ino} {stat.st_size} {stat.st_mtime_ns}"
        if name not in self.known:
            self.known[name] = compute(path)
        return self.known[name]

    def file(self, path: Path) -> str:
        """Return the hash of a file's content."""
        return self._remember("file", path, _hash_content)

    def module(self, path: Path, root: Path) -> tuple[str, list[Path]]:
        """Return the fingerprint of a Python file, and the files of CODE_PACKAGES that it imports itself.

        The fingerprint is a hash of the code without comments and docstrings, see `fingerprint`.

        Args:
            path: the Python file.
            root: folder with stages/.

        Raises:
            Refused: the file is not valid Python.
        """
        names, code = self._remember("module", path, _read_module)
        if (path, code) not in self._imports:
            self._imports[path, code] = list(_imported_files(names, path, root))
        return code, self._imports[path, code]

    def folder(self, folder: Path, exclude: tuple[str, ...] = NOT_CONTENT) -> str:
        """Return one hash of the names and contents of all files below a folder. Hidden files are left out.

        Args:
            folder: the folder.
            exclude: names of files and folders, directly in the folder, that are left out too.
        """
        return hash_listing(self.listing(folder), exclude)

    def listing(self, folder: Path, files: Iterable[Path] | None = None) -> dict[str, str]:
        """Return name relative to `folder` -> hash of `files`; None for all files below it without hidden ones."""
        chosen = list_files(folder) if files is None else files
        return {os.path.relpath(path, folder): self.file(path) for path in chosen}

    def weights(self, folder: Path) -> str:
        """Return the hash of a file of weights, or of the folder of a model.

        The model's card, pictures and scripts in the folder are left out, so that editing them reruns no stage.
        """
        read = (path for path in list_files(folder) if path.suffix not in NOT_WEIGHTS)
        return self.file(folder) if folder.is_file() else hash_listing(self.listing(folder, read))

    def save(self) -> None:
        """Write the cache to its file, unless it is as it was read or written before."""
        if (known := self.known.copy()) == self._saved:  # a copy, since other threads may add to it
            return
        kept = dict(list(known.items())[-self.LIMIT :])
        # If the disk is full or read-only, nothing is saved, and the hashes are computed again the next time.
        with suppress(OSError), self._saving:
            partial = self.path.with_name(f"{self.path.name}.{os.getpid()}")  # runners of other scenes write here too
            write_text(partial, json.dumps(kept))
            os.replace(partial, self.path)
            self._saved = known


def paths_outside(value: Any, folder: Path) -> Iterator[Path]:
    """Yield the existing files and folders outside the scene's folder that parameters name, as resolved paths.

    Only texts with a slash, and "..", can name such a path. A path may be yielded more than once.

    Args:
        value: a parameter or nested parameters; texts in it are tried as paths relative to `folder`.
        folder: folder of the scene.
    """
    if isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from paths_outside(part, folder)
    elif isinstance(value, str) and value and "\0" not in value and len(value) < 1024:
        path = (folder / value).resolve()
        if ("/" in value or value == "..") and not path.is_relative_to(folder) and path.exists():
            yield path


def files_outside(files: Iterable[str], folder: Path) -> list[Path]:
    """Return the normalized paths of those files that lie outside a folder. Links are not resolved.

    Args:
        files: paths, absolute or relative to `folder`.
        folder: the folder.
    """
    paths = (Path(os.path.normpath(os.path.join(folder, file))) for file in files)
    return [path for path in paths if not path.is_relative_to(folder)]


def fingerprint(tree: ast.Module) -> str:
    """Hash Python code without comments, docstrings, layout and descriptions of fields; modifies `tree` in place."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            body[:] = [s for s in body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Field":
            node.keywords = [k for k in node.keywords if k.arg != "description"]
    return digest(ast.unparse(tree))  # as text: syntax trees print differently in other Python versions


def _read_module(path: Path) -> list[Any]:
    """Return the names that a Python file imports, and its fingerprint. Raises Refused if it is not valid Python."""
    try:
        with _PARSING:
            tree = ast.parse(path.read_text(encoding="utf-8"))
    except SyntaxError as error:
        raise Refused(f"{path}:{error.lineno}: not valid Python: {error.msg}") from None
    return [sorted(set(_imported(tree))), fingerprint(tree)]  # `fingerprint` changes the tree, so it comes last


def _imported(tree: ast.AST) -> Iterator[str]:
    """Yield every imported name that may be a module (`.name` if relative), also of imports inside functions."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            yield module
            yield from (module + ("" if module.endswith(".") else ".") + alias.name for alias in node.names)
        elif not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):  # such imports never run
            yield from _imported(node)


def _module_path(path: Path, root: Path) -> Path:
    """Return the path of a module relative to the root, such as reffusion/types.py."""
    # An installed root lies inside the library, whose modules are relative to the folder that contains the library.
    return path.relative_to(root if path.is_relative_to(root) else root.parents[1])


def _imported_files(names: Iterable[str], path: Path, root: Path) -> Iterator[Path]:
    """Yield the files of CODE_PACKAGES that Python runs when the file at `path` imports `names`, see `_imported`."""
    places = set()
    for name in names:
        level = len(name) - len(name.lstrip("."))
        package = _module_path(path, root).parts[:-level] if level else ()
        parts = (*package, *filter(None, name.lstrip(".").split(".")))
        if parts and parts[0] in CODE_PACKAGES:
            base = root.parents[1] if parts[0] == "reffusion" and is_installed(root) else root
            places |= {os.path.join(base, *parts[: n + 1]) for n in range(len(parts))}  # a.b.c runs a and a.b too
    yield from (Path(p) for place in places for p in (f"{place}.py", f"{place}/__init__.py") if os.path.isfile(p))


def code_fingerprints(root: Path, stage: str, hashes: Hashes, folder: str = "stages") -> dict[str, str]:
    """Return the fingerprints of a stage's code: of <folder>/<stage>.py and of everything that it imports.

    Only modules of CODE_PACKAGES count, imported directly or indirectly. The description of a stage
    (stages/plan/<stage>.py) does not count unless the stage imports it.

    Args:
        root: folder with stages/.
        stage: name of the stage.
        hashes: the cache.
        folder: folder of the stage's file, relative to `root`.

    Returns:
        File relative to the root -> fingerprint.
    """
    found: dict[Path, str] = {}
    waiting = [root / folder / f"{stage}.py"]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found[path], imported = hashes.module(path, root)
            waiting += imported
    return {_module_path(path, root).as_posix(): found[path] for path in sorted(found)}


@dataclass(frozen=True)
class Inputs:
    """Everything that an artifact depends on. The receipt stores it, so that a plan can say what changed.

    Attributes:
        params: every parameter of the stage, defaults included; groups are nested dicts.
        needs: need -> hash of its content; None if the need was skipped.
        weights: parameter -> hash of the folder or file that it names, or the name if it is not local.
        code: file -> fingerprint.
        unkeyed: dotted names of the parameters that do not change the artifact.
        unavailable: optional features, such as LPIPS, that the machine lacked. The stage runs again once one is
            available.
    """

    params: dict[str, Any]
    needs: dict[str, str | None]
    weights: dict[str, str]
    code: dict[str, str]
    unkeyed: tuple[str, ...] = ()
    unavailable: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """The hash of the parameters (without `unkeyed`), needs, weights and code."""
        return digest(json.dumps([self.keyed(self.params), self.needs, self.weights, self.code], sort_keys=True))

    def keyed(self, params: dict[str, Any]) -> dict[str, Any]:
        """Flatten `params` to a dict dotted name -> value, without `unkeyed`, which are not part of the key."""
        inside = tuple(f"{name}." for name in self.unkeyed)
        return {n: v for n, v in flatten_params(params).items() if not f"{n}.".startswith(inside)}


def flatten_params(params: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested parameters to a dict dotted name -> value.

    Args:
        params: parameters, in which groups are nested dicts.
        prefix: text before each name.
    """
    found = {}
    for name, value in params.items():
        inner = isinstance(value, dict) and value
        found |= flatten_params(value, f"{prefix}{name}.") if inner else {f"{prefix}{name}": value}
    return found


def list_changes(old: dict[str, Any], new: Inputs) -> list[str]:
    """Return a phrase for each difference between a receipt, `old`, and the current inputs, except those of code.

    Parameters that do not change the artifact are not compared. An optional feature counts as a difference if the
    machine lacked it at the time of the receipt and has it now.
    """
    before, after = new.keyed(old["params"]), new.keyed(new.params)
    found = []
    for name in sorted({*before, *after}):
        if name not in after or name not in before:
            found.append(f"param {name} is {'new' if name in after else 'gone'}")
        elif before[name] != after[name]:
            found.append(f"param {name} {_short(before[name])} -> {_short(after[name])}")
    for need in _differing(old["needs"], new.needs):
        whole, _, part = need.partition(": ")
        found.append(f"the scene's {part or 'files'} changed" if whole == "scene" else f"the result of {need} changed")
    found += [f"weights {name} changed" for name in _differing(old["weights"], new.weights)]
    gained = (name for name in old.get("unavailable", ()) if name not in new.unavailable)
    return found + [f"{name} is on this machine now" for name in gained]


def _differing(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return the keys with different values in two dicts, sorted; a missing key counts as a value of None."""
    return [name for name in sorted({*old, *new}) if old.get(name) != new.get(name)]


def list_code_changes(old: dict[str, Any], new: Inputs) -> list[str]:
    """Return a phrase for each file of code that differs between a receipt, `old`, and the current inputs."""
    return [f"code of {name} changed" for name in _differing(old["code"], new.code)]


def _short(value: Any) -> str:
    """Return a value as text of at most 40 characters."""
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."
