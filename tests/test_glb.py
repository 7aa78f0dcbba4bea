"""Files .glb of splats: other programs read and write the same, and what cannot be read is refused with one line."""

from __future__ import annotations

import json
import re
import struct
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes.random_scene import random_gaussians
from scipy.spatial.transform import Rotation

from reffusion.io.files import BadInput
from reffusion.io.ply import load_ply, save_ply, save_splats
from reffusion.io.splat_transform import PACKAGE
from reffusion.io.splats import load_splats, summarize_splats
from reffusion.splat.rotation import rotate_gaussians
from reffusion.types import Similarity

FRAME = Similarity(0.31, np.array([1.5, -20.0, 4.0]))
HERE = Similarity(1.0, np.zeros(3))
FIELDS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
KHR = "KHR_gaussian_splatting"


def assert_same(found, made, atol=1e-5):
    for name in FIELDS:
        one, two = (getattr(each, name) for each in (found, made))
        if name == "quaternions":
            one, two = (torch.nn.functional.normalize(each) for each in (one, two))
            one = one * (one * two).sum(1, keepdim=True).sign()
        np.testing.assert_allclose(one, two, atol=atol, rtol=1e-5, err_msg=name)


def read_glb(path):
    """Return the JSON and the binary chunk of a .glb."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def write_glb(path, document, content):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(content))
    head += struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(content), b"BIN\0")
    path.write_bytes(head + content)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_glb_is_read_as_it_was_written(tmp_path, degree):
    made, path = random_gaussians(300, degree), tmp_path / "s.glb"
    save_splats(path, made, FRAME)
    assert summarize_splats(path).count == 300
    assert_same(load_ply(path, FRAME), made, 2e-5)


def test_places_far_from_the_origin_are_not_rounded(tmp_path):
    made, far = random_gaussians(300, 1), Similarity(0.3, np.array([5e5, -4e6, 300.0]))
    save_splats(tmp_path / "s.glb", made, far)
    assert_same(load_ply(tmp_path / "s.glb", far), made, 1e-5)
    assert read_glb(tmp_path / "s.glb")[0]["nodes"][0]["translation"][1] == pytest.approx(4e6, abs=20)


def test_trimesh_shows_colored_points_with_y_up(tmp_path):
    trimesh, made = pytest.importorskip("trimesh"), random_gaussians(300, 1)
    save_splats(tmp_path / "s.glb", made, HERE)
    (cloud,) = trimesh.load(tmp_path / "s.glb").geometry.values()
    np.testing.assert_allclose(cloud.vertices, made.means.numpy() * (-1, -1, 1), atol=1e-6)
    colors = (255 * (0.5 + 0.28209479 * made.sh[:, 0])).clamp(0, 255)
    np.testing.assert_allclose(np.asarray(cloud.colors)[:, :3], colors, atol=0.6)


def test_nodes_move_quantized_and_interleaved_splats(tmp_path):
    """Two primitives of different degree, one below two nodes; rotations and opacities of another are integers."""
    made, path = random_gaussians(200, 2), tmp_path / "s.glb"
    save_splats(path, made, HERE)
    document, content = read_glb(path)
    turn = Rotation.from_euler("xyz", (10, 20, -50), degrees=True)
    plain = document["meshes"][0]["primitives"][0]
    up = np.diag([-1.0, -1, 1])
    unit = (Rotation.from_matrix(up) * Rotation.from_quat(made.quaternions.numpy(), scalar_first=True)).as_quat()
    packed = np.zeros(200, [("rotation", "<i2", 4), ("opacity", "u1", 1), ("nothing", "u1", 3)])
    packed["rotation"] = np.round(32767 * unit)
    packed["opacity"][:, 0] = np.round(255 * made.opacity_logits.sigmoid())
    at = len(content)
    content += packed.tobytes()
    document["bufferViews"].append({"buffer": 0, "byteOffset": at, "byteLength": packed.nbytes, "byteStride": 12})
    view, first = len(document["bufferViews"]) - 1, len(document["accessors"])
    document["accessors"] += [
        {"bufferView": view, "componentType": 5122, "normalized": True, "type": "VEC4", "count": 200},
        {
            "bufferView": view,
            "byteOffset": 8,
            "componentType": 5121,
            "normalized": True,
            "type": "SCALAR",
            "count": 200,
        },
    ]
    attributes = {n: k for n, k in plain["attributes"].items() if "DEGREE" not in n or "DEGREE_0" in n}
    small = plain | {"attributes": attributes | {f"{KHR}:ROTATION": first, f"{KHR}:OPACITY": first + 1}}
    document["buffers"][0]["byteLength"] = len(content)
    document["meshes"] = [{"primitives": [plain]}, {"primitives": [small]}]
    document["nodes"] = [
        {"children": [1, 2], "scale": [2, 2, 2], "translation": [1, 2, 3]},
        {"mesh": 0, "rotation": turn.as_quat().tolist()},
        {"mesh": 1, "matrix": np.diag([0.5, 0.5, 0.5, 1.0]).ravel().tolist()},
    ]
    write_glb(path, document, content)
    assert summarize_splats(path).count == 400
    found = load_ply(path)
    assert found.sh.shape == (400, 9, 3)
    parts = [found.map(lambda values, half=half: values[half * 200 : half * 200 + 200]) for half in (0, 1)]
    few, whole = sorted(parts, key=lambda part: int(part.sh[:, 1:].abs().sum() > 0))
    turned = rotate_gaussians(made, up @ turn.as_matrix() @ up)
    shift = torch.tensor([-1.0, -2.0, 3.0])
    assert_same(whole, replace(turned, means=2 * turned.means + shift, log_scales=made.log_scales + np.log(2)), 1e-4)
    np.testing.assert_allclose(few.means, made.means + shift, atol=1e-5)
    np.testing.assert_allclose(few.sh[:, 0], made.sh[:, 0], atol=1e-6)
    np.testing.assert_allclose(few.opacity_logits.sigmoid(), made.opacity_logits.sigmoid(), atol=0.5 / 255 + 1e-6)
    one, two = (torch.nn.functional.normalize(each.quaternions) for each in (few, made))
    assert (one * two).sum(1).abs().min() > 0.99999


def test_refusals_say_what_would_help(tmp_path):
    path = tmp_path / "s.glb"
    save_splats(path, random_gaussians(20, 1), HERE)
    document, content = read_glb(path)

    def refuse(change, message):
        changed = json.loads(json.dumps(document))
        change(changed, changed["meshes"][0]["primitives"][0], changed["meshes"][0]["primitives"][0]["extensions"][KHR])
        write_glb(path, changed, content)
        with pytest.raises(BadInput, match=re.escape(message)) as error:
            load_splats(path)
        assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)

    compression = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
    refuse(
        lambda _, p, e: e.update(extensions=compression), "compressed by KHR_gaussian_splatting_compression_spz_2; save"
    )
    refuse(
        lambda _, p, e: e.update(colorSpace="lin_rec709_display"),
        "colors in the space 'lin_rec709_display'; save it in",
    )
    refuse(lambda _, p, e: e.update(kernel="box"), "splats of the kernel 'box'; only the ellipse")
    refuse(lambda _, p, e: p["extensions"].clear(), f"it has no splats of {KHR}; export the Gaussians")
    refuse(
        lambda _, p, e: p["attributes"].pop(f"{KHR}:SCALE"), f"its splats lack {KHR}:SCALE: a draft of the extension"
    )
    refuse(lambda _, p, e: p["attributes"].pop(f"{KHR}:SH_DEGREE_1_COEF_2"), "3 spherical harmonics; 1, 4, 9 or 16")
    refuse(lambda d, p, e: d["nodes"][0].update(scale=[1, 1, -1]), "a node mirrors or stretches its splats; apply")
    refuse(lambda d, p, e: d["nodes"][0].update(scale=[1, 2, 1]), "a node mirrors or stretches its splats; apply")
    refuse(
        lambda d, p, e: d["buffers"][0].update(uri="data.bin"), "its splats are in another file; save it as one .glb"
    )
    refuse(lambda d, p, e: d["accessors"][3].update(count=7), f"{KHR}:SCALE has 7 values for 20 splats")
    refuse(lambda d, p, e: d["bufferViews"][0].update(byteOffset=10**9), "not a .glb file")
    refuse(lambda d, p, e: d["scenes"][0].update(nodes=[7]), "not a .glb file")
    write_glb(path, document, content[:-100])
    with pytest.raises(BadInput, match=r"s\.glb: not a \.glb file"):
        load_splats(path)
    write_glb(path, document, content)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(BadInput, match=r"s\.glb: cut off: \d+ of \d+ bytes"):
        summarize_splats(path)
    path.write_bytes(b"no glb at all")
    with pytest.raises(BadInput, match=r"s\.glb: not a \.glb file"):
        summarize_splats(path)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 3])
def test_what_splat_transform_writes_is_read(tmp_path, degree):
    made = random_gaussians(300, degree)
    save_ply(tmp_path / "s.ply", made)
    command = ["npm", "exec", "--yes", "--fetch-retries=0", f"--package={PACKAGE}", "--", "splat-transform"]
    ended = subprocess.run([*command, "s.ply", "theirs.glb"], cwd=tmp_path, capture_output=True, text=True)
    if ended.returncode:
        pytest.skip(f"no npm, or no network: {ended.stderr[-200:]}")
    assert_same(load_ply(tmp_path / "theirs.glb"), made)
    save_splats(tmp_path / "ours.glb", made, HERE)
    theirs, ours = (read_glb(tmp_path / name)[0] for name in ("theirs.glb", "ours.glb"))
    for key in ("extensionsUsed", "scenes", "nodes", "meshes"):
        assert json.dumps(ours[key], sort_keys=True) == json.dumps(theirs[key], sort_keys=True), key
