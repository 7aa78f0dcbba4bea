"""Compressed .ply, as PlayCanvas's editor writes it: 256 Gaussians a chunk, quantised within its bounds.

The only importer of gsply.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reffusion.io.files import BadInput, reading

if TYPE_CHECKING:
    from reffusion.types import Gaussians, Similarity

PACKED = "packed_position"  # a property that only these files have


def save_compressed(path: Path, gaussians: Gaussians, similarity: Similarity) -> None:
    """Write Gaussians in the scene's own frame; neighbours next to each other, so that chunks are small and steps fine.

    Positions keep 11, 10 and 11 bits of their chunk's extent, colours and opacity 8 bits, spherical harmonics 8.

    Raises:
        BadInput: gsply is not installed.
    """
    gsply = _library(path)
    order = np.argsort(_interleaved(gaussians.means.double().numpy()), kind="stable")
    arrays = {name: getattr(gaussians, name).double().numpy()[order] for name in ("means", "log_scales", "quaternions")}
    plain = lambda array: np.ascontiguousarray(array, np.float32)
    lengths = np.linalg.norm(arrays["quaternions"], axis=1, keepdims=True)
    turned = np.where(lengths > 0, arrays["quaternions"] / np.maximum(lengths, 1e-30), [1.0, 0.0, 0.0, 0.0])
    sh = gaussians.sh.numpy()[order]
    data = gsply.compress_to_bytes(
        plain(similarity.invert(arrays["means"])),
        plain(arrays["log_scales"] - np.log(similarity.scale)),
        plain(turned),
        plain(gaussians.opacity_logits.numpy()[order]),
        plain(sh[:, 0]),
        plain(sh[:, 1:]) if sh.shape[1] > 1 else None,
    )
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_bytes(data)


def load_table(path: Path) -> np.ndarray:
    """[N] with the properties of the standard layout, float32. BadInput where it is broken, or gsply not installed."""
    gsply = _library(path)
    with reading(path, "a compressed .ply"):
        data = gsply.plyread(str(path))
        count, higher = len(data.means), 0 if data.shN is None else data.shN.shape[1]
        columns = {name: data.means[:, k] for k, name in enumerate("xyz")}
        columns |= {f"f_dc_{k}": data.sh0[:, k] for k in range(3)}
        rest = np.zeros((count, 0)) if not higher else data.shN.transpose(0, 2, 1).reshape(count, 3 * higher)
        columns |= {f"f_rest_{k}": rest[:, k] for k in range(rest.shape[1])}
        columns |= {"opacity": data.opacities.reshape(-1)}
        columns |= {f"scale_{k}": data.scales[:, k] for k in range(3)}
        columns |= {f"rot_{k}": data.quats[:, k] for k in range(4)}
    table = np.empty(count, [(name, "f4") for name in columns])
    for name, column in columns.items():
        table[name] = column
    return table


def _library(path: Path):
    try:
        import gsply
    except ImportError:
        raise BadInput(f"{path}: a compressed .ply takes gsply: `pip install gsply`, or save it uncompressed") from None
    return gsply


def _interleaved(points: np.ndarray) -> np.ndarray:
    """uint64 [N], places [N, 3] along a curve on which neighbours are near: the bits of x, y and z in turn."""
    low, extent = points.min(0, initial=np.inf), np.ptp(points, axis=0).max(initial=1e-30)
    cells = ((points - low) / extent * (2**20 - 1)).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(20):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code
