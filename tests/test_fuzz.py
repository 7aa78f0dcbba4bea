"""All readers of user files, on corrupted files: they raise only the project's own errors (BadInput, Refused).

With `REFFUSION_SLOW=1`, each reader is tested for `REFFUSION_FUZZ_SECONDS` (600 by default).
`python -m tests.test_fuzz` does the same without pytest. `FOUND` holds files that once caused another error.
"""

from __future__ import annotations

import base64
import json
import os
import struct
import tempfile
import time
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from PIL import Image

from reffusion.capture.load import load_capture
from reffusion.io.arrays import load_array, load_json
from reffusion.io.colmap import ModelCamera, ModelImage, load_cameras, load_images, load_model_points, save_model
from reffusion.io.compressed import save_spz
from reffusion.io.depth_maps import load_depth
from reffusion.io.files import BadInput
from reffusion.io.given_masks import load_given_mask
from reffusion.io.images import image_size, load_alpha, load_exr, load_image, load_mask, save_exr
from reffusion.io.ply import load_ply, load_points, save_ply, save_points
from reffusion.io.splat_format import save_splat
from reffusion.io.splats import load_splats, summarize_splats
from reffusion.types import Gaussians
from runner import Refused
from runner.user_yaml import read_user_yaml

pytestmark = pytest.mark.integration

SECONDS = float(os.environ.get("REFFUSION_FUZZ_SECONDS", "600"))
QUICK = 40  # corrupted files for each reader in an ordinary run
LONGEST = 60  # s: a reader that takes longer hangs; a busy machine takes 11


@dataclass(frozen=True)
class Reader:
    """A function that reads files named `name`, and valid files (`seeds`) from which corrupted files are made."""

    name: str
    read: Callable[[Path], object]
    seeds: tuple[bytes, ...]


# ---------------------------------------------------------------------------------------------- good files


def good_files() -> dict[str, bytes]:
    """Return a valid file of every kind: file name -> content."""
    import torch

    draw = np.random.default_rng(0)
    picture = draw.integers(0, 256, (9, 12, 3), np.uint8)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cameras = {1: ModelCamera("OPENCV", 12, 9, (9.0, 9.0, 6.0, 4.5, 0.1, 0.0, 0.0, 0.0))}
        pose = np.eye(4)
        images = {k: ModelImage(f"v{k}.png", 1, pose) for k in (1, 2, 3)}
        save_model(folder, cameras, images, draw.normal(size=(3, 3)), np.zeros((3, 3), np.uint8))
        for mode, kind in (("RGB", "png"), ("RGB", "jpg"), ("L", "bmp"), ("RGB", "webp"), ("RGB", "tif"), ("P", "gif")):
            Image.fromarray(picture).convert(mode).save(folder / f"p.{kind}")
        Image.fromarray(picture[..., 0] > 127).save(folder / "bit.png")
        Image.fromarray(picture[..., 0].astype(np.uint16) * 99).save(folder / "deep.png")
        Image.fromarray(np.dstack([picture, picture[..., :1]])).save(folder / "alpha.png")
        save_exr(folder / "d.exr", picture[..., 0] / 7)
        np.save(folder / "d.npy", picture[..., 0] / 7)
        np.save(folder / "poses_bounds.npy", np.arange(51.0).reshape(3, 17) + 1)
        save_points(folder / "points.ply", draw.normal(size=(3, 3)), np.zeros((3, 3), np.uint8))
        some = lambda *shape: torch.from_numpy(draw.normal(size=shape).astype(np.float32))
        save_ply(folder / "g.ply", Gaussians(some(3, 3), some(3, 4), some(3, 3), some(3), some(3, 4, 3)))
        rows = load_splats(folder / "g.ply").rows
        save_splat(folder / "g.splat", rows)
        save_spz(folder / "g.spz", rows)
        return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


