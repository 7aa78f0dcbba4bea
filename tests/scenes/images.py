"""Pictures and masks with simple content."""

from __future__ import annotations

import numpy as np
import torch

from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians


def rectangle_mask(shape: tuple[int, int], rows: tuple[int, int], columns: tuple[int, int]) -> np.ndarray:
    """Return bool [H, W], True in a rectangle; `rows` and `columns` are its start (included) and stop (excluded)."""
    mask = np.zeros(shape, bool)
    mask[slice(*rows), slice(*columns)] = True
    return mask


def disk_mask(shape: tuple[int, int], row: float, column: float, radius: float) -> np.ndarray:
    """Return bool [H, W], True for the pixels whose distance from (row, column) is below `radius` px."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return (rows - row) ** 2 + (columns - column) ** 2 < radius**2


def gradient_image(shape: tuple[int, int], row_step: int, column_step: int) -> np.ndarray:
    """Return uint8 [H, W, 3] whose red grows by `row_step` a row, and whose green grows by `column_step` a column."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return np.stack([row_step * rows, column_step * columns, np.full(shape, 100)], -1).astype(np.uint8)


def paint_red(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return a copy of the picture whose masked pixels have the red of the test scenes' object."""
    return np.where(mask[..., None], np.uint8([230, 26, 26]), image)


def natural_noise(seed: int, size=(160, 120)) -> np.ndarray:
    """Return noise, uint8 [H, W, 3], with equal energy in each octave of frequency, as photographs have."""
    rng, (width, height) = np.random.default_rng(seed), size
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None]).clip(1 / width)
    fields = [np.fft.ifft2(np.fft.fft2(rng.normal(size=(height, width))) / frequency).real for _ in range(3)]
    mixed = [fields[0] + 0.3 * field for field in fields]  # mostly gray, as photographs are
    return np.stack([np.clip(128 + 40 * f / f.std(), 0, 255) for f in mixed], -1).astype(np.uint8)


def psnr(a: np.ndarray, b: np.ndarray, where: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(((a.astype(float) - b)[where] ** 2).mean(), 1e-3)))


def render_color(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Return the rendered colors, float32 [H, W, 3], which may lie outside [0, 1]."""
    with torch.no_grad():
        return rasterizer.render(gaussians, camera).color.numpy()
