"""PSNR, SSIM, FLIP and LPIPS on the mask's box, outside the mask and on the full image.

Images are [H, W, 3] sRGB, uint8 or float in [0, 1]. A box is cut out first and scored as an image of its own: no pixel
outside it enters, and nothing is resized. Every function raises ValueError on unequal or empty images.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor, inf, log10
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
import torch

from reffusion.metrics import flip as ldr_flip
from reffusion.metrics.flip import PIXELS_PER_DEGREE
from reffusion.metrics.lpips import NAMES, SMALLEST, Lpips

SSIM_WINDOW = 11  # px
SSIM_SIGMA = 1.5  # px
SSIM_CONSTANTS = 0.01**2, 0.03**2  # C1 and C2 of the paper for a data range of 1
BOX_DILATION = 0.1  # share of the box's extent by which each side of the mask's box moves outwards
PSNR_CAP = 100.0  # dB, value of an identical image in a mean

BOX_COLUMNS = (*(f"{name}_box" for name in NAMES.values()), "psnr_box", "ssim_box", "flip_box")
COLUMNS = (
    *BOX_COLUMNS, "psnr_outside", "ssim_outside", "flip_outside", "psnr_outside_seen", "unseen_share",
    "psnr_full", "ssim_full", "flip_full",
)  # fmt: skip

PROTOCOL = {
    "images": "8-bit sRGB as saved in renders/, against the ground truth at the same size; nothing is resized",
    "box": "bounding box of the view's test mask (its consistent mask where the scene gives none), moved outwards by "
    "10% of its width and height on each side, rounded outwards, clipped to the image; cut out before scoring",
    "empty_box": "a view with an empty mask has no box: it is left out of the box means",
    "outside": "the pixels outside the view's mask, which is first grown by the share `outside_margin` of the image's "
    "width; inside it both pictures show the photograph, so that nothing painted there enters through a window or a "
    "filter; no value where the mask covers all",
    "held_out": "a test view whose photograph shows the object (its mask lies among the training masks) has no truth "
    "inside its mask: it is scored outside only",
    "psnr": f"dB, peak 1, mean squared error over pixels and channels; a view above {PSNR_CAP:.0f} dB "
    f"(identical: infinite) counts {PSNR_CAP:.0f} dB in a mean",
    "ssim": f"Gaussian window {SSIM_WINDOW} px, sigma {SSIM_SIGMA} px, population covariance, data range 1, mean over "
    "the pixels whose window lies inside the image (valid region) and over RGB; no value under 11 px a side",
    "flip": f"LDR-FLIP, mean of the error map, {PIXELS_PER_DEGREE:.0f} pixels per degree",
    "lpips": "version 0.1, backbones alex and vgg16, input in [-1, 1] at native resolution; "
    f"no value under {SMALLEST['alex']} (alex) or {SMALLEST['vgg']} (vgg) px a side",
    "mean": "over the views that have the value; `views` says how many those are",
}


Pixels = TypeVar("Pixels", np.ndarray, torch.Tensor)


class Box(NamedTuple):
    """Pixel columns left..right-1 and rows top..bottom-1."""

    left: int
    top: int
    right: int
    bottom: int

    def crop(self, array: Pixels) -> Pixels:
        """The part of an array [H, W, ...] inside the box."""
        return array[self.top : self.bottom, self.left : self.right]


def mask_box(mask: np.ndarray, dilation: float = BOX_DILATION) -> Box | None:
    """The bounding box of a bool mask [H, W], each side moved outwards by the share `dilation` of the box's extent.

    The box is rounded outwards and clipped to the image. None for an empty mask.
    """
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if len(rows) == 0:
        return None
    height, width = mask.shape
    top, bottom = _dilate_interval(int(rows[0]), int(rows[-1]) + 1, dilation, height)
    left, right = _dilate_interval(int(columns[0]), int(columns[-1]) + 1, dilation, width)
    return Box(left, top, right, bottom)


def _dilate_interval(low: int, high: int, dilation: float, size: int) -> tuple[int, int]:
    """The interval low..high-1 widened by the share `dilation` of its length, within 0..size-1."""
    margin = round(dilation * (high - low), 9)  # 0.1 * 30 is a hair above 3: rounding outwards must not make it 4
    return max(0, floor(low - margin)), min(size, ceil(high + margin))


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB, inf for identical images."""
    image, truth = _as_unit_pair(image, truth)
    error = float(np.mean((image - truth) ** 2))
    return -10.0 * log10(error) if error > 0 else inf


