"""LaMa and MI-GAN from files: the networks' input and output, and which files are refused.

The tests build stand-in networks with the inputs and outputs of the published files. A stand-in fills the hole with the
mean of all pixels outside the hole.
"""

import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from pydantic import ValidationError
from scenes.images import gradient_image, rectangle_mask
from scenes.networks import MeanInpainter
from scenes.references import write_wall_capture

from reffusion.inpaint import exemplar, feedforward
from reffusion.inpaint.onnx_model import Network
from reffusion.io.images import load_image
from reffusion.io.scene import load_mask_sets, load_references, load_scene
from reffusion.params import evaluate, lift
from reffusion.params.inpainter import Inpainter
from reffusion.params.reference import Params
from reffusion.weights import painters
from reffusion.weights.published import PAINTERS
from runner.keys import Hashes
from runner.plan import plan
from runner.resolve import Request
from runner.resolve import resolve as prepare_job
from stages import reference
from stages.plan import reference as plan_reference

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent
HEIGHT, WIDTH = 96, 136  # multiples of 8: the picture is not padded, so padding does not change the mean
SIDE = 32
PICTURE = gradient_image((HEIGHT, WIDTH), 2, 1)


def two_part_hole() -> np.ndarray:
    shape = (HEIGHT, WIDTH)
    return rectangle_mask(shape, (20, 40), (25, 65)) | rectangle_mask(shape, (30, 50), (50, 60))


# ------------------------------------------------------------------------------------------------------- the stand-ins


def write_onnx_model(path, kind="lama", side=None, answer=None, **changes):
    """Write an ONNX file with the inputs and outputs of LaMa or MI-GAN; return its path.

    Args:
        kind: "lama" or "migan".
        side: Height and width of the only size that the network accepts, in pixels. None if it accepts any size.
        answer: Factor on the output. None for the factor that this kind of network has.
        changes: Deviations from the published file: "names" (of image and mask input), "mask" (channels of the mask),
            "size" (height, width), "batch" (batch dimension), "outputs" (names of the outputs).
    """
    onnx = pytest.importorskip("onnx", reason="needs onnx and onnxruntime")
    pytest.importorskip("onnxruntime", reason="needs onnx and onnxruntime")
    helper, FLOAT = onnx.helper, onnx.TensorProto.FLOAT
    lama = kind == "lama"
    own = FLOAT if lama else onnx.TensorProto.UINT8
    size = changes.get("size", (side, side) if side else ("height", "width"))
    image, mask = changes.get("names", ("image", "mask"))
    batch = changes.get("batch", "batch" if lama else "batch_size")
    value = helper.make_tensor_value_info
    constants = {"full": 255.0, "one": 1.0, "scale": answer or (255.0 if lama else 1.0), "least": 1e-6}
    initial = [helper.make_tensor(name, FLOAT, [], [number]) for name, number in constants.items()]
    initial.append(helper.make_tensor("axes", onnx.TensorProto.INT64, [2], [2, 3]))
    node = lambda op, inputs, out, **more: helper.make_node(op, inputs, [out], **more)
    nodes = [node("Cast", [image], "shown", to=FLOAT), node("Cast", [mask], "said", to=FLOAT)]
    nodes += (
        [node("Identity", ["said"], "inner"), node("Sub", ["one", "said"], "known")]
        if lama
        else [node("Div", ["said", "full"], "known"), node("Sub", ["one", "known"], "inner")]
    )
    nodes += [
        node("Mul", ["shown", "known"], "kept"),
        node("ReduceSum", ["kept", "axes"], "sum"),
        node("ReduceSum", ["known", "axes"], "number"),
        node("Add", ["number", "least"], "count"),
        node("Div", ["sum", "count"], "mean"),
        node("Mul", ["mean", "inner"], "filled"),
        node("Add", ["kept", "filled"], "all"),
        node("Mul", ["all", "scale"], "scaled"),
        node("Cast", ["scaled"], "result", to=own),
    ]
    inputs = [value(image, own, [batch, 3, *size]), value(mask, own, [batch, changes.get("mask", 1), *size])]
    outputs = [value(name, own, None) for name in changes.get("outputs", ["result"])]
    graph = helper.make_graph(nodes, kind, inputs, outputs, initial)
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(made, str(path))
    return path


def write_torchscript_model(path):
    torch.jit.script(MeanInpainter()).save(path)
    return path


def inpainter_setting(kind, weights=None) -> dict:
    return {"kind": kind, "weights": weights and str(weights)}


def load_inpainter(kind, weights=None):
    return feedforward.load_inpainter(Inpainter(**inpainter_setting(kind, weights)))


