"""Scores by the protocol `imfine_bbox_v1` of FreeInpaint (after IMFine), which other methods print their figures by.

Facts of the protocol: `metrics/evaluate.py` of github.com/Rorisis/FreeInpaint, and the defaults of pyiqa that it uses.
"""

from __future__ import annotations

from math import log10

import cv2
import numpy as np
from PIL import Image

from reffusion.metrics import image_metrics
from reffusion.metrics.image_metrics import SSIM_WINDOW, Box
from reffusion.metrics.lpips import NAMES, Lpips

SIZE = 504, 280  # px, width and height of all pictures
LUMA = np.array([0.299, 0.587, 0.114])
LEAST_ERROR = 1e-8  # is added to the mean squared error
NET = "alex"
PREFIX = "imfine_bbox_v1_"  # of the columns of per_view.csv
COLUMNS = ("psnr", "ssim", NAMES[NET])
PROTOCOL = (
    f"imfine_bbox_v1 (FreeInpaint, its SPIn-NeRF setting) without FID and KID: pictures resized to {SIZE[0]}x{SIZE[1]} "
    "px (Lanczos; masks: nearest pixel), the box of the mask's largest contour without a margin; PSNR of RGB, SSIM of "
    "the rounded luma, negative structure counted 0, LPIPS alex; mean over the views that have the value"
)


def score_view(image: np.ndarray, truth: np.ndarray, mask: np.ndarray, models: dict[str, Lpips]) -> dict[str, float]:
    """Return the scores of a view: name of `COLUMNS` with `PREFIX` -> value.

    A score that the box is too small for, or whose network is missing, is left out. The result is {} if the mask is
    empty.

    Args:
        image, truth: uint8 [H, W, 3].
        mask: bool [H, W], True = the object.
        models: name of the network -> LPIPS network.
    """
    box = largest_contour_box(_resize(mask.astype(np.uint8), Image.Resampling.NEAREST))
    if box is None:
        return {}
    image, truth = (box.crop(_resize(each, Image.Resampling.LANCZOS)) for each in (image, truth))
    error = float(np.mean((image / 255.0 - truth / 255.0) ** 2))
    values = {"psnr": -10 * log10(error + LEAST_ERROR)}
    if min(truth.shape[:2]) >= SSIM_WINDOW:
        # SSIM is the product of a luminance term, which is never negative, and of the structure that is clipped.
        values["ssim"] = float(image_metrics.ssim_map(_luma(image), _luma(truth)).clip(min=0).mean())
    targets = image_metrics.lpips_targets(truth, {net: model for net, model in models.items() if net == NET})
    values |= {NAMES[net]: target.distance(image) for net, target in targets.items() if target}
    return {PREFIX + name: value for name, value in values.items()}


def largest_contour_box(mask: np.ndarray) -> Box | None:
    """Return the box of the contour with the largest area in a mask, uint8 [H, W]; None if all pixels are 0."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not contours:
        return None
    left, top, width, height = cv2.boundingRect(max(contours, key=cv2.contourArea))
    return Box(left, top, left + width, top + height)


def _resize(picture: np.ndarray, resampling: Image.Resampling) -> np.ndarray:
    return np.asarray(Image.fromarray(picture).resize(SIZE, resampling))


def _luma(picture: np.ndarray) -> np.ndarray:
    """Return the rounded luma of a picture in three equal channels, uint8 [H, W, 3]."""
    return np.repeat(np.rint(picture @ LUMA).astype(np.uint8)[..., None], 3, 2)
