"""Opens ONNX models on the CPU. The only module that imports onnxruntime."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch


def open_session(model: Path | bytes, name: str) -> Any:
    """An onnxruntime.InferenceSession that uses as many threads as torch.

    Args:
        model: a file, or its content.
        name: of the file, for messages.

    Raises:
        ValueError: onnxruntime is not installed, or cannot read the model; one line.
    """
    try:
        import onnxruntime
    except ImportError:
        raise ValueError(f"{name} needs onnxruntime: `pip install onnxruntime`") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()  # onnxruntime does not read OMP_NUM_THREADS
    options.log_severity_level = 3  # errors only: it would warn of output sizes that exporters misname
    source = model if isinstance(model, bytes) else str(model)
    try:
        return onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions have no common base class
        text = " ".join(str(error).split())
        raise ValueError(f"{name} is no ONNX model that onnxruntime reads ({text[:120]})") from None
