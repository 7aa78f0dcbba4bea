"""Files of feed-forward 2D inpainters on this machine: finds the one a setting means, or explains that it is missing.

Imports nothing heavy, so that `plan` can use it.
"""

from __future__ import annotations

import hashlib
import importlib.util
from pathlib import Path

from reffusion.params.inpainter import Inpainter
from reffusion.weights.local import Need, explain_missing, locate
from reffusion.weights.published import PAINTERS


def resolve_inpainter(inpainter: Inpainter) -> Inpainter:
    """The inpainter; for kind "auto" the best feed-forward one that is on this machine and can run, else "exemplar"."""
    if inpainter.kind != "auto":
        return inpainter
    can_run = lambda each: not weights_needs(each)[0].problem
    return next(filter(can_run, [Inpainter(kind=kind) for kind in PAINTERS]), Inpainter(kind="exemplar"))


def find_file(inpainter: Inpainter) -> Path:
    """The file of an inpainter of kind "lama" or "migan".

    `inpainter.weights` names it, or a folder with exactly one of its kind, relative to the working directory; without,
    it is the file downloaded by `make weights`, or another of its kind in that folder.

    Raises:
        ValueError: there is no such file, or there are several.
    """
    published = PAINTERS[inpainter.kind]
    path = Path(inpainter.weights).expanduser() if inpainter.weights else locate(published.repo)
    if path is None:
        raise ValueError(f"{published.name}: {explain_missing(published.repo)}")
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


def weights_needs(inpainter: Inpainter, param: str = "inpainter") -> list[Need]:
    """The need for the inpainter's file, and for onnxruntime if it is an ONNX file; empty for a kind without a file.

    Args:
        param: the parameter that holds the setting, for messages.
    """
    if inpainter.kind not in PAINTERS:
        return []
    published = PAINTERS[inpainter.kind]
    try:
        file = find_file(inpainter)
    except ValueError as error:
        if inpainter.weights:
            return [Need(published.name, f"{param}: {error}", fetched=False)]
        return [Need(published.repo, f"{param}: {error}", published.bytes, file=published.file)]
    lacks_runtime = file.suffix == ".onnx" and importlib.util.find_spec("onnxruntime") is None
    problem = f"{param}: {file.name} needs onnxruntime: `pip install onnxruntime`" if lacks_runtime else None
    return [Need(str(file), problem, file.stat().st_size, fetched=False)]


def inpainter_facts(inpainter: Inpainter) -> dict[str, str]:
    """What results depend on: the inpainter, and the hash of its file; empty for one without a file."""
    resolved = resolve_inpainter(inpainter)
    if resolved.kind not in PAINTERS:
        return {"inpainter": resolved.kind} if inpainter.kind == "auto" else {}
    try:
        with open(find_file(resolved), "rb") as file:
            return {"inpainter": f"{resolved.kind} {hashlib.file_digest(file, 'sha256').hexdigest()[:16]}"}
    except (OSError, ValueError):
        return {"inpainter": resolved.kind}
