"""Splat files of editors and other trainers are read with the correct values, or refused with a message of one line."""

from __future__ import annotations

import json
import re
import shutil
import struct
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from scenes.cameras import make_camera
from scenes.capture import make_truth, write_capture
from scenes.edited_capture import write_edited_capture
from scenes.images import render_color
from scenes.random_scene import random_gaussians
from scenes.splat_tables import read_rows, replace_columns, write_rows

from reffusion.io.arrays import load_labels
from reffusion.io.compressed import load_spz, save_spz
from reffusion.io.files import BadInput
from reffusion.io.ply import load_ply, load_points, save_ply, save_splats
from reffusion.io.ply_table import load_header
from reffusion.io.splat_format import save_splat
from reffusion.io.splat_transform import PACKAGE, save_for_web
from reffusion.io.splats import load_splats, summarize_splats
from reffusion.types import Gaussians, Similarity
from stages import poses
from stages.plan import poses as planned

SH0 = 0.28209479177387814
COUNT = 40
HERE = Similarity(1.0, np.zeros(3))
VIEW = make_camera("v", (48, 36), 40.0, (0.0, 0.0, -6.0))


@pytest.fixture
def splat_file(tmp_path):
    """The path of a .ply file of 40 splats of degree 2, and its rows."""
    save_ply(tmp_path / "g.ply", random_gaussians(COUNT, 2))
    return tmp_path / "g.ply", read_rows(tmp_path / "g.ply")


# ---------------------------------------------------------------------------------------------- rows


def test_infinite_opacities_and_flat_scales_look_as_their_limits(splat_file):
    path, table = splat_file
    table["opacity"][3], table["opacity"][4], table["scale_2"][5], table["scale_0"][6] = np.inf, -np.inf, -np.inf, -1e30
    write_rows(path, table)
    found = load_splats(path)
    assert found.notes == ("2 infinite opacities and 1 scales of minus infinity are clamped to finite values that look "
                           "the same",)  # fmt: skip
    made = found.gaussians()
    assert len(made) == COUNT and made.opacity_logits[3:5].tolist() == [20, -20]
    assert made.log_scales[5, 2] == made.log_scales[6, 0] == -20
    opaque, flat = made.opacity_logits.clone(), made.log_scales.clone()
    opaque[3], flat[5, 2], flat[6, 0] = 80.0, -60.0, -60.0
    limit = Gaussians(made.means, made.quaternions, flat, opaque, made.sh)
    kept = limit.map(lambda p: p[torch.arange(COUNT) != 4])  # a transparent splat renders like no splat
    np.testing.assert_allclose(render_color(made, VIEW), render_color(kept, VIEW), atol=1e-6)


@pytest.mark.parametrize(
    ("column", "value"),
    [(name, value) for name in ("x", "rot_2", "f_dc_1", "f_rest_20") for value in (np.nan, np.inf, -np.inf)]
    + [("opacity", np.nan), ("scale_1", np.nan), ("scale_1", np.inf), ("scale_1", 1e30)],
)
@pytest.mark.parametrize("form", ["binary", "text", "big-endian doubles"])
def test_rows_that_hold_no_number_are_dropped_with_their_number(splat_file, column, value, form):
    path, table = splat_file
    table[column][[2, 30]] = value
    if form == "big-endian doubles":
        table = table.astype([(name, "f8") for name in table.dtype.names])
    write_rows(path, table, form == "text", ">" if form == "big-endian doubles" else "<")
    found = load_splats(path)
    assert found.notes == ("2 of 40 splats are dropped: 2 with NaN or infinite values",)
    kept = np.delete(np.arange(COUNT), [2, 30])
    np.testing.assert_allclose(found.rows.means[:, 1], table["y"][kept], rtol=1e-6)
    np.testing.assert_allclose(found.rows.sh[:, 3, 1], table["f_rest_10"][kept], rtol=1e-6)


