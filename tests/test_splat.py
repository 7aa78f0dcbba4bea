"""The rasterizer: the compiled kernel against the float64 reference, the reference against finite differences."""

from __future__ import annotations

import math
import sys
import types
from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes.cameras import make_camera
from scenes.simulated_gpu import has_gpu

from reffusion.splat import cuda, pure_torch, rasterizer
from reffusion.types import PARAMETERS, Camera, Gaussians

BLOCKS = (*PARAMETERS, "features", "background", "probe")
IMAGES = ("color", "depth", "alpha", "features")


def off_center_camera(width: int, height: int, distance: float = 3.0) -> Camera:
    """Return a camera that sees the origin, slightly rotated and off-center, so that no symmetry hides an error."""
    turn = 0.3
    pose = np.eye(4)
    pose[:3, :3] = [[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]]
    pose[:3, 3] = 0.05, -0.02, distance
    return Camera("test", width, height, 1.2 * width, 1.25 * width, width / 2 + 0.7, height / 2 - 0.3, pose)


def random_cloud(count: int, log_scale: float, seed: int = 0, degree: int = 3, spread: float = 1.0) -> Gaussians:
    """Return random Gaussians around the origin, with colors in and out of [0, 1] and some saturated opacities."""
    generator = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*shape, generator=generator)
    higher = 0.15 * normal(count, (degree + 1) ** 2 - 1, 3)
    return Gaussians(
        means=spread * normal(count, 3) * 0.6,
        quaternions=normal(count, 4) * 2,
        log_scales=log_scale + 0.6 * normal(count, 3),
        opacity_logits=2 * normal(count),
        sh=torch.cat((normal(count, 1, 3), higher), 1),
    )


def differentiate(gaussians, view, impl, dtype, channels=3, sh_degree=None):
    """Render, and return the rendering and the gradients of a fixed random linear function of all its outputs."""
    generator = torch.Generator().manual_seed(1)
    random = lambda *shape: torch.randn(*shape, generator=generator).to(dtype)
    leaf = lambda tensor: tensor.detach().to(dtype).clone().requires_grad_()
    gaussians = gaussians.map(leaf)
    features, background = leaf(random(len(gaussians), channels)), leaf(torch.tensor([0.2, 0.3, 0.4]))
    probe = leaf(torch.zeros(len(gaussians), 2))
    rendering = rasterizer.render(
        gaussians,
        view,
        features=features,
        background=background,
        impl=impl,
        sh_degree=sh_degree,
        probe=probe,
    )
    loss = sum((getattr(rendering, name) * random(*getattr(rendering, name).shape)).sum() for name in IMAGES)
    leaves = (*(getattr(gaussians, name) for name in PARAMETERS), features, background, probe)
    return rendering, dict(zip(BLOCKS, torch.autograd.grad(loss, leaves), strict=True))


def assert_close(actual, expected, relative, floor, what):
    error = (actual.double() - expected.double()).norm().item()
    assert error <= relative * expected.double().norm().item() + floor, (what, error, expected.norm().item())


def assert_matches_reference(gaussians, view, relative=2e-5, **options):
    """Assert that values and gradients of the compiled kernel equal the float64 reference, up to `relative` in L2."""
    fast, fast_gradients = differentiate(gaussians, view, "cpu", torch.float32, **options)
    exact, exact_gradients = differentiate(gaussians, view, "torch", torch.float64, **options)
    assert torch.equal(fast.radii, exact.radii)
    for name in IMAGES:
        assert_close(getattr(fast, name), getattr(exact, name), relative, 1e-6, name)
    for name in BLOCKS:
        assert_close(fast_gradients[name], exact_gradients[name], relative, 1e-5, name)
    return exact


@pytest.mark.parametrize(
    ("count", "log_scale", "size", "options"),
    [
        (300, -3.2, (61, 47), {}),
        (300, -2.0, (64, 64), {"channels": 0}),
        (600, -4.5, (50, 70), {"channels": 1, "sh_degree": 1}),
        (80, -3.0, (7, 5), {"channels": 9, "sh_degree": 2}),
        (20, -1.0, (1, 1), {"sh_degree": 0}),
    ],
)
def test_equals_reference(count, log_scale, size, options):
    exact = assert_matches_reference(random_cloud(count, log_scale), off_center_camera(*size), **options)
    assert exact.alpha.mean() > 0.1


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_stored_degrees(degree):
    assert_matches_reference(random_cloud(50, -2.5, degree=degree), off_center_camera(33, 20))


