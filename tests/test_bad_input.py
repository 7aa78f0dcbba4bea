"""Bad input is refused within seconds, in one line that names the file or the key, and nothing is written.

Most cases call the functions that the command calls (`first_message`), which is faster; some run the command itself.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes.capture import HEIGHT, WIDTH, make_truth, write_capture, write_masks, write_pictures
from scenes.processes import run_module

from reffusion.capture.roles import capture_views
from reffusion.capture.scene_folder import read_scene
from reffusion.io.depth_maps import load_depth
from reffusion.io.files import BadInput
from reffusion.io.images import load_image, save_exr, save_image
from reffusion.io.ply import save_ply
from reffusion.params.capture import MaskSpec, SceneKeys
from reffusion.params.reference import ReferenceSpec
from reffusion.references.files import ReferenceFile, load_reference_files
from reffusion.types import Gaussians
from runner import Refused, worker
from runner.parameters import parse_duration, parse_set, stack_layers
from runner.pipeline import load_pipeline, load_scene_file
from runner.resolve import choose_profile
from runner.user_yaml import read_user_yaml
from stages import poses, raw_masks

ROOT = Path(__file__).resolve().parent.parent
PIPELINE = load_pipeline(ROOT)
SLOW = os.environ.get("REFFUSION_SLOW") == "1"
LONGEST = 10.0  # seconds until the refusal

Change = Callable[[Path], None]


@pytest.fixture(scope="session")
def good_captures(tmp_path_factory) -> Path:
    """Return a folder with a good capture of each layout; tests corrupt copies of these captures."""
    home = tmp_path_factory.mktemp("good")
    for layout in ("llff", "colmap", "colmap txt", "transforms", "photos"):
        write_capture(home / layout, layout, make_truth())
    return home


def first_message(folder: Path, out: Path, set_: str = "") -> str | None:
    """Return the message by which the command refuses a scene, or None if the stages `poses` and `raw_masks` accept it.

    Args:
        folder: the scene.
        out: the folder that the stages write to.
        set_: parameters as typed after `set=`.

    Raises:
        Exception: any error that is not a refusal.
    """
    try:
        scene = load_scene_file(folder, PIPELINE)
        profile, _ = choose_profile("laptop" if scene.profile is None else None, scene, [], PIPELINE)
        layers = stack_layers(PIPELINE, scene, profile, None, parse_set(set_, PIPELINE), {})
        if scene.budget is not None:
            parse_duration(scene.budget, str(scene.path))
    except Refused as error:
        return str(error)
    for stage, spec in PIPELINE.stages.items():
        question = {"stage": stage, "params": layers.values[stage], "takes": spec.all_needs}
        if "scene" in spec.all_needs and stage in ("poses", "raw_masks"):
            question |= {"scene": str(folder), "needs": {"scene": str(folder)}}
        try:
            answer = worker._describe(question)
        except Refused as error:
            return str(error)
        assert "broken" not in answer, answer
        for error in answer.get("errors", ()):
            origin = layers.origin(stage, error["where"])
            return f"{origin}: {stage}.{error['where']} = {error['value']}: {error['message']}"
        if "refusal" in answer:
            return answer["refusal"]
        assert not any("preview failed" in note for note in answer.get("notes", ())), answer["notes"]
    try:
        poses.run(poses.Params(**layers.values["poses"]), out, scene=folder)
        raw_masks.run(raw_masks.Params(**layers.values["raw_masks"]), out, scene=folder, poses=out)
    except BadInput as error:
        return str(error)
    return None


def assert_bad_input(
    good_captures: Path, tmp_path: Path, layout: str, change: Change, names: str, set_: str = ""
) -> str:
    """Corrupt a copy of a good capture by `change`, and assert that it is refused by one line that contains `names`.

    Args:
        good_captures: the fixture.
        tmp_path: a folder for the copy and the output.
        layout: the capture in `good_captures`.
        change: corrupts the copy.
        names: the file or key that the message must name.
        set_: parameters as typed after `set=`.

    Returns:
        The message.
    """
    folder, out = tmp_path / "s", tmp_path / "out"
    shutil.copytree(good_captures / layout, folder)
    out.mkdir()
    change(folder)
    began = time.monotonic()
    message = first_message(folder, out, set_)
    assert message is not None, "accepted"
    assert time.monotonic() - began < LONGEST
    assert "\n" not in message and len(message) < 1000 and names in message, message
    assert not (out / "views.json").exists()
    return message


# -------------------------------------------------------------------------------------- changes that corrupt a capture


def write_file(name: str, content: bytes | str) -> Change:
    def change(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).unlink(missing_ok=True)
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)

    return change


def write_yaml(text: str) -> Change:
    return write_file("scene.yaml", text)


def truncate_file(name: str, keep: int) -> Change:
    """Return a change that keeps the first `keep` bytes of a file; a negative `keep` drops that many last bytes."""
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:keep])


def replace_in_file(name: str, old: str, new: str) -> Change:
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return change


def replace_by(name: str, kind: str) -> Change:
    """Return a change that puts a folder, a pipe or a dangling link (`kind`) in place of a file."""

    def change(folder: Path) -> None:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        {"folder": path.mkdir, "pipe": lambda: os.mkfifo(path), "link": lambda: path.symlink_to("nowhere")}[kind]()

    return change


def change_transforms(change: Callable[[dict], object]) -> Change:
    def edit(folder: Path) -> None:
        path = folder / "transforms.json"
        content = json.loads(path.read_text())
        changed = change(content)
        path.write_text(json.dumps(content if changed is None else changed))

    return edit


def set_key(name: str, value: object) -> Change:
    return change_transforms(lambda r: r.update({name: value}))


def set_frame_key(name: str, value: object) -> Change:
    return change_transforms(lambda r: r["frames"][1].update({name: value}))


def edit_bounds(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda folder: np.save(folder / "poses_bounds.npy", change(np.load(folder / "poses_bounds.npy")))


def set_value(row: int, column: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array[row, column] = value
        return array

    return change


def do_all(*changes: Change) -> Change:
    def change(folder: Path) -> None:
        for each in changes:
            each(folder)

    return change


def png_header(width: int, height: int, kind: int = 2) -> bytes:
    """Return a PNG file that declares a size but has almost no pixel data; `kind` is the PNG color type."""
    chunk = lambda tag, data: struct.pack(">I", len(data)) + tag + data + struct.pack(">I", zlib.crc32(tag + data))
    header = struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 99)) + chunk(b"IEND", b"")
    )


def npy_header(shape: str, data: bytes = b"", descr: str = "'<f8'") -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


# ---------------------------------------------------------------------------------------------- scene.yaml


LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12)
)
YAML = {
    "a list": "- images",
    "a word": "images",
    "a number": "7",
    "open bracket": "test: [v00",
    "open brace": "region: {center: [0, 0, 0]",
    "open quote": 'images: "images',
    "tab": "reference:\n\tview: v00",
    "bad indent": "reference:\n  view: v00\n image: x.png",
    "two documents": "images: images\n---\nimages: other",
    "python tag": "images: !!python/object/apply:os.system [true]",
    "python name": "images: !!python/name:os.system",
    "own tag": "images: !folder images",
    "set tag": "test: !!set {v00}",
    "binary tag": "images: !!binary aW1hZ2Vz",
    "omap tag": "reference: !!omap [view: v00]",
    "timestamp tag": "test: [!!timestamp 2022-08-19]",
    "billion laughs": LAUGHS,
    "an alias of itself": "test: &a [*a]",
    "an unknown alias": "test: *a",
    "deep": "test: " + "[" * 5000,
    "deep and closed": "test: " + "[" * 500 + "]" * 500,
    "deep mappings": "region: " + "{a: " * 500 + "1" + "}" * 500,
    "key twice": "images: images\nimages: other",
    "key twice inside": "stages: {fit: {iterations: 1, iterations: 2}}",
    "stage twice": "stages: {fit: {iterations: 1}, fit: {seed: 2}}",
    "key that is a list": "? [images]\n: images",
    "key that is a mapping": "? {a: b}\n: images",
    "unknown key": "imagse: images",
    "number as a key": "1: images",
    "null as a key": "~: images",
    "control character": "images: \x01images",
    "null byte": "images: im\0ages",
    "merge of a number": "stages: {fit: {<<: 5}}",
    "stages a list": "stages: [fit]",
    "stages a word": "stages: fit",
    "stage a number": "stages: {fit: 5}",
    "stage nothing": "stages: {fit: }",
    "unknown stage": "stages: {fitt: {iterations: 1}}",
    "unknown parameter": "stages: {fit: {iteration: 1}}",
    "group a number": "stages: {fit: {densify: 3}}",
    "profile unknown": "profile: lapdog",
    "profile a list": "profile: [laptop]",
    "profile a mapping": "profile: {laptop: 1}",
    "profile on": "profile: on",
    "budget a word": "budget: soon",
    "budget a list": "budget: [5m]",
    "budget zero": "budget: 0s",
    "budget negative": "budget: -5m",
    "budget sexagesimal": "budget: 1:30",
    "layout unknown": "layout: nerf",
    "layout a number": "layout: 5",
    "images a list": "images: [images]",
    "images a mapping": "images: {folder: images}",
    "images a file": "images: transforms.json",
    "masks a list": "masks: [masks]",
    "masks empty text": 'masks: ""',
    "test_masks not there": "test_masks: nowhere",
    "test_masks a mapping": "test_masks: {a: b}",
    "train nobody": "train: []",
    "train a mapping": "train: {v00: v01}",
    "train lists": "train: [[v00, v01, v02]]",
    "train nothing inside": "train: [v00, v01, ~]",
    "train one name": "train: v00",
    "train twice": "train: [v00, v01, v02, v02]",
    "train every 0": "train: every 0",
    "train every -2": "train: every -2",
    "train every": "train: every",
    "test unknown": "test: [2022-08-19]",
    "test a date unlike the name": "test: [2022-8-19]",
    "test without zeros": "test: [0]",
    "test a truth value": "test: [on]",
    "test a mapping inside": "test: [{view: v00}]",
    "clean a word": "clean: v00",
    "gaussians a folder": "gaussians: images",
    "gaussians a picture": "gaussians: images/v00.png",
    "gaussians a list": "gaussians: [a.ply]",
    "gaussians empty text": 'gaussians: ""',
    "region a number": "region: 5",
    "region nothing inside": "region: {}",
    "region without size": "region: {center: [0, 0, 0]}",
    "region of two sides": "region: {center: [0, 0, 0], size: [1, 1]}",
    "region of no size": "region: {center: [0, 0, 0], size: [0, 0, 0]}",
    "region flat": "region: {center: [0, 0, 0], size: [1, 1, 0]}",
    "region negative": "region: {center: [0, 0, 0], size: [1, -1, 1]}",
    "region nan": "region: {center: [0, .nan, 0], size: [1, 1, 1]}",
    "region infinite": "region: {center: [0, 0, 0], size: [1, 1, inf]}",
    "region of words": "region: {center: [a, b, c], size: [1, 1, 1]}",
    "region with more": "region: {center: [0, 0, 0], size: [1, 1, 1], turn: 5}",
    "region truth value": "region: {center: [true, 0, 0], size: [1, 1, 1]}",
    "reference a word": "reference: v00",
    "reference without image": "reference: {view: v00}",
    "reference without view": "reference: {image: images/v00.png}",
    "reference with more": "reference: {view: v00, image: images/v00.png, mask: masks/v00.png}",
    "reference of no view": "reference: {view: v99, image: images/v00.png}",
    "reference not there": "reference: {view: v00, image: nowhere.png}",
    "reference a folder": "reference: {view: v00, image: images}",
    "reference no picture": "reference: {view: v00, image: transforms.json}",
    "reference twice": "reference: [{view: v00, image: images/v00.png}, {view: v00, image: images/v01.png}]",
    "reference of a test view": "test: [v00]\nreference: {view: v00, image: images/v00.png}",
    "reference of neither": "train: [v00, v01, v02]\nreference: {view: v03, image: images/v03.png}",
    "reference trust perhaps": "reference: {view: v00, image: images/v00.png, trust: perhaps}",
    "reference depth missing": "reference: {view: v00, image: images/v00.png, depth: d.exr}",
    "reference depth a jpg": "reference: {view: v00, image: images/v00.png, depth: transforms.json}",
    "reference lists in lists": "reference: [[{view: v00, image: images/v00.png}]]",
}


@pytest.mark.parametrize("text", YAML.values(), ids=YAML.keys())
def test_scene_yaml(good_captures, tmp_path, text):
    assert_bad_input(good_captures, tmp_path, "transforms", write_yaml(text), "")


VALUES = {  # parameter -> values that must be refused
    "fit.iterations": ("true", "-1", "1.5", "many", ".nan", ".inf", "[1]", "{a: 1}", "null", '"x"'),
    "fit.seed": ("on", "half", "1e400"),
    "fit.lr.means": ("true", "-1", ".nan", ".inf", "fast"),
    "fit.pixels": ("some", "1", "true"),
    "poses.longest": ("0", "8", "-5", "false", "wide", "2022-08-19"),
    "poses.min_detail": ("-1", ".nan", "yes"),
    "poses.refine": ("perhaps", "2", "[]"),
    "masks.tau": ("much", ".inf"),
    "reference.prompt": ("1984", "true", "[a]"),
    "reference.candidates": ("0", "true", "2.5"),
    "reference.sampler.steps": ("0", "on", "-1"),
    "distill.sds.patches": ("-1", "true"),
    "finish.backdrop": ("maybe",),
}


@pytest.mark.integration
@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in VALUES.items() for value in values])
def test_values_of_parameters(good_captures, tmp_path, name, value):
    stage, *groups = name.split(".")
    text = "".join(f"{{{group}: " for group in groups) + value + "}" * len(groups)
    assert_bad_input(good_captures, tmp_path, "transforms", write_yaml(f"stages: {{{stage}: {text}}}"), f"{name}")
    if "[" not in value and "{" not in value and '"' not in value:
        message = assert_bad_input(
            good_captures, tmp_path / "typed", "transforms", lambda folder: None, name, f"{name}={value}"
        )
        assert message.startswith("set: ")


SET = {
    "no stage": "iterations=5",
    "no value": "fit.iterations",
    "unknown stage": "fitt.iterations=5",
    "unknown parameter": "fit.iteration=5",
    "open quote": "fit.iterations='5",
    "open bracket": "poses.test=[v00",
    "tag": "poses.test=!!set",
    "spaces": "fit.iterations = 5",
    "double dot": "fit..iterations=5",
    "deep": "poses.test=" + "[" * 3000,
    "unknown view": "poses.test=[2022-08-19]",
    "an unknown alias": "poses.test=*a",
    "laughs": "fit.iterations=" + "[&a*a]",
}


@pytest.mark.parametrize("text", SET.values(), ids=SET.keys())
def test_set_options_are_refused(good_captures, tmp_path, text):
    assert_bad_input(good_captures, tmp_path, "transforms", lambda folder: None, "", text)


@pytest.mark.parametrize("kind", ["folder", "pipe", "link"])
def test_scene_yaml_of_other_file_types(good_captures, tmp_path, kind):
    assert_bad_input(good_captures, tmp_path, "transforms", replace_by("scene.yaml", kind), "scene.yaml")


@pytest.mark.parametrize("content", [b"\xff\xfei\0m\0", b"images: \xe4\xf6", b"\0\0\0", b"x" * 1_100_000])
def test_scene_yaml_of_other_bytes(good_captures, tmp_path, content):
    assert_bad_input(good_captures, tmp_path, "transforms", write_file("scene.yaml", content), "scene.yaml")


# ---------------------------------------------------------------------------------------------- transforms.json

NUMBERS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "p1")
NO_NUMBERS: tuple[object, ...] = ("640", float("nan"), float("inf"), None, True, [], {"a": 1}, 1e300)
TRANSFORMS: dict[str, Change] = {
    **{f"{name} = {value!r}": set_key(name, value) for name in NUMBERS for value in NO_NUMBERS},
    **{f"{name} = {value!r}": set_key(name, value) for name in ("w", "h", "fl_x", "fl_y") for value in (0, -100)},
    **{f"frame's {name} = 'x'": set_frame_key(name, "x") for name in NUMBERS},
    **{
        f"angle = {value!r}": do_all(
            change_transforms(lambda r: r.pop("fl_x") and None), set_key("camera_angle_x", value)
        )
        for value in (0, -1, 3.2, 7, "wide", float("nan"))
    },
    "model a mapping": set_key("camera_model", {"a": list(range(1000))}),
    "a list": change_transforms(lambda r: [r]),
    "a number": change_transforms(lambda r: 5),
    "nothing": change_transforms(lambda r: {}),
    "no frames": set_key("frames", []),
    "frames a mapping": set_key("frames", {"0": 1}),
    "frames of numbers": set_key("frames", [1, 2, 3]),
    "frames of null": set_key("frames", [None]),
    "a frame without path": change_transforms(lambda r: r["frames"][0].pop("file_path") and None),
    "a frame without pose": change_transforms(lambda r: r["frames"][0].pop("transform_matrix") and None),
    **{f"path {value!r}": set_frame_key("file_path", value) for value in (5, None, [], "", "a\0b", {}, True, "/", ".")},
    "no picture is there": change_transforms(
        lambda r: [f.update(file_path="none/x.png") for f in r["frames"]] and None
    ),
    "two of a name": change_transforms(lambda r: r["frames"][0].update(file_path=r["frames"][1]["file_path"])),
    **{
        f"pose {name}": set_frame_key("transform_matrix", value)
        for name, value in {
            "of words": [["a"] * 4] * 4,
            "of null": [[None] * 4] * 4,
            "null": None,
            "a number": 5,
            "a word": "identity",
            "of 3x3": np.eye(3).tolist(),
            "ragged": [[1, 0, 0, 0], [0, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
            "of zeros": np.zeros((4, 4)).tolist(),
            "sheared": np.diag([1.0, 2, 1, 1]).tolist(),
            "infinite": np.full((4, 4), np.inf).tolist(),
            "of truth values": [[True] * 4] * 4,
            "of huge numbers": [[10**400] * 4] * 4,
            "deep": [[[[1]]]],
        }.items()
    },
    **{
        f"points file {value!r}": set_key("ply_file_path", value)
        for value in (5, [], "", "a\0b", "images", "transforms.json")
    },
    **{f"cut at {keep}": truncate_file("transforms.json", keep) for keep in (0, 1, 10, 100, 500, -1, -30)},
    "deep": write_file("transforms.json", "[" * 100_000),
    "deep mappings": write_file("transforms.json", '{"a":' * 100_000),
    "long number": write_file("transforms.json", '{"frames": ' + "9" * 10_000 + "}"),
    "latin": write_file("transforms.json", '{"frames": "é"}'.encode("latin-1")),
    "zeros": write_file("transforms.json", b"\0" * 100),
    "not JSON": write_file("transforms.json", "frames: []"),
    "a picture": write_file("transforms.json", png_header(2, 2)),
    **{f"a {kind}": replace_by("transforms.json", kind) for kind in ("folder", "pipe", "link")},
}


@pytest.mark.integration
@pytest.mark.parametrize("change", TRANSFORMS.values(), ids=TRANSFORMS.keys())
def test_transforms_json(good_captures, tmp_path, change):
    message = assert_bad_input(good_captures, tmp_path, "transforms", change, "")
    assert "transforms.json" in message or ".png" in message or "images" in message


# ---------------------------------------------------------------------------------------------- COLMAP, LLFF

MODEL = "sparse/0"
CAMERA = "1 SIMPLE_PINHOLE 96 72 90"  # the beginning of the camera's line in cameras.txt
COLMAP_TEXT: dict[str, tuple[str, Change]] = {
    **{
        f"camera: {line!r:.40}": ("cameras.txt", write_file(f"{MODEL}/cameras.txt", line + "\n"))
        for line in (
            "1",
            "1 SIMPLE_PINHOLE",
            "x SIMPLE_PINHOLE 96 72 90 48 36",
            "1 PINHOLE_CAMERA 96 72 90 48 36",
            "1 SIMPLE_PINHOLE 96 72 90 48",
            "1 SIMPLE_PINHOLE 96 72 90 48 36 0",
            "1 SIMPLE_PINHOLE wide 72 90 48 36",
            "1 SIMPLE_PINHOLE 96.5 72 90 48 36",
            "1 SIMPLE_PINHOLE 96 72 long 48 36",
            "1 SIMPLE_PINHOLE 96 72 nan 48 36",
            "1 SIMPLE_PINHOLE 96 72 inf 48 36",
            "1 SIMPLE_PINHOLE 96 72 -90 48 36",
            "1 SIMPLE_PINHOLE 96 72 0 48 36",
            "1 PINHOLE 96 72 90 -90 48 36",
            "1 SIMPLE_PINHOLE 0 0 90 48 36",
            "1 SIMPLE_PINHOLE -96 -72 90 48 36",
            "1 FOV 96 72 90 90 48 36 0.5",
            "1 SIMPLE_PINHOLE 96 72 90 48 36\n1 SIMPLE_PINHOLE 96 72 91 48 36",
            "ÿ",
        )
    },
    **{
        f"camera: {line!r:.40}": (names, write_file(f"{MODEL}/cameras.txt", line + "\n"))
        for names, line in (
            ("SIMPLE_RADIAL", "1 SIMPLE_RADIAL 96 72 90 48 36 -9"),
            ("OPENCV_FISHEYE", "1 OPENCV_FISHEYE 96 72 20 20 48 36 0 0 0 0"),
            ("v00.png", "1 SIMPLE_PINHOLE 500 72 90 48 36"),
        )
    },
    "no cameras": ("images", write_file(f"{MODEL}/cameras.txt", "")),
    **{
        f"image: {line!r:.40}": ("images", write_file(f"{MODEL}/images.txt", line + "\n\n"))
        for line in (
            "1 1 0 0 0",
            "x 1 0 0 0 0 0 0 1 v00.png",
            "1 one 0 0 0 0 0 0 1 v00.png",
            "1 nan 0 0 0 0 0 0 1 v00.png",
            "1 0 0 0 0 0 0 0 1 v00.png",
            "1 1 0 0 0 inf 0 0 1 v00.png",
            "1 1 0 0 0 0 0 0 x v00.png",
            "1 1 0 0 0 0 0 0 7 v00.png",
            "1 1 0 0 0 0 0 0 1 v99.png",
            "1 1 0 0 0 0 0 0 1 v00.png\n\n1 1 0 0 0 0 0 0 1 v01.png",
            "1 1 0 0 0 0 0 0 1 v00.png\n\n2 1 0 0 0 0 0 0 1 v00.png",
        )
    },
    "one image": ("training view", write_file(f"{MODEL}/images.txt", "1 1 0 0 0 0 0 0 1 v00.png\n\n")),
    "no images": ("images", write_file(f"{MODEL}/images.txt", "")),
    **{
        f"point: {line!r:.40}": ("points3D.txt", write_file(f"{MODEL}/points3D.txt", line + "\n"))
        for line in (
            "1",
            "1 0 0",
            "1 0 0 0 255 255",
            "1 x 0 0 255 255 255 1",
            "1 nan 0 0 255 255 255 1",
            "1 0 0 0 red 255 255 1",
            "1 0 0 0 256 0 0 1",
            "1 0 0 0 -1 0 0 1",
            "1 0 0 0 1 2 3 1 a b",
            "1 0 0 0 1 2 3 1 99999999999999999999 0",
        )
    },
    **{
        f"{name} {kind}": (name, replace_by(f"{MODEL}/{name}", kind))
        for name in ("cameras.txt", "images.txt", "points3D.txt")
        for kind in ("folder", "pipe", "link")
    },
}


@pytest.mark.parametrize(("names", "change"), COLMAP_TEXT.values(), ids=COLMAP_TEXT.keys())
def test_colmap_text(good_captures, tmp_path, names, change):
    assert_bad_input(good_captures, tmp_path, "colmap txt", change, names)


def overwrite_number(name: str, at: int, layout: str, value: float) -> Change:
    """Return a change that overwrites the number at byte `at` of a binary file; `layout`: its type for `struct`."""

    def change(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        struct.pack_into("<" + layout, data, at, value)
        (folder / name).write_bytes(data)

    return change


COLMAP_BINARY: dict[str, tuple[str, Change]] = {
    **{
        f"{name} cut at {keep}": (f"{name}.bin", truncate_file(f"{MODEL}/{name}.bin", keep))
        for name in ("cameras", "images", "points3D")
        for keep in (0, 1, 8, 20, 40, -1, -9)
    },
    **{
        f"{name} of {count}": (f"{name}.bin", overwrite_number(f"{MODEL}/{name}.bin", 0, "Q", count))
        for name in ("cameras", "images", "points3D")
        for count in (10**6, 2**63, 2**64 - 1)
    },
    **{
        f"{name} too long": (
            f"{name}.bin",
            lambda f, n=name: (f / MODEL / f"{n}.bin").open("ab").write(b"\0" * 9) and None,
        )
        for name in ("cameras", "images", "points3D")
    },
    "unknown model": ("cameras.bin", overwrite_number(f"{MODEL}/cameras.bin", 12, "i", 99)),
    "negative model": ("cameras.bin", overwrite_number(f"{MODEL}/cameras.bin", 12, "i", -1)),
    "no width": ("cameras.bin", overwrite_number(f"{MODEL}/cameras.bin", 16, "Q", 0)),
    "huge width": ("v00", overwrite_number(f"{MODEL}/cameras.bin", 16, "Q", 2**63)),
    "nan focal length": ("cameras.bin", overwrite_number(f"{MODEL}/cameras.bin", 32, "d", float("nan"))),
    "negative focal length": ("cameras.bin", overwrite_number(f"{MODEL}/cameras.bin", 32, "d", -90.0)),
    "nan pose": ("images.bin", overwrite_number(f"{MODEL}/images.bin", 12, "d", float("nan"))),
    "long track": ("points3D.bin", overwrite_number(f"{MODEL}/points3D.bin", 8 + 43, "Q", 2**62)),
    "nan point": ("points3D.bin", overwrite_number(f"{MODEL}/points3D.bin", 16, "d", float("nan"))),
    "text as binary": ("cameras.bin", write_file(f"{MODEL}/cameras.bin", CAMERA)),
}


@pytest.mark.parametrize(("names", "change"), COLMAP_BINARY.values(), ids=COLMAP_BINARY.keys())
def test_colmap_binary(good_captures, tmp_path, names, change):
    assert_bad_input(good_captures, tmp_path, "colmap", change, names)


LLFF: dict[str, Change] = {
    "empty": write_file("poses_bounds.npy", b""),
    "text": write_file("poses_bounds.npy", "1 2 3"),
    "pickle": lambda f: np.save(f / "poses_bounds.npy", np.array([{}], object), allow_pickle=True),
    "archive": lambda f: np.savez(open(f / "poses_bounds.npy", "wb"), a=np.zeros((6, 17))),
    "words": lambda f: np.save(f / "poses_bounds.npy", np.full((6, 17), "a")),
    "complex": lambda f: np.save(f / "poses_bounds.npy", np.zeros((6, 17), complex)),
    "16 columns": edit_bounds(lambda r: r[:, :16]),
    "flat": edit_bounds(np.ravel),
    "no rows": edit_bounds(lambda r: r[:0]),
    "five rows": edit_bounds(lambda r: r[:5]),
    "nan": edit_bounds(set_value(2, 0, np.nan)),
    "infinite bound": edit_bounds(set_value(2, 16, np.inf)),
    "negative focal length": edit_bounds(set_value(2, 14, -5)),
    "no height": edit_bounds(set_value(2, 4, 0)),
    "near is far": edit_bounds(set_value(2, 15, 1e9)),
    "a pose of zeros": edit_bounds(lambda r: np.where(np.arange(17) % 5 < 3, 0 * r, r)),
    "other proportions": edit_bounds(set_value(2, 4, 5000)),
    "huge": write_file("poses_bounds.npy", npy_header("(1000000000000, 17)")),
    "negative shape": write_file("poses_bounds.npy", npy_header("(-1, 17)")),
    "a shape of words": write_file("poses_bounds.npy", npy_header("('a', 17)")),
    "a broken header": write_file("poses_bounds.npy", npy_header("((((", b"")),
    "an unknown type": write_file("poses_bounds.npy", npy_header("(6, 17)", b"\0" * 816, "'<q9'")),
    **{f"cut at {keep}": truncate_file("poses_bounds.npy", keep) for keep in (3, 6, 9, 60, 128, 200, -1)},
    **{f"a {kind}": replace_by("poses_bounds.npy", kind) for kind in ("folder", "pipe", "link")},
}


@pytest.mark.parametrize("change", LLFF.values(), ids=LLFF.keys())
def test_poses_bounds(good_captures, tmp_path, change):
    message = assert_bad_input(good_captures, tmp_path, "llff", change, "")
    assert "poses_bounds.npy" in message or ".png" in message


# ---------------------------------------------------------------------------------------------- pictures, masks


def save_picture(name: str, array: np.ndarray, kind: str = "PNG") -> Change:
    return lambda folder: Image.fromarray(array).save(folder / name, kind)


BROKEN: dict[str, Callable[[str], Change]] = {
    "empty": lambda name: write_file(name, b""),
    "text": lambda name: write_file(name, "no picture"),
    "postscript": lambda name: write_file(name, "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 96 72\n"),
    "a bomb": lambda name: write_file(name, png_header(60_000, 60_000)),
    "of no width": lambda name: write_file(name, png_header(0, 72)),
    "of a little data": lambda name: write_file(name, png_header(WIDTH, HEIGHT)),
    **{f"cut at {keep}": lambda name, keep=keep: truncate_file(name, keep) for keep in (1, 8, 20, 33, 60, -30)},
    **{f"a {kind}": lambda name, kind=kind: replace_by(name, kind) for kind in ("folder", "pipe", "link")},
}
NOISE = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


@pytest.mark.parametrize("layout", ["transforms", "colmap", "llff"])
@pytest.mark.parametrize("broken", BROKEN.values(), ids=BROKEN.keys())
def test_photographs(good_captures, tmp_path, broken, layout):
    name = f"{'images_4' if layout == 'llff' else 'images'}/v01.png"
    change = do_all(
        save_picture(name, NOISE), broken(name), lambda folder: (folder / "masks/v01.png").unlink(missing_ok=True)
    )
    assert_bad_input(good_captures, tmp_path, layout, change, "v01")


@pytest.mark.parametrize("broken", BROKEN.values(), ids=BROKEN.keys())
def test_masks(good_captures, tmp_path, broken):
    change = do_all(
        save_picture("masks/v01.png", np.kron(NOISE[..., 0] > 127, np.ones((1, 1), bool))), broken("masks/v01.png")
    )
    assert_bad_input(good_captures, tmp_path, "transforms", change, "v01")


WHITE = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
WHITE[10:30, 20:40, 3] = 0
NAMES_OF_ALL = [f"v{k:02d}" for k in range(6)]


def fill_masks(folder: Path) -> None:
    for path in (folder / "masks").iterdir():
        save_image(path, np.full((HEIGHT, WIDTH), 255, np.uint8))


def masks_as_file(folder: Path) -> None:
    shutil.rmtree(folder / "masks")
    (folder / "masks").write_text("x")


def copy_file(old: str, new: str) -> Change:
    return lambda folder: shutil.copy(folder / old, folder / new)


OTHER_PICTURES: dict[str, tuple[str, Change]] = {
    "floats": ("v01", save_picture("images/v01.png", np.zeros((HEIGHT, WIDTH), np.float32), "TIFF")),
    "photograph of other proportions": ("v01", lambda f: write_pictures(f / "images", ["v01"], (HEIGHT, WIDTH))),
    "mask of one pixel": ("v01", lambda f: write_masks(f / "masks", ["v01"], (1, 9))),
    "two masks": ("v01", copy_file("masks/v01.png", "masks/v01.bmp")),
    "mask in alpha": ("v01", save_picture("masks/v01.png", WHITE)),
    "mask in alpha of black": ("v01", save_picture("masks/v01.png", WHITE * np.array([0, 0, 0, 1], np.uint8))),
    "mask of sevens": ("masks", lambda f: write_masks(f / "masks", NAMES_OF_ALL, value=7)),
    "mask of a hundred": ("masks", lambda f: write_masks(f / "masks", NAMES_OF_ALL, value=100)),
    "full masks": ("masks", fill_masks),
    "masks a file": ("mask", masks_as_file),
    "no pictures": ("images", lambda f: shutil.rmtree(f / "images")),
}


@pytest.mark.parametrize("layout", ["transforms", "colmap"])
@pytest.mark.parametrize(("names", "change"), OTHER_PICTURES.values(), ids=OTHER_PICTURES.keys())
def test_other_pictures(good_captures, tmp_path, names, change, layout):
    assert_bad_input(good_captures, tmp_path, layout, change, names)


# ---------------------------------------------------------------------------------------------- Gaussians


def write_gaussians(folder: Path, count: int = 20) -> None:
    import torch

    draw = lambda *shape: torch.rand(*shape, generator=torch.Generator().manual_seed(0))
    made = Gaussians(draw(count, 3), draw(count, 4), draw(count, 3) - 4, draw(count), draw(count, 1, 3))
    save_ply(folder / "g.ply", made)
    (folder / "scene.yaml").write_text("gaussians: g.ply\n")


def convert_ply_to_text(folder: Path) -> None:
    from plyfile import PlyData

    read = PlyData.read(str(folder / "g.ply"), mmap=False)
    read.text = True
    read.write(str(folder / "g.ply"))


def edit_header(old: bytes, new: bytes) -> Change:
    def change(folder: Path) -> None:
        data = (folder / "g.ply").read_bytes()
        assert old in data
        (folder / "g.ply").write_bytes(data.replace(old, new, 1))

    return change


def halve_ply(folder: Path) -> None:
    data = (folder / "g.ply").read_bytes()
    (folder / "g.ply").write_bytes(data[: data.index(b"end_header") + (len(data) - data.index(b"end_header")) // 2])


PLY: dict[str, Change] = {
    "none": lambda folder: write_gaussians(folder, 0),
    "none, as text": do_all(lambda folder: write_gaussians(folder, 0), convert_ply_to_text),
    "half": halve_ply,
    "half, as text": do_all(convert_ply_to_text, halve_ply),
    "half a line, as text": do_all(convert_ply_to_text, truncate_file("g.ply", -40)),
    **{f"cut at {keep}": truncate_file("g.ply", keep) for keep in (0, 3, 10, 50, 200, -1)},
    "too many": edit_header(b"vertex 20", b"vertex 21"),
    "far too many": edit_header(b"vertex 20", b"vertex 99999999999999"),
    "fewer than none": edit_header(b"vertex 20", b"vertex -20"),
    "a word of them": edit_header(b"vertex 20", b"vertex many"),
    "no number of them": edit_header(b"vertex 20", b"vertex"),
    "no vertices": edit_header(b"element vertex", b"element points"),
    "no format": edit_header(b"format binary_little_endian 1.0\n", b""),
    "an unknown format": edit_header(b"binary_little_endian", b"binary_middle_endian"),
    "an unknown type": edit_header(b"property float x", b"property quad x"),
    "a list": edit_header(b"property float x", b"property list uchar float x"),
    "no opacity": edit_header(b"property float opacity", b"property float opaque"),
    "two of a property": edit_header(b"property float y", b"property float x"),
    "a property alone": edit_header(b"property float y", b"property"),
    "no end": edit_header(b"end_header", b"endheader!"),
    "other rest": edit_header(b"property float nx", b"property float f_rest_7"),
    "text with words": do_all(convert_ply_to_text, lambda folder: edit_header(b"\n0.", b"\nx.")(folder)),
    "a picture": write_file("g.ply", png_header(5, 5)),
    **{f"a {kind}": replace_by("g.ply", kind) for kind in ("folder", "pipe", "link")},
}


@pytest.mark.parametrize("change", PLY.values(), ids=PLY.keys())
def test_gaussians(good_captures, tmp_path, change):
    assert_bad_input(good_captures, tmp_path, "transforms", do_all(write_gaussians, change), "g.ply")


# ---------------------------------------------------------------------------------------------- references

KINDS: dict[str, Callable[[str], Change]] = {
    "empty": lambda name: write_file(name, b""),
    "text": lambda name: write_file(name, "deep"),
    "a folder": lambda name: replace_by(name, "folder"),
    "a pipe": lambda name: replace_by(name, "pipe"),
    "a link to nothing": lambda name: replace_by(name, "link"),
}


def write_truncated_exr(keep: int) -> Change:
    return do_all(lambda folder: save_exr(folder / "d.exr", NOISE[..., 0]), truncate_file("d.exr", keep))


DEPTH: dict[str, tuple[str, Change]] = {
    **{
        f"{ending}: {kind}": (f"d.{ending}", change(f"d.{ending}"))
        for ending in ("png", "exr", "npy", "tif")
        for kind, change in KINDS.items()
    },
    "8-bit": ("d.png", save_picture("d.png", NOISE[..., 0])),
    "colours": ("d.png", save_picture("d.png", NOISE)),
    "constant": ("d.npy", lambda f: np.save(f / "d.npy", np.ones((HEIGHT, WIDTH)))),
    "nothing known": ("d.npy", lambda f: np.save(f / "d.npy", np.full((HEIGHT, WIDTH), np.nan))),
    "three channels": ("d.npy", lambda f: np.save(f / "d.npy", np.ones((HEIGHT, WIDTH, 3)))),
    "no pixel": ("d.npy", lambda f: np.save(f / "d.npy", np.ones((0, WIDTH)))),
    "words": ("d.npy", lambda f: np.save(f / "d.npy", np.full((HEIGHT, WIDTH), "a"))),
    "complex": ("d.npy", lambda f: np.save(f / "d.npy", np.zeros((HEIGHT, WIDTH), complex))),
    "pickle": ("d.npy", lambda f: np.save(f / "d.npy", np.array([{}], object), allow_pickle=True)),
    "huge npy": ("d.npy", write_file("d.npy", npy_header("(1000000, 1000000)"))),
    "huge png": ("d.png", write_file("d.png", png_header(60_000, 60_000, 0))),
    **{f"EXR cut at {keep}": ("d.exr", write_truncated_exr(keep)) for keep in (4, 20, 100, 300, -400)},
}


@pytest.mark.parametrize(("name", "change"), DEPTH.values(), ids=DEPTH.keys())
def test_depth_maps(good_captures, tmp_path, name, change):
    """Depth maps of references. Either `poses` refuses the file by its header, or loading the file refuses it."""
    folder = tmp_path / "s"
    shutil.copytree(good_captures / "transforms", folder)
    change(folder)
    began = time.monotonic()
    with pytest.raises(BadInput, match=name):
        capture, roles = read_scene(poses.Params(), folder)
        spec = {"view": "v01", "image": "images/v01.png", "depth": name}
        found = load_reference_files(folder, capture_views(capture, roles), poses.Params(reference=spec).reference)
        load_depth(found[0].depth)
    assert time.monotonic() - began < LONGEST


@pytest.mark.parametrize("broken", BROKEN.values(), ids=BROKEN.keys())
def test_paintings(good_captures, tmp_path, broken):
    folder = tmp_path / "s"
    shutil.copytree(good_captures / "transforms", folder)
    (folder / "painted").mkdir()
    do_all(save_picture("painted/v01.png", NOISE), broken("painted/v01.png"))(folder)
    with pytest.raises(BadInput, match="v01"):
        capture, roles = read_scene(poses.Params(), folder)
        found = load_reference_files(folder, capture_views(capture, roles), None)
        load_image(found[0].path if found else ReferenceFile("v01", folder / "painted/v01.png").path)


# ---------------------------------------------------------------------------------- names that look like other types

NAMES = ["20220819_104425", "2022-08-19", "007", "1e3", "on", "null_"]


def test_names_that_look_like_numbers_or_dates_are_names(good_captures, tmp_path):
    folder, out = tmp_path / "s", tmp_path / "out"
    shutil.copytree(good_captures / "transforms", folder)
    for old, new in zip([f"v{k:02d}" for k in range(6)], NAMES, strict=True):
        for kind in ("images", "masks"):
            (folder / kind / f"{old}.png").rename(folder / kind / f"{new}.png")
        replace_in_file("transforms.json", f"images/{old}.png", f"images/{new}.png")(folder)
    shutil.copy(folder / "images/20220819_104425.png", folder / "12.png")
    write_yaml(
        "test: [2022-08-19, 007]\nclean: [on]\nreference: {view: 20220819_104425, image: 12.png, trust: off}\n"
        "budget: 90\nregion: {center: [0, 1, 0.5], size: [1, 2, 3]}\nstages: {fit: {iterations: 20}}"
    )(folder)
    assert first_message(folder, out) is None
    views = json.loads((out / "views.json").read_text())
    assert views["test"] == ["007", "2022-08-19"] and views["clean"] == ["on"] and "20220819_104425" in views["train"]
    shutil.rmtree(out)
    assert first_message(folder, out, "poses.test=[1e3]") is None
    assert json.loads((out / "views.json").read_text())["test"] == ["1e3"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_encodings_of_scene_yaml(tmp_path, encoding):
    file = tmp_path / "scene.yaml"
    file.write_bytes("masks: Maß\r\ntest: [images\\a.png]\r\n".encode(encoding))
    assert read_user_yaml(file, ()) == {"masks": "Maß", "test": ["images\\a.png"]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"stages:\n\tfit: {iterations: 200}\n", "line 2: a tab; YAML indents by blanks only"),
        (b"test:\n  - a\n\t- b\n", "line 3: a tab; YAML indents by blanks only"),
        (b"train: [a]\ntest: [~, b]", "line 2: `~` in a list means nothing; put it in quotes if it is a name"),
        (b"test:\n- a\n- null\n", "line 3: `null` in a list means nothing; put it in quotes if it is a name"),
        (b"test:\n- a\n-\n", "line 3: an empty entry in a list; name something, or remove it"),
        (b"images: \xe4\xf6", "save it as UTF-8"),
    ],
)
def test_messages_about_scene_yaml(tmp_path, content, message):
    (tmp_path / "scene.yaml").write_bytes(content)
    with pytest.raises(Refused) as error:
        read_user_yaml(tmp_path / "scene.yaml", ("stages",))
    assert str(error.value).endswith(message)


def test_backslashes_of_windows_in_scene_yaml():
    keys = SceneKeys.model_validate(
        {"images": ".\\a", "masks": {"folder": "m\\n"}, "reference": {"view": "v", "image": "p\\v.png"}}
    )
    assert isinstance(keys.masks, MaskSpec) and isinstance(keys.reference, ReferenceSpec)
    assert (keys.images, keys.masks.folder, keys.reference.image) == ("./a", "m/n", "p/v.png")
    assert SceneKeys(masks=".\\masks").mask_folder == "./masks"


# ---------------------------------------------------------------------------------------------- the command itself

QUICK = [  # refused before a stage checks its parameters
    ("scene.yaml", write_yaml(YAML["billion laughs"]), ""),
    ("scene.yaml", write_yaml(YAML["python tag"]), ""),
    ("scene.yaml", replace_by("scene.yaml", "pipe"), ""),
    ("scene.yaml", write_yaml("profile: [laptop]"), ""),
    ("set", lambda folder: None, "fit.iterations='5"),
]
ASKED = [
    ("scene.yaml", write_yaml("stages: {fit: {iterations: true}}"), ""),
    ("scene.yaml", write_yaml(YAML["region flat"]), ""),
    ("transforms.json", set_key("fl_x", "640"), ""),
    ("transforms.json", truncate_file("transforms.json", 100), ""),
    ("v01", write_file("images/v01.png", png_header(60_000, 60_000)), ""),
    ("v01", replace_by("images/v01.png", "pipe"), ""),
    ("g.ply", do_all(write_gaussians, halve_ply), ""),
    ("v00", write_yaml(YAML["reference of a test view"]), ""),
]
THROUGH_THE_COMMAND = [*QUICK, *(ASKED if SLOW else ASKED[:1])]


@pytest.mark.integration
@pytest.mark.parametrize(("names", "change", "set_"), THROUGH_THE_COMMAND)
def test_the_command_says_one_line_and_ends_with_2(good_captures, tmp_path, names, change, set_):
    folder, runs = tmp_path / "s", tmp_path / "runs"
    shutil.copytree(good_captures / "transforms", folder)
    (runs / "s" / "poses").mkdir(parents=True)
    (runs / "s" / "poses" / "kept.txt").write_text("earlier")
    change(folder)
    command = ("run", "poses", "--profile", "laptop", "--scene", folder, "--runs", runs, "--set", set_)
    ended = run_module("runner", *command, timeout=60)
    errors = [line for line in ended.stderr.splitlines() if line.startswith("error: ")]
    assert ended.returncode == 2 and len(errors) == 1 and names in errors[0], ended.stderr
    assert "Traceback" not in ended.stdout + ended.stderr
    assert (runs / "s" / "poses" / "kept.txt").read_text() == "earlier"