# ---------------------------------------------------------------------------- the networks' input and output


@pytest.mark.parametrize("kind", ["lama", "migan"])
@pytest.mark.parametrize("side", [None, SIDE, 512])
def test_only_the_hole_changes_and_its_content_does_not_count(tmp_path, kind, side):
    painter = load_inpainter(kind, write_onnx_model(tmp_path / "net.onnx", kind, side))
    assert painter.name == {"lama": "LaMa (net.onnx)", "migan": "MI-GAN (net.onnx)"}[kind]
    image, inner = PICTURE, two_part_hole()
    painted = painter.paint(image, inner)
    assert painted.dtype == np.uint8 and (painted[~inner] == image[~inner]).all()
    place = feedforward.crop_around(inner, side) if side else (slice(None), slice(None))
    known = image[place][~inner[place]].mean(0)
    # If the output is resized, interpolation mixes colors at the border of the hole; compare away from the border.
    middle = cv2.erode(inner.astype(np.uint8), np.ones((9, 9))) > 0
    assert np.abs(painted[middle if side else inner] - known).max() < (1.01 if not side else 4)
    noise = np.random.default_rng(0).integers(0, 256, image.shape, np.uint8)
    assert (painter.paint(np.where(inner[..., None], noise, image), inner) == painted).all()
    assert (painter.paint(image, np.zeros_like(inner)) == image).all()
    assert (painted[inner][:, 2] >= 90).all(), "no black is scaled or blended into the rim"


def test_a_torchscript_lama_is_read_as_by_the_baselines(tmp_path):
    painter = load_inpainter("lama", write_torchscript_model(tmp_path / "big.pt").parent)
    painted = painter.paint(PICTURE, two_part_hole())
    assert painter.name == "LaMa (big.pt)" and (painted[two_part_hole()] == painted[two_part_hole()][0]).all()


def record_network_input(side, inner):
    """Return the input (picture, hole) that a network with input size `side` gets for the hole `inner`."""
    inputs = []

    def paint(image, mask):
        inputs.append((image, mask))
        return image

    feedforward.run_network(Network(side, paint), np.full((*inner.shape, 3), 77, np.uint8), inner)
    return inputs[0]


def test_a_fixed_size_sees_a_square_around_the_hole_with_as_much_again():
    inner = np.zeros((300, 400), bool)
    inner[100:140, 200:260] = True
    assert feedforward.crop_around(inner, 64) == (slice(60, 180), slice(170, 290))  # twice the size of the hole
    assert feedforward.crop_around(inner, 200) == (slice(20, 220), slice(130, 330))  # the size of the network's input
    assert feedforward.crop_around(inner, 512) == (slice(0, 300), slice(80, 380))  # at most the height of the picture
    inner[:] = False
    inner[290:, :20] = True
    assert feedforward.crop_around(inner, 64) == (slice(236, 300), slice(0, 64)), "at the picture's border"
    inner[10, :] = True
    assert feedforward.crop_around(inner, 64) == (slice(0, 300), slice(0, 400)), "longer than the picture is high"
    for side in (64, 512):
        image, mask = record_network_input(side, inner)
        assert image.shape == (side, side, 3) and mask.shape == (side, side) and (abs(image.astype(int) - 77) < 5).all()
        assert mask[int(10.5 * side / 400)].all(), "a line of one pixel is not lost"
    image, mask = record_network_input(None, inner[:, :397])
    assert image.shape == (304, 400, 3) and mask.shape == (304, 400), "any size: multiples of 8"


# ----------------------------------------------------------------------------------------------------- refused files


def test_other_models_are_refused_in_one_line(tmp_path):
    def refusal(kind, path):
        with pytest.raises(ValueError) as error:
            load_inpainter(kind, path)
        assert "\n" not in str(error.value) and path.name in str(error.value)
        return str(error.value)

    file = tmp_path / "net.onnx"
    expected = "expected image float32 [1, 3, H, W], mask float32 [1, 1, H, W], of any or one square size"
    message = refusal("lama", write_onnx_model(file, "migan"))
    assert expected in message and "it takes image uint8 [batch_size, 3, height, width]" in message
    assert "expected image uint8" in refusal("migan", write_onnx_model(file, "lama", 512))
    assert "it takes input float" in refusal("lama", write_onnx_model(file, names=("input", "mask")))
    for other in ({"mask": 3}, {"size": (512, 256)}, {"size": (512, "width")}, {"batch": 4}):
        assert expected in refusal("lama", write_onnx_model(file, **other))
    assert "one float32 picture" in refusal("lama", write_onnx_model(file, outputs=["result", "mean"]))
    file.write_text("<html>")
    assert "is no ONNX model that onnxruntime reads" in refusal("lama", file)
    fraction = load_inpainter("lama", write_onnx_model(file, answer=1.0))
    with pytest.raises(ValueError, match=r"net\.onnx: answers in \[0, 1\]; expected 0\.\.255"):
        fraction.paint(PICTURE, two_part_hole())
    poisoned = load_inpainter("lama", write_onnx_model(file, answer=float("inf")))
    with pytest.raises(ValueError, match="not finite"):
        poisoned.paint(PICTURE, two_part_hole())


