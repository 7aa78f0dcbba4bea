"""Gaussians and scenes of random numbers, for tests of files and formats."""

import numpy as np
import torch

from reffusion.types import Camera, Gaussians, Scene, Similarity


def random_gaussians(count: int, degree: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=generator)
    return Gaussians(draw(count, 3), draw(count, 4), draw(count, 3), draw(count), draw(count, (degree + 1) ** 2, 3))


def random_rotation(generator: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(generator.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def random_scene(names=("b", "a", "c")) -> Scene:
    generator, cameras = np.random.default_rng(0), {}
    for name in sorted(names):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = random_rotation(generator), generator.normal(size=3)
        cameras[name] = Camera(name, 12, 8, 10.5, 11.25, 6.1, 3.9, pose)
    return Scene(
        cameras,
        ("a", "b"),
        ("c",),
        frozenset({"b"}),
        generator.normal(size=(7, 3)),
        generator.integers(0, 256, (7, 3)).astype(np.uint8),
        Similarity(1.0 / 3.0, np.array([1e6 / 7, -2e6 / 3, 0.1])),
    )