def test_padding_is_dropped_and_a_zero_quaternion_is_the_identity(splat_file):
    path, table = splat_file
    for name in table.dtype.names:
        table[name][7] = 0
    table["x"][8] = np.nan
    for axis in range(4):
        table[f"rot_{axis}"][9] = 0
    write_rows(path, table)
    found = load_splats(path)
    assert found.notes == ("2 of 40 splats are dropped: 1 with NaN or infinite values and 1 of zeros only (padding)",)
    made = found.gaussians()
    assert not made.quaternions[7].any()
    turned = made.quaternions.clone()
    turned[7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(render_color(made, VIEW), render_color(replace(made, quaternions=turned), VIEW))


def test_a_file_of_mostly_invalid_rows_is_refused(splat_file):
    path, table = splat_file
    table["scale_0"][:21] = np.nan
    write_rows(path, table)
    with pytest.raises(BadInput, match=r"g\.ply: 21 of 40 splats hold NaN or infinite values: the file is damaged"):
        load_ply(path)
    table["scale_0"][0] = 0.5
    write_rows(path, table)
    assert len(load_ply(path)) == 20
    for name in table.dtype.names:
        table[name] = 0
    write_rows(path, table)
    with pytest.raises(BadInput, match=r"it holds no Gaussians: 40 of 40 splats are dropped: 40 of zeros only"):
        load_ply(path)


# ---------------------------------------------------------------------------------------------- other trainers


def test_the_filter_of_mip_splatting_is_folded_in(splat_file):
    path, table = splat_file
    table["opacity"][3] = np.inf
    sizes = np.random.default_rng(0).uniform(0.01, 2.0, COUNT).astype(np.float32)
    write_rows(path, replace_columns(table, {"filter_3D": sizes}))
    found = load_splats(path)
    assert found.notes == ("the 3D filter of Mip-Splatting is folded into scales and opacities",) and found.antialiased
    scales = np.exp(np.stack([table[f"scale_{k}"] for k in range(3)], 1).astype(np.float64))
    widened = np.sqrt(scales**2 + sizes[:, None].astype(np.float64) ** 2)
    opacity = 1 / (1 + np.exp(-table["opacity"].astype(np.float64)))
    opacity *= np.sqrt(np.prod(scales**2, 1) / np.prod(widened**2, 1))
    np.testing.assert_allclose(np.exp(found.rows.log_scales), widened, rtol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-found.rows.opacity_logits.astype(np.float64))), opacity, rtol=2e-6)
    write_rows(path, replace_columns(table, {"filter_3D": np.zeros(COUNT, np.float32)}))
    plain, table["opacity"][3] = load_splats(path).rows, 20
    np.testing.assert_allclose(plain.log_scales[:, 0], table["scale_0"], rtol=1e-6)
    np.testing.assert_allclose(plain.opacity_logits, table["opacity"], rtol=1e-5, atol=1e-6)


def test_two_scales_are_a_flat_splat(splat_file):
    path, table = splat_file
    write_rows(path, replace_columns(table, {}, leave_out=("scale_2",)))
    found = load_splats(path)
    assert found.notes == ("it has two scales, as 2DGS writes: the third axis is flat",)
    made = found.gaussians()
    assert (made.log_scales[:, 2] == -20).all()
    np.testing.assert_array_equal(made.log_scales[:, 1], table["scale_1"])
    thin = made.log_scales.clone()
    thin[:, 2] = made.log_scales[:, :2].min(1).values - 9
    np.testing.assert_allclose(render_color(made, VIEW), render_color(replace(made, log_scales=thin), VIEW), atol=1e-4)


@pytest.mark.parametrize("degree", [4, 5])
def test_higher_harmonics_are_cut_to_degree_3(splat_file, degree):
    path, table = splat_file
    higher = (degree + 1) ** 2 - 1
    draws = np.random.default_rng(0).normal(size=(3 * higher, COUNT)).astype(np.float32)
    rest = {f"f_rest_{k}": draws[k] for k in range(3 * higher)}
    write_rows(path, replace_columns(table, rest))
    found = load_splats(path)
    assert found.notes == (f"spherical harmonics of degree {degree} are cut to degree 3",)
    expected = draws.reshape(3, higher, COUNT)[:, :15].transpose(2, 1, 0)
    np.testing.assert_array_equal(found.rows.sh[:, 1:], expected)
    write_rows(path, replace_columns(table, {"f_rest_70": draws[70]}))
    with pytest.raises(BadInput, match="25 f_rest properties; 0, 9, 24, 45 or 72 belong to degrees 0 to 4"):
        summarize_splats(path)


