"""PSNR, SSIM, FLIP and LPIPS on the mask's bounding box, outside the mask and on the full image.

Images are sRGB [H, W, 3], uint8 or float in [0, 1]. The box is cut out first and scored as a separate image, so no
pixel outside the box affects a score of the box. Nothing is resized. Every function that compares two images raises
ValueError if their sizes differ, if they are empty, or if an image has another dtype or values outside [0, 1].
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
BOX_DILATION = 0.1  # share of the box's width or height by which each side of the mask's box moves outwards
PSNR_CAP = 100.0  # dB, value that an identical image (infinite PSNR) contributes to a mean

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
    """A box of pixels: the columns left to right - 1 and the rows top to bottom - 1."""

    left: int
    top: int
    right: int
    bottom: int

    def crop(self, array: Pixels) -> Pixels:
        """Return the part of an array [H, W, ...] inside the box."""
        return array[self.top : self.bottom, self.left : self.right]


def mask_box(mask: np.ndarray, dilation: float = BOX_DILATION) -> Box | None:
    """Return the enlarged bounding box of a mask, rounded outwards and clipped to the image; None if the mask is empty.

    Args:
        mask: bool [H, W].
        dilation: share of the box's width (or height) by which the left and right sides (or top and bottom) move
            outwards.
    """
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if len(rows) == 0:
        return None
    height, width = mask.shape
    top, bottom = _dilate_interval(int(rows[0]), int(rows[-1]) + 1, dilation, height)
    left, right = _dilate_interval(int(columns[0]), int(columns[-1]) + 1, dilation, width)
    return Box(left, top, right, bottom)


def _dilate_interval(low: int, high: int, dilation: float, size: int) -> tuple[int, int]:
    """Widen the interval of pixels low to high - 1 by the share `dilation` at each end, clipped to 0 and `size`."""
    margin = round(dilation * (high - low), 9)  # 0.1 * 30 is slightly above 3 in floats: rounding up must not give 4
    return max(0, floor(low - margin)), min(size, ceil(high + margin))


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio in dB for a peak of 1; inf for identical images."""
    image, truth = _as_unit_pair(image, truth)
    return _decibels(image - truth)


def _decibels(difference: np.ndarray) -> float:
    """Return the PSNR in dB for a peak of 1, from the differences of all values; inf if all are 0."""
    error = float(np.mean(difference**2))
    return -10.0 * log10(error) if error > 0 else inf


def ssim(image: np.ndarray, truth: np.ndarray) -> float:
    """Return the mean structural similarity (Wang et al., 2004), computed as `PROTOCOL["ssim"]` states.

    Raises:
        ValueError: a side of the images has fewer than 11 px.
    """
    return float(ssim_map(image, truth).mean())


def ssim_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the SSIM of each window of 11 x 11 px that lies inside the image, float64 [H - 10, W - 10, 3].

    Raises:
        ValueError: a side of the images has fewer than 11 px.
    """
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
    """Return the mean LDR-FLIP error (Andersson et al., 2020) in [0, 1]; 0 for identical images."""
    return float(flip_map(image, truth).mean(dtype=np.float64))


def flip_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the LDR-FLIP error at each pixel, float32 [H, W] in [0, 1]."""
    return ldr_flip.flip_map(*_as_unit_pair(image, truth))


@dataclass(frozen=True)
class LpipsTarget:
    """A ground truth in the form of its activations in an LPIPS network.

    The activations are computed once for all images that are compared with this ground truth.

    Attributes:
        model: the LPIPS network.
        activations: the result of `Lpips.activations` for the ground truth.
    """

    model: Lpips
    activations: list[torch.Tensor]

    @torch.no_grad()
    def distance(self, image: np.ndarray) -> float:
        """Return the LPIPS distance between an image and the ground truth.

        Args:
            image: [H, W, 3] of the ground truth's size, uint8 or float in [0, 1].

        Raises:
            ValueError: the array has another dtype or range, or is too small for the network.
        """
        return float(self.model.distance(_as_lpips_input(image), self.activations))


@torch.no_grad()
def lpips_targets(truth: np.ndarray, models: dict[str, Lpips]) -> dict[str, LpipsTarget | None]:
    """Compute the LPIPS activations of a ground truth in each network.

    Args:
        truth: [H, W, 3].
        models: name of the network ("alex" or "vgg") -> network.

    Returns:
        Name of the network -> target; None if the ground truth is too small for the network.
    """
    fits = {net: min(truth.shape[:2]) >= SMALLEST[net] for net in models}
    return {n: LpipsTarget(m, m.activations(_as_lpips_input(truth))) if fits[n] else None for n, m in models.items()}


