"""The files of feed-forward 2D inpainters on this machine: which one a parameter names, and what to say where none is.

Nothing heavy is imported, so that `plan` can ask. None is fetched: people who have one name it.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

from reffusion.weights.local import Need
from reffusion.weights.published import PAINTERS


def file_of(inpainter: str, source: str | Path) -> Path:
    """The file that `source` is, or the only one of its kind in the folder that it is.

    Args:
        inpainter: "lama" or "migan".
        source: a file, or a folder of one; read from the working directory where relative.
    Raises:
        ValueError: there is none or there are several, of a kind that this inpainter has.
    """
    known, path = PAINTERS[inpainter], Path(source).expanduser()
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


def of_painter(inpainter: str, source: str | Path, param: str) -> Need:
    """The file that an inpainter works with, and onnxruntime where it needs that.

    Args:
        inpainter, source: as in `file_of`.
        param: what names the file, for the message.
    """
    try:
        file = file_of(inpainter, source)
    except ValueError as error:
        return Need(PAINTERS[inpainter].name, f"{param}: {error}", fetched=False)
    lacks = file.suffix == ".onnx" and importlib.util.find_spec("onnxruntime") is None
    problem = f"{param}: {file.name} needs onnxruntime: `pip install onnxruntime`" if lacks else None
    return Need(str(file), problem, file.stat().st_size, fetched=False)