CAMERAS_TXT = b"# ids\n1 SIMPLE_PINHOLE 12 9 9.5 6 4.5\n2 OPENCV 12 9 9 9 6 4.5 0.1 0 0 0\n"
IMAGES_TXT = b"""# ids
1 1 0 0 0 0.5 0 -1 1 v1.png
1 2 -1 3 4 5
2 0.9 0.1 0 0 0 0 0 1 sub/v2.png

3 1 0 0 0 0 0 1 1 v3.png

"""
POINTS_TXT = b"# ids\n1 0.5 1 2 255 0 9 0.3 1 0 2 1\n2 -1 1e3 0 1 2 3 0.1\n"
LABELME = json.dumps(
    {"imageWidth": 12, "imageHeight": 9, "shapes": [{"label": "a", "points": [[1, 1], [9, 2], [5, 7]]}]}
).encode()
TRANSFORMS = json.dumps(
    {
        "w": 12,
        "h": 9,
        "fl_x": 9.5,
        "k1": 0.1,
        "camera_model": "OPENCV",
        "ply_file_path": "points.ply",
        "frames": [
            {"file_path": f"images/v{k}.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 9} for k in (1, 2, 3)
        ],
    }
).encode()
CSV = b"#name,x,y,alt,heading,pitch,roll,f,px,py,k1\n" + b"".join(
    b"v%d.png,1,2,%d,9,80,1,36,0,0,0.1\n" % (k, k) for k in (1, 2, 3)
)
BUNDLE = b"# Bundle file v0.3\n3 1\n" + b"9.5 0.1 0\n1 0 0\n0 1 0\n0 0 1\n0.5 0 1\n" * 3 + b"0 0 -9\n1 2 3\n1 0 0 1 1\n"
SPLAT_CAMERAS = json.dumps(
    [
        {
            "img_name": f"v{k}",
            "width": 12,
            "height": 9,
            "fx": 9,
            "fy": 9,
            "position": [k, 0, 0],
            "rotation": np.eye(3).tolist(),
        }
        for k in (1, 2, 3)
    ]
).encode()
OPENSFM = json.dumps(
    [
        {
            "cameras": {"c": {"projection_type": "perspective", "width": 12, "height": 9, "focal": 0.8, "k1": 0.1}},
            "shots": {
                f"v{k}.png": {"rotation": [0, 0.1, 0], "translation": [k, 0, 0], "camera": "c"} for k in (1, 2, 3)
            },
            "points": {"7": {"coordinates": [0, 0, 5], "color": [1, 2, 3]}},
        }
    ]
).encode()
SCENE = b"""layout: transforms
train: [v1, 20220819_104425, 2022-08-19]
test: every 8
reference:
  - {view: v1, image: "r.png", trust: off}
  - &other {view: 'v2', image: r2.png, depth: ~}
region: {center: [0, .5, -1e3], size: [1, 1, 1]}
profile: laptop
budget: 5m
stages:
  fit: {iterations: 500, densify: {cap_max: 3_000, stop: .5}}
  poses: &p {longest: 0x10, refine: yes}
"""


def capture_reader(name: str, others: dict[str, bytes]) -> Callable[[Path], object]:
    """Return a function that adds three pictures and their list beside a file, and reads its folder as a capture.

    Args:
        name: Layout of the capture.
        others: File name -> content; the pictures are copies of `p.png`.
    """

    def read(path: Path) -> object:
        folder = path.parent
        (folder / "images").mkdir(exist_ok=True)
        for k in (1, 2, 3):
            (folder / "images" / f"v{k}.png").write_bytes(others["p.png"])
        (folder / "list.txt").write_text("v1.png\nv2.png\nv3.png\n")
        return load_capture(folder, name)

    return read


def ply_as_text(data: bytes) -> bytes:
    from plyfile import PlyData

    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "g.ply"
        path.write_bytes(data)
        read = PlyData.read(str(path), mmap=False)
        read.text = True
        read.write(str(path))
        return path.read_bytes()


def readers() -> list[Reader]:
    made = good_files()
    of = lambda *names: tuple(made[name] for name in names)
    pictures = of("p.png", "p.jpg", "p.bmp", "p.webp", "p.tif", "p.gif", "alpha.png", "bit.png")

    def any_ply(path: Path) -> None:
        for read in (summarize_splats, load_points, load_ply):
            try_read(read, path)

    def any_splats(path: Path) -> None:
        for read in (summarize_splats, load_ply):
            try_read(read, path)

    def any_picture(path: Path) -> None:
        upright = (lambda p: image_size(p, True), lambda p: load_image(p, True))
        for read in (image_size, load_image, load_alpha, load_mask, load_given_mask, *upright):
            try_read(read, path)

    return [
        Reader("cameras.bin", load_cameras, of("cameras.bin")),
        Reader("images.bin", load_images, of("images.bin")),
        Reader("points3D.bin", load_model_points, of("points3D.bin")),
        Reader("cameras.txt", load_cameras, (CAMERAS_TXT,)),
        Reader("images.txt", load_images, (IMAGES_TXT,)),
        Reader("points3D.txt", load_model_points, (POINTS_TXT,)),
        Reader("transforms.json", capture_reader("transforms", made), (TRANSFORMS,)),
        Reader("poses_bounds.npy", capture_reader("llff", made), of("poses_bounds.npy")),
        Reader("cameras.csv", capture_reader("realitycapture", made), (CSV,)),
        Reader("bundle.out", capture_reader("bundler", made), (BUNDLE,)),
        Reader("cameras.json", capture_reader("3dgs", made), (SPLAT_CAMERAS,)),
        Reader("reconstruction.json", capture_reader("opensfm", made), (OPENSFM,)),
        Reader("scene.yaml", lambda path: read_user_yaml(path, ("stages",)), (SCENE,)),
        Reader(
            "g.ply",
            any_ply,
            (*of("g.ply", "points.ply"), ply_as_text(made["g.ply"]), ply_as_text(made["points.ply"])),
        ),
        Reader("g.splat", any_splats, of("g.splat")),
        Reader("g.spz", any_splats, of("g.spz")),
        Reader("p.png", any_picture, pictures),
        Reader("d.exr", load_depth, of("d.exr")),
        Reader("d.npy", load_depth, of("d.npy")),
        Reader("d.png", load_depth, of("deep.png", "p.tif", "p.png")),
        Reader("mask.npy", load_given_mask, of("d.npy")),
        Reader("mask.json", load_given_mask, (LABELME,)),
        Reader("array.npy", load_array, of("d.npy", "poses_bounds.npy")),
        Reader("any.json", load_json, (TRANSFORMS,)),
        Reader("any.exr", load_exr, (*of("d.exr"), *pictures)),
    ]


# ---------------------------------------------------------------------------------------------- corruption

NUMBERS = [struct.pack(f"<{kind}", value) for kind, value in (
    ("B", 0), ("B", 255), ("H", 65535), ("I", 2**31), ("I", 2**32 - 1), ("Q", 2**63), ("Q", 2**64 - 1), ("Q", 10**9),
    ("d", float("nan")), ("d", float("inf")), ("d", 1e308), ("d", -1.0), ("d", 0.0), ("f", float("nan")), ("f", 3e38),
)]  # fmt: skip
WORDS = [word.encode() for word in (
    "nan", "-1", "0", "1e999", "99999999999999999999", "true", "null", "~", "[]", "{}", "[[[[", "}", "\n", "\n\n", " ",
    "#",
    '"', "'", "&a", "*a", "<<: *p", "!!set ", "!!python/name:os.system", "? ", "- ", ": ", "é", "ÿþ", "\0",
    "element x 5",
    "property list uchar int x", "end_header", "..", "/", "2022-08-19", "1:30", "0o7", "PINHOLE", "\\u0000", "NaN",
)]  # fmt: skip


@st.composite
def corrupted_bytes(draw: st.DrawFn, seeds: tuple[bytes, ...]) -> bytes:
    """Draw a valid file with 1 to 6 random changes: parts are cut, overwritten, inserted, repeated or removed."""
    data = bytearray(draw(st.sampled_from(seeds)))
    for _ in range(draw(st.integers(1, 6))):
        at = draw(st.integers(0, max(len(data), 1)))
        length = draw(st.integers(0, 24))
        kind = draw(st.sampled_from(("cut", "over", "word", "number", "bytes", "out", "double", "flip", "long")))
        if kind == "cut":
            del data[at:]
        elif kind == "over":
            put = draw(st.sampled_from(NUMBERS))
            data[at : at + len(put)] = put
        elif kind == "word":
            data[at : at + length] = draw(st.sampled_from(WORDS))
        elif kind == "number":
            data[at:at] = draw(st.sampled_from(NUMBERS))
        elif kind == "bytes":
            data[at : at + length] = draw(st.binary(max_size=24))
        elif kind == "out":
            del data[at : at + length]
        elif kind == "double":
            data[at:at] = data[at : at + length] * draw(st.integers(1, 4))
        elif kind == "long":
            data[at:at] = draw(st.sampled_from((b"[", b"9", b"a", b"\0", b" ", b"{a: "))) * 2000
        elif at < len(data):
            data[at] ^= 1 << draw(st.integers(0, 7))
    data = bytes(data)
    return fix_png_checksums(data) if draw(st.booleans()) else data


def fix_png_checksums(data: bytes) -> bytes:
    """Return a PNG file with corrected checksums, so that a reader does not reject the file for its checksums."""
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        return data
    out, at = bytearray(data[:8]), 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        chunk = data[at + 4 : at + 8 + length]
        if len(chunk) < length + 4:
            break
        out += data[at : at + 4] + chunk + struct.pack(">I", zlib.crc32(chunk))
        at += 12 + length
    return bytes(out) + data[at:]


def try_read(read: Callable[[Path], object], path: Path) -> None:
    began = time.monotonic()
    try:
        read(path)
    except (BadInput, Refused) as error:
        message = str(error)
        assert "\n" not in message and len(message) < 1500, message
        assert path.parent.name in message or path.name in message or "scene.yaml" in message, message
    assert time.monotonic() - began < LONGEST, "too long"


def try_reader(reader: Reader, data: bytes) -> None:
    """Write `data` to a file and read the file.

    Only the project's own errors may be raised. Their message must be one line that names the file or its folder.
    """
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(name) / reader.name
        path.write_bytes(data)
        try_read(reader.read, path)


def fuzz(reader: Reader, files: int | None, seconds: float = 0.0) -> int:
    """Test a reader on corrupted files; return the number of files.

    Args:
        files: Number of files, which are the same in every run. None: new random files until `seconds` are over.
        seconds: Least duration, in seconds.
    """
    count = 0

    def one(data: bytes) -> None:
        nonlocal count
        count += 1
        try_reader(reader, data)

    began, most = time.monotonic(), files or 500
    while True:
        chosen = settings(
            max_examples=most,
            deadline=None,
            database=None,
            derandomize=files is not None,
            phases=(Phase.generate,) if files else (Phase.generate, Phase.shrink),
            suppress_health_check=list(HealthCheck),
        )
        chosen(given(corrupted_bytes(reader.seeds))(one))()
        if time.monotonic() - began >= seconds:
            return count


READERS = {reader.name: reader for reader in readers()}


@pytest.mark.parametrize("name", READERS)
def test_good_files_are_read(name):
    for seed in READERS[name].seeds:
        try_reader(READERS[name], seed)


@pytest.mark.parametrize("name", READERS)
def test_spoilt_files(name):
    fuzz(READERS[name], QUICK)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_spoilt_files_for_long(name):
    fuzz(READERS[name], None, SECONDS)


# Name of the reader -> files in base64 that once caused an error which is not the project's own.
FOUND: dict[str, tuple[str, ...]] = {
    "cameras.txt": (base64.b64encode(b"9" * 2000 + b" PINHOLE 0 9 9 9 6 4.5\n").decode(),),
    "p.png": (
        "iVBORw0KGgoAAAANSUhEUgAAAAwAQAAJAQAAAAAHXjIUAAAAJElEQVR4nGOIYmB0lWY8dorRTonp9wWGRwoMPgeYvBgY5D4A"
        "AGRfB+OsiEFuAAAAAElFTkSuQmCC",
    ),  # 93 bytes that declare 50 megapixels: took over 10 s on a busy machine
}


@pytest.mark.parametrize(("name", "data"), [(name, data) for name, each in FOUND.items() for data in each])
def test_what_was_found_once(name, data):
    try_reader(READERS[name], base64.b64decode(data))


if __name__ == "__main__":
    for each in READERS.values():
        print(f"{each.name}: {fuzz(each, None, SECONDS)} files", flush=True)