def test_inside_the_cloud():
    """Gaussians lie behind, around and close in front of the camera. The Jacobian's clamp is active for some."""
    exact = assert_matches_reference(
        random_cloud(400, -2.5, seed=3, spread=2.0), off_center_camera(48, 40, distance=0.1), relative=1e-4
    )
    assert (exact.radii == 0).any() and (exact.radii > 100).any()


def test_cropped_view():
    view = off_center_camera(64, 48)
    whole = rasterizer.render(random_cloud(100, -3.0), view).color
    part = rasterizer.render(random_cloud(100, -3.0), view.cropped(17, 9, 32, 24)).color
    assert_close(part, whole[9:33, 17:49], 1e-2, 0, "crop")  # the Jacobian's clamp depends on the window
    assert_matches_reference(random_cloud(100, -3.0), view.cropped(17, 9, 32, 24))


@pytest.mark.parametrize("log_scale", [-5.0, -3.2, -1.5])
def test_antialiased_equals_reference(log_scale):
    """Footprints reach from far below a pixel to large. Kernel and reference leave out the same faint Gaussians."""
    exact = assert_matches_reference(replace(random_cloud(300, log_scale), antialiased=True), off_center_camera(61, 47))
    assert exact.alpha.max() > 0.1
    assert_matches_reference(replace(random_cloud(300, log_scale), antialiased=False), off_center_camera(61, 47))


def test_antialiased_needles_and_sheets():
    """The determinant of the 2D covariance before the low-pass filter is nearly 0 (needles), or 0 (lines).

    Needles equal the reference. Lines are not drawn, and all gradients stay finite.
    """
    gaussians = replace(random_cloud(40, 0.0, seed=5, spread=0.5), antialiased=True)
    needles = replace(gaussians, log_scales=torch.tensor([-1.0, -7.9, -7.9]).repeat(40, 1))
    assert (assert_matches_reference(needles, off_center_camera(64, 64), relative=1e-3).radii > 0).any()
    lines = replace(gaussians, log_scales=torch.tensor([-1.0, -500.0, -500.0]).repeat(40, 1))
    rendering, gradients = differentiate(lines, off_center_camera(64, 64), "cpu", torch.float32)
    assert (rendering.radii == 0).all() and all(torch.isfinite(g).all() for g in gradients.values())


@pytest.mark.parametrize("impl", ["cpu", "torch"])
def test_antialiased_adds_up_to_the_same_from_any_distance(impl):
    """The sum of alpha of a round Gaussian is 2 pi o (f s / z)^2, even if the footprint is far below a pixel.

    Here o is the opacity, s the standard deviation, f the focal length and z the depth. Without antialiasing, 3DGS's
    low-pass filter makes the sum at least 2 pi o 0.3, however far the Gaussian is.
    """
    turn, logit = torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([2.0])
    one = Gaussians(torch.zeros(1, 3), turn, torch.full((1, 3), -3.0), logit, torch.zeros(1, 1, 3))
    opacity = torch.tensor(2.0).sigmoid().item()
    for distance in (2.0, 5.0, 10.0, 20.0):
        view = make_camera("far", (64, 64), 100.0)
        view.world_to_camera[2, 3] = distance
        size = 100 * math.exp(-3) / distance
        true = 2 * math.pi * opacity * size**2
        total = rasterizer.render(replace(one, antialiased=True), view, impl=impl).alpha.sum().item()
        # The cut at an alpha of 1/255 removes 2 pi / 255 times the variance of the footprint.
        faint = 2 * math.pi * (size**2 + 0.3) / 255
        assert total == pytest.approx(true, abs=faint + 0.01 * true), distance


@pytest.mark.parametrize("antialiased", [False, True])
def test_reference_against_finite_differences(antialiased):
    """Each parameter is varied along random directions in float64. No pixel of the scene is close to a threshold."""
    gaussians, view = replace(random_cloud(12, -1.2, seed=2), antialiased=antialiased), off_center_camera(9, 8)
    gaussians = gaussians.map(torch.Tensor.double)
    _, gradients = differentiate(gaussians, view, "torch", torch.float64)
    generator = torch.Generator().manual_seed(1)
    random = lambda *shape: torch.randn(*shape, generator=generator).double()
    features, weights = random(12, 3), [random(8, 9, 3), random(8, 9), random(8, 9), random(8, 9, 3)]

    def loss(changed: dict[str, torch.Tensor]) -> float:
        rendering = rasterizer.render(
            replace(gaussians, **{k: v for k, v in changed.items() if k in PARAMETERS}),
            view,
            features=changed.get("features", features),
            background=changed.get("background", torch.tensor([0.2, 0.3, 0.4]).double()),
            probe=changed.get("probe"),
            impl="torch",
        )
        return sum((getattr(rendering, n) * w).sum().item() for n, w in zip(IMAGES, weights, strict=True))

    base = {name: getattr(gaussians, name) for name in PARAMETERS} | {"features": features}
    base |= {"background": torch.tensor([0.2, 0.3, 0.4]).double(), "probe": torch.zeros(12, 2).double()}
    for name in BLOCKS:
        direction, step = torch.randn(base[name].shape, generator=generator).double(), 1e-6
        slope = (loss({name: base[name] + step * direction}) - loss({name: base[name] - step * direction})) / (2 * step)
        assert slope == pytest.approx((gradients[name] * direction).sum().item(), rel=1e-5, abs=1e-6), name


