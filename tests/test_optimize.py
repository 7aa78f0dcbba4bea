"""Optimization of Gaussians: reconstruction loss, confinement of gradients, Adam, densification.

Confinement limits the gradients of a loss to selected Gaussians. Adam works on a set of Gaussians that changes.
"""

import numpy as np
import pytest
import torch
from scenes.cameras import make_camera

from reffusion import seeding
from reffusion.gaussians import ssim
from reffusion.gaussians.adam import Update, adam, adam_cpu
from reffusion.gaussians.densify import SHRINK, densify, prune, rotate, split
from reffusion.gaussians.optimize import (
    GaussianOptimizer,
    Rates,
    confine,
    reconstruction_loss,
)
from reffusion.gaussians.ssim import dssim, dssim_torch
from reffusion.splat.rasterizer import render
from reffusion.types import PARAMETERS, Camera, Gaussians


def gaussians_near_origin(count: int, degree: int = 1, seed: int = 0, scale: float = 0.05) -> Gaussians:
    draw = lambda *shape: torch.randn(*shape, generator=generator)
    generator = seeding.generator(seed, "test")
    return Gaussians(
        means=draw(count, 3) * 0.2,
        quaternions=draw(count, 4),
        log_scales=np.log(scale) + 0.3 * draw(count, 3),
        opacity_logits=draw(count),
        sh=draw(count, (degree + 1) ** 2, 3) * 0.3,
    )


def unit_camera(width: int = 24, height: int = 18) -> Camera:
    """Return a camera at distance 1 from the origin that looks at the origin; its focal length is the image width."""
    return make_camera("view", (width, height), float(width), (0.0, 0.0, -1.0))


def noisy_images(height: int = 23, width: int = 31, channels: int = 3):
    generator = seeding.generator(1, "pictures")
    image = torch.rand(height, width, channels, generator=generator)
    target = (image + 0.2 * torch.randn(image.shape, generator=generator)).clamp(0, 1)
    return image, target, torch.rand(height, width, generator=generator) > 0.4


# ---------------------------------------------------------------------------------------------- loss


def test_ssim_is_the_formula_of_wang_et_al():
    """The value is that of scikit-image. The images differ only in the middle, so no window at a border counts."""
    from skimage.metrics import structural_similarity

    image, target, _ = noisy_images(40, 44)
    differs = torch.zeros(40, 44, 1, dtype=torch.bool)
    differs[10:-10, 10:-10] = True
    target = torch.where(differs, target, image)
    _, similarity = structural_similarity(
        image.double().numpy(), target.double().numpy(), channel_axis=2, data_range=1.0, gaussian_weights=True,
        sigma=1.5, use_sample_covariance=False, full=True,
    )  # fmt: skip
    assert abs(dssim(image, target).item() - (1 - similarity.mean())) < 1e-6


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("kind", ["all", "mask", "soft"])
def test_kernel_agrees_with_plain_torch_in_float64(channels, kind):
    image, target, mask = noisy_images(channels=channels)
    weights = {"all": None, "mask": mask, "soft": mask * torch.rand(mask.shape)}[kind]
    fast, exact = image.clone().requires_grad_(), image.double().requires_grad_()
    value = dssim(fast, target, weights)
    oracle = dssim_torch(exact, target.double(), None if weights is None else weights.double())
    (3 * value).backward()
    (3 * oracle).backward()
    assert abs(value.item() - oracle.item()) < 1e-6
    assert (fast.grad - exact.grad).abs().max() < 1e-5 * exact.grad.abs().max()


def test_loss_gradient_by_finite_differences():
    image, target, mask = noisy_images(7, 6, 1)
    for weights in (None, mask, mask.double() * 0.7):
        loss = lambda x, w=weights: reconstruction_loss(x, target.double(), w)
        assert torch.autograd.gradcheck(loss, image.double().requires_grad_())


