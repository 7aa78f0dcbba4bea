"""Files of Gaussians that the stage `poses` reads: .spz of version 2."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
from plyfile import PlyData
from scenes.capture import make_truth, write_capture
from scenes.capture_checks import run_with_messages


def sigmoid(values):
    return 1 / (1 + np.exp(-np.asarray(values, np.float64)))


def gaussian_table(count: int):
    """Return a structured array of random Gaussians around the origin, with the properties of a 3DGS file."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    table, generator = np.zeros(count, [(name, "f4") for name in names]), np.random.default_rng(11)
    for name in names:
        low, high = {"o": (-2, 3), "s": (-5, -2)}.get(name[0], (-0.9, 0.9))
        if not name.startswith("n"):
            table[name] = generator.uniform(low, high, count)
    return table


def write_transforms_capture(folder: Path) -> Path:
    return write_capture(folder, "transforms", make_truth())


def load_written_gaussians(folder: Path, name: str, **params) -> tuple[dict[str, np.ndarray], list[str]]:
    """Run the stage `poses` on a file of Gaussians; return the columns in the scene's own frame, and messages."""
    scene, out, sentences = run_with_messages(folder, gaussians=name, **params)
    data = PlyData.read(str(out / "gaussians.ply"), mmap=False)["vertex"].data
    columns = {each: np.array(data[each], np.float64) for each in data.dtype.names}
    places = scene.similarity.invert(np.stack([columns[axis] for axis in "xyz"], 1))
    columns |= dict(zip("xyz", places.T, strict=True))
    columns |= {f"scale_{k}": columns[f"scale_{k}"] - np.log(scene.similarity.scale) for k in range(3)}
    return columns, sentences


def assert_columns_equal(columns: dict[str, np.ndarray], table: np.ndarray, names, atol: float = 1e-4) -> None:
    for name in names:
        np.testing.assert_allclose(columns[name], table[name], atol=atol, err_msg=name)


def covariances(columns) -> np.ndarray:
    """Return the covariances [N, 3, 3], which do not depend on the sign of quaternions and the order of axes."""
    w, x, y, z = (np.asarray(columns[f"rot_{k}"], np.float64) for k in range(4))
    length = np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]]
    rows += [[2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]]
    rows += [[2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
    turn = np.moveaxis(np.array(rows), 2, 0)
    squares = np.exp(2 * np.stack([np.asarray(columns[f"scale_{k}"], np.float64) for k in range(3)], 1))
    return np.einsum("nij,nj,nkj->nik", turn, squares, turn)


def spz_bytes(table: np.ndarray, turns: np.ndarray) -> bytes:
    """Return a .spz file of version 2 and spherical-harmonics degree 0, which stores positions with negated y and z.

    Args:
        turns: unit quaternions wxyz, [N, 4].
    """
    count = len(table)
    places = np.stack([table["x"], -table["y"], -table["z"]], 1).astype(np.float64)
    fixed = np.round(places * 4096).astype("<i4")
    stream = struct.pack("<IIIBBBB", 0x5053474E, 2, count, 0, 12, 0, 0)
    stream += fixed.reshape(-1, 1).view(np.uint8).reshape(-1, 4)[:, :3].tobytes()
    stream += np.round(255 * sigmoid(table["opacity"])).astype(np.uint8).tobytes()
    base = np.stack([table[f"f_dc_{k}"] for k in range(3)], 1).astype(np.float64)
    stream += np.clip(np.round(base * 0.15 * 255 + 127.5), 0, 255).astype(np.uint8).tobytes()
    scales = np.stack([table[f"scale_{k}"] for k in range(3)], 1).astype(np.float64)
    stream += np.round((scales + 10) * 16).astype(np.uint8).tobytes()
    for w, x, y, z in turns:
        values = np.round(np.array([x, y, z]) * np.sign(w) * 127.5 + 127.5)
        stream += np.clip(values, 0, 255).astype(np.uint8).tobytes()
    return gzip.compress(stream)


def test_spz_file(tmp_path):
    """The axes of a .spz file are right, up, back. A reader may keep these axes or convert them to a PLY file's axes.

    In both cases, positions and rotations must be in the same axes.
    """
    folder, table = write_transforms_capture(tmp_path / "s"), gaussian_table(32)
    turns = np.random.default_rng(6).normal(size=(32, 4))
    turns[:, 0] += np.sign(turns[:, 0])  # version 2 does not store w, and is inexact where w is near 0
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    (folder / "scan.spz").write_bytes(spz_bytes(table, turns))
    columns, _ = load_written_gaussians(folder, "scan.spz")
    assert_columns_equal(columns, table, ["x"], 2e-3)
    side = float(np.sign(columns["y"] @ table["y"]))
    for axis in "yz":
        np.testing.assert_allclose(columns[axis], side * table[axis], atol=2e-3)
    assert_columns_equal(columns, table, ["f_dc_0", "f_dc_1", "f_dc_2"], 0.02)
    assert_columns_equal(columns, table, ["scale_0", "scale_1", "scale_2"], 0.04)
    np.testing.assert_allclose(sigmoid(columns["opacity"]), sigmoid(table["opacity"]), atol=0.01)
    signs = (1, 1, side * -1, side * -1)
    expected = {f"scale_{k}": columns[f"scale_{k}"] for k in range(3)}
    expected |= {f"rot_{k}": turns[:, k] * signs[k] for k in range(4)}
    found, right = covariances(columns), covariances(expected)
    assert np.abs(found - right).max() < 0.05 * np.abs(right).max()
