"""Pictures and masks with simple content."""

from __future__ import annotations

import numpy as np
import torch

from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians


def rectangle_mask(shape: tuple[int, int], rows: tuple[int, int], columns: tuple[int, int]) -> np.ndarray:
    """bool [H, W], True from the first to before the last of `rows` and `columns`."""
    mask = np.zeros(shape, bool)
    mask[slice(*rows), slice(*columns)] = True
    return mask


def disk_mask(shape: tuple[int, int], row: float, column: float, radius: float) -> np.ndarray:
    """bool [H, W], True where a pixel is nearer than `radius` px to a place."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return (rows - row) ** 2 + (columns - column) ** 2 < radius**2


def gradient_image(shape: tuple[int, int], row_step: int, column_step: int) -> np.ndarray:
    """uint8 [H, W, 3]: red grows with the row and green with the column by these steps."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return np.stack([row_step * rows, column_step * columns, np.full(shape, 100)], -1).astype(np.uint8)


def paint_red(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A copy of the picture whose masked pixels are of the object's red."""
    return np.where(mask[..., None], np.uint8([230, 26, 26]), image)


def natural_noise(seed: int, size=(160, 120)) -> np.ndarray:
    """uint8 [H, W, 3] with equal energy in each octave, as in photographs."""
    rng, (width, height) = np.random.default_rng(seed), size
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None]).clip(1 / width)
    fields = [np.fft.ifft2(np.fft.fft2(rng.normal(size=(height, width))) / frequency).real for _ in range(3)]
    mixed = [fields[0] + 0.3 * field for field in fields]  # mostly grey, as photographs are
    return np.stack([np.clip(128 + 40 * f / f.std(), 0, 255) for f in mixed], -1).astype(np.uint8)


def psnr(a: np.ndarray, b: np.ndarray, where: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(((a.astype(float) - b)[where] ** 2).mean(), 1e-3)))


def render_color(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """float32 [H, W, 3]: the rendered colours, which may exceed [0, 1]."""
    with torch.no_grad():
        return rasterizer.render(gaussians, camera).color.numpy()
