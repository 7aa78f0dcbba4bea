"""Cases of metrics (identical, constant, 1-px images) and of masks (empty, full, contradictory, in one view only)."""

from __future__ import annotations

import math

import numpy as np
import torch

from lab.stability.cases import EPS32, EPS64, EXACT, UNCLEAR, Case, count_unclear_refusal, nan_safe_max
from lab.stability.splatting import camera, cloud
from reffusion import morphology
from reffusion.background import continuation, unobserved, visibility
from reffusion.gaussians.optimize import reconstruction_loss
from reffusion.gaussians.ssim import C1
from reffusion.masks import voting
from reffusion.metrics import image_metrics
from reffusion.metrics.lpips import Lpips
from reffusion.splat.rasterizer import render

VIEWS = [camera(12, 10), camera(12, 10, 1.2), camera(12, 10, 1.5)]
NAMED = [type(view)(f"v{k}", *list(vars(view).values())[1:8]) for k, view in enumerate(VIEWS)]  # with unequal names
EMPTY, FULL = np.zeros((10, 12), bool), np.ones((10, 12), bool)


def picture(height: int = 24, width: int = 32) -> np.ndarray:
    """Return a picture of noise, uint8 [H, W, 3]."""
    return np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint8)


def flat(value: float, height: int = 24, width: int = 32) -> np.ndarray:
    """Return a constant picture [H, W, 3]."""
    return np.full((height, width, 3), value)


# ------------------------------------------------------------------------------------------------ metrics


def identical() -> float:
    """Count wrong scores of identical images: PSNR must be infinite, and 100 dB in a mean; SSIM 1; FLIP 0."""
    scores = image_metrics.score(picture(), picture())
    good = scores["psnr"] == math.inf, abs(scores["ssim"] - 1) < 1e-12, scores["flip"] == 0
    return float(4 - sum(good) - (image_metrics.mean([scores["psnr"]]) == image_metrics.PSNR_CAP))


def constant_ssim() -> float:
    """Return the largest error of SSIM for two constant images a and b.

    The exact value is the luminance term of SSIM, (2ab + C1) / (a^2 + b^2 + C1).
    """
    worst = 0.0
    for a, b in ((0.0, 1.0), (0.25, 0.75), (0.0, 0.0), (1.0, 1.0)):
        worst = nan_safe_max(worst, abs(image_metrics.ssim(flat(a), flat(b)) - (2 * a * b + C1) / (a * a + b * b + C1)))
    return worst


def constant_psnr() -> float:
    """Return the largest error of PSNR for constant images, whose exact value is -20 log10 of their difference.

    Differences are as small as 2^-24. The error in dB is divided by -log2 of the difference, if this is above 1.
    """
    worst = 0.0
    for step in (1.0, 0.5, 2.0**-8, 2.0**-24):
        missed = abs(image_metrics.psnr(flat(0.0), flat(step)) + 20 * math.log10(step))
        worst = nan_safe_max(worst, missed / max(1, -math.log2(step)))
    return worst


def constant_flip() -> float:
    """Return by how much FLIP is outside its range for constant images; at most 0 if it is inside.

    FLIP must be 0 for an image and itself, and in [0.9, 1] for black and white.
    """
    zero, most = image_metrics.flip(flat(0.3), flat(0.3)), image_metrics.flip(flat(0.0), flat(1.0))
    return nan_safe_max(zero, 0.9 - most, most - 1.0)


def one_pixel() -> float:
    """Count wrong scores of images of 1 x 1 px: PSNR and FLIP must be right and finite, SSIM None."""
    black, gray = flat(0.0, 1, 1), flat(0.5, 1, 1)
    scores = image_metrics.score(black, gray)
    good = abs(scores["psnr"] + 20 * math.log10(0.5)) < 1e-9, 0 < scores["flip"] <= 1, scores["ssim"] is None
    return float(3 - sum(good))


def one_pixel_box() -> float:
    """Count the violations for a mask of one pixel in a corner.

    Its box must be inside the image, its PSNR finite, and its SSIM None.
    """
    mask = np.zeros((24, 32), bool)
    mask[-1, -1] = True
    box = image_metrics.mask_box(mask)
    scored = image_metrics.score_view(picture(), 255 - picture(), box)
    inside = 0 <= box.left < box.right <= 32 and 0 <= box.top < box.bottom <= 24
    return float(not inside) + float(not math.isfinite(scored["psnr_box"])) + float(scored["ssim_box"] is not None)


