"""What an artifact depends on, as hashes."""

import ast
import hashlib
import json
import os
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reffusion.command import installed
from runner import Refused
from runner.files import RECEIPT, files_below, read_json, write_text

OWN = ("reffusion", "stages")  # the packages whose modules count as a stage's code where it imports them
HASHES = ".hashes.json"  # in runs/: where they are remembered
NOT_CONTENT = (RECEIPT, "trace.jsonl", "warnings.json", "checkpoint.pt", "checkpoint.pt.writing")
NOT_WEIGHTS = (".md", ".py", ".png", ".jpg")  # a model's card, its pictures, the scripts that trained it


def digest(*parts: str) -> str:
    """20 hexadecimal digits that depend on every part and on where one ends."""
    state = hashlib.blake2b(digest_size=10)
    for part in parts:
        data = part.encode()
        state.update(len(data).to_bytes(8, "little") + data)
    return state.hexdigest()


def content(listing: dict[str, str], leave_out: tuple[str, ...] = NOT_CONTENT) -> str:
    """One hash of names and hashes, but for the files and folders in `leave_out`."""
    kept = {name: file for name, file in listing.items() if name.partition("/")[0] not in leave_out}
    return digest(*(part for item in kept.items() for part in item))


class Hashes:
    """Hashes of files, remembered in a JSON file for as long as inode, size and time of change stay the same; beside
    them what stages say of themselves (`resolve`)."""

    LIMIT = 1_000_000  # entries kept, the latest; a demo scene and its results are 1,000
    SLOW, SHARE = 0.1, 50  # a save that took so many seconds is not repeated before so many times that

    def __init__(self, path: Path, afresh: bool = False):
        """afresh: compute all that is asked for, once; `rotten` are files that changed though nothing else says so."""
        self.path, self.afresh = path, afresh
        self.rotten: list[Path] = []
        found = read_json(path)
        self.known: dict[str, Any] = found if isinstance(found, dict) else {}
        self._saved, self._saving = 0 if afresh else len(self.known), threading.Lock()
        self._took, self._at = 0.0, 0.0  # seconds of the last save, and when it was
        self._runs: dict[tuple[Path, str], list[Path]] = {}  # a module with its fingerprint -> see `module`

    def _remember(self, kind: str, path: Path, compute: Any) -> Any:
        stat = os.stat(path)
        name = f"{kind} {stat.st_dev} {stat.st_ino} {stat.st_size} {stat.st_mtime_ns}"
        if name not in self.known or self.afresh:
            before, self.known[name] = self.known.get(name), compute(path)
            if before not in (None, self.known[name]):
                self.rotten.append(path)
        return self.known[name]

    def file(self, path: Path) -> str:
        def content(path: Path) -> str:
            with open(path, "rb") as file:
                return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=10)).hexdigest()

        return self._remember("file", path, content)

    def module(self, path: Path, root: Path) -> tuple[str, list[Path]]:
        """The fingerprint of a Python file, and those files below `root` that its imports run."""
        names, fingerprint = self._remember("module", path, _read_module)
        if (path, fingerprint) not in self._runs:
            self._runs[path, fingerprint] = list(_run_by(names, path, root))
        return fingerprint, self._runs[path, fingerprint]

    def folder(self, folder: Path, leave_out: tuple[str, ...] = NOT_CONTENT) -> str:
        """Names and contents of all files below `folder`, but hidden ones and those at its top in `leave_out`."""
        return content(self.listing(folder), leave_out)

    def listing(self, folder: Path) -> dict[str, str]:
        """Name, as seen from `folder`, and hash of all files below, but hidden ones."""
        top = os.path.join(folder, "")
        return {str(path)[len(top) :]: self.file(path) for path in files_below(folder)}

    def files(self, folder: Path, files: Iterable[Path]) -> str:
        """Names as seen from `folder` and contents of these files, in this order."""
        top = os.path.join(folder, "")
        name = lambda path: path[len(top) :] if path.startswith(top) else os.path.relpath(path, folder)
        return digest(*(part for path in files for part in (name(str(path)), self.file(path))))

    def weights(self, folder: Path) -> str:
        """Of a model's folder: what a library may read of it. Writing in its card reruns nothing. Or of a file."""
        read = [path for path in files_below(folder) if path.suffix not in NOT_WEIGHTS]
        return self.file(folder) if folder.is_file() else self.files(folder, read)

    def save(self) -> None:
        began = time.monotonic()
        if len(self.known) == self._saved or (self._took > self.SLOW and began - self._at < self.SHARE * self._took):
            return
        kept = dict(list(self.known.copy().items())[-self.LIMIT :])  # other threads may add to it
        # A full disk, or one that is only read: they are computed again the next time.
        with suppress(OSError), self._saving:
            partial = self.path.with_name(f"{self.path.name}.{os.getpid()}")  # runners of other scenes do the same
            write_text(partial, json.dumps(kept))
            os.replace(partial, self.path)
            self._saved, self._at = len(self.known), time.monotonic()
            self._took = self._at - began


def outside(value: Any, folder: Path) -> Iterator[Path]:
    """Files and folders named anywhere in `value`, relative to the scene, that the scene's folder does not hold."""
    if isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from outside(part, folder)
    elif isinstance(value, str) and value and "\0" not in value and len(value) < 1024:
        path = (folder / value).resolve()
        if ("/" in value or value == "..") and not path.is_relative_to(folder) and path.exists():
            yield path


