"""RefFusion's environment, asked from nerfbaselines': one process, that stays."""

from __future__ import annotations

import functools
import io
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

WORKER = Path(__file__).with_name("worker.py")


class RefFusionError(RuntimeError):
    """What RefFusion said, in a line."""


def python() -> str:
    """RefFusion's Python: $REFFUSION_PYTHON, else that of the checkout this lies in."""
    beside = WORKER.resolve().parents[3] / ".venv/bin/python"
    path = os.environ.get("REFFUSION_PYTHON") or (str(beside) if beside.is_file() else "")
    if not path:
        raise RefFusionError("set REFFUSION_PYTHON to the Python of the environment that RefFusion is installed in")
    return path


@functools.cache
def _process() -> subprocess.Popen[bytes]:
    outside = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    return subprocess.Popen([python(), str(WORKER)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=outside)


def ask(request: str, **arrays: Any) -> dict[str, np.ndarray]:
    """Return the reply of the function of worker.py; raise `RefFusionError` with its message if it refuses."""
    process = _process()
    np.savez(buffer := io.BytesIO(), ask=request, **arrays)
    data = buffer.getvalue()
    process.stdin.write(len(data).to_bytes(8, "little") + data)
    process.stdin.flush()
    length = process.stdout.read(8)
    if len(length) < 8:
        raise RefFusionError(f"{python()} ended with code {process.wait()}; see above")
    with np.load(io.BytesIO(process.stdout.read(int.from_bytes(length, "little")))) as file:
        reply = dict(file)
    if "error" in reply:
        raise RefFusionError(str(reply["error"]))
    return reply