@pytest.mark.parametrize("junk", [0.0, 1.0, 1e30, float("nan"), float("inf")])
def test_masked_pixels_have_no_influence_at_all(junk):
    image, target, mask = noisy_images()
    clean, dirty = image.clone(), image.clone()
    dirty[~mask] = junk
    values, gradients = [], []
    for picture, truth in ((clean, target), (dirty, torch.where(mask[..., None], target, junk))):
        leaf = picture.requires_grad_()
        loss = reconstruction_loss(leaf, truth, mask)
        loss.backward()
        values.append(loss.item())
        gradients.append(leaf.grad)
    assert values[0] == values[1]
    assert torch.equal(gradients[0], gradients[1])
    assert torch.all(gradients[0][~mask] == 0)
    assert gradients[0][mask].abs().sum() > 0


def test_wholly_masked_and_perfect_views_give_zero():
    image, target, mask = noisy_images()
    leaf = image.clone().requires_grad_()
    loss = reconstruction_loss(leaf, target, torch.zeros_like(mask))
    loss.backward()
    assert loss.item() == 0 and torch.all(leaf.grad == 0)
    assert abs(reconstruction_loss(target, target).item()) < 1e-6


def test_large_images_in_one_value():
    """1 - SSIM of two opposite checkerboards is almost 2, its largest value."""
    rows = torch.arange(40)[:, None] + torch.arange(40)[None]
    checker = (rows % 2).float()[..., None]
    assert 1.9 < dssim(checker, 1 - checker).item() <= 2.0


def test_ssim_is_never_computed_in_tf32(monkeypatch):
    """TF32 is off in the forward and the backward pass. Its flag is restored afterwards, also after an exception."""
    seen, convolve = [], torch.nn.functional.conv2d

    def watched(*arguments, **options):
        seen.append(torch.backends.cudnn.allow_tf32)
        return convolve(*arguments, **options)

    monkeypatch.setattr(ssim.F, "conv2d", watched)
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", True)
    image = torch.rand(20, 30, 3, dtype=torch.float64, requires_grad=True)
    dssim(image, torch.rand(20, 30, 3, dtype=torch.float64)).backward()
    assert len(seen) == 4 and not any(seen) and torch.backends.cudnn.allow_tf32
    with pytest.raises(ZeroDivisionError), ssim.no_tf32():
        raise ZeroDivisionError
    assert torch.backends.cudnn.allow_tf32


# ---------------------------------------------------------------------------------------------- confine


def test_confined_rows_receive_exactly_nothing():
    leaves = gaussians_near_origin(30).map(lambda p: p.requires_grad_())
    select = torch.arange(30) % 3 == 0
    rendering = render(confine(leaves, select), unit_camera(), impl="torch")
    (rendering.color.square().sum() + rendering.depth.sum() + rendering.alpha.sum()).backward()
    for name in PARAMETERS:
        gradient = getattr(leaves, name).grad
        assert torch.all(gradient[~select] == 0), name
        if name != "quaternions":
            assert gradient[select].abs().sum() > 0, name


def test_confine_stops_even_nan():
    leaves = gaussians_near_origin(4).map(lambda p: p.requires_grad_())
    select = torch.tensor([True, False, True, False])
    (confine(leaves, select).means * torch.tensor([[1.0], [float("nan")], [1.0], [float("inf")]])).sum().backward()
    assert torch.equal(leaves.means.grad, torch.tensor([[1.0], [0.0], [1.0], [0.0]]).expand(4, 3))


def test_confine_leaves_the_picture_alone():
    gaussians = gaussians_near_origin(20)
    seen = render(gaussians, unit_camera(), impl="torch").color
    confined = confine(gaussians, torch.zeros(20, dtype=torch.bool))
    assert torch.equal(render(confined, unit_camera(), impl="torch").color, seen)


# ---------------------------------------------------------------------------------------------- Adam


def set_random_gradients(optimizer: GaussianOptimizer, step: int) -> None:
    for name in PARAMETERS:
        parameter = getattr(optimizer.gaussians, name)
        parameter.grad = torch.randn(parameter.shape, generator=seeding.generator(step, name))


