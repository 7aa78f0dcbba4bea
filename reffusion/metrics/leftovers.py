"""A score without ground truth: the share of an object that a segmentation network still finds after its removal."""

from __future__ import annotations

import cv2
import numpy as np

from reffusion.clicks.marks import Clicks
from reffusion.clicks.sam_onnx import load_distilled_sam
from reffusion.clicks.segmenter import Prompt, Segmenter, encode_image, predict_masks
from reffusion.morphology import open_mask
from reffusion.weights.local import segmenter_cache

SAME = 20  # of 255: largest difference of a color channel at which a pixel looks as it did with the object
WIDTH = 0.01  # of the image's width: narrower remains are not examined
SEGMENT = 0.8  # least share of a segment that looks as it did with the object
FOUND = 0.02  # least share of the object's pixels for a leftover
MOST_PROMPTS = 8  # in a view
MOST_VIEWS = 8  # views in which leftovers are looked for
COLUMN = "leftover_share"
PROTOCOL = (
    "a leftover is a segment of the distilled SAM, asked in the middle of each island of the mask's pixels that differ "
    f"by at most {SAME} of 255 from the rendering with the object; {SEGMENT:.0%} of the segment or more are such "
    f"pixels, and it has at least {FOUND:.0%} of the mask's size; share: of the mask, mean over the examined views"
)


def load_segmenter() -> tuple[Segmenter | None, str | None]:
    """Load the network. Returns (network, None), or (None, why it cannot be used on this machine)."""
    try:
        segmenter = load_distilled_sam(segmenter_cache())
    except ValueError as error:
        return None, str(error)
    return segmenter, None if segmenter else "the network is not on this machine: `make weights` fetches it"


def find_leftovers(segmenter: Segmenter, before: np.ndarray, after: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Find the parts of a removed object that are still visible as things of their own in a view, bool [H, W].

    Args:
        segmenter: the network, which is asked about `after`.
        before, after: uint8 [H, W, 3], the rendered view with the object and after its removal.
        mask: bool [H, W], the object; other pixels are False in the result.
    """
    same = mask & (cv2.absdiff(before, after).max(-1) <= SAME)
    found, left, features = np.zeros_like(mask), open_mask(same, WIDTH), None
    for _ in range(MOST_PROMPTS):
        if np.count_nonzero(left) < FOUND * np.count_nonzero(mask):
            break
        features = features or encode_image(segmenter, after)
        depth = cv2.distanceTransform(np.pad(left, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
        middle = np.array(np.unravel_index(depth.argmax(), depth.shape)[::-1]) + 0.5
        prompt = Prompt(Clicks(middle[None], np.array([True])))
        segments = [each.mask for each in predict_masks(segmenter, features, prompt)]
        things = [each for each in segments if each.any() and same[each].mean() >= SEGMENT]
        thing = max(things, key=np.count_nonzero, default=np.zeros_like(mask))
        if np.count_nonzero(thing) >= FOUND * np.count_nonzero(mask):
            found |= thing & mask
        around = cv2.circle(np.zeros(mask.shape, np.uint8), middle.astype(int).tolist(), int(depth.max()), 1, -1) > 0
        left = open_mask(left & ~thing & ~around, WIDTH)
    return found


def measure_share(segmenter: Segmenter, before: np.ndarray, after: np.ndarray, mask: np.ndarray) -> float:
    """Return the share in [0, 1] of a non-empty mask that `find_leftovers` finds; the arguments are the same."""
    return float(find_leftovers(segmenter, before, after, mask)[mask].mean())
