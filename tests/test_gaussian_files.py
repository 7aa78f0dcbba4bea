"""Files of Gaussians from editors and other trainers: precisions, byte orders, 3D filters, .splat and .spz."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData
from scenes.capture import make_truth, write_capture
from scenes.capture_checks import assert_message, run_with_messages
from scenes.splat_tables import write_rows

SH0 = 0.28209479177387814


def logit(values):
    values = np.asarray(values, np.float64)
    return np.log(values) - np.log1p(-values)


def sigmoid(values):
    return 1 / (1 + np.exp(-np.asarray(values, np.float64)))


def gaussian_table(count: int, rest: int = 0, scales: int = 3, more: tuple[str, ...] = (), kind: str = "f4"):
    """Return a structured array of random Gaussians around the origin, with the properties of a 3DGS file.

    Args:
        rest: Number of properties f_rest_*.
        scales: Number of properties scale_*.
        more: Names of further properties, all 0.
        kind: NumPy type of all properties.
    """
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{k}" for k in range(rest))]
    names += ["opacity", *(f"scale_{k}" for k in range(scales)), "rot_0", "rot_1", "rot_2", "rot_3", *more]
    table, generator = np.zeros(count, [(name, kind) for name in names]), np.random.default_rng(11)
    for name in names:
        low, high = {"o": (-2, 3), "s": (-5, -2)}.get(name[0], (-0.9, 0.9))
        if not name.startswith("n") and name not in more:
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


PLACE_AND_COLOR = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2")
SHAPE = ("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")

# ---------------------------------------------------------------------------------------------- edited files


def test_not_finite_and_zero_rows_of_big_endian_doubles(tmp_path):
    folder, table = write_transforms_capture(tmp_path / "s"), gaussian_table(60, rest=9, kind="f8")
    table["rot_2"][3] = table["f_rest_4"][41] = np.nan
    for row in (10, 11, 55):
        table[row] = 0
    table["opacity"][[0, 20]], table["opacity"][21] = np.inf, -np.inf
    table["scale_1"][22] = -np.inf
    for name in ("scale_0", "scale_1", "scale_2"):
        table[name][59] = -np.inf
    write_rows(folder / "edited.ply", table, byte_order=">")
    columns, sentences = load_written_gaussians(folder, "edited.ply")
    kept = np.delete(np.arange(60), [3, 10, 11, 41, 55])
    assert len(columns["x"]) == 55
    assert_columns_equal(columns, table[kept], [*PLACE_AND_COLOR, "f_rest_0", "f_rest_8", "rot_0", "rot_3"])
    assert all(np.isfinite(values).all() for values in columns.values())
    opacity, clamped = sigmoid(columns["opacity"]), np.isinf(table["opacity"][kept])
    assert (opacity[np.isposinf(table["opacity"][kept])] > 0.99).all()
    assert (opacity[np.isneginf(table["opacity"][kept])] < 0.01).all()
    np.testing.assert_allclose(columns["opacity"][~clamped], table["opacity"][kept][~clamped], atol=1e-4)
    for name in ("scale_0", "scale_1", "scale_2"):
        flat = np.isneginf(table[name][kept])
        assert flat.any() and (columns[name][flat] < -7).all()
        np.testing.assert_allclose(columns[name][~flat], table[name][kept][~flat], atol=1e-4)
    try:
        assert_message(sentences, "5")
    except AssertionError:
        assert_message(sentences, "2", "3")


def test_deleted_splats_are_those_of_the_rows_that_stay(tmp_path):
    """An editor deleted 30 rows. Both files have 3 invalid rows before these 30; deleted.npy omits invalid rows."""
    folder, before = write_transforms_capture(tmp_path / "s"), gaussian_table(400)
    before["z"][5] = np.nan
    before[[17, 18]] = 0
    before["opacity"][100:140] = np.inf
    gone = np.arange(200, 230)
    for axis in "xyz":
        before[axis][gone] *= 0.01  # together, as the splats of an object
    write_rows(folder / "before.ply", before)
    write_rows(folder / "after.ply", np.delete(before, gone))
    columns, _ = load_written_gaussians(folder, "before.ply", cleaned="after.ply")
    deleted = np.load(tmp_path / "s_out" / "deleted.npy")
    kept = np.delete(np.arange(400), [5, 17, 18])
    assert len(deleted) == len(columns["x"]) == 397
    assert deleted.dtype == np.bool_ and kept[deleted].tolist() == gone.tolist()


def test_text_file_with_words_for_what_is_not_finite(tmp_path):
    folder, table = write_transforms_capture(tmp_path / "s"), gaussian_table(20)
    table["opacity"][4], table["scale_2"][6], table["f_dc_1"][8] = np.inf, -np.inf, np.nan
    write_rows(folder / "splats/scan.ply", table, text=True)
    columns, sentences = load_written_gaussians(folder, "splats/scan.ply")
    assert_columns_equal(columns, np.delete(table, 8), [*PLACE_AND_COLOR, "scale_0", "rot_1"])
    assert sigmoid(columns["opacity"][4]) > 0.99 and np.isfinite(columns["scale_2"]).all()
    assert_message(sentences, "1", "scan.ply")


# ---------------------------------------------------------------------------------------------- other trainers


def assert_filter_folded(columns: dict[str, np.ndarray], table: np.ndarray, atol: float) -> None:
    filters = np.asarray(table["filter_3D"], np.float64)
    squares = np.exp(2 * np.stack([np.asarray(table[f"scale_{k}"], np.float64) for k in range(3)], 1))
    wider = squares + filters[:, None] ** 2
    opacity = sigmoid(table["opacity"]) * np.sqrt(squares.prod(1) / wider.prod(1))
    for k in range(3):
        np.testing.assert_allclose(columns[f"scale_{k}"], 0.5 * np.log(wider[:, k]), atol=1e-4)
    np.testing.assert_allclose(sigmoid(columns["opacity"]), opacity, atol=atol)
    assert_columns_equal(columns, table, [*PLACE_AND_COLOR, "rot_0", "rot_1", "rot_2", "rot_3"])
    assert "filter_3D" not in columns


def test_filter_of_some_splats_in_doubles(tmp_path):
    folder, table = (
        write_transforms_capture(tmp_path / "s"),
        gaussian_table(30, rest=45, more=("filter_3D",), kind="f8"),
    )
    table["filter_3D"] = np.linspace(0, 0.4, 30)
    write_rows(folder / "mip.ply", table)
    columns, _ = load_written_gaussians(folder, "mip.ply")
    assert_filter_folded(columns, table, 1e-5)
    assert_columns_equal(columns, table, ["f_rest_0", "f_rest_44"])


def test_filter_of_opaque_splats(tmp_path):
    """An infinite opacity logit becomes the finite one that the 3D filter gives."""
    folder, table = write_transforms_capture(tmp_path / "s"), gaussian_table(24, more=("filter_3D",))
    table["filter_3D"], table["opacity"][::3] = 0.05, np.inf
    write_rows(folder / "mip.ply", table, text=True)
    columns, _ = load_written_gaussians(folder, "mip.ply")
    assert_filter_folded(columns, table, 5e-3)  # infinite logits may be clamped before the filter is applied


@pytest.mark.parametrize("rest", [0, 24])
def test_two_scales_are_flat_along_the_third_axis(tmp_path, rest):
    folder, table = write_transforms_capture(tmp_path / "s"), gaussian_table(25, rest=rest, scales=2)
    write_rows(folder / "surfels.ply", table)
    columns, _ = load_written_gaussians(folder, "surfels.ply")
    assert_columns_equal(columns, table, [*PLACE_AND_COLOR, "opacity", "scale_0", "scale_1", "rot_0", "rot_2"])
    assert np.isfinite(columns["scale_2"]).all()
    assert (columns["scale_2"] < np.minimum(table["scale_0"], table["scale_1"]) - 2).all()


@pytest.mark.parametrize("text", [False, True])
def test_fourth_degree_is_cut_channel_by_channel(tmp_path, text):
    folder, table = write_transforms_capture(tmp_path / "s"), gaussian_table(12, rest=72)
    write_rows(folder / "four.ply", table, text, ">")
    columns, sentences = load_written_gaussians(folder, "four.ply")
    assert sum(name.startswith("f_rest_") for name in columns) == 45
    for channel in range(3):
        for k in range(15):
            ours, theirs = columns[f"f_rest_{15 * channel + k}"], table[f"f_rest_{24 * channel + k}"]
            np.testing.assert_allclose(ours, theirs, atol=1e-5)
    assert_columns_equal(columns, table, [*PLACE_AND_COLOR, "opacity", *SHAPE])
    assert_message(sentences, "degree", "3")


def test_splat_file(tmp_path):
    """A .splat file has 32 bytes a Gaussian: position and sizes as floats; color, opacity and rotation as bytes."""
    folder, table = write_transforms_capture(tmp_path / "s"), gaussian_table(16)
    colors = np.random.default_rng(2).integers(0, 256, (16, 4)).astype(np.uint8)
    colors[:2, 3] = 255, 1
    turns = np.random.default_rng(4).normal(size=(16, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    bytes_ = np.clip(np.round(turns * 128 + 128), 0, 255).astype(np.uint8)
    with open(folder / "scan.splat", "wb") as file:
        for row, color, turn in zip(table, colors, bytes_, strict=True):
            file.write(struct.pack("<3f", row["x"], row["y"], row["z"]))
            file.write(struct.pack("<3f", *(np.exp(row[f"scale_{k}"]) for k in range(3))))
            file.write(color.tobytes() + turn.tobytes())
    columns, _ = load_written_gaussians(folder, "scan.splat")
    assert_columns_equal(columns, table, ["x", "y", "z", "scale_0", "scale_1", "scale_2"])
    for k in range(3):
        np.testing.assert_allclose(columns[f"f_dc_{k}"], (colors[:, k] / 255 - 0.5) / SH0, atol=1e-3)
    np.testing.assert_allclose(sigmoid(columns["opacity"]), colors[:, 3] / 255, atol=0.01)
    expected = {f"scale_{k}": table[f"scale_{k}"] for k in range(3)}
    expected |= {f"rot_{k}": bytes_[:, k] / 128.0 - 1 for k in range(4)}
    np.testing.assert_allclose(covariances(columns), covariances(expected), rtol=1e-3, atol=1e-6)


def spz_bytes(table: np.ndarray, turns: np.ndarray, version: int) -> bytes:
    """Return a .spz file of spherical-harmonics degree 0. The format stores positions with negated y and z.

    Args:
        turns: Unit quaternions wxyz, [N, 4].
        version: 2 or 3, version of the format; the versions store quaternions differently.
    """
    count = len(table)
    places = np.stack([table["x"], -table["y"], -table["z"]], 1).astype(np.float64)
    fixed = np.round(places * 4096).astype("<i4")
    stream = struct.pack("<IIIBBBB", 0x5053474E, version, count, 0, 12, 0, 0)
    stream += fixed.reshape(-1, 1).view(np.uint8).reshape(-1, 4)[:, :3].tobytes()
    stream += np.round(255 * sigmoid(table["opacity"])).astype(np.uint8).tobytes()
    base = np.stack([table[f"f_dc_{k}"] for k in range(3)], 1).astype(np.float64)
    stream += np.clip(np.round(base * 0.15 * 255 + 127.5), 0, 255).astype(np.uint8).tobytes()
    scales = np.stack([table[f"scale_{k}"] for k in range(3)], 1).astype(np.float64)
    stream += np.round((scales + 10) * 16).astype(np.uint8).tobytes()
    for w, x, y, z in turns:
        if version == 2:
            values = np.round(np.array([x, y, z]) * np.sign(w) * 127.5 + 127.5)
            stream += np.clip(values, 0, 255).astype(np.uint8).tobytes()
            continue
        four = np.array([x, y, z, w])
        largest = int(np.abs(four).argmax())
        four, packed = four * np.sign(four[largest]), largest
        for value in np.delete(four, largest):
            packed = packed << 10 | int(value < 0) << 9 | int(511 * abs(value) * 2**0.5 + 0.5)
        stream += struct.pack("<I", packed)
    return gzip.compress(stream)


@pytest.mark.parametrize("version", [2, 3])
def test_spz_file(tmp_path, version):
    """The axes of a .spz file are right, up, back. A reader may keep these axes or convert them to a PLY file's axes.

    In both cases, positions and rotations must be in the same axes.
    """
    folder, table = write_transforms_capture(tmp_path / "s"), gaussian_table(32)
    turns = np.random.default_rng(6).normal(size=(32, 4))
    turns[:, 0] += np.sign(turns[:, 0])  # version 2 does not store w, and is inexact where w is near 0
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    (folder / "scan.spz").write_bytes(spz_bytes(table, turns, version))
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