def test_colors_in_bytes_stand_for_the_constant_harmonic(splat_file):
    path, table = splat_file
    colors = np.random.default_rng(0).integers(0, 256, (3, COUNT)).astype(np.uint8)
    without = tuple(n for n in table.dtype.names if n.startswith("f_"))
    write_rows(path, replace_columns(table, dict(zip(("red", "green", "blue"), colors, strict=True)), without))
    made = load_ply(path)
    assert made.sh.shape == (COUNT, 1, 3)
    np.testing.assert_allclose(0.5 + SH0 * made.sh[:, 0], colors.T / 255, atol=1e-6)
    write_rows(path, replace_columns(table, {}, ("f_dc_1",)))
    with pytest.raises(BadInput, match="not a file of Gaussians, it lacks f_dc_1"):
        summarize_splats(path)


# ---------------------------------------------------------------------------------------------- comments


def add_comments(path, *comments):
    """Insert comments, each bytes, into the header of a .ply."""
    first, rest = path.read_bytes().split(b"element", 1)
    path.write_bytes(first + b"".join(b"comment " + each + b"\n" for each in comments) + b"element" + rest)


@pytest.mark.parametrize(("comments", "antialiased"), [
    ((), False),
    ((b"SplatRenderMode: mip",), True),
    ((b"Exported from Brush", b"splatrendermode:  MIP ", b"SH degree: 3"), True),
    ((b"SplatRenderMode: default",), False),
    ((b"SplatRenderMode: 2dgs",), False),
    ((b"antialiased 1",), True),
    ((b"antialiased 0",), False),
    ((b"antialiased",), True),
    ((b"antialiased edges are blurred",), False),
    ((b"antialiased 1", b"SplatRenderMode: default"), False),
    ((b"SplatRenderMode: default", b"antialiased 1"), True),
])  # fmt: skip
@pytest.mark.parametrize("ending", [".ply", ".compressed.ply"])
def test_the_last_comment_says_whether_splats_are_antialiased(tmp_path, ending, comments, antialiased):
    path = tmp_path / f"g{ending}"
    if ending == ".compressed.ply":
        pytest.importorskip("gsply")
    save_splats(path, random_gaussians(3, 1), HERE)
    add_comments(path, *comments)
    assert summarize_splats(path).antialiased == load_ply(path).antialiased == antialiased


def test_splats_of_two_scales_are_not_antialiased(splat_file):
    path, table = splat_file
    write_rows(path, replace_columns(table, {}, leave_out=("scale_2",)))
    add_comments(path, b"SplatRenderMode: mip")
    assert not load_ply(path).antialiased


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("ending", [".ply", ".compressed.ply", ".spz", ".splat", ".glb"])
def test_every_format_but_splat_says_whether_splats_are_antialiased(tmp_path, ending, antialiased):
    gsply, path = pytest.importorskip("gsply"), tmp_path / f"g{ending}"
    save_splats(path, replace(random_gaussians(300, 1), antialiased=antialiased), HERE)
    assert load_ply(path).antialiased == (antialiased and ending != ".splat")
    if ending.endswith(".ply"):
        assert (b"\ncomment SplatRenderMode: mip\n" in path.read_bytes()) == antialiased
    if ending not in (".splat", ".glb"):
        read = gsply.read_spz if ending == ".spz" else gsply.plyread
        assert len(read(str(path))) == 300, "other readers read it, too"


@pytest.mark.parametrize("comment", ["von Jörg 東京".encode(), "von Jörg".encode("latin-1")])
@pytest.mark.parametrize("text", [False, True])
def test_comments_beyond_ascii_are_read(splat_file, comment, text):
    path, table = splat_file
    write_rows(path, table, text)
    add_comments(path, comment, b"antialiased 1")
    made = load_ply(path)
    np.testing.assert_allclose(made.means[:, 1], table["y"], rtol=1e-6)
    np.testing.assert_allclose(load_points(path)[0][:, 2], table["z"], rtol=1e-6)
    assert made.antialiased and load_header(path).comments[0].startswith("von Jörg")


# ---------------------------------------------------------------------------------------------- quantised files


