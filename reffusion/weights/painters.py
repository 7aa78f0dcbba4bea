"""Files of feed-forward 2D inpainters (LaMa, MI-GAN) on this machine: which file a setting means, or why it is missing.

The module imports no large libraries, so that `plan` can use it.
"""

from __future__ import annotations

import hashlib
import importlib.util
from pathlib import Path

from reffusion.params.inpainter import Inpainter
from reffusion.weights.local import Need, explain_missing, locate
from reffusion.weights.published import PAINTERS


def resolve_inpainter(inpainter: Inpainter) -> Inpainter:
    """Replace an inpainter of kind "auto" by the best one that can run on this machine.

    This is the first of LaMa and MI-GAN whose file is on this machine and can be read, else "exemplar" (patches of the
    photographs). An inpainter of another kind is returned unchanged.
    """
    if inpainter.kind != "auto":
        return inpainter
    can_run = lambda each: not weights_needs(each)[0].problem
    return next(filter(can_run, [Inpainter(kind=kind) for kind in PAINTERS]), Inpainter(kind="exemplar"))


def find_file(inpainter: Inpainter) -> Path:
    """Find the file of an inpainter of kind "lama" or "migan".

    If `inpainter.weights` is set, it names the file, or a folder with exactly one file of a readable format. A relative
    path starts at the working directory. Otherwise the folder of the model that `make weights` downloads is searched.

    Raises:
        ValueError: there is no such file, or the folder has several.
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
    """Return the need for an inpainter's file, as a list of one; an empty list for kinds other than "lama" and "migan".

    The list is empty for the kind "auto" too, which can do without a file. An ONNX file without onnxruntime is also a
    problem of the need.

    Args:
        param: name of the parameter that holds the setting, for messages.
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
    """Return the facts about an inpainter on which results depend: its kind and the hash of its file.

    Returns:
        {"inpainter": "<kind> <16 digits of the file's sha256>"}, or only the kind if the file cannot be found. For an
        inpainter without a file: {"inpainter": kind} if `inpainter` has the kind "auto", else an empty dict.
    """
    resolved = resolve_inpainter(inpainter)
    if resolved.kind not in PAINTERS:
        return {"inpainter": resolved.kind} if inpainter.kind == "auto" else {}
    try:
        with open(find_file(resolved), "rb") as file:
            return {"inpainter": f"{resolved.kind} {hashlib.file_digest(file, 'sha256').hexdigest()[:16]}"}
    except (OSError, ValueError):
        return {"inpainter": resolved.kind}