def count_lpips_faults(first: float, second: float, kind: torch.dtype) -> float:
    """Count the violated properties of LPIPS for two constant images, with random weights of both networks.

    The value must be 0 for equal images, and finite and not 0 for different ones. The gradient must be finite, and 0
    for equal images.

    Args:
        first: value of the first image, in [-1, 1].
        second: value of the second image.
        kind: precision.
    """
    torch.manual_seed(0)
    wrong = 0
    for net in ("alex", "vgg"):
        model = Lpips(net)
        for weight in model.linear:
            weight.data.fill_(1.0)
        model, image = model.to(kind), torch.full((1, 3, 32, 32), first, dtype=kind, requires_grad=True)
        value = model(image, torch.full((1, 3, 32, 32), second, dtype=kind))
        value.sum().backward()
        largest_slope = image.grad.abs().max().item()
        wrong += (value.item() == 0) != (first == second) or not math.isfinite(value.item())
        wrong += not math.isfinite(largest_slope) or (first == second and largest_slope > 0)
    return float(wrong)


def loss_of_constant_images() -> float:
    """Return the largest absolute value or gradient of the reconstruction loss for equal constant images.

    The loss is taken without weights, with weights of 1 and with weights of 0.
    """
    wrong = 0.0
    for value in (0.0, 0.5, 1.0):
        for weights in (None, torch.ones(9, 8), torch.zeros(9, 8)):
            image = torch.full((9, 8, 3), value, requires_grad=True)
            loss = reconstruction_loss(image, torch.full((9, 8, 3), value), weights)
            loss.backward()
            wrong = nan_safe_max(wrong, abs(loss.item()), image.grad.abs().max().item())
    return wrong


def loss_of_one_pixel() -> float:
    """Return the error of the reconstruction loss of 1 x 1 px, gray against black.

    The exact value is 0.8 * 0.5 + 0.2 * (1 - C1 / (0.25 + C1)).
    """
    loss = reconstruction_loss(torch.full((1, 1, 3), 0.5), torch.zeros(1, 1, 3))
    return abs(loss.item() - (0.4 + 0.2 * (1 - C1 / (0.25 + C1))))


# -------------------------------------------------------------------------------------------------- masks


def count_labelled(masks: dict[str, np.ndarray]) -> float:
    """Return the number of Gaussians that the masks' votes label as the object.

    Args:
        masks: view -> bool [H, W].
    """
    return float(voting.label_gaussians(voting.cast_votes(cloud(), NAMED, masks)).sum())


def count_seen() -> int:
    """Return the number of Gaussians that contribute to at least one of the views."""
    votes = voting.cast_votes(cloud(), NAMED, {view.name: FULL for view in NAMED})
    return int((votes.masked > 0).sum())


def full_mask_errors() -> float:
    """Return the difference between the numbers of labelled and of visible Gaussians if all masks are full.

    Full masks must label exactly the visible Gaussians.
    """
    return abs(count_labelled({view.name: FULL for view in NAMED}) - count_seen())


def tie_errors() -> float:
    """Count the violations if the masks of two views with the same camera contradict each other.

    One mask is full, the other empty. The votes must then be equal, and no Gaussian labelled (tau = 1).
    """
    twice = [NAMED[0], type(NAMED[0])("other", *list(vars(NAMED[0]).values())[1:8])]
    votes = voting.cast_votes(cloud(), twice, {NAMED[0].name: FULL, "other": EMPTY})
    return float(voting.label_gaussians(votes).sum() + (votes.masked != votes.unmasked).sum())


def one_view_errors() -> float:
    """Count the violations if only one of three views has a (full) mask.

    Views without a mask must not vote, so all Gaussians that the masked view sees must be labelled.
    """
    votes = voting.cast_votes(cloud(), NAMED, {"v1": FULL})
    return float((votes.unmasked > 0).sum() + (voting.label_gaussians(votes) != (votes.masked > 0)).sum())


def refuse_no_mask() -> float:
    """Return 0 if votes without any mask are refused with the cause, else 1."""
    return count_unclear_refusal(lambda: voting.cast_votes(cloud(), NAMED, {}), "none of the training views has a mask")