def test_probe_is_the_gradient_of_the_2d_mean():
    """A shift of the principal point shifts every 2D mean, so its gradient is the sum of the probe's gradients."""
    gaussians, view = random_cloud(60, -2.5), off_center_camera(30, 30)
    _, gradients = differentiate(gaussians, view, "cpu", torch.float32)
    generator = torch.Generator().manual_seed(1)
    random = lambda *shape: torch.randn(*shape, generator=generator).double()
    features = random(60, 3)
    weights = [random(30, 30, 3), random(30, 30), random(30, 30), random(30, 30, 3)]

    def loss(shift: float) -> float:
        probe = torch.tensor([[shift, 0.0]]).double().repeat(60, 1)
        rendering = rasterizer.render(
            gaussians.map(torch.Tensor.double),
            view,
            features=features,
            background=torch.tensor([0.2, 0.3, 0.4]).double(),
            probe=probe,
            impl="torch",
        )
        return sum((getattr(rendering, n) * w).sum().item() for n, w in zip(IMAGES, weights, strict=True))

    slope = (loss(1e-6) - loss(-1e-6)) / 2e-6
    assert gradients["probe"][:, 0].sum().item() == pytest.approx(slope, rel=1e-3)


def test_same_bits_for_any_number_of_threads():
    gaussians, view, before = random_cloud(3000, -3.5), off_center_camera(150, 131), torch.get_num_threads()
    values, results = torch.rand(131, 150, 2), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            rendering, gradients = differentiate(gaussians, view, "cpu", torch.float32)
            results.append([*rendering, *gradients.values(), rasterizer.accumulate(gaussians, view, values)])
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_footprints_over_many_tiles():
    """Each Gaussian covers an image of a hundred tiles, far more than the buffers' initial size allows for."""
    exact = assert_matches_reference(random_cloud(6, 0.3), off_center_camera(200, 150), channels=1)
    assert (exact.radii > 200).all()


def test_results_outlive_later_calls():
    """Large arrays reuse the memory of earlier calls, but only after the earlier results were released."""
    view = off_center_camera(160, 150)
    rendering, gradients = differentiate(random_cloud(2000, -3.0), view, "cpu", torch.float32)
    kept = [*rendering, *gradients.values()]
    copies = [tensor.clone() for tensor in kept]
    for seed in (1, 2):
        differentiate(random_cloud(2000, -3.0, seed=seed), view, "cpu", torch.float32)
    assert all(torch.equal(a, b) for a, b in zip(kept, copies, strict=True))


def test_equal_depths_are_drawn_by_index():
    """Of forty opaque Gaussians in the same place, the first is red and the rest are green; the pixel must be red."""
    gaussians = replace(random_cloud(40, -1.0), means=torch.zeros(40, 3), opacity_logits=torch.full((40,), 9.0))
    gaussians.sh[:] = 0.0
    gaussians.sh[:, 0] = torch.tensor([-2.0, 2.0, -2.0])
    gaussians.sh[0, 0] = torch.tensor([2.0, -2.0, -2.0])
    for impl in ("cpu", "torch"):
        red, green, blue = rasterizer.render(gaussians, off_center_camera(20, 20), impl=impl).color[10, 10]
        assert red > 0.8 and green < 0.2 and blue < 0.2


def test_zero_quaternion_is_the_identity():
    gaussians = random_cloud(30, -2.0)
    zero = replace(gaussians, quaternions=torch.zeros(30, 4))
    identity = replace(gaussians, quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(30, 1))
    for impl in ("cpu", "torch"):
        images = [rasterizer.render(g, off_center_camera(20, 20), impl=impl).color for g in (zero, identity)]
        assert torch.equal(*images)
    assert_matches_reference(zero, off_center_camera(20, 20))


