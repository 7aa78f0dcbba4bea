"""Loading of ONNX models for the CPU. Only this module imports onnxruntime."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch


def open_session(model: Path | bytes, name: str) -> Any:
    """Return an onnxruntime.InferenceSession of the model, on the CPU, with as many threads as torch uses.

    Args:
        model: the path of the model's file, or the content of the file.
        name: name of the file for error messages.

    Raises:
        ValueError: onnxruntime is not installed, or cannot read the model. The message is one line.
    """
    try:
        import onnxruntime
    except ImportError:
        raise ValueError(f"{name} needs onnxruntime: `pip install onnxruntime`") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()  # onnxruntime does not read OMP_NUM_THREADS
    options.log_severity_level = 3  # errors only, without warnings of output shapes that exporters misname
    source = model if isinstance(model, bytes) else str(model)
    try:
        return onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions have no common base class
        text = " ".join(str(error).split())
        raise ValueError(f"{name} is no ONNX model that onnxruntime reads ({text[:120]})") from None