def _as_lpips_input(image: np.ndarray) -> torch.Tensor:
    """Convert an image [H, W, 3] to float32 [1, 3, H, W] in [-1, 1]."""
    return torch.from_numpy(2.0 * _as_unit(image) - 1.0).permute(2, 0, 1)[None].float()


def score(
    image: np.ndarray, truth: np.ndarray, targets: dict[str, LpipsTarget | None] | None = None
) -> dict[str, float | None]:
    """Compute all metrics of an image against its ground truth.

    Args:
        image, truth: [H, W, 3] of one size.
        targets: the result of `lpips_targets` for the ground truth; None to leave LPIPS out.

    Returns:
        "psnr", "ssim", "flip", and for each target "lpips_alex" or "lpips_vgg" -> value; None if the image is too small
        for this metric.
    """
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
    """Compute all scores of a view: in the mask's box, outside the mask, and on the full image (without LPIPS).

    Args:
        image, truth: [H, W, 3] of one size.
        box: the mask's box; None if the mask is empty, which makes the scores of the box None.
        targets: the result of `lpips_targets` for the part of the ground truth in the box; None to leave LPIPS out.
        mask: bool [H, W], True = the object, which the caller may have grown by a margin (`rows.OUTSIDE_MARGIN`). The
            scores outside count the other pixels. None if no pixel is masked.
        shows_object: True if the ground truth shows the object, so that only pixels outside the mask can be scored, and
            the scores of the box and of the full image are None.
        unseen: bool [H, W], True = no training view shows the surface of this pixel; None if unknown, which makes
            "psnr_outside_seen" and "unseen_share" None.

    Returns:
        A value for each name in `COLUMNS`; None if it cannot be computed.
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
    """Compute "psnr_outside", "ssim_outside" and "flip_outside" over the pixels where the mask, bool [H, W], is False.

    The windows of SSIM and the filters of FLIP at these pixels reach into the mask. For both metrics the ground truth
    replaces the image inside the mask, so that the image's pixels inside the mask do not change a score outside.

    Returns:
        Name -> value. All are None if the mask covers the image. "ssim_outside" is None if no window of 11 x 11 px
        inside the image has its center outside the mask.
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
    """Compute the PSNR over the pixels outside the mask that training views show, and the share that they do not show.

    Args:
        mask: bool [H, W], True = not scored.
        unseen: bool [H, W], True = no training view shows the surface of this pixel.

    Returns:
        "psnr_outside_seen": PSNR over the pixels outside mask and `unseen`; None if there are none. "unseen_share": the
        share in [0, 1] of the pixels outside the mask that are in `unseen`; None if the mask covers the image.
    """
    kept = ~mask
    return {
        "psnr_outside_seen": _masked_psnr(image, truth, kept & ~unseen),
        "unseen_share": float(unseen[kept].mean()) if kept.any() else None,
    }


def _masked_psnr(image: np.ndarray, truth: np.ndarray, pixels: np.ndarray) -> float | None:
    """Return the PSNR over chosen pixels, bool [H, W]; None if no pixel is chosen."""
    if not pixels.any():
        return None
    image, truth = _as_unit_pair(image, truth)
    return _decibels((image - truth)[pixels])


def mean(values: list[float | None]) -> float | None:
    """Return the mean of the values that are not None, each at most `PSNR_CAP`; None if all values are None.

    Only PSNR can exceed the cap. Without the cap one identical view would make the mean infinite. If identical views
    were left out instead, a better result could get a worse mean.
    """
    present = [min(value, PSNR_CAP) for value in values if value is not None]
    return float(np.mean(present)) if present else None


def join_side_by_side(panels: list[np.ndarray], box: Box | None) -> np.ndarray:
    """Join pictures from left to right, with 4 px of white between them and the box drawn in yellow on each.

    Args:
        panels: uint8 [H, W, 3] each, of one height.
        box: the box to draw; None to draw none.

    Returns:
        uint8 [H, W', 3].
    """
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
    """Convert two images to float64 in [0, 1]; raises ValueError if they are no images, differ in size or are empty."""
    if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"a metric compares two [H, W, 3] of one size; got {image.shape} and {truth.shape}")
    if image.size == 0:
        raise ValueError("a metric needs at least one pixel")
    return _as_unit(image), _as_unit(truth)


def _as_unit(image: np.ndarray) -> np.ndarray:
    """Convert a uint8 image, or a float image in [0, 1], to float64 in [0, 1]; raises ValueError for other images."""
    if image.dtype == np.uint8:
        return image / 255.0
    if not np.issubdtype(image.dtype, np.floating):
        raise ValueError(f"an image is uint8 or float in [0, 1], not {image.dtype}")
    if not (image.min() >= 0.0 and image.max() <= 1.0):  # also refuses NaN
        raise ValueError(f"a float image lies in [0, 1]; this one spans {image.min():.3g} to {image.max():.3g}")
    return image.astype(np.float64)
