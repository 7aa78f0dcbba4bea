"""2D inpainters change only the hole and ignore the hole's content; LaMa gets the input that LaMa expects."""

import numpy as np
import pytest
import torch
from scenes.images import gradient_image, rectangle_mask
from scenes.networks import MeanInpainter

from reffusion import morphology
from reffusion.distill import perceptual
from reffusion.inpaint import classical
from reffusion.seeding import generator

HEIGHT, WIDTH = 37, 50
PICTURE = gradient_image((HEIGHT, WIDTH), 3, 4)
HOLE = rectangle_mask((HEIGHT, WIDTH), (12, 24), (15, 36))


class WrongSizeInpainter(torch.nn.Module):
    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return image[:, :, 1:]


def load_inpainters(folder):
    torch.jit.script(MeanInpainter()).save(folder / "any-name.pt")
    return [
        classical.load_lama(folder / "any-name.pt"),
        classical.load_classical(),
        classical.Painter("telea", classical.telea),
    ]


def test_only_the_hole_changes_and_its_content_does_not_count(tmp_path):
    image, noise = PICTURE, np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    poisoned = np.where(HOLE[..., None], noise, image)
    for painter in load_inpainters(tmp_path):
        painted = painter.paint(image, HOLE)
        assert (painted[~HOLE] == image[~HOLE]).all() and painted.dtype == np.uint8, painter.name
        assert (painter.paint(poisoned, HOLE) == painted).all(), painter.name
        assert (painter.paint(image, np.zeros_like(HOLE)) == image).all(), painter.name


def test_a_mask_is_widened_by_a_share_of_the_width():
    wide = morphology.dilate(HOLE, 0.04)  # the share 0.04 of the width of 50 px is 2 px
    assert (wide[10:26, 25]).all() and not wide[9, 25] and not wide[26, 25] and wide[18, 13] and not wide[18, 12]
    assert (morphology.dilate(HOLE, 0) == HOLE).all() and not morphology.dilate(np.zeros_like(HOLE), 0.1).any()


def test_a_smooth_picture_is_continued():
    for painter in (classical.load_classical(), classical.Painter("telea", classical.telea)):
        error = np.abs(painter.paint(PICTURE, HOLE).astype(int) - PICTURE)[HOLE]
        assert error.mean() < 12, painter.name


def test_large_pictures_are_painted_small_by_fsr():
    rows, columns = np.mgrid[:300, :400]
    image = np.stack([rows // 3, columns // 3, 0 * rows + 50], -1).astype(np.uint8)
    mask = np.zeros((300, 400), bool)
    mask[100:160, 150:260] = True
    painted = classical.fsr(image, mask)
    assert (painted[~mask] == image[~mask]).all() and np.abs(painted.astype(int) - image)[mask].mean() < 10


def test_lama_is_fed_and_named(tmp_path):
    lama, fallback, *_ = load_inpainters(tmp_path)
    assert lama.name == "LaMa (any-name.pt)" and fallback.name.startswith("OpenCV")
    painted = lama.paint(PICTURE, HOLE)[HOLE]
    assert (painted == painted[0]).all() and abs(int(painted[0, 2]) - 100) <= 1


def test_weights_that_are_none_are_refused(tmp_path):
    file = tmp_path / "a.pt"
    file.write_text("no module")
    with pytest.raises(ValueError, match=r"a.pt is no TorchScript module"):
        classical.load_lama(file)
    torch.jit.script(WrongSizeInpainter()).save(file)
    with pytest.raises(ValueError, match="the module's answer"):
        classical.load_lama(file).paint(PICTURE, HOLE)


def test_the_stand_in_for_lpips_is_named_as_such_and_measures_structure(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    name, distance = perceptual.load()
    assert name.startswith("multi-scale D-SSIM (no weights of LPIPS (vgg)")
    target = torch.rand(32, 32, 3, generator=generator(0))
    assert float(distance(target, target)) == pytest.approx(0, abs=1e-5)
    brighter, other = target * 0.8 + 0.2, torch.rand(32, 32, 3, generator=generator(1))
    assert 0 < float(distance(brighter, target)) < 0.3 < float(distance(other, target))
    render = other.clone().requires_grad_()
    distance(render, target).backward()
    step = 1e-3 * torch.randn(32, 32, 3, generator=generator(2))
    slope = float((render.grad * step).sum())
    found = float(distance(other + step, target) - distance(other - step, target))
    assert found == pytest.approx(2 * slope, rel=0.05)
    with pytest.raises(ValueError, match="11 px"):
        distance(target[:10], target[:10])