def test_records_of_32_bytes_are_read(tmp_path):
    record = lambda *values: struct.pack("<3f3f4B4B", *values)
    path = tmp_path / "s.splat"
    path.write_bytes(
        record(1.5, -2, 3, 0.1, 0.2, 0.0, 255, 0, 51, 255, 255, 128, 64, 0)
        + record(0, 0, 0, 1, 1, 1, 128, 128, 128, 51, 128, 128, 128, 255)
        + bytes(32)
    )
    assert summarize_splats(path).count == 3
    found = load_splats(path)
    assert found.notes == ("1 of 3 splats are dropped: 1 of zeros only (padding); 1 infinite opacities and 1 scales of "
                           "minus infinity are clamped to finite values that look the same",)  # fmt: skip
    made = found.gaussians()
    np.testing.assert_array_equal(made.means, [[1.5, -2, 3], [0, 0, 0]])
    np.testing.assert_allclose(made.log_scales[0], [np.log(0.1), np.log(0.2), -20], rtol=1e-6)
    np.testing.assert_allclose(made.opacity_logits, [20, np.log(0.2 / 0.8)], rtol=1e-6)
    np.testing.assert_allclose(made.quaternions[0], [127 / 128, 0, -0.5, -1])
    np.testing.assert_allclose(0.5 + SH0 * made.sh[0, 0], [1, 0, 0.2], atol=1e-6)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(BadInput, match=r"s\.splat: cut off, or no \.splat file: 91 bytes are no multiple of 32"):
        summarize_splats(path)


@pytest.mark.parametrize("version", [3, 4])
def test_spz_is_read_in_the_frame_of_a_ply(tmp_path, version):
    """The format's y axis points up: its writer turns .ply splats, with their harmonics, by 180 degrees about x."""
    gsply, made, path = pytest.importorskip("gsply"), random_gaussians(300, 3), tmp_path / "s.spz"
    made = replace(made, sh=0.3 * made.sh.clamp(-3, 3))  # the format stores values in [-1, 1]
    save_spz(path, load_rows(tmp_path, made))
    raw = gsply.read_spz(str(path))
    np.testing.assert_allclose(raw.means, made.means.numpy() * (1, -1, -1), atol=1e-5)
    if version == 4:
        gsply.write_spz(str(path), raw, version=4)
    assert summarize_splats(path).count == 300
    again = load_ply(path)
    np.testing.assert_allclose(again.means, made.means, atol=3e-4)
    np.testing.assert_allclose(again.log_scales, made.log_scales, atol=1 / 32 + 1e-4)
    assert np.abs(render_color(again, VIEW) - render_color(made, VIEW)).mean() < 0.01
    blind = replace(again, sh=torch.cat([again.sh[:, :1], -again.sh[:, 1:]], 1))
    assert np.abs(render_color(blind, VIEW) - render_color(made, VIEW)).mean() > 0.03
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(BadInput, match=r"s\.spz: not a \.spz file"):
        load_spz(path)
    path.write_bytes(b"NGSP")
    with pytest.raises(BadInput, match=r"s\.spz: not a \.spz file"):
        summarize_splats(path)


def load_rows(folder, gaussians):
    save_ply(folder / "rows.ply", gaussians)
    return load_splats(folder / "rows.ply").rows