def empty_scene_errors() -> float:
    """Count the violations if all Gaussians were removed as the object.

    All pixels must then be unobserved, no plane may continue into the hole, and no view may see a point or past it.
    """
    nobody = cloud().map(lambda p: p[:0])
    views = visibility.render_depth_views(nobody, NAMED, {view.name: FULL for view in NAMED})
    planes = continuation.find_planes(np.zeros(3), 1.0, views, np.zeros((0, 3)))
    pixels = unobserved.find_unobserved(render(nobody, NAMED[0]), NAMED[0], FULL, views, planes)
    counts = visibility.count_views(np.zeros((1, 3)), views)
    return float(
        (~pixels.unobserved).sum() + np.isfinite(pixels.continued_depth).sum() + counts.seen.sum() + counts.free.sum()
    )


def tidying_errors() -> float:
    """Count the pixels of empty and full masks that change when small specks and gaps are removed; none may."""
    changed = [(morphology.remove_small_parts(mask, 5.0, 5.0) != mask).sum() for mask in (EMPTY, FULL)]
    return float(sum(changed))


def view_choice_errors() -> float:
    """Count wrong answers for empty and full masks.

    Empty masks must have no view to complete and no box, full masks must have both.
    """
    names = [view.name for view in NAMED]
    none = voting.best_view(dict.fromkeys(names, EMPTY), names), image_metrics.mask_box(EMPTY)
    some = voting.best_view(dict.fromkeys(names, FULL), names), image_metrics.mask_box(FULL)
    return float(sum(x is not None for x in none) + sum(x is None for x in some) + (some[1] != (0, 0, 12, 10)))


WRONG = "properties that do not hold"
CASES = (
    Case("metrics of identical images", WRONG, EXACT, identical),
    # Means of squares of numbers of order one over eleven by eleven weights, in float64; C1 = 1e-4 divides.
    Case("SSIM of constant images", "difference from the luminance term", 1e4 * EPS64 * 16, constant_ssim),
    Case("PSNR of constant images", "error (dB, by binary digit)", 64 * EPS64, constant_psnr),
    # FLIP computes in float32. Its value for white on black, the largest difference, is a few percent below 1 because
    # of FLIP's own tone mapping.
    Case("FLIP of constant images", "how far outside [0, 0] and [0.9, 1]", 16 * EPS32, constant_flip),
    Case("metrics of 1-px images", WRONG, EXACT, one_pixel),
    Case("box of a 1-px mask", WRONG, EXACT, one_pixel_box),
    Case("LPIPS of black and grey", WRONG, EXACT, lambda: count_lpips_faults(-1.0, 0.0, torch.float32)),
    Case("LPIPS of equal images", WRONG, EXACT, lambda: count_lpips_faults(0.3, 0.3, torch.float32)),
    Case("LPIPS of black images", WRONG, EXACT, lambda: count_lpips_faults(-1.0, -1.0, torch.float32)),
    Case("LPIPS in half precision", WRONG, EXACT,
         lambda: count_lpips_faults(-1.0, 0.0, torch.float16) + count_lpips_faults(-1.0, -1.0, torch.float16)),
    # E[x^2] - E[x]^2 of numbers of order one rounds by some 2^-24, against C2 = 9e-4.
    Case("reconstruction loss of identical constant images", "largest value or gradient", 4 * EPS32 / 9e-4,
         loss_of_constant_images),
    Case("reconstruction loss of 1-px images", "difference from the closed form", 8 * EPS32, loss_of_one_pixel),
    Case("masks empty", "Gaussians labelled", EXACT, lambda: count_labelled({view.name: EMPTY for view in NAMED})),
    Case("masks full", "Gaussians labelled wrongly", EXACT, full_mask_errors),
    Case("masks contradicting", "Gaussians labelled, and unequal votes", EXACT, tie_errors),
    Case("mask present in one view", "Gaussians labelled wrongly", EXACT, one_view_errors),
    Case("mask in no view", UNCLEAR, EXACT, refuse_no_mask),
    Case("masks full, nothing remains", "pixels and votes that say something", EXACT, empty_scene_errors),
    Case("masks empty and full, tidied", "pixels changed", EXACT, tidying_errors),
    Case("masks empty and full, views and boxes", WRONG, EXACT, view_choice_errors),
)  # fmt: skip