def test_adam_is_torch_adam_where_all_are_visible():
    start, rates, steps = gaussians_near_origin(17, degree=2), Rates(), 12
    ours = GaussianOptimizer(start, rates=rates)
    theirs = {name: getattr(start, name).clone().requires_grad_() for name in PARAMETERS}
    dc, rest = start.sh[:, :1].clone().requires_grad_(), start.sh[:, 1:].clone().requires_grad_()
    groups = [{"params": [theirs[name]], "lr": getattr(rates, name)} for name in PARAMETERS[:-1]]
    groups += [{"params": [dc], "lr": rates.sh_dc}, {"params": [rest], "lr": rates.sh_rest}]
    reference = torch.optim.Adam(groups, eps=1e-15)
    for i in range(steps):
        set_random_gradients(ours, i)
        for name in PARAMETERS[:-1]:
            theirs[name].grad = getattr(ours.gaussians, name).grad.clone()
        dc.grad, rest.grad = ours.gaussians.sh.grad[:, :1].clone(), ours.gaussians.sh.grad[:, 1:].clone()
        reference.param_groups[0]["lr"] = rates.means * (rates.means_last / rates.means) ** (i / steps)
        reference.step()
        ours.step(i / steps)
    theirs["sh"] = torch.cat([dc, rest], 1)
    for name in PARAMETERS:
        moved = (theirs[name] - getattr(start, name)).abs().max()
        assert (getattr(ours.gaussians, name) - theirs[name]).abs().max() < 1e-4 * moved, name


def test_plain_and_compiled_adam_agree():
    generator = seeding.generator(3, "adam")
    steps, visible = torch.arange(1500, dtype=torch.int32) % 40, torch.rand(1500, generator=generator) > 0.3
    masked, unbias = torch.rand(1500, generator=generator) > 0.5, list(1 + torch.rand(2, 40, generator=generator))
    results = []
    for step, dtype in ((adam, torch.float64), (adam_cpu, torch.float32)):
        generator = seeding.generator(3, "parameters")
        updates = []
        for width in (1, 3, 27):
            rows = [torch.randn(1500, width, generator=generator).to(dtype) for _ in range(4)]
            rows[2].abs_().add_(0.1)
            updates.append(Update(*rows, torch.rand(width, generator=generator), masked_factor=1 / width))
        step(updates, steps, visible, masked, *unbias, 0.875, 1 - 2**-10, 1e-15)  # betas that float32 holds exactly
        results.append([tensor.float() for update in updates for tensor in update[:3]])
    for plain, compiled in zip(*results, strict=True):
        assert torch.allclose(plain, compiled, rtol=1e-5, atol=1e-6)


def test_against_epsilon_a_gradient_is_large_or_small():
    steps = []
    for size in (1e-3, 1e-9):
        optimizer = GaussianOptimizer(gaussians_near_origin(6), epsilon=1e-6)
        before = optimizer.gaussians.means.detach().clone()
        for name in PARAMETERS:
            getattr(optimizer.gaussians, name).grad = torch.full_like(getattr(optimizer.gaussians, name), size)
        optimizer.step(0.0)
        steps.append(float((optimizer.gaussians.means - before).abs().mean()) / Rates().means)
    assert abs(steps[0] - 1) < 0.01 and abs(steps[1] - 1e-3) < 1e-4


def test_unseen_gaussians_stay_and_late_ones_start_afresh():
    optimizer = GaussianOptimizer(gaussians_near_origin(6))
    visible = torch.tensor([True, True, True, False, False, False])
    before = optimizer.gaussians.map(lambda p: p.detach().clone())
    for i in range(5):
        set_random_gradients(optimizer, i)
        optimizer.step(0.0, visible)
    assert torch.equal(optimizer.gaussians.means[3:], before.means[3:])
    assert not torch.equal(optimizer.gaussians.means[:3], before.means[:3])
    set_random_gradients(optimizer, 9)
    sign = optimizer.gaussians.means.grad.sign()
    optimizer.step(0.0)
    # The first Adam step of a Gaussian has the length of the step size and the gradient's sign, at any iteration.
    first = optimizer.gaussians.means[3:] - before.means[3:]
    assert torch.allclose(first, -Rates().means * sign[3:], rtol=1e-2)


def test_state_continues_bit_for_bit():
    unbroken = GaussianOptimizer(gaussians_near_origin(9), masked=torch.arange(9) % 2 == 0)
    for i in range(3):
        set_random_gradients(unbroken, i)
        unbroken.step(i / 6)
    resumed = GaussianOptimizer(gaussians_near_origin(2))
    resumed.load_state_dict(unbroken.state_dict())
    for optimizer in (unbroken, resumed):
        for i in range(3, 6):
            set_random_gradients(optimizer, i)
            optimizer.step(i / 6, torch.arange(9) < 7)
    for name in PARAMETERS:
        assert torch.equal(getattr(unbroken.gaussians, name), getattr(resumed.gaussians, name))
    assert torch.equal(unbroken.masked, resumed.masked)


