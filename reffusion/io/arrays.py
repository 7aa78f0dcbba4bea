"""Reads and writes JSON, text, and arrays of labels."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from reffusion.io.files import BadInput, reading

if TYPE_CHECKING:
    from torch import Tensor


def save_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, creating the folder. Floats keep every digit; NaN and infinity raise
    ValueError."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=2, allow_nan=False) + "\n")


def save_text(path: Path, text: str) -> None:
    """Write lines for people, creating the folder."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text, encoding="utf-8")


def load_json(path: Path) -> Any:
    """The value in a JSON file, in UTF-8, -16 or -32; BadInput naming the file where it is missing or not JSON."""
    with reading(path, "valid JSON"):
        return json.loads(Path(path).read_bytes())


def load_array(path: Path, what: str = "a readable array") -> np.ndarray:
    """The array in a `.npy` file. BadInput where it is something else: neither pickles nor archives are read."""
    with reading(path, what):
        # Mapped first, so that the size in the header is compared with the file's length before memory is allocated.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise BadInput(f"{path}: an archive; save a single array, as .npy")
        return np.array(array)


def save_labels(path: Path, labels: Tensor | np.ndarray) -> None:
    """Write bool [N] (True = masked Gaussian) as `.npy`."""
    array = np.asarray(labels)
    if array.dtype != np.bool_ or array.ndim != 1:
        raise ValueError(f"{path}: labels must be bool [N], got {array.dtype} {list(array.shape)}")
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as file:
        np.save(file, array)


def load_labels(path: Path) -> Tensor:
    """bool [N] on the CPU, True = masked Gaussian."""
    import torch

    array = load_array(path)
    if array.dtype != np.bool_ or array.ndim != 1:
        raise BadInput(f"{path}: labels must be bool [N], got {array.dtype} {list(array.shape)}")
    return torch.from_numpy(array)


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays as a compressed `.npz`, creating the folder; equal arrays give equal bytes."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as file:
        # Any: an array may be called like the parameter allow_pickle, as the stub of numpy sees it.
        np.savez_compressed(file, **cast(Mapping[str, Any], arrays))


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays that `save_arrays` wrote."""
    with reading(path, "a readable archive of arrays"), np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}