def elsewhere(files: Iterable[str], folder: Path) -> list[Path]:
    """Those of these files that are not reached through the folder."""
    paths = (Path(os.path.normpath(os.path.join(folder, file))) for file in files)
    return [path for path in paths if not path.is_relative_to(folder)]


def fingerprint(tree: ast.Module) -> str:
    """A hash of Python code that comments, docstrings, layout and descriptions of fields do not change."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            body[:] = [s for s in body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Field":
            node.keywords = [k for k in node.keywords if k.arg != "description"]
    return digest(ast.unparse(tree))  # text, because the trees of two Python versions print differently


def _read_module(path: Path) -> list[Any]:
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"))
    except SyntaxError as error:
        raise Refused(f"{path}:{error.lineno}: not valid Python: {error.msg}") from None
    return [sorted(set(_imported(tree))), fingerprint(tree)]  # which changes the tree


def _imported(tree: ast.AST) -> Iterator[str]:
    """Every imported name that may be a module (`.name`: relative), also those imported inside functions, but for
    those under `if TYPE_CHECKING`, which are never run."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            yield module
            yield from (module + ("" if module.endswith(".") else ".") + alias.name for alias in node.names)
        elif not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
            yield from _imported(node)


def _named(path: Path, root: Path) -> Path:
    """From the root; a module of the library from beside it where it is installed, for it then holds the root."""
    return path.relative_to(root if path.is_relative_to(root) else root.parents[1])


def _run_by(names: Iterable[str], path: Path, root: Path) -> Iterator[Path]:
    """The files of our own packages that importing `names` in the file at `path` runs."""
    places = set()
    for name in names:
        level = len(name) - len(name.lstrip("."))
        package = _named(path, root).parts[:-level] if level else ()
        parts = (*package, *filter(None, name.lstrip(".").split(".")))
        if parts and parts[0] in OWN:
            base = root.parents[1] if parts[0] == "reffusion" and installed(root) else root
            places |= {os.path.join(base, *parts[: n + 1]) for n in range(len(parts))}  # a.b.c runs a and a.b too
    yield from (Path(p) for place in places for p in (f"{place}.py", f"{place}/__init__.py") if os.path.isfile(p))


def code_of(root: Path, stage: str, hashes: Hashes, folder: str = "stages") -> dict[str, str]:
    """File -> fingerprint, of stages/<stage>.py and of each module of ours that it imports, directly or not.

    What describes a stage beforehand (stages/plan/<stage>.py) is not part of it, unless the stage itself imports it."""
    found: dict[Path, str] = {}
    waiting = [root / folder / f"{stage}.py"]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found[path], imported = hashes.module(path, root)
            waiting += imported
    return {_named(path, root).as_posix(): found[path] for path in sorted(found)}


@dataclass(frozen=True)
class Inputs:
    """All that an artifact depends on; kept in its receipt, so that a rerun can say what changed."""

    params: dict[str, Any]  # every parameter of the stage, resolved
    needs: dict[str, str | None]  # need -> hash of its content, None where it was left out
    weights: dict[str, str]  # parameter -> hash of the folder or file it names, or the name itself where none is here
    code: dict[str, str]  # file -> fingerprint
    unkeyed: tuple[str, ...] = ()  # parameters that nothing in the artifact depends on
    unavailable: tuple[str, ...] = ()  # what the stage did without; where it is there, the artifact is made anew

    @property
    def key(self) -> str:
        return digest(json.dumps([self.keyed(self.params), self.needs, self.weights, self.code], sort_keys=True))

    def keyed(self, params: dict[str, Any]) -> dict[str, Any]:
        """Dotted name -> value, of those parameters that count."""
        inside = tuple(f"{name}." for name in self.unkeyed)
        return {n: v for n, v in leaves(params).items() if n not in self.unkeyed and not n.startswith(inside)}


def leaves(params: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted name -> value, of all that is no mapping itself."""
    found = {}
    for name, value in params.items():
        inner = isinstance(value, dict) and value
        found |= leaves(value, f"{prefix}{name}.") if inner else {f"{prefix}{name}": value}
    return found


def changes(old: dict[str, Any], new: Inputs) -> list[str]:
    """What differs between a receipt and the inputs of today, in words; code comes last."""
    said, before, after = [], new.keyed(old["params"]), new.keyed(new.params)
    for name in sorted({*before, *after}):
        if name not in after:
            said.append(f"param {name} is gone")
        elif name not in before:
            said.append(f"param {name} is new")
        elif before[name] != after[name]:
            said.append(f"param {name} {_short(before[name])} -> {_short(after[name])}")
    for kind, then, now in (("need", old["needs"], new.needs), ("weights", old["weights"], new.weights)):
        said += [f"{kind} {name} changed" for name in sorted({*then, *now}) if then.get(name) != now.get(name)]
    said += [f"{name} is on this machine now" for name in old.get("unavailable", ()) if name not in new.unavailable]
    return said + code_changes(old, new)


def code_changes(old: dict[str, Any], new: Inputs) -> list[str]:
    files = sorted({*old["code"], *new.code})
    return [f"code of {name} changed" for name in files if old["code"].get(name) != new.code.get(name)]


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."
