"""Files of feed-forward 2D inpainters on this machine: finds the one a parameter names, or explains that it is missing.

Imports nothing heavy, so that `plan` can use it.
"""

from __future__ import annotations

import hashlib
import importlib.util
from pathlib import Path

from reffusion.weights.local import Need, explain_missing, locate
from reffusion.weights.published import PAINTERS, PUBLISHED

AUTO, EXEMPLAR = "auto", "exemplar"


def resolve_inpainter(inpainter: str) -> str:
    """The inpainter; for "auto" the best feed-forward one that is on this machine and can run, else "exemplar"."""
    if inpainter != AUTO:
        return inpainter
    can_run = lambda kind: (file := published_file(kind)) and not _lacks_runtime(file)
    return next((kind for kind in PAINTERS if can_run(kind)), EXEMPLAR)


def published_file(inpainter: str) -> Path | None:
    """The file downloaded by `make weights`, or another of its kind in that folder; None if there is none."""
    folder = locate(PAINTERS[inpainter].repo)
    try:
        return find_file(inpainter, folder) if folder else None
    except ValueError:
        return None


def inpainter_file(inpainter: str, source: str | Path = "") -> Path:
    """The file named by `source`, or the published one if `source` is empty or a diffusion prior.

    Args:
        inpainter: "lama" or "migan".
        source: a file, or a folder with exactly one of its kind; relative to the working directory.

    Raises:
        ValueError: there is no such file, or there are several.
    """
    if not _names_no_file(source):
        return find_file(inpainter, Path(source).expanduser())
    if file := published_file(inpainter):
        return file
    raise ValueError(f"{PAINTERS[inpainter].name}: {explain_missing(PAINTERS[inpainter].repo)}")


def find_file(inpainter: str, path: Path) -> Path:
    """`path`, or the only file of the inpainter's kind in it. Raises ValueError as `inpainter_file`."""
    published = PAINTERS[inpainter]
    endings = " or ".join(published.endings)
    candidates = sorted(path.iterdir()) if path.is_dir() else [path]
    files = [each for each in candidates if each.is_file() and each.suffix in published.endings]
    if len(files) > 1:
        names = ", ".join(each.name for each in files)
        raise ValueError(f"{published.name}: {path} holds {len(files)} {endings} files ({names}); name one of them")
    if not files:
        detail = f"holds no {endings} file" if path.is_dir() else f"is no {endings} file"
        reason = f"{path} {detail if path.exists() else 'is not on this machine'}"
        raise ValueError(f"{published.name}: {reason}; get {published.where}, and name the file or its folder")
    return files[0]


def inpainter_need(inpainter: str, source: str | Path = "", param: str = "inpainter") -> Need:
    """The need for the file of an inpainter, and for onnxruntime if it is an ONNX file.

    Args:
        inpainter, source: as in `inpainter_file`.
        param: the parameter that names the file, for messages.
    """
    known = PAINTERS[inpainter]
    try:
        file = inpainter_file(inpainter, source)
    except ValueError as error:
        if _names_no_file(source):
            return Need(known.repo, f"{param}: {error}", known.bytes, file=known.file)
        return Need(known.name, f"{param}: {error}", fetched=False)
    problem = f"{param}: {file.name} needs onnxruntime: `pip install onnxruntime`" if _lacks_runtime(file) else None
    return Need(str(file), problem, file.stat().st_size, fetched=False)


def inpainter_facts(inpainter: str, source: str | Path = "") -> dict[str, str]:
    """What results depend on: the inpainter, and the hash of its file; empty for one without a file."""
    kind = resolve_inpainter(inpainter)
    if kind not in PAINTERS:
        return {"inpainter": kind} if inpainter == AUTO else {}
    try:
        with open(inpainter_file(kind, source), "rb") as file:
            return {"inpainter": f"{kind} {hashlib.file_digest(file, 'sha256').hexdigest()[:16]}"}
    except (OSError, ValueError):
        return {"inpainter": kind}


def _names_no_file(source: str | Path) -> bool:
    """Is `source` empty or a diffusion prior, and so names no file of a feed-forward inpainter?"""
    return not str(source) or str(source) in PUBLISHED or (Path(source).expanduser() / "unet").is_dir()


def _lacks_runtime(file: Path) -> bool:
    return file.suffix == ".onnx" and importlib.util.find_spec("onnxruntime") is None
