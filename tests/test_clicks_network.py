"""The segmentation network of the mask page: the real architecture, small and with random weights."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from scenes import wall_scene

from reffusion.clicks.marks import Clicks
from reffusion.clicks.network import encode_image, load_segmenter, make_segmenter, predict_mask
from report.mask_session import Capture, Session

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


def test_loaded_from_a_folder_it_answers_as_the_model_saved(sam_folder):
    from transformers import SamModel

    image, clicks = noise_image((40, 60)), Clicks(np.array([[20.0, 10.0], [50.0, 30.0]]), np.array([True, False]))
    loaded, own = load_segmenter(sam_folder), make_segmenter(SamModel.from_pretrained(sam_folder))
    found = predict_mask(loaded, encode_image(loaded, image), clicks)
    assert found.shape == (40, 60) and found.dtype == bool
    assert (found == predict_mask(own, encode_image(own, image), clicks)).all()


def test_clicks_and_answers_are_in_the_pictures_pixels(sam_folder):
    segmenter = load_segmenter(sam_folder)
    asked = []
    segmenter.model.prompt_encoder.register_forward_pre_hook(lambda _, __, said: asked.append(said), with_kwargs=True)

    def right_of_the_click(_, __, answer):
        columns = (torch.arange(answer.pred_masks.shape[-1]) + 0.5) * SIDE / answer.pred_masks.shape[-1]
        answer.pred_masks[:] = columns - asked[-1]["input_points"][0, 0, 0, 0]
        return answer

    segmenter.model.register_forward_hook(right_of_the_click)
    for size in (1, 3):
        image, at = noise_image((36 * size, 48 * size)), np.array([[30.0, 9.0]]) * size
        found = predict_mask(segmenter, encode_image(segmenter, image), Clicks(at, np.array([True])))
        assert np.allclose(asked[-1]["input_points"].numpy(), [40.0, 12.0])
        assert (found == (np.arange(48 * size) + 0.5 > 30 * size)).all()


def test_no_click_on_the_object_is_no_mask(sam_folder):
    segmenter = load_segmenter(sam_folder)
    looked = encode_image(segmenter, noise_image((20, 20)))
    assert not predict_mask(segmenter, looked, Clicks(np.array([[3.0, 3.0]]), np.array([False]))).any()


def test_weights_that_are_not_here_are_none_and_others_are_refused(sam_folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert load_segmenter("somebody/segments") is None
    with pytest.raises(ValueError, match=r"config\.json"):
        load_segmenter(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "clip"}))
    with pytest.raises(ValueError, match="type 'clip'"):
        load_segmenter(tmp_path)


def test_the_page_asks_the_network_and_takes_back_without_it(sam_folder, tmp_path):
    placed, fit, _ = wall_scene.write_poses_and_fit(tmp_path / "scene", 1.7, masks={})
    wall_scene.write_capture_photos(tmp_path / "scene/given", placed, wall_scene.CAMERAS)
    segmenter = load_segmenter(sam_folder)
    session = Session(Capture(tmp_path, tmp_path / "masks", placed, fit, {}), lambda: False, segmenter)
    name, at = session.views[0], (10.0, 12.0)
    session.click(name, [(*at, True)])
    expected = predict_mask(
        segmenter, encode_image(segmenter, session.images[name]), Clicks(np.array([at]), np.array([True]))
    )
    assert (session.masks[name] == expected).all()
    session.click(session.views[1], [(*at, False)])
    assert set(session.embeddings) == {name}
