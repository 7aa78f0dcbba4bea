"""Reading and writing of JSON, text, and numpy arrays, such as labels of Gaussians."""

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
    """Write `value` as indented JSON, and create the folder.

    Floats are written so that they read back exactly.

    Raises:
        ValueError: a float is NaN or infinite.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=2, allow_nan=False) + "\n")


def save_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file, and create its folder."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text, encoding="utf-8")


def load_json(path: Path) -> Any:
    """Read a JSON file in UTF-8, UTF-16 or UTF-32.

    Raises:
        BadInput: the file is missing or not valid JSON. The message names the file.
    """
    with reading(path, "valid JSON"):
        try:
            return json.loads(Path(path).read_bytes())
        except json.JSONDecodeError as error:
            if error.doc.startswith(("//", "#", "/*"), error.pos):
                raise BadInput(
                    f"{path}: not valid JSON: line {error.lineno} has a comment, which JSON does not allow; remove it"
                ) from None
            raise


def load_array(path: Path, what: str = "a readable array") -> np.ndarray:
    """Read the array in a `.npy` file.

    Args:
        what: what the file should be, for error messages.

    Raises:
        BadInput: the file is missing, damaged, or no plain array. Pickled objects and archives (.npz) are not read.
    """
    with reading(path, what):
        # A memory map compares the size in the header with the length of the file, before memory is allocated.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise BadInput(f"{path}: an archive; save a single array, as .npy")
        return np.array(array)


def save_labels(path: Path, labels: Tensor | np.ndarray) -> None:
    """Write labels of Gaussians, bool [N], as `.npy`, and create the folder. Raises ValueError for any other array.

    True means a masked Gaussian: the object's in the stage `masks`, a new one in `initialize` and `distill`.
    """
    array = np.asarray(labels)
    if array.dtype != np.bool_ or array.ndim != 1:
        raise ValueError(f"{path}: labels must be bool [N], got {array.dtype} {list(array.shape)}")
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as file:
        np.save(file, array)


def load_labels(path: Path) -> Tensor:
    """Read labels that `save_labels` wrote, as bool [N] on the CPU, True = masked Gaussian.

    Raises:
        BadInput: the file is unreadable or holds another kind of array.
    """
    import torch

    array = load_array(path)
    if array.dtype != np.bool_ or array.ndim != 1:
        raise BadInput(f"{path}: labels must be bool [N], got {array.dtype} {list(array.shape)}")
    return torch.from_numpy(array)


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays as a compressed `.npz`, and create the folder. Equal arrays give byte-identical files."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as file:
        # The cast is for mypy: by numpy's types, an array in ** could be passed as the parameter allow_pickle.
        np.savez_compressed(file, **cast(Mapping[str, Any], arrays))


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays that `save_arrays` wrote, as a dict name -> array. Raises BadInput if the file is unreadable."""
    with reading(path, "a readable archive of arrays"), np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}
