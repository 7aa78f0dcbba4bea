"""The monocular depth network: loading, preprocessing, disparity, and the refusal of unusable weights."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import wall_scene
from scenes.networks import small_depth_model

from reffusion.depth import monocular
from reffusion.depth.background_depth import CompletionSettings, ViewDepth
from reffusion.initialize import unprojection
from reffusion.seeding import generator
from reffusion.splat import rasterizer
from reffusion.types import Reference

TINY = Path(__file__).resolve().parent.parent / "priors" / "tiny"


@pytest.fixture(scope="module")
def depth_model_folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("network")
    small_depth_model().save_pretrained(path)
    return path


@pytest.fixture(scope="module")
def network(depth_model_folder):
    return monocular.load_network(depth_model_folder)


def random_smooth_image(height, width, seed=0):
    coarse = torch.rand(1, 3, 5, 7, generator=generator(seed, "picture"))
    smooth = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear")[0]
    return (smooth * 255).round() / 255


@pytest.mark.parametrize("size", [(48, 64), (64, 48), (200, 60), (56, 56), (3, 5)])
def test_a_picture_is_prepared_as_the_models_own_processor_does(network, size):
    from transformers.models.dpt.image_processing_pil_dpt import DPTImageProcessorPil

    own = DPTImageProcessorPil(
        size={"height": 56, "width": 56}, ensure_multiple_of=14, keep_aspect_ratio=True,
        image_mean=list(monocular.MEAN), image_std=list(monocular.DEVIATION),
    )  # fmt: skip
    image = random_smooth_image(*size)
    expected = own((image * 255).byte().numpy(), return_tensors="pt", input_data_format="channels_first").pixel_values
    prepared = monocular.preprocess(network, image)
    assert prepared.shape == expected.shape
    assert (prepared - expected).abs().max() < 0.02  # the processor rounds to 8 bits: half a level is 0.009


def test_disparity_has_the_pictures_size_and_repeats(network, depth_model_folder):
    image = random_smooth_image(48, 64)
    first = monocular.predict_disparity(network, image)
    assert first.shape == (48, 64) and torch.isfinite(first).all() and first.std() > 0
    assert (first == monocular.predict_disparity(monocular.load_network(depth_model_folder), image)).all()
    assert (first != monocular.predict_disparity(network, random_smooth_image(48, 64, 1))).any()
    with pytest.raises(ValueError, match=r"\[3, H, W\]"):
        monocular.predict_disparity(network, image[None])


def test_a_metric_model_is_inverted(network):
    model = small_depth_model("metric")
    image = random_smooth_image(48, 64)
    answer = model(pixel_values=monocular.preprocess(network, image)).predicted_depth
    found = monocular.predict_disparity(monocular.make_network(model), image)
    inverse = 1 / answer[None].clamp(1e-6, 1e6)
    expected = torch.nn.functional.interpolate(inverse, (48, 64), mode="bilinear")[0, 0].detach()
    torch.testing.assert_close(found, expected)


def test_refusals_name_what_is_wrong(tmp_path, depth_model_folder):
    with pytest.raises(ValueError, match="no such folder"):
        monocular.load_network(tmp_path / "nothing")
    with pytest.raises(ValueError, match=r"lacks config\.json"):
        monocular.load_network(tmp_path)
    with pytest.raises(ValueError, match="clip_text_model"):
        monocular.load_network(TINY / "text_encoder")
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ValueError, match=r"leave `depth\.model` empty"):
        monocular.load_network(tmp_path)
    shutil.copy(depth_model_folder / "config.json", tmp_path)
    with pytest.raises(ValueError, match=r"leave `depth\.model` empty"):
        monocular.load_network(tmp_path)  # a configuration without weights
    with pytest.raises(ValueError, match=r"leave `depth\.model` empty"):
        monocular.load_network("nobody/nothing-at-all")


def test_the_references_depth_is_the_estimate_aligned():
    """A disparity estimate with the wrong scale and offset still gives the true depth of the wall in the hole.

    The stage `initialize` aligns the estimate to the depth outside the hole.
    """
    view = wall_scene.CAMERAS["a2"]
    gaussians, labels = wall_scene.wall_and_square(1.7)
    hole = wall_scene.true_mask(view, 1.7)
    reference = Reference(view, wall_scene.photo(view), hole)
    remaining = gaussians.map(lambda p: p[~labels])
    # The wall is tilted about the image's middle: a wall parallel to the image has a single disparity, and no scale can
    # be fitted to a single value.
    means = remaining.means.clone()
    means *= 1 / (1 - 0.2 * means[:, 1:2] / wall_scene.WALL)
    height = (np.mgrid[: wall_scene.HEIGHT, : wall_scene.WIDTH][0] + 0.5 - wall_scene.HEIGHT / 2) / wall_scene.FOCAL
    true = (1 - 0.2 * height) / wall_scene.WALL
    tilted = rasterizer.render(replace(remaining, means=means), reference.camera)
    behind_it = lambda estimate: unprojection.estimate_depth(
        tilted, reference, hole, hole, np.zeros((0, 3)), CompletionSettings(), estimate
    )
    _, made_up, message = behind_it(50 * true - 3)
    assert "aligned" in message
    np.testing.assert_allclose(made_up[hole], 1 / true[hole], rtol=0.02)
    with pytest.raises(ValueError, match="reference a2: the estimate falls"):
        behind_it(-true)


def test_the_stage_shows_the_model_the_reference(network):
    from reffusion.initialize.fill import _predict_disparity

    view = wall_scene.CAMERAS["a2"]
    reference = Reference(view, wall_scene.photo(view), np.zeros((wall_scene.HEIGHT, wall_scene.WIDTH), bool))
    image = torch.from_numpy(reference.image).permute(2, 0, 1) / 255
    assert (_predict_disparity(network, reference) == monocular.predict_disparity(network, image).numpy()).all()
    assert _predict_disparity(None, reference) is None


def test_the_depth_term_asks_the_model_of_its_parameter(depth_model_folder, network):
    """The scene's disparity is the model's own answer, scaled and shifted; the estimator must find it in the hole."""
    from reffusion.distill.depth_estimator import build_estimator
    from reffusion.params.distill import Params

    view, image = wall_scene.CAMERAS["a2"], random_smooth_image(wall_scene.HEIGHT, wall_scene.WIDTH)
    true = 2.0 + 0.3 * monocular.predict_disparity(network, image).double().numpy()
    hole = wall_scene.true_mask(view, 1.7)
    seen = ViewDepth(view, np.where(hole, 0.0, 1 / true), ~hole, hole, hole, np.zeros_like(hole))
    estimator = build_estimator(Params(depth={"model": str(depth_model_folder)}), np.zeros((0, 3)))
    np.testing.assert_allclose(estimator.disparity(seen, lambda: image.permute(1, 2, 0).numpy()), true, rtol=1e-6)
