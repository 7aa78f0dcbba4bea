"""The job of the plug-in: two splat files, and the program `reffusion patch` that fills what one of them lacks.

It imports nothing of the editor.
"""

from __future__ import annotations

import os
import subprocess
import threading
from pathlib import Path

import numpy as np

FIELDS = ("means_raw", "sh0_raw", "shN_raw", "opacity_raw", "scaling_raw", "rotation_raw")


def read_splats(data) -> dict[str, np.ndarray]:
    """Copy the splats of a node to arrays [N, ...] float32, by the names of `FIELDS`.

    Args:
        data: the node's `SplatData`.
    """
    return {name: np.asarray(getattr(data, name).cpu().numpy(), np.float32) for name in FIELDS}


def write_splats(path: Path, splats: dict[str, np.ndarray], keep: np.ndarray) -> None:
    """Write the splats at which `keep`, bool [N], is True as a .ply file of 3DGS."""
    means, sh0, rest, opacity, scaling, rotation = (splats[name][keep] for name in FIELDS)
    count = len(means)
    columns = {axis: means[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"f_dc_{k}": sh0.reshape(count, 3)[:, k] for k in range(3)}
    # the file has all coefficients of red, then those of green and of blue
    flat = rest.reshape(count, -1, 3).transpose(0, 2, 1).reshape(count, -1)
    columns |= {f"f_rest_{k}": flat[:, k] for k in range(flat.shape[1])}
    columns["opacity"] = opacity.reshape(count)
    columns |= {f"scale_{k}": scaling[:, k] for k in range(3)} | {f"rot_{k}": rotation[:, k] for k in range(4)}
    table = np.empty(count, [(name, "<f4") for name in columns])
    for name, column in columns.items():
        table[name] = column
    properties = "".join(f"property float {name}\n" for name in columns)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n"
    path.write_bytes(header.encode() + table.tobytes())


def split_splats(count: int, selected: np.ndarray | None, deleted: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return which splats the scene has before and after the object is deleted, bool [count] both.

    The selected splats are the object. If none is selected, the object is what was deleted.

    Raises:
        ValueError: nothing is selected or deleted, or everything is.
    """
    alive = np.ones(count, bool) if deleted is None else ~deleted
    if selected is not None and (selected & alive).any():
        before, after = alive, alive & ~selected
    else:
        before, after = np.ones(count, bool), alive
    if after.all():
        raise ValueError("select the splats of the object first, or delete them")
    if not after.any():
        raise ValueError("every splat is selected or deleted: nothing is left to continue into the hole")
    return before, after


class FillJob:
    """A running `reffusion patch`.

    Attributes:
        out: the filled scene, written when the job has ended without an error.
        line: the last line that the program printed.
    """

    def __init__(self, program: str, folder: Path, cameras: str):
        """Start the program on before.ply and after.ply of a folder, which also receives its results.

        Args:
            program: path of RefFusion's command `reffusion`.
            cameras: a folder with cameras and photographs; empty for none.

        Raises:
            ValueError: the program cannot be started.
        """
        self.out, self.line = folder / "filled.ply", "starting"
        command = [program, "patch", str(folder / "before.ply"), str(folder / "after.ply"), "--out", str(self.out)]
        command += ["--cameras", cameras] if cameras else []
        merged = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "errors": "replace"}
        environment = os.environ | {"PYTHONUNBUFFERED": "1"}  # each line arrives when it is printed
        try:
            self._process = subprocess.Popen(command, cwd=folder, env=environment, **merged)
        except OSError as error:
            raise ValueError(
                f"{program or 'reffusion'} cannot be started ({error.strerror}): name the command"
            ) from None
        self._reader = threading.Thread(target=self._read_lines, daemon=True)
        self._reader.start()

    def _read_lines(self) -> None:
        with (self.out.parent / "log.txt").open("w") as log:
            for line in self._process.stdout:
                log.write(line)
                log.flush()
                self.line = line.strip() or self.line

    def poll(self) -> int | None:
        """Return the exit status of the program, or None while it runs or prints."""
        return None if self._reader.is_alive() else self._process.wait()

    def stop(self) -> None:
        """Interrupt the program. What it has computed stays in its folder."""
        self._process.terminate()
