"""Triton kernels agree with the PyTorch implementations, on a GPU or in Triton's interpreter (TRITON_INTERPRET=1)."""

from __future__ import annotations

import os

import pytest
import torch
from scenes.simulated_gpu import has_gpu

from reffusion.gaussians import adam, optimize
from reffusion.gaussians.ssim import C1, C2, dssim_torch, window
from reffusion.seeding import generator
from reffusion.types import PARAMETERS, Gaussians

DEVICE = "cuda" if has_gpu() else "cpu"
if DEVICE == "cpu" and os.environ.get("TRITON_INTERPRET") != "1":
    pytest.skip("needs a CUDA GPU, or Triton's interpreter", allow_module_level=True)
pytest.importorskip("triton")

from reffusion.gaussians import cuda_kernels  # noqa: E402


@pytest.mark.parametrize("size", [(4, 4, 1), (23, 31, 3), (61, 1030, 3)])
@pytest.mark.parametrize("masked", [None, "soft", "hard"])
def test_ssim_and_its_gradient(size, masked):
    rand = lambda *shape: torch.rand(*shape, generator=generator(0, "gpu", *map(str, shape)), dtype=torch.float64)
    image, weights = rand(*size), None
    target = (image + 0.2 * rand(*size).flip(0)).clamp(0, 1)
    if masked:
        weights = rand(*size[:2]) if masked == "soft" else (rand(*size[:2]) > 0.4).double()
        image, target = (torch.where((weights > 0)[..., None], each, 0.0) for each in (image, target))
    leaf = image.clone().requires_grad_()
    exact = dssim_torch(leaf, target, weights)
    (slope,) = torch.autograd.grad(exact, leaf)
    inputs = [None if each is None else each.float().to(DEVICE) for each in (image, target, weights)]
    value, gradient = cuda_kernels.dssim_and_gradient(*inputs, window(), (C1, C2))
    assert abs(float(value) - float(exact.detach())) < 1e-6
    assert (gradient.cpu().double() - slope).norm() < 1e-5 * slope.norm()


def test_adam(monkeypatch):
    count, found = 700, []
    for update in (adam.adam, cuda_kernels.adam):
        monkeypatch.setattr(adam, "fastest", lambda device, update=update: update)
        draw = generator(0, "adam")
        normal = lambda *shape, draw=draw: torch.randn(*shape, generator=draw).to(DEVICE)
        scene = Gaussians(normal(count, 3), normal(count, 4), normal(count, 3), normal(count), normal(count, 16, 3))
        optimizer = optimize.GaussianOptimizer(scene, masked=normal(count) < -0.5, masked_factors={"means": 0.3})
        for i in range(3):
            for name in PARAMETERS:
                getattr(optimizer.gaussians, name).grad = normal(*getattr(scene, name).shape)
            optimizer.step(i / 3, visible=normal(count) < 0.5, sh_degree=2)
        found.append(optimizer.gaussians)
    for name in PARAMETERS:
        assert torch.allclose(getattr(found[0], name), getattr(found[1], name), rtol=1e-5, atol=2e-6), name
