"""Inpainting networks in ONNX files, run on the CPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.onnx import open_session

ONNX_TYPES = {"float32": "tensor(float)", "uint8": "tensor(uint8)"}


@dataclass(frozen=True)
class Network:
    """An inpainting network.

    Attributes:
        side: px, side of the square images that the network takes; None if it takes any size.
        paint: function (picture uint8 [H, W, 3], hole bool [H, W], True = to fill) -> uint8 [H, W, 3]. The result is
            the network's output for the whole picture, also outside the hole. Raises ValueError if the network fails on
            the picture, or if its output has another size, is not finite, or has values in [0, 1] instead of 0..255.
    """

    side: int | None
    paint: Callable[[np.ndarray, np.ndarray], np.ndarray]


def load(file: Path, dtype: str) -> Network:
    """Load a network with inputs `image` [1, 3, H, W] and `mask` [1, 1, H, W] and one output [1, 3, H, W].

    Args:
        file: the ONNX file.
        dtype: type of the arrays. For "float32" (LaMa), the image is in [0, 1], the mask is 1 in the hole, and the
            output is in 0..255. For "uint8" (MI-GAN), image and output are in 0..255, and the mask is 0 in the hole and
            255 elsewhere.

    Raises:
        ValueError: onnxruntime is missing, the file is no ONNX model, or its inputs and outputs are others than
            these. The message is one line that names the file.
    """
    session = open_session(file, str(file))
    side = _read_side(session, file, dtype)
    return Network(side, lambda picture, hole: _run(session, file, dtype, picture, hole))


def _read_side(session: Any, file: Path, dtype: str) -> int | None:
    """Return the side, px, of the model's square images, None for any; raises ValueError if the interface is wrong."""
    inputs = {each.name: (each.type, list(each.shape)) for each in session.get_inputs()}
    outputs = [(each.type, list(each.shape)) for each in session.get_outputs()]
    sides = [side for _, shape in inputs.values() for side in shape[2:]]
    fixed = {side for side in sides if isinstance(side, int)}
    # A size that is not fixed is a name or None. The size of the output is checked when the model runs, because
    # exporters write wrong names for it.
    one_size = len(fixed) == 1 and all(isinstance(side, int) for side in sides)
    fits = (
        {name: _type_and_channels(*each) for name, each in inputs.items()} == {"image": (dtype, 3), "mask": (dtype, 1)}
        and len(outputs) == 1
        and outputs[0][0] == ONNX_TYPES[dtype]
        and (one_size or not fixed)
    )
    if not fits:
        described = ", ".join(f"{name} {describe(*each)}" for name, each in inputs.items())
        raise ValueError(
            f"{file}: expected image {dtype} [1, 3, H, W], mask {dtype} [1, 1, H, W], of any or one square size, and "
            f"one {dtype} picture; it takes {described} and gives {', '.join(describe(*each) for each in outputs)}"
        )
    return fixed.pop() if fixed else None


def _type_and_channels(kind: str, shape: list[Any]) -> tuple[str, int] | None:
    """Return the type and the number of channels of an input; None if it cannot hold a batch of one image."""
    types = {onnx_type: dtype for dtype, onnx_type in ONNX_TYPES.items()}
    batch = len(shape) == 4 and (shape[0] == 1 or not isinstance(shape[0], int))
    return (types[kind], shape[1]) if batch and kind in types else None


def describe(kind: str, shape: list[Any]) -> str:
    """Return the type and shape of an input or output as text for messages, such as "float [1, 3, H, W]"."""
    return f"{kind.removeprefix('tensor(').removesuffix(')')} [{', '.join(map(str, shape))}]"


def _run(session: Any, file: Path, dtype: str, picture: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Run the model on one picture; arguments, result and errors as of `Network.paint`."""
    if dtype == "uint8":
        image, mask = picture, np.where(hole, np.uint8(0), np.uint8(255))
    else:
        mask = hole.astype(np.float32)
        image = np.where(hole[..., None], np.float32(0), picture.astype(np.float32) / 255)
    try:
        inputs = {"image": np.ascontiguousarray(image.transpose(2, 0, 1)[None]), "mask": mask[None, None]}
        (answer,) = session.run(None, inputs)
    except Exception as error:  # onnxruntime's exceptions have no common base class
        raise ValueError(
            f"{file}: failed on a picture of {hole.shape[1]}x{hole.shape[0]} px ({one_line(error)})"
        ) from None
    if answer.shape != (1, 3, *hole.shape) or not np.isfinite(answer).all():
        raise ValueError(f"{file}: its answer to {[1, 3, *hole.shape]} is {list(answer.shape)}, or not finite")
    if answer.max() <= 1 < picture[~hole].max(initial=0):
        raise ValueError(f"{file}: answers in [0, 1]; expected 0..255")
    return answer[0].transpose(1, 2, 0).round().clip(0, 255).astype(np.uint8)


def one_line(error: BaseException) -> str:
    """Return the error's text on one line of at most 160 characters."""
    text = " ".join(str(error).split())
    return text if len(text) <= 160 else text[:157] + "..."