def ssim(image: np.ndarray, truth: np.ndarray) -> float:
    """Structural similarity (Wang et al., 2004) as `PROTOCOL["ssim"]` says. Raises ValueError under 11 px a side."""
    return float(ssim_map(image, truth).mean())


def ssim_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """[H - 10, W - 10, 3]: SSIM of the windows that lie inside the image. Raises ValueError under 11 px a side."""
    image, truth = _as_unit_pair(image, truth)
    if min(image.shape[:2]) < SSIM_WINDOW:
        raise ValueError(f"SSIM needs {SSIM_WINDOW} px a side; the image is {image.shape[1]}x{image.shape[0]} px")
    edge, window = SSIM_WINDOW // 2, cv2.getGaussianKernel(SSIM_WINDOW, SSIM_SIGMA, cv2.CV_64F)
    inside = lambda x: cv2.sepFilter2D(x, cv2.CV_64F, window, window)[edge:-edge, edge:-edge]
    ours, true = inside(image), inside(truth)
    product, square_ours, square_true = ours * true, ours**2, true**2
    covariance, variances = inside(image * truth) - product, inside(image**2 + truth**2) - square_ours - square_true
    first, second = SSIM_CONSTANTS
    similar = (2 * product + first) * (2 * covariance + second)
    return similar / ((square_ours + square_true + first) * (variances + second))


def flip(image: np.ndarray, truth: np.ndarray) -> float:
    """Mean LDR-FLIP (Andersson et al., 2020) in [0, 1], 0 for identical images."""
    return float(flip_map(image, truth).mean(dtype=np.float64))


def flip_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """[H, W] float32 in [0, 1]: LDR-FLIP at each pixel."""
    return ldr_flip.flip_map(*_as_unit_pair(image, truth))


@dataclass(frozen=True)
class LpipsTarget:
    """A ground truth's activations in an LPIPS network, computed once for all images that are compared with it."""

    model: Lpips
    activations: list[torch.Tensor]

    @torch.no_grad()
    def distance(self, image: np.ndarray) -> float:
        """LPIPS of an image of the truth's size. Raises ValueError for an array that is no image."""
        return float(self.model.distance(_as_lpips_input(image), self.activations))


@torch.no_grad()
def lpips_targets(truth: np.ndarray, models: dict[str, Lpips]) -> dict[str, LpipsTarget | None]:
    """Network -> target; None where the truth is too small for it."""
    fits = {net: min(truth.shape[:2]) >= SMALLEST[net] for net in models}
    return {n: LpipsTarget(m, m.activations(_as_lpips_input(truth))) if fits[n] else None for n, m in models.items()}


def _as_lpips_input(image: np.ndarray) -> torch.Tensor:
    """The image as [1, 3, H, W] float32 in [-1, 1]."""
    return torch.from_numpy(2.0 * _as_unit(image) - 1.0).permute(2, 0, 1)[None].float()


def score(
    image: np.ndarray, truth: np.ndarray, targets: dict[str, LpipsTarget | None] | None = None
) -> dict[str, float | None]:
    """{"psnr", "ssim", "flip", and `NAMES` of each LPIPS target}; None where the image is too small for a metric."""
    side = min(image.shape[:2])
    values = {
        "psnr": psnr(image, truth),
        "ssim": ssim(image, truth) if side >= SSIM_WINDOW else None,
        "flip": flip(image, truth),
    }
    for net, target in (targets or {}).items():
        values[NAMES[net]] = target and target.distance(image)
    return values


def score_view(
    image: np.ndarray,
    truth: np.ndarray,
    box: Box | None,
    targets: dict[str, LpipsTarget | None] | None = None,
    mask: np.ndarray | None = None,
    shows_object: bool = False,
    unseen: np.ndarray | None = None,
) -> dict[str, float | None]:
    """A value for each of `COLUMNS`: `score` on the box (None without one), `score_outside` of the mask, and `score` on
    the full image without LPIPS.

    Args:
        targets: `lpips_targets` of the truth in the box.
        mask: bool [H, W], the object; None: no pixel is masked.
        shows_object: the truth shows the object, so that only pixels outside the mask are scored.
        unseen: bool [H, W], pixels that no training view saw; None where that is not known: the columns about them
            are then None.
    """
    mask = np.zeros(truth.shape[:2], bool) if mask is None else mask
    values = score_outside(image, truth, mask)
    if unseen is not None:
        values |= score_outside_seen(image, truth, mask, unseen)
    if not shows_object:
        inside = score(box.crop(image), box.crop(truth), targets) if box is not None else {}
        values |= {f"{name}_box": value for name, value in inside.items()}
        values |= {f"{name}_full": value for name, value in score(image, truth).items()}
    return {column: values.get(column) for column in COLUMNS}