def test_splat_is_written_as_it_is_read(tmp_path):
    made = random_gaussians(300, 1)
    save_splat(tmp_path / "s.splat", load_rows(tmp_path, made))
    again = load_ply(tmp_path / "s.splat")
    np.testing.assert_array_equal(again.means, made.means)
    np.testing.assert_allclose(again.log_scales, made.log_scales, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(again.opacity_logits.sigmoid(), made.opacity_logits.sigmoid(), atol=0.5 / 255 + 1e-6)
    unit = torch.nn.functional.normalize(made.quaternions)
    assert (torch.nn.functional.normalize(again.quaternions) * unit).sum(1).abs().min() > 0.999


@pytest.mark.parametrize(("ending", "remedy"), [
    ("usdz", "save the scene as .ply in the program that wrote it"),
    ("gltf", "save the scene as .glb or .ply in the program that wrote it"),
    ("zip", "unpack it, and name a file of splats in it"),
    ("pt", "it is a checkpoint of gsplat; gsplat.export_splats writes a .ply of its `splats`"),
    ("ckpt", "it is a checkpoint of nerfstudio; `ns-export gaussian-splat --load-config config.yml --output-dir .` "
     "writes a .ply"),
])  # fmt: skip
def test_other_formats_are_refused_with_what_converts_them(tmp_path, ending, remedy):
    path = tmp_path / f"scene.{ending}"
    path.write_bytes(bytes(4096))
    with pytest.raises(BadInput, match=f"^{re.escape(f'{path}: .{ending} is not read; {remedy}')}$"):
        summarize_splats(path)


def test_a_ply_of_reduced_3dgs_is_named(splat_file):
    path, table = splat_file
    elements = [PlyElement.describe(table[:5], name) for name in ("vertex_0", "vertex_1", "codebook_centers")]
    PlyData(elements).write(str(path))
    with pytest.raises(BadInput, match=r"g\.ply: a \.ply of reduced-3dgs \(vertex_0, vertex_1, codebook_centers\) is "
                       r"not read; load it with GaussianModel\.load_ply of that project"):  # fmt: skip
        load_points(path)


# ---------------------------------------------------------------------------------------------- the stage `poses`


def test_rows_dropped_leave_what_was_deleted_consistent(tmp_path, recwarn):
    """scene.ply has invalid rows, cleaned.ply has padding. The mask of deleted splats has one value a valid splat."""
    folder = tmp_path / "s"
    whole, deleted = write_edited_capture(folder)
    table = read_rows(folder / "scene.ply")
    table["opacity"][[1, 2000]] = np.nan
    table["x"][3999] = np.inf
    table["opacity"][:1] = np.inf
    write_rows(folder / "scene.ply", table)
    rest = read_rows(folder / "cleaned.ply")
    padding = np.zeros(1500, rest.dtype)  # more rows than were deleted
    write_rows(folder / "cleaned.ply", np.concatenate([rest, padding]))
    (out := tmp_path / "out").mkdir()
    params = poses.Params(gaussians="scene.ply", cleaned="cleaned.ply", masks="none")
    planned.preview(params, folder)
    poses.run(params, out, scene=folder)
    kept = np.delete(np.arange(len(whole)), [1, 2000, 3999])
    np.testing.assert_array_equal(load_labels(out / "deleted.npy").numpy(), deleted[kept])
    assert len(load_ply(out / "gaussians.ply")) == 3997
    lines = json.loads((out / "warnings.json").read_text())
    assert lines[0] == ("scene.ply: 3 of 4000 splats are dropped: 3 with NaN or infinite values; 1 infinite opacities "
                        "are clamped to finite values that look the same")  # fmt: skip
    rows = len(rest) + 1500
    assert lines[1] == f"cleaned.ply: 1500 of {rows} splats are dropped: 1500 of zeros only (padding)"


@pytest.mark.parametrize("ending", ["splat", "spz"])
def test_what_was_deleted_is_found_in_quantised_files(tmp_path, ending, capsys):
    if ending == "spz":
        pytest.importorskip("gsply")
    folder = tmp_path / "s"
    _, deleted = write_edited_capture(folder)
    rest = load_splats(folder / "cleaned.ply").rows
    (save_splat if ending == "splat" else save_spz)(folder / f"cleaned.{ending}", rest)
    (out := tmp_path / "out").mkdir()
    poses.run(poses.Params(gaussians="scene.ply", cleaned=f"cleaned.{ending}", masks="none"), out, scene=folder)
    assert np.count_nonzero(load_labels(out / "deleted.npy").numpy() != deleted) <= 2
    assert "of 4000 splats were deleted" in capsys.readouterr().out


def test_plan_says_what_reading_changes(tmp_path):
    folder = write_capture(tmp_path / "s", "transforms", make_truth())
    save_ply(folder / "g.ply", random_gaussians(COUNT, 0))
    table = read_rows(folder / "g.ply")
    rest = {f"f_rest_{k}": np.zeros(COUNT, np.float32) for k in range(72)}
    write_rows(folder / "g.ply", replace_columns(table, rest | {"filter_3D": np.ones(COUNT, np.float32)}, ("scale_2",)))
    notes = planned.preview(poses.Params(gaussians="g.ply"), folder)
    for note in ("the 3D filter of Mip-Splatting is folded into scales and opacities",
                 "it has two scales, as 2DGS writes: the third axis is flat",
                 "spherical harmonics of degree 4 are cut to degree 3"):  # fmt: skip
        assert f"g.ply: {note}" in notes


def test_points_of_a_cloud_are_not_touched(tmp_path):
    table = np.zeros(3, [(axis, "f4") for axis in "xyz"])
    write_rows(tmp_path / "p.ply", table)
    assert len(load_points(tmp_path / "p.ply")[0]) == 3


@pytest.mark.slow
def test_splat_transform_and_we_read_the_same(tmp_path):
    if not (npx := shutil.which("npx")):
        pytest.skip("there is no npm")
    convert = lambda source, target: subprocess.run(
        [npx, "--yes", "@playcanvas/splat-transform", "-w", str(tmp_path / source), str(tmp_path / target)],
        check=True, capture_output=True,
    )  # fmt: skip
    made = random_gaussians(300, 3)
    made = replace(made, sh=0.3 * made.sh.clamp(-3, 3))
    save_ply(tmp_path / "made.ply", made)
    rows = load_rows(tmp_path, made)
    save_splat(tmp_path / "ours.splat", rows)
    save_spz(tmp_path / "ours.spz", rows)
    convert("ours.splat", "from_splat.ply")
    convert("ours.spz", "from_spz.ply")
    convert("made.ply", "theirs.spz")
    files = [("from_splat.ply", 1), ("from_spz.ply", 16), ("theirs.spz", 16)]
    if gaussforge := pytest.importorskip("gaussforge"):
        written = gaussforge.GaussForge().convert((tmp_path / "made.ply").read_bytes(), "ply", "ksplat")
        (tmp_path / "theirs.ksplat").write_bytes(written["data"])
        files.append(("theirs.ksplat", 1))
    for name, harmonics in files:
        read = load_ply(tmp_path / name)
        nearest = torch.cdist(made.means, read.means).argmin(1)
        assert sorted(nearest.tolist()) == list(range(300)), name
        np.testing.assert_allclose(read.means[nearest], made.means, atol=3e-4, err_msg=name)
        np.testing.assert_allclose(read.log_scales[nearest], made.log_scales, atol=1 / 32 + 1e-3, err_msg=name)
        unit = torch.nn.functional.normalize(made.quaternions)
        theirs = torch.nn.functional.normalize(read.quaternions[nearest])
        assert (unit * theirs).sum(1).abs().min() > 0.999, name
        np.testing.assert_allclose(read.sh[nearest][:, :harmonics], made.sh[:, :harmonics], atol=0.07, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["theirs.sog", "meta.json"])
def test_sog_is_read_by_splat_transform(tmp_path, name):
    made = random_gaussians(300, 2)
    made = replace(made, sh=torch.cat([made.sh[:, :1], 0.1 * made.sh[:, 1:]], 1).clamp(-1, 1))
    save_ply(tmp_path / "made.ply", made)
    try:
        save_for_web(tmp_path / name, tmp_path / "made.ply", False)
    except BadInput as error:
        pytest.skip(f"no npm, or no network: {error}")
    (note,) = summarize_splats(tmp_path / name).notes
    assert note == f"it is converted to .ply by {PACKAGE}, which npm downloads at its first use (210 MB)"
    read = load_ply(tmp_path / name)
    assert not read.antialiased
    nearest = torch.cdist(made.means, read.means).argmin(1)
    assert sorted(nearest.tolist()) == list(range(300))
    np.testing.assert_allclose(read.means[nearest], made.means, atol=1e-3)
    np.testing.assert_allclose(read.log_scales[nearest], made.log_scales, atol=0.05)
    np.testing.assert_allclose(read.sh[nearest][:, 0], made.sh[:, 0], atol=0.05)
    assert np.abs(render_color(read, VIEW) - render_color(made, VIEW)).mean() < 0.02
    if name == "theirs.sog":
        save_for_web(tmp_path / name, tmp_path / "made.ply", True)
        assert load_ply(tmp_path / name).antialiased
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-300])
        with pytest.raises(BadInput, match=r"theirs\.sog: not a \.sog file"):
            summarize_splats(tmp_path / name)


@pytest.mark.slow
def test_a_damaged_ksplat_is_refused_in_one_line(tmp_path):
    (tmp_path / "s.ksplat").write_bytes(bytes(4096))
    if not shutil.which("npm"):
        pytest.skip("there is no npm")
    with pytest.raises(BadInput, match=r"s\.ksplat: .*splat-transform@\S+ cannot convert it to \.ply: \S+") as error:
        load_splats(tmp_path / "s.ksplat")
    assert "\n" not in str(error.value)


def test_without_node_the_message_says_what_reads_sog(tmp_path, monkeypatch):
    (tmp_path / "s.sog").write_bytes(bytes(64))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BadInput, match=r"s\.sog: .*splat-transform\S+ converts it, which needs Node; install Node 18"):
        summarize_splats(tmp_path / "s.sog")