# ---------------------------------------------------------------------------------------------- densification


def test_the_mean_of_what_was_remembered():
    """The mean of the remembered parameters follows a removal of Gaussians and is part of a checkpoint.

    After Gaussians were added, no mean is left, and `apply_mean` changes nothing.
    """
    optimizer, seen = GaussianOptimizer(gaussians_near_origin(6)), []
    optimizer.apply_mean()  # nothing was remembered, so nothing changes
    for step in range(4):
        set_random_gradients(optimizer, step)
        optimizer.step(0.0)
        if step != 1:
            optimizer.remember()
            seen.append(optimizer.gaussians.map(torch.clone))
    keep = torch.tensor([True, False, True, True, False, True])
    optimizer.select(keep)
    other = GaussianOptimizer(gaussians_near_origin(4))
    other.load_state_dict(optimizer.state_dict())
    other.apply_mean()
    for name in PARAMETERS:
        mean = torch.stack([getattr(each, name).double() for each in seen]).mean(0)[keep]
        assert torch.allclose(getattr(other.gaussians, name).double(), mean, atol=1e-6), name
    last = optimizer.gaussians.means.detach().clone()
    optimizer.append(gaussians_near_origin(2), torch.zeros(2, dtype=torch.bool))
    optimizer.apply_mean()
    assert torch.equal(optimizer.gaussians.means[:4], last)


def optimizer_with_slopes(gaussians: Gaussians, slopes: list[float], masked=None) -> GaussianOptimizer:
    optimizer = GaussianOptimizer(gaussians, masked)
    optimizer.grad2d_sum = torch.tensor(slopes) * 4
    optimizer.grad2d_count = torch.full((len(slopes),), 4, dtype=torch.int32)
    return optimizer


def test_labels_and_moments_follow_through_clone_split_and_prune():
    start = gaussians_near_origin(5, scale=0.005)
    start.log_scales[3:] += 3.0  # 3 and 4 are so large that they would be split, not cloned
    masked = torch.tensor([True, False, True, True, False])
    optimizer = optimizer_with_slopes(start, [9e-4, 0.0, 0.0, 9e-4, 0.0], masked)
    set_random_gradients(optimizer, 0)
    optimizer.step(0.0)
    kept = optimizer.state_dict()
    grown = densify(optimizer, 2e-4, 0.02, 100, seeding.generator(0, "split"))
    # The order is now 0, 1, 2, 4, the clone of 0, the two children of 3.
    assert grown == 2 and len(optimizer.gaussians) == 7
    assert optimizer.masked.tolist() == [True, False, True, False, True, True, True]
    old = torch.tensor([0, 1, 2, 4])
    after = optimizer.state_dict()
    for part in ("parameters", "first", "second"):
        for name in PARAMETERS:
            assert torch.equal(after[part][name][:4], kept[part][name][old]), (part, name)
    for name in PARAMETERS:
        assert torch.equal(after["parameters"][name][4], kept["parameters"][name][0])
        assert torch.all(after["first"][name][4:] == 0) and torch.all(after["second"][name][4:] == 0)
    assert after["_steps"].tolist() == [1, 1, 1, 1, 0, 0, 0]
    assert torch.allclose(
        after["parameters"]["log_scales"][5], kept["parameters"]["log_scales"][3] - float(np.log(SHRINK))
    )

    with torch.no_grad():
        optimizer.gaussians.opacity_logits[[0, 3, 5]] = -9.0
        optimizer.gaussians.opacity_logits[[1, 2, 4, 6]] = 1.0
    assert prune(optimizer, 0.005, 10.0) == 3
    assert optimizer.masked.tolist() == [False, True, True, True]
    assert torch.equal(optimizer.state_dict()["first"]["means"][:2], kept["first"]["means"][[1, 2]])
    assert len(optimizer.grad2d_sum) == len(optimizer.grad2d_count) == 4