def extreme_gaussians() -> Gaussians:
    """Return Gaussians behind the camera, at its center, far to the side, huge, tiny, transparent and opaque."""
    center = torch.tensor(off_center_camera(20, 20).center, dtype=torch.float32)
    gaussians = random_cloud(10, -1.0)
    for array, row, value in (
        (gaussians.means, 0, center * 1.5),
        (gaussians.means, 1, center),
        (gaussians.means, 2, torch.tensor([1e30, 0.0, 0.0])),
        (gaussians.means, 3, torch.tensor([1e5, -1e5, 0.0])),
        (gaussians.log_scales, 4, 1e4),
        (gaussians.log_scales, 5, 20.7),
        (gaussians.log_scales, 6, -1e4),
        (gaussians.log_scales, 7, torch.tensor([80.0, -80.0, 0.0])),
        (gaussians.opacity_logits, 8, -1e4),
        (gaussians.opacity_logits, 9, 1e4),
    ):
        array[row] = value
    return gaussians


def test_extremes_stay_finite():
    rendering, gradients = differentiate(extreme_gaussians(), off_center_camera(20, 20), "cpu", torch.float32)
    for name in IMAGES:
        assert torch.isfinite(getattr(rendering, name)).all(), name
    for name, gradient in gradients.items():
        assert torch.isfinite(gradient).all(), name
    assert rendering.radii[[0, 1, 2, 4, 8]].tolist() == [0] * 5
    assert rendering.radii[9] > 0


@pytest.mark.parametrize("impl", ["cpu", "torch"])
def test_nothing_to_draw(impl):
    """Without Gaussians before the camera, the render is the background, all else is zero, and so are the gradients."""
    view, background = off_center_camera(5, 3), torch.tensor([0.1, 0.2, 0.3])
    behind = replace(random_cloud(4, -2.0), means=torch.tensor(view.center * 2, dtype=torch.float32).repeat(4, 1))
    for gaussians in (behind, random_cloud(0, -2.0)):
        features = torch.ones(len(gaussians), 2, requires_grad=True)
        rendering = rasterizer.render(gaussians, view, features=features, background=background, impl=impl)
        assert torch.equal(rendering.color, background.expand(3, 5, 3))
        assert not rendering.depth.any() and not rendering.alpha.any() and not rendering.radii.any()
        assert rendering.features.shape == (3, 5, 2) and not rendering.features.any()
        (rendering.features.sum() + rendering.depth.sum()).backward()
        assert features.grad is None or not features.grad.any()
        assert not rasterizer.accumulate(gaussians, view, torch.ones(3, 5, 1), impl=impl).any()


def test_a_finished_pixel_stays_finished():
    """Opaque Gaussians cover each pixel. Transmittance never falls below 1e-4, and Gaussians behind change nothing."""
    view, count = off_center_camera(16, 16), 60
    gaussians = replace(random_cloud(count, 0.0), opacity_logits=torch.full((count,), 3.0))
    assert rasterizer.render(gaussians, view).alpha.max() <= 1 - 1e-4 + 1e-6
    assert_matches_reference(gaussians, view)


def test_deep_faint_stack():
    """Each pixel blends two thousand layers of an alpha of about 1/150."""
    view, gaussians = off_center_camera(18, 12), random_cloud(2000, 2.0, seed=4)
    depths = torch.linspace(2.0, 4.0, 2000)[torch.randperm(2000, generator=torch.Generator().manual_seed(0))]
    forward = torch.tensor(view.world_to_camera[2, :3], dtype=torch.float32)
    means = torch.tensor(view.center, dtype=torch.float32) + depths[:, None] * forward
    gaussians = replace(gaussians, means=means, opacity_logits=torch.full((2000,), math.log(1 / 149)))
    assert_matches_reference(gaussians, view, relative=5e-5)


def test_accumulate_is_the_gradient_of_features():
    gaussians, view, values = random_cloud(200, -2.5), off_center_camera(45, 40), torch.rand(40, 45, 2)
    features = torch.zeros(200, 2, requires_grad=True)
    rasterizer.render(gaussians, view, features=features).features.backward(values)
    gathered = rasterizer.accumulate(gaussians, view, values)
    assert_close(gathered, features.grad, 1e-6, 1e-6, "accumulate")
    for count in (False, True):
        exact = rasterizer.accumulate(
            gaussians.map(torch.Tensor.double), view, values.double(), impl="torch", count=count
        )
        assert_close(rasterizer.accumulate(gaussians, view, values, count=count), exact, 2e-6, 0, count)