def score_outside(image: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> dict[str, float | None]:
    """{"psnr", "ssim", "flip"}_outside: over the pixels where the bool mask [H, W] is False; None where there are none.

    The windows of SSIM and the filters of FLIP reach into the mask. There the truth replaces both images, so that
    nothing painted inside the mask changes a score outside it.
    """
    kept = ~mask
    if not kept.any():
        return dict.fromkeys(("psnr_outside", "ssim_outside", "flip_outside"))
    image, truth = _as_unit_pair(image, truth)
    outside_only, edge = np.where(kept[..., None], image, truth), SSIM_WINDOW // 2
    windows = kept[edge:-edge, edge:-edge]  # empty where the image is smaller than a window
    return {
        "psnr_outside": _masked_psnr(image, truth, kept),
        "ssim_outside": float(ssim_map(outside_only, truth)[windows].mean()) if windows.any() else None,
        "flip_outside": float(flip_map(outside_only, truth)[kept].mean(dtype=np.float64)),
    }


def score_outside_seen(
    image: np.ndarray, truth: np.ndarray, mask: np.ndarray, unseen: np.ndarray
) -> dict[str, float | None]:
    """{"psnr_outside_seen", "unseen_share"}: PSNR over the pixels outside the bool mask [H, W] that some training view
    saw, and the share of the pixels outside the mask that none saw; each is None if
    it has no pixels."""
    kept = ~mask
    return {
        "psnr_outside_seen": _masked_psnr(image, truth, kept & ~unseen),
        "unseen_share": float(unseen[kept].mean()) if kept.any() else None,
    }


def _masked_psnr(image: np.ndarray, truth: np.ndarray, pixels: np.ndarray) -> float | None:
    """PSNR over the chosen pixels, bool [H, W]; None where there are none."""
    if not pixels.any():
        return None
    image, truth = _as_unit_pair(image, truth)
    error = float(np.mean((image - truth)[pixels] ** 2))
    return -10.0 * log10(error) if error > 0 else inf


def mean(values: list[float | None]) -> float | None:
    """Mean of the values that are not None, each capped at `PSNR_CAP`; None if there are none.

    Only PSNR reaches the cap. It keeps one identical view from making the mean infinite, and unlike leaving that view
    out it never makes a better result score worse.
    """
    present = [min(value, PSNR_CAP) for value in values if value is not None]
    return float(np.mean(present)) if present else None


def join_side_by_side(panels: list[np.ndarray], box: Box | None) -> np.ndarray:
    """uint8 [H, W', 3]: the panels from left to right with 4 px of white between them, the box drawn in yellow."""
    gap = np.full((panels[0].shape[0], 4, 3), 255, np.uint8)
    strip = []
    for panel in panels:
        panel = panel.copy()
        if box is not None:
            inside = box.crop(panel)
            for edge in (inside[0], inside[-1], inside[:, 0], inside[:, -1]):
                edge[:] = (255, 220, 0)
        strip += [panel, gap]
    return np.concatenate(strip[:-1], axis=1)


def _as_unit_pair(image: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both images as float64 in [0, 1]. Raises ValueError where they are no images of one size, or empty."""
    if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"a metric compares two [H, W, 3] of one size; got {image.shape} and {truth.shape}")
    if image.size == 0:
        raise ValueError("a metric needs at least one pixel")
    return _as_unit(image), _as_unit(truth)


def _as_unit(image: np.ndarray) -> np.ndarray:
    """float64 in [0, 1] of a uint8 or float image. Raises ValueError for other types and ranges."""
    if image.dtype == np.uint8:
        return image / 255.0
    if not np.issubdtype(image.dtype, np.floating):
        raise ValueError(f"an image is uint8 or float in [0, 1], not {image.dtype}")
    if not (image.min() >= 0.0 and image.max() <= 1.0):  # also refuses NaN
        raise ValueError(f"a float image lies in [0, 1]; this one spans {image.min():.3g} to {image.max():.3g}")
    return image.astype(np.float64)
