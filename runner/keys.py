"""What an artifact depends on, as hashes."""

from __future__ import annotations

import ast
import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from runner.pipeline import Refused

LIBRARY = "reffusion"  # the package whose modules count as a stage's code
NOT_CONTENT = ("receipt.json", "trace.jsonl", "checkpoint.pt", "checkpoint.pt.writing")
NOT_WEIGHTS = (".md", ".py", ".png", ".jpg")  # a model's card, its pictures, the scripts that trained it


def digest(*parts: str) -> str:
    """20 hexadecimal digits that depend on every part and on where one ends."""
    state = hashlib.blake2b(digest_size=10)
    for part in parts:
        data = part.encode()
        state.update(len(data).to_bytes(8, "little") + data)
    return state.hexdigest()


class Hashes:
    """Hashes of files, remembered in a JSON file for as long as inode, size and time of change stay the same."""

    LIMIT = 100_000  # entries kept, the latest

    def __init__(self, path: Path):
        self.path = path
        try:
            self._known: dict[str, Any] = json.loads(path.read_text())
        except (OSError, ValueError):
            self._known = {}
        self._saved = len(self._known)

    def _remember(self, kind: str, path: Path, compute: Any) -> Any:
        stat = path.stat()
        name = f"{kind} {stat.st_dev} {stat.st_ino} {stat.st_size} {stat.st_mtime_ns}"
        if name not in self._known:
            self._known[name] = compute(path)
        return self._known[name]

    def file(self, path: Path) -> str:
        return self._remember("file", path, _file_digest)

    def module(self, path: Path) -> tuple[str, list[str]]:
        """The fingerprint of a Python file and the dotted names it imports (`.name`: relative)."""
        fingerprint, names = self._remember("code", path, _read_module)
        return fingerprint, names

    def folder(self, folder: Path, leave_out: tuple[str, ...] = NOT_CONTENT) -> str:
        """Names and contents of all files below `folder`, but hidden ones and those at its top in `leave_out`."""
        files = (path for path in files_below(folder) if path.relative_to(folder).as_posix() not in leave_out)
        return self.files(folder, files)

    def files(self, folder: Path, files: Iterable[Path]) -> str:
        """Names as seen from `folder` and contents of these files, in this order."""
        return digest(*(part for path in files for part in (os.path.relpath(path, folder), self.file(path))))

    def weights(self, folder: Path) -> str:
        """Of a model's folder: what a library may read of it. Writing in its card reruns nothing."""
        files = (path for path in files_below(folder) if path.suffix not in NOT_WEIGHTS)
        return digest(*(part for path in files for part in (path.relative_to(folder).as_posix(), self.file(path))))

    def save(self) -> None:
        if len(self._known) == self._saved:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        kept = dict(list(self._known.items())[-self.LIMIT :])
        partial = self.path.with_name(f"{self.path.name}.{os.getpid()}")
        partial.write_text(json.dumps(kept))
        os.replace(partial, self.path)
        self._saved = len(self._known)


def files_below(folder: Path) -> Iterator[Path]:
    """Files, sorted, links followed, hidden names left out."""
    seen = set()
    for place, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        folders[:] = [] if real in seen else sorted(f for f in folders if not f.startswith(".") and f != "__pycache__")
        seen.add(real)
        for name in sorted(names):
            path = Path(place, name)
            if not name.startswith(".") and path.is_file():
                yield path


def _file_digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=10)).hexdigest()


def fingerprint(source: str) -> str:
    """A hash of Python code that comments, docstrings, layout and descriptions of fields do not change."""
    return _fingerprint(ast.parse(source))


def _fingerprint(tree: ast.Module) -> str:
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [s for s in body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Field":
            node.keywords = [k for k in node.keywords if k.arg != "description"]
    return digest(ast.unparse(tree))  # text, because the trees of two Python versions print differently


def _read_module(path: Path) -> list[Any]:
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"))
    except SyntaxError as error:
        raise Refused(f"{path}:{error.lineno}: not valid Python: {error.msg}") from None
    names = sorted(set(_imported(tree)))
    return [_fingerprint(tree), names]


def _imported(tree: ast.Module) -> Iterator[str]:
    """Every imported name that may be a module, also those imported inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            yield module
            yield from (module + ("" if module.endswith(".") else ".") + alias.name for alias in node.names)


def _absolute(name: str, path: Path, root: Path) -> str:
    """The dotted name of an import as written in the file at `path`."""
    level = len(name) - len(name.lstrip("."))
    if not level:
        return name
    package = path.relative_to(root).parts[:-level]
    return ".".join((*package, *filter(None, name.lstrip(".").split("."))))


def code_of(root: Path, stage: str, hashes: Hashes) -> dict[str, str]:
    """File -> fingerprint, of stages/<stage>.py and of each `reffusion` module it imports, directly or not."""
    found: dict[str, str] = {}
    waiting = [root / "stages" / f"{stage}.py"]
    while waiting:
        path = waiting.pop()
        name = path.relative_to(root).as_posix()
        if name in found:
            continue
        found[name], imported = hashes.module(path)
        for dotted in imported:
            parts = _absolute(dotted, path, root).split(".")
            if parts[0] != LIBRARY:
                continue
            for depth in range(1, len(parts) + 1):  # importing a.b.c runs a and a.b too
                place = root.joinpath(*parts[:depth])
                waiting += [p for p in (place.with_suffix(".py"), place / "__init__.py") if p.is_file()]
    return dict(sorted(found.items()))


@dataclass(frozen=True)
class Inputs:
    """All that an artifact depends on; kept in its receipt, so that a rerun can say what changed.

    Attributes:
        params: every parameter of the stage, resolved.
        profile: the profile's name.
        needs: need -> hash of its content, None where it was left out.
        weights: parameter -> hash of the weights folder it names, or the name itself where that is not a folder here.
        code: file -> fingerprint.
    """

    params: dict[str, Any]
    profile: str
    needs: dict[str, str | None]
    weights: dict[str, str]
    code: dict[str, str]

    @property
    def key(self) -> str:
        return digest(json.dumps(asdict(self), sort_keys=True))


def changes(old: dict[str, Any], new: Inputs) -> list[str]:
    """What differs between a receipt and the inputs of today, in words; code comes last."""
    said = []
    if old["profile"] != new.profile:
        said.append(f"profile {old['profile']} -> {new.profile}")
    for name in sorted({*old["params"], *new.params}):
        if name not in new.params:
            said.append(f"param {name} is gone")
        elif name not in old["params"]:
            said.append(f"param {name} is new")
        elif (before := old["params"][name]) != new.params[name]:
            said.append(f"param {name} {_short(before)} -> {_short(new.params[name])}")
    for kind, before, after in (("need", old["needs"], new.needs), ("weights", old["weights"], new.weights)):
        said += [f"{kind} {name} changed" for name in sorted({*before, *after}) if before.get(name) != after.get(name)]
    return said + code_changes(old, new)


def code_changes(old: dict[str, Any], new: Inputs) -> list[str]:
    files = sorted({*old["code"], *new.code})
    return [f"code of {name} changed" for name in files if old["code"].get(name) != new.code.get(name)]


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."
