"""Inpainters as ONNX files, on the CPU. The only importer of onnxruntime, which is optional."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

TYPES = {"float32": "tensor(float)", "uint8": "tensor(uint8)"}


@dataclass(frozen=True)
class Network:
    """One pass of an inpainter.

    Attributes:
        side: of the square pictures that it takes, px; None where it takes any size.
        paint: (picture [H, W, 3] uint8, hole [H, W] bool) -> uint8 [H, W, 3], the whole picture as it answers.
            ValueError where the answer is of another size, not finite or not in 0..255.
    """

    side: int | None
    paint: Callable[[np.ndarray, np.ndarray], np.ndarray]


def load(file: Path, dtype: str) -> Network:
    """An inpainter that takes `image` [1, 3, H, W] and `mask` [1, 1, H, W] and gives one picture [1, 3, H, W].

    Args:
        dtype: "float32" (as LaMa's): image in [0, 1], mask 1 in the hole, answer in 0..255; "uint8" (as MI-GAN's):
            image and answer in 0..255, mask 0 in the hole and 255 elsewhere.
    Raises:
        ValueError: no onnxruntime, no ONNX model, or one of other inputs and outputs; one line that names the file.
    """
    session = _session(file)
    side = _side(session, file, dtype)
    return Network(side, lambda picture, hole: _painted(session, file, dtype, picture, hole))


def _session(file: Path) -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise ValueError(f"{file.name} needs onnxruntime: `pip install onnxruntime`") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()  # it does not read OMP_NUM_THREADS itself
    options.log_severity_level = 3  # errors: exporters name sizes that do not hold, which it would warn of
    try:
        return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # classes of its own, which share none
        raise ValueError(f"{file} is no ONNX model that onnxruntime reads ({_line(error)})") from None


def _side(session: Any, file: Path, dtype: str) -> int | None:
    """Reads what the model says of itself. ValueError where it is not what `load` says."""
    inputs = {each.name: (each.type, list(each.shape)) for each in session.get_inputs()}
    outputs = [(each.type, list(each.shape)) for each in session.get_outputs()]
    sides = [side for _, shape in inputs.values() for side in shape[2:]]
    fixed = {side for side in sides if isinstance(side, int)}
    # A size that is not fixed has a name, or none. Outputs' sizes are checked as they come: exporters misname them.
    one_size = len(fixed) == 1 and all(isinstance(side, int) for side in sides)
    fits = (
        {name: _kind(*each) for name, each in inputs.items()} == {"image": (dtype, 3), "mask": (dtype, 1)}
        and len(outputs) == 1
        and outputs[0][0] == TYPES[dtype]
        and (one_size or not fixed)
    )
    if not fits:
        says = ", ".join(f"{name} {_words(*each)}" for name, each in inputs.items())
        raise ValueError(
            f"{file}: expected image {dtype} [1, 3, H, W], mask {dtype} [1, 1, H, W], of any or one square size, and "
            f"one {dtype} picture; it takes {says} and gives {', '.join(_words(*each) for each in outputs)}"
        )
    return fixed.pop() if fixed else None


def _kind(kind: str, shape: list[Any]) -> tuple[str, int] | None:
    """Its type and channels, of a batch that may be of one picture; None where it is no such batch."""
    types = {theirs: ours for ours, theirs in TYPES.items()}
    batch = len(shape) == 4 and (shape[0] == 1 or not isinstance(shape[0], int))
    return (types[kind], shape[1]) if batch and kind in types else None


def _words(kind: str, shape: list[Any]) -> str:
    return f"{kind.removeprefix('tensor(').removesuffix(')')} [{', '.join(map(str, shape))}]"


def _painted(session: Any, file: Path, dtype: str, picture: np.ndarray, hole: np.ndarray) -> np.ndarray:
    if dtype == "uint8":
        image, mask = picture, np.where(hole, np.uint8(0), np.uint8(255))
    else:
        mask = hole.astype(np.float32)
        image = np.where(hole[..., None], np.float32(0), picture.astype(np.float32) / 255)
    try:
        fed = {"image": np.ascontiguousarray(image.transpose(2, 0, 1)[None]), "mask": mask[None, None]}
        (answer,) = session.run(None, fed)
    except Exception as error:  # classes of its own, which share none
        raise ValueError(
            f"{file}: failed on a picture of {hole.shape[1]}x{hole.shape[0]} px ({_line(error)})"
        ) from None
    if answer.shape != (1, 3, *hole.shape) or not np.isfinite(answer).all():
        raise ValueError(f"{file}: its answer to {[1, 3, *hole.shape]} is {list(answer.shape)}, or not finite")
    if answer.max() <= 1 < picture[~hole].max(initial=0):
        raise ValueError(f"{file}: answers in [0, 1]; expected 0..255")
    return answer[0].transpose(1, 2, 0).round().clip(0, 255).astype(np.uint8)


def _line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 160 else text[:157] + "..."