def test_counts_are_whole_numbers_of_blended_pixels():
    gaussians, view = random_cloud(50, -2.0), off_center_camera(45, 40)
    counts = rasterizer.accumulate(gaussians, view, torch.ones(40, 45, 1), count=True)[:, 0]
    assert torch.equal(counts, counts.round()) and counts.max() > 20
    projected, _ = pure_torch.project(gaussians.map(torch.Tensor.double), view, None)
    assert set(torch.nonzero(counts)[:, 0].tolist()) <= set(projected.order.tolist())


def test_rendering_without_gradients_keeps_nothing():
    rendering = rasterizer.render(random_cloud(10, -2.0), off_center_camera(9, 9))
    assert not rendering.color.requires_grad and rendering.color.grad_fn is None


def test_background_and_alpha_agree():
    gaussians, view = random_cloud(40, -2.5), off_center_camera(25, 25)
    black, white = (rasterizer.render(gaussians, view, background=torch.full((3,), b)) for b in (0.0, 1.0))
    assert_close(white.color - black.color, (1 - black.alpha)[..., None].expand(-1, -1, 3), 1e-6, 0, "background")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": torch.ones(3, 2)}, "features has shape"),
        ({"background": torch.ones(4)}, "background has shape"),
        ({"probe": torch.ones(10, 2).double()}, "probe is torch.float64"),
        ({"sh_degree": 4}, "sh_degree 4 is outside 0..3"),
        ({"impl": "metal"}, "none of auto, torch, cpu, cuda"),
        ({"impl": "cuda"}, "impl='cuda' needs"),
    ],
)
def test_bad_input_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        rasterizer.render(random_cloud(10, -2.0), off_center_camera(4, 4), **change)


def test_gsplat_without_its_extension_is_named(monkeypatch):
    """gsplat can be imported without its compiled extension, but fails at the first render with an unclear error."""
    for name, module in (("gsplat", types.ModuleType("gsplat")), ("gsplat.cuda", types.ModuleType("gsplat.cuda"))):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "gsplat.cuda._backend", raising=False)  # an earlier test may have loaded it
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    like = types.SimpleNamespace(is_cuda=True, dtype=torch.float32, device="cuda:0")
    with pytest.raises(ValueError, match="needs gsplat: `make gpu`"):
        cuda.require_gpu(like)
    sys.modules["gsplat.cuda"]._backend = types.SimpleNamespace(_C=None)
    with pytest.raises(ValueError, match="compiled extension, and there is no nvcc"):
        cuda.require_gpu(like)
    sys.modules["gsplat.cuda"]._backend = types.SimpleNamespace(_C=object())
    cuda.require_gpu(like)


def test_bad_gaussians_are_named():
    gaussians = random_cloud(10, -2.0)
    with pytest.raises(ValueError, match="sh is"):
        rasterizer.render(replace(gaussians, sh=torch.zeros(10, 7, 3)), off_center_camera(4, 4))
    with pytest.raises(ValueError, match="log_scales has shape"):
        rasterizer.render(replace(gaussians, log_scales=torch.zeros(9, 3)), off_center_camera(4, 4))
    with pytest.raises(ValueError, match="takes float32"):
        rasterizer.render(gaussians.map(torch.Tensor.double), off_center_camera(4, 4), impl="cpu")


@pytest.mark.skipif(not has_gpu(), reason="needs a CUDA GPU and gsplat")
@pytest.mark.parametrize("antialiased", [False, True])
def test_cuda_equals_reference(antialiased):
    gaussians = replace(random_cloud(300, -3.2), opacity_logits=torch.linspace(-5, 4, 300))
    gaussians = replace(gaussians, antialiased=antialiased)
    view, on_gpu = off_center_camera(61, 47), gaussians.map(torch.Tensor.cuda)
    exact = rasterizer.render(gaussians.map(torch.Tensor.double), view, impl="torch")
    rendering = rasterizer.render(on_gpu, view)
    for name in ("color", "depth", "alpha"):
        assert_close(getattr(rendering, name).cpu(), getattr(exact, name), 1e-4, 0, name)
    for count in (False, True):
        values = torch.rand(47, 61, 2)
        gathered = rasterizer.accumulate(on_gpu, view, values.cuda(), count=count)
        assert_close(gathered.cpu(), rasterizer.accumulate(gaussians, view, values, count=count), 1e-3, 0, count)