def test_the_budget_takes_the_steepest():
    optimizer = optimizer_with_slopes(gaussians_near_origin(4, scale=0.001), [3e-4, 9e-4, 1e-4, 5e-4])
    assert densify(optimizer, 2e-4, 0.01, 6, seeding.generator(0)) == 2
    assert torch.equal(optimizer.gaussians.means[4:], optimizer.gaussians.means[[1, 3]])
    optimizer.grad2d_sum += 1
    optimizer.grad2d_count += 1
    assert densify(optimizer, 2e-4, 0.01, 6, seeding.generator(0)) == 0


def test_split_keeps_the_picture_roughly():
    parent = gaussians_near_origin(12, seed=4, scale=0.1)
    parent.opacity_logits[:] = 0.0
    children = split(parent, seeding.generator(0, "split"))
    before = render(parent, unit_camera(48, 36), impl="torch")
    after = render(children, unit_camera(48, 36), impl="torch")
    error = (before.color - after.color).square().mean()
    assert error < 0.25 * before.color.square().mean()
    assert abs(after.alpha.mean() / before.alpha.mean() - 1) < 0.25


def test_split_draws_from_the_gaussian_itself():
    """The means of the children of one anisotropic Gaussian have the covariance of this Gaussian about its mean."""
    one = gaussians_near_origin(1, seed=2)
    one.log_scales[0] = torch.log(torch.tensor([0.5, 0.1, 0.02]))
    many = one.map(lambda p: p.repeat(4000, *[1] * (p.ndim - 1)))
    offsets = split(many, seeding.generator(1)).means - one.means
    basis = rotate(one.quaternions.expand(3, 4), torch.eye(3)).T
    truth = basis @ torch.diag(torch.tensor([0.5, 0.1, 0.02]) ** 2) @ basis.T
    assert (torch.cov(offsets.T) - truth).abs().max() < 0.05 * truth.abs().max()
    assert torch.equal(rotate(torch.zeros(1, 4), torch.ones(1, 3)), torch.ones(1, 3))


def test_slopes_do_not_depend_on_the_image_size():
    """The screen-space gradients, on which densification depends, are the same for a rendering of twice the size."""
    slopes = []
    for width in (32, 64):
        optimizer = GaussianOptimizer(gaussians_near_origin(15, seed=7, scale=0.15))
        probe = torch.zeros(15, 2, requires_grad=True)
        seen = render(optimizer.gaussians, unit_camera(width, width * 3 // 4), impl="torch", probe=probe)
        (seen.color - 0.3).square().mean().backward()
        optimizer.observe(probe.grad, seen.radii, width, width * 3 // 4)
        slopes.append(optimizer.grad2d_sum)
    assert torch.allclose(slopes[0], slopes[1], rtol=0.05, atol=0.02 * float(slopes[0].max()))


def test_capped_opacities_start_over():
    optimizer = GaussianOptimizer(gaussians_near_origin(8))
    set_random_gradients(optimizer, 0)
    optimizer.step(0.0)
    optimizer.cap_opacity()
    assert optimizer.gaussians.opacity_logits.sigmoid().max() < 0.01 + 1e-6
    assert torch.all(optimizer.state_dict()["first"]["opacity_logits"] == 0)


def test_masked_gaussians_go_at_their_own_pace():
    masked = torch.tensor([True, False, False])
    rates = Rates(means=0.5, sh_dc=0.5, sh_rest=0.5)  # large, so that differences of float32 values are exact enough
    optimizer = GaussianOptimizer(gaussians_near_origin(3), masked, rates, {"means": 0.25, "sh": 0.5})
    before = optimizer.gaussians.map(lambda p: p.detach().clone())
    for name in PARAMETERS:
        getattr(optimizer.gaussians, name).grad = torch.ones_like(getattr(optimizer.gaussians, name))
    optimizer.step(0.0)
    moved = before.zip_map(optimizer.gaussians, lambda a, b: (a - b).detach())
    torch.testing.assert_close(moved.means / moved.means[1], torch.tensor([0.25, 1.0, 1.0])[:, None].expand(3, 3))
    torch.testing.assert_close(moved.sh[0] / moved.sh[1], torch.full_like(moved.sh[0], 0.5))
    torch.testing.assert_close(moved.sh[2], moved.sh[1])
    torch.testing.assert_close(moved.log_scales[0], moved.log_scales[1])
