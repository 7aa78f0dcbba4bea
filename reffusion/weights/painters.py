"""The files of feed-forward 2D inpainters on this machine: which one a parameter names, and what to say where none is.

Nothing heavy is imported, so that `plan` can ask.
"""

from __future__ import annotations

import hashlib
import importlib.util
from pathlib import Path

from reffusion.weights.local import Need, absent, locate
from reffusion.weights.published import PAINTERS, PUBLISHED

AUTO, EXEMPLAR = "auto", "exemplar"


def resolve_inpainter(inpainter: str) -> str:
    """The inpainter; for "auto" the best feed-forward one whose published file is on this machine and can be run, else
    "exemplar"."""
    if inpainter != AUTO:
        return inpainter
    can_run = lambda kind: (file := published_file(kind)) and not _lacks_runtime(file)
    return next((kind for kind in PAINTERS if can_run(kind)), EXEMPLAR)


def published_file(inpainter: str) -> Path | None:
    """The file that `make weights` fetches, or another of its kind in that place; None where it is not here."""
    folder = locate(PAINTERS[inpainter].repo)
    try:
        return find_file(inpainter, folder) if folder else None
    except ValueError:
        return None


def file_of(inpainter: str, source: str | Path = "") -> Path:
    """The file that `source` is, or the only one of its kind in the folder that it is; the published one where it is
    empty or a diffusion prior.

    Args:
        inpainter: "lama" or "migan".
        source: a file, or a folder of one; read from the working directory where relative.
    Raises:
        ValueError: there is none or there are several, of a kind that this inpainter has.
    """
    if not _is_none(source):
        return find_file(inpainter, Path(source).expanduser())
    if file := published_file(inpainter):
        return file
    raise ValueError(f"{PAINTERS[inpainter].name}: {absent(PAINTERS[inpainter].repo)}")


def find_file(inpainter: str, path: Path) -> Path:
    """`path`, or the only file of the inpainter's kind in it. ValueError as of `file_of`."""
    known = PAINTERS[inpainter]
    kinds = " or ".join(known.endings)
    candidates = sorted(path.iterdir()) if path.is_dir() else [path]
    files = [each for each in candidates if each.is_file() and each.suffix in known.endings]
    if len(files) > 1:
        named = ", ".join(each.name for each in files)
        raise ValueError(f"{known.name}: {path} holds {len(files)} {kinds} files ({named}); name one of them")
    if not files:
        wrong = f"holds no {kinds} file" if path.is_dir() else f"is no {kinds} file"
        lacks = f"{path} {wrong if path.exists() else 'is not on this machine'}"
        raise ValueError(f"{known.name}: {lacks}; get {known.where}, and name the file or its folder")
    return files[0]


def of_painter(inpainter: str, source: str | Path = "", param: str = "inpainter") -> Need:
    """The file that an inpainter works with, and onnxruntime where it needs that.

    Args:
        inpainter, source: as in `file_of`.
        param: what names the file, for the message.
    """
    known = PAINTERS[inpainter]
    try:
        file = file_of(inpainter, source)
    except ValueError as error:
        if _is_none(source):
            return Need(known.repo, f"{param}: {error}", known.bytes, file=known.file)
        return Need(known.name, f"{param}: {error}", fetched=False)
    problem = f"{param}: {file.name} needs onnxruntime: `pip install onnxruntime`" if _lacks_runtime(file) else None
    return Need(str(file), problem, file.stat().st_size, fetched=False)


def inpainter_facts(inpainter: str, source: str | Path = "") -> dict[str, str]:
    """What its result depends on: which inpainter, and its file's content; nothing for one without a file."""
    kind = resolve_inpainter(inpainter)
    if kind not in PAINTERS:
        return {"inpainter": kind} if inpainter == AUTO else {}
    try:
        with open(file_of(kind, source), "rb") as file:
            return {"inpainter": f"{kind} {hashlib.file_digest(file, 'sha256').hexdigest()[:16]}"}
    except (OSError, ValueError):
        return {"inpainter": kind}


def _is_none(source: str | Path) -> bool:
    """Is this no source of a feed-forward inpainter: empty, or a diffusion prior?"""
    return not str(source) or str(source) in PUBLISHED or (Path(source).expanduser() / "unet").is_dir()


def _lacks_runtime(file: Path) -> bool:
    return file.suffix == ".onnx" and importlib.util.find_spec("onnxruntime") is None