def test_without_onnxruntime_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    (tmp_path / "lama_fp32.onnx").write_bytes(b"x")
    with pytest.raises(ValueError, match=r"lama_fp32.onnx needs onnxruntime: `pip install onnxruntime`"):
        load_inpainter("lama", tmp_path)
    (need,) = needed_weights("lama", tmp_path)
    assert "pip install onnxruntime" in need.problem and not need.can_download


# --------------------------------------------------------------------------------------------- the parameter, the stage


def needed_weights(kind, weights=None):
    return plan_reference.needed_weights(Params(inpainter=inpainter_setting(kind, weights)), frozenset())


@pytest.fixture
def empty_weight_cache(tmp_path, monkeypatch):
    """An empty cache of weights. The fixture is the cache's folder, in which models lie under owner/name."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hub"))
    monkeypatch.delenv("HF_HUB_CACHE", raising=False)
    return tmp_path / "cache" / "reffusion"


def write_published_model(empty_weight_cache, kind):
    """Write a stand-in network to the path where `make weights` stores the published file; return this path."""
    folder = empty_weight_cache / PAINTERS[kind].repo
    folder.mkdir(parents=True)
    return write_onnx_model(folder / PAINTERS[kind].file, kind)


def test_auto_takes_the_best_available_model(empty_weight_cache):
    auto, exemplar, diffusion = (Inpainter(kind=kind) for kind in ("auto", "exemplar", "diffusion"))
    assert painters.resolve_inpainter(auto) == exemplar and load_inpainter("auto") is None
    assert painters.inpainter_facts(auto) == {"inpainter": "exemplar"}
    write_published_model(empty_weight_cache, "migan")
    assert painters.resolve_inpainter(auto).kind == "migan" and painters.resolve_inpainter(exemplar) == exemplar
    before = painters.inpainter_facts(auto)
    file = write_published_model(empty_weight_cache, "lama")
    assert painters.resolve_inpainter(auto).kind == "lama" and painters.inpainter_facts(auto) != before
    assert load_inpainter("lama").name == load_inpainter("auto").name == "LaMa (lama_fp32.onnx)"
    assert painters.find_file(Inpainter(kind="lama")) == file
    assert painters.inpainter_facts(exemplar) == painters.inpainter_facts(diffusion) == {}, (
        "the default depends on no cache"
    )
    assert not needed_weights("auto") and load_inpainter("exemplar") is None and load_inpainter("diffusion") is None


@pytest.mark.parametrize(
    ("params", "value", "said"),
    [
        (Params, {"kind": "exemplar", "weights": "a.pt"}, "kind exemplar takes no `weights`, only lama, migan"),
        (Params, {"kind": "diffusion", "weights": "a/model"}, "`prior` names the diffusion prior"),
        (Params, {"weights": "a.pt"}, "write a kind, such as lama, or {kind: lama, weights: FILE}"),
        (Params, ["lama"], "write a kind, such as lama, or {kind: lama, weights: FILE}"),
        (Params, "fsr", "Input should be 'exemplar', 'diffusion', 'lama', 'migan', 'auto', 'moebius'"),
        (lift.Params, "auto", "Input should be 'fsr', 'lama', 'migan' or 'diffusion'"),
        (evaluate.Params, {"kind": "diffusion"}, "Input should be 'fsr', 'lama' or 'migan'"),
    ],
)
def test_the_setting_refuses_what_a_stage_cannot_do(params, value, said):
    with pytest.raises(ValidationError) as refused:
        params(inpainter=value)
    (error,) = refused.value.errors()
    assert said in error["msg"]


def test_a_plain_string_is_the_kind():
    assert Params(inpainter="lama") == Params(inpainter={"kind": "lama"}) != Params()
    assert Params().changed({"inpainter": "auto"}).inpainter.kind == "auto"


def test_the_key_of_scene_yaml_reaches_references_and_further_views(empty_weight_cache, tmp_path):
    scene = write_wall_capture(tmp_path / "wall")
    (scene / "scene.yaml").write_text("inpainter: auto\n")

    def machine():
        job = prepare_job(Request(ROOT, tmp_path / "runs", str(scene), profile="laptop"))
        assert all(job.params[stage]["inpainter"]["kind"] == "auto" for stage in ("reference", "initialize"))
        return [job.stages[stage].machine for stage in ("reference", "initialize")]

    assert machine() == [{"inpainter": "exemplar"}] * 2
    write_published_model(empty_weight_cache, "lama")
    first, second = machine()
    assert first == second and first["inpainter"].startswith("lama ")


def test_the_file_is_found_or_the_plan_says_where_people_get_it(empty_weight_cache, tmp_path):
    (need,) = needed_weights("lama")
    assert (need.name, need.files, need.can_download) == ("Carve/LaMa-ONNX", ("lama_fp32.onnx",), True)
    assert "Carve/LaMa-ONNX is not on this machine" in need.problem and "make weights" in need.problem
    (need,) = needed_weights("lama", tmp_path / "nowhere.onnx")
    assert not need.can_download and "is not on this machine; get lama_fp32.onnx (208 MB" in need.problem
    (need,) = needed_weights("migan", write_torchscript_model(tmp_path / "big.pt"))
    assert "is no .onnx file; get migan_pipeline_v2.onnx" in need.problem
    (need,) = needed_weights("lama", tmp_path)
    assert need.problem is None and need.name == str(tmp_path / "big.pt") and need.bytes > 0
    assert painters.find_file(Inpainter(**inpainter_setting("lama", tmp_path))) == tmp_path / "big.pt"
    shutil.copy(tmp_path / "big.pt", tmp_path / "other.pt")
    (need,) = needed_weights("lama", tmp_path)
    assert r"holds 2 .pt or .onnx files (big.pt, other.pt); name one" in need.problem
    params = Params(inpainter=inpainter_setting("lama", tmp_path), prompt="a vase")
    (note,) = plan_reference.preview(params, scene=tmp_path)
    assert "by LaMa, one picture" in note and "'a vase' is not read" in note
    assert not plan_reference.needed_weights(params, frozenset({"painted"}))


def test_a_model_file_is_checked_before_any_work_and_keyed_by_content(empty_weight_cache, tmp_path):
    scene, file = write_wall_capture(tmp_path / "wall"), tmp_path / "big.pt"

    def planned(inpainter):
        setting = f"'reference.inpainter={inpainter}'"
        job = prepare_job(Request(ROOT, tmp_path / "runs", str(scene), profile="laptop", set=setting))
        assert job.params["initialize"]["inpainter"] == job.params["reference"]["inpainter"]
        found = plan(job, job.pipeline.closure("reference"))["reference"]
        return found.status, found.reason

    word, reason = planned(f"{{kind: lama, weights: {file}}}")
    assert word == "missing" and f"reference.inpainter.weights: no weights at {file}; name a folder, a file" in reason
    word, reason = planned("lama")
    assert word == "missing" and "Carve/LaMa-ONNX is not on this machine" in reason and "(208 MB)" in reason
    write_torchscript_model(file)
    assert planned(f"{{kind: lama, weights: {file}}}")[0] == "pending", "it waits for masks"
    hashes = Hashes(tmp_path / "hashes.json")
    before = hashes.weights(file)
    file.write_bytes(file.read_bytes() + b"more")
    assert hashes.weights(file) != before


@pytest.mark.parametrize("kind", ["lama", "migan"])
def test_the_stage_paints_the_hole_in_one_pass(wall_folders, tmp_path, kind):
    file = (
        write_torchscript_model(tmp_path / "big.pt")
        if kind == "lama"
        else write_onnx_model(tmp_path / "pipeline.onnx", "migan")
    )
    out = tmp_path / "out"
    out.mkdir()
    reference.run(Params(inpainter=inpainter_setting(kind, file)), out, **wall_folders)
    (found,) = load_references(out, load_scene(wall_folders["poses"]))
    pixels = load_mask_sets(wall_folders["masks"], ["a2"])["a2"]
    inner = exemplar.mask_to_paint(pixels.consistent, pixels.invent)
    assert found.camera.name == "a2" and np.array_equal(found.mask, pixels.invent)
    assert np.ptp(found.image[inner].astype(int), axis=0).max() <= 1, "the stand-in's mean"
    outside = ~inner & ~pixels.consistent
    assert np.array_equal(found.image[outside], load_image(wall_folders["poses"] / "images" / "a2.png")[outside])
    assert np.array_equal(load_image(out / "candidates.png"), found.image)
    name = {"lama": "LaMa (big.pt)", "migan": "MI-GAN (pipeline.onnx)"}[kind]
    record = json.loads((out / "candidates.json").read_text())
    assert record == {"view": "a2", "painter": name, "chosen": 0}
