"""OpenCV's shift maps, in a process of their own: `python -m reffusion.paint.shiftmap`.

An .npz on stdin, an .npy on stdout. OpenCV (5.0) reads memory there that it has not written: the same picture was
completed in several ways, within a long-lived process, and in fresh ones by the length of their environment. So the
process is a fresh one whose memory is handed out as zeros (glibc's `MALLOC_PERTURB_`).
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np


def completed(lab: np.ndarray, known: np.ndarray) -> np.ndarray:
    """uint8 [H, W, 3], `lab` (CIELAB, uint8) with the pixels where `known` (uint8 [H, W]) is 0 put together from
    others; zeros where no offset reaches.

    Raises:
        RuntimeError: the process failed.
    """
    sent = io.BytesIO()
    np.savez(sent, lab=lab, known=known)
    command = [sys.executable, "-m", "reffusion.paint.shiftmap"]
    root = Path(__file__).resolve().parents[2]
    zeroed = {**os.environ, "MALLOC_PERTURB_": "255"}  # the complement of each byte: 0
    done = subprocess.run(command, input=sent.getvalue(), capture_output=True, cwd=root, env=zeroed)
    if done.returncode:
        raise RuntimeError(f"shift maps failed: {done.stderr.decode(errors='replace').strip()[-300:]}")
    return np.load(io.BytesIO(done.stdout))


def main() -> None:
    given, painted = np.load(io.BytesIO(sys.stdin.buffer.read())), io.BytesIO()
    found = np.zeros_like(given["lab"])
    cv2.xphoto.inpaint(given["lab"], given["known"], found, cv2.xphoto.INPAINT_SHIFTMAP)
    np.save(painted, found)
    sys.stdout.buffer.write(painted.getvalue())


if __name__ == "__main__":
    main()
