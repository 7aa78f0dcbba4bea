"""What 2D inpainters need on this machine: the files of LaMa, MI-GAN and Moebius, pipelines, programs.

The module imports no large libraries, so that `plan` can use it.
"""

from __future__ import annotations

import hashlib
import importlib.util
import shutil
from pathlib import Path

from reffusion.params.inpainter import Inpainter, split_command
from reffusion.weights.local import Need, explain_missing, is_id, locate, pipeline_need
from reffusion.weights.published import MOEBIUS, PAINTERS


def resolve_inpainter(inpainter: Inpainter) -> Inpainter:
    """Replace an inpainter of kind "auto" by the best one that can run on this machine.

    This is the first of LaMa and MI-GAN whose file is on this machine and can be read, else "exemplar" (patches of the
    photographs). An inpainter of another kind is returned unchanged.
    """
    if inpainter.kind != "auto":
        return inpainter
    can_run = lambda each: not inpainter_needs(each)[0].problem
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


def inpainter_needs(inpainter: Inpainter, param: str = "inpainter", dtype: str = "float32") -> list[Need]:
    """Return what an inpainter needs on this machine: a list of one need, or an empty list.

    The list is empty for kinds that need nothing, for "auto", which can do without a file, and for "diffusion", whose
    model another parameter names.

    Args:
        param: name of the parameter that holds the setting, for messages.
        dtype: the precision in which a pipeline is used.
    """
    if inpainter.kind == "pipeline":
        return [pipeline_need(str(inpainter.weights), dtype)]
    if inpainter.kind == "command":
        program = split_command(str(inpainter.command))[0]
        problem = None if shutil.which(program) else f"{param}: {program} is no program that can be started here"
        return [Need(program, problem, can_download=False)]
    if inpainter.kind == "moebius":
        return [_moebius_need(inpainter, param)]
    return [_network_need(inpainter, param)] if inpainter.kind in PAINTERS else []


def _network_need(inpainter: Inpainter, param: str) -> Need:
    """Return the need for the file of "lama" or "migan"; an ONNX file without onnxruntime is a problem, too."""
    published = PAINTERS[inpainter.kind]
    try:
        file = find_file(inpainter)
    except ValueError as error:
        if inpainter.weights:
            return Need(published.name, f"{param}: {error}", can_download=False)
        return Need(published.repo, f"{param}: {error}", published.bytes, files=(published.file,))
    lacks_runtime = file.suffix == ".onnx" and importlib.util.find_spec("onnxruntime") is None
    problem = f"{param}: {file.name} needs onnxruntime: `pip install onnxruntime`" if lacks_runtime else None
    return Need(str(file), problem, file.stat().st_size, can_download=False)


def _moebius_need(inpainter: Inpainter, param: str) -> Need:
    """Return the need for the files of Moebius and for onnxruntime."""
    lacks_runtime = importlib.util.find_spec("onnxruntime") is None
    problem = f"{param}: Moebius needs onnxruntime: `pip install onnxruntime`" if lacks_runtime else None
    try:
        folder = find_moebius(inpainter)
    except ValueError as error:
        can_download = not (inpainter.weights or lacks_runtime)
        return Need(MOEBIUS.repo, problem or f"{param}: {error}", MOEBIUS.bytes, can_download, files=MOEBIUS.files)
    size = sum((folder / name).stat().st_size for name in MOEBIUS.files)
    return Need(str(folder), problem, size, can_download=False)


def name_seed_painter(inpainter: Inpainter) -> str:
    """Return the name of an inpainter of the kinds `SEED_KINDS` for tables and messages, without folders."""
    if inpainter.kind == "moebius":
        return "Moebius"
    if inpainter.kind == "pipeline":
        source = str(inpainter.weights)
        return f"the pipeline {source if is_id(source) else Path(source).name}"
    return f"the program {Path(split_command(str(inpainter.command))[0]).name}"


def find_moebius(inpainter: Inpainter) -> Path:
    """Find the folder of Moebius that a setting means; raises ValueError if a file is not there."""
    folder = Path(inpainter.weights).expanduser() if inpainter.weights else locate(MOEBIUS.repo)
    if folder is None:
        raise ValueError(f"Moebius: {explain_missing(MOEBIUS.repo)}")
    if missing := [name for name in MOEBIUS.files if not (folder / name).is_file()]:
        raise ValueError(f"Moebius: {folder} holds no {missing[0]}: it must hold {', '.join(MOEBIUS.files)}")
    return folder


def inpainter_facts(inpainter: Inpainter) -> dict[str, str]:
    """Return the facts about an inpainter on which results depend: its kind and a hash of its files.

    The files of a command are the existing ones that it names, such as the program.

    Returns:
        {"inpainter": "<kind> <16 digits of a sha256>"}, or only the kind if the file of "lama" or "migan" cannot be
        found. For an inpainter without files, or a pipeline, whose weights the runner hashes: {"inpainter": kind} if
        `inpainter` has the kind "auto", else an empty dict.
    """
    resolved = resolve_inpainter(inpainter)
    if resolved.kind in PAINTERS:
        try:
            return {"inpainter": f"{resolved.kind} {_hash(find_file(resolved))[:16]}"}
        except (OSError, ValueError):
            return {"inpainter": resolved.kind}
    if resolved.kind == "command":
        found = [shutil.which(word) or word for word in split_command(str(inpainter.command))]
        files = [Path(each) for each in found if Path(each).is_file()]
    elif resolved.kind == "moebius":
        try:
            files = [find_moebius(inpainter) / name for name in MOEBIUS.files]
        except ValueError:
            files = []
    else:
        return {"inpainter": resolved.kind} if inpainter.kind == "auto" else {}
    digests = "".join(map(_hash, files))
    return {"inpainter": f"{resolved.kind} {hashlib.sha256(digests.encode()).hexdigest()[:16]}"}


def _hash(path: Path) -> str:
    """Return the sha256 of the content of a file, as hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
