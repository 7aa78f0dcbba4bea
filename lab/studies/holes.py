"""Pictures with holes and scores of their fillings, shared by `lab/studies/prior.py` and related studies.

*Held-out* pictures are pictures that the prior was not trained on. They come from the generators of the embedded
prior's training data, with seeds that no training uses. Every random draw is seeded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from lab.prior import images
from reffusion import seeding
from reffusion.io.images import save_image
from reffusion.metrics import image_metrics, lpips
from reffusion.prior import diffusion, harmonic_fill
from reffusion.prior.model import Prior

SIDE = 64  # side of the held-out pictures, px
SEED = 20  # seed of the held-out set; training and validation of the prior use other seeds
COVER = (0.05, 0.4)  # share of a held-out picture that its hole covers
SAMPLER_STEPS = 12  # default number of sampler steps: that of the laptop profile for its reference
BATCH = 16  # holes filled at once
COLUMNS = ("psnr", "ssim", "flip", "energy", "lpips")
WINDOW_SCALES = (0.35, 1.0)  # scales of the photographs of which windows are cut


@dataclass(frozen=True)
class Case:
    """Picture with a hole to fill.

    Attributes:
        truth: uint8 [H, W, 3], the whole picture.
        hole: bool [H, W], True for the pixels to fill.
        kind: "photograph", "procedural", "whole" or "window" for held-out pictures, else the name of a view.
    """

    truth: np.ndarray
    hole: np.ndarray
    kind: str


def make_cases(count: int, seed: int = SEED) -> list[Case]:
    """Make held-out pictures of `SIDE` px, each with a random silhouette as its hole, whose size is within `COVER`."""
    cases = []
    for index in range(count):
        picture, subject = images.image(seed, index, held_out=True)
        truth = cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        rng = np.random.default_rng(seeding.seed_for(seed, "hole", index))
        is_photograph = subject in {images.SUBJECTS[name] for name in images.HELD_OUT_PHOTOS}
        kind = "photograph" if is_photograph else "procedural"
        cases.append(Case(truth, _draw_hole(rng), kind))
    return cases


def make_photograph_cases(photographs: images.Photographs, count: int, seed: int = SEED) -> list[Case]:
    """Make `count` pictures of each kind from photographs, `SIDE` px, with holes as in `make_cases`.

    Of kind "whole" is the largest square of a photograph at a random place, reduced; of kind "window" a square of
    `SIDE` px from a photograph at one of `WINDOW_SCALES`.
    """
    cases = []
    for index in range(count):
        _, photograph = photographs[index % len(photographs)]
        rng = np.random.default_rng(seeding.seed_for(seed, "photograph", index))
        scale = rng.uniform(*WINDOW_SCALES)
        reduced = cv2.resize(photograph, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        whole = _cut_square(rng, photograph, min(photograph.shape[:2]))
        whole = cv2.resize(whole, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        cases.append(Case(whole, _draw_hole(rng), "whole"))
        cases.append(Case(_cut_square(rng, reduced, SIDE), _draw_hole(rng), "window"))
    return cases


def _cut_square(rng: np.random.Generator, picture: np.ndarray, side: int) -> np.ndarray:
    top, left = (rng.integers(length - side + 1) for length in picture.shape[:2])
    return np.ascontiguousarray(picture[top : top + side, left : left + side])


def _draw_hole(rng: np.random.Generator) -> np.ndarray:
    """Draw a silhouette, bool [SIDE, SIDE], whose size is within `COVER`."""
    hole = images.silhouettes(rng, SIDE)
    while not COVER[0] <= hole.mean() <= COVER[1]:
        hole = images.silhouettes(rng, SIDE)
    return hole


def hole_scores(picture: np.ndarray, truth: np.ndarray, hole: np.ndarray) -> dict[str, float]:
    """Score a filling inside its hole.

    Args:
        picture: uint8 [H, W, 3]; outside the hole its pixels are replaced by the truth.
        truth: uint8 [H, W, 3].
        hole: bool [H, W], True for the filled pixels.

    Returns:
        "psnr" over the hole's pixels in dB, at most `PSNR_CAP`; "ssim" and "flip" as means of their maps over the hole;
        "energy", the gradient energy in the hole relative to that of the truth (below 1 is too smooth); "lpips", of the
        whole picture by AlexNet, NaN if its weights have not been fetched.

    Raises:
        ValueError: the hole is empty.
    """
    if not hole.any():
        raise ValueError("the hole is empty: there is nothing to score")
    picture = np.where(hole[..., None], picture, truth)
    error = float(np.mean((picture[hole] / 255.0 - truth[hole] / 255.0) ** 2))
    return {
        "psnr": min(-10 * np.log10(error), image_metrics.PSNR_CAP) if error > 0 else image_metrics.PSNR_CAP,
        "ssim": float(ssim_map(picture, truth)[hole].mean()),
        "flip": float(image_metrics.flip_map(picture, truth)[hole].mean()),
        "energy": gradient_energy(picture, hole) / max(gradient_energy(truth, hole), 1e-9),
        "lpips": _lpips(picture, truth),
    }


@torch.no_grad()
def _lpips(picture: np.ndarray, truth: np.ndarray) -> float:
    network = _load_alexnet()
    if network is None:
        return float("nan")
    to_input = lambda image: torch.from_numpy(image).permute(2, 0, 1)[None].float() / 127.5 - 1
    return float(network(to_input(picture), to_input(truth)))


@lru_cache
def _load_alexnet() -> lpips.Lpips | None:
    return lpips.load("alex")[0]


def ssim_map(picture: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the map [H, W] of SSIM, averaged over RGB, with the Gaussian window of `image_metrics.ssim`."""
    from skimage.metrics import structural_similarity

    _, values = structural_similarity(
        picture / 255.0,
        truth / 255.0,
        gaussian_weights=True,
        sigma=image_metrics.SSIM_SIGMA,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
        full=True,
    )
    return values.mean(2)


def gradient_energy(picture: np.ndarray, hole: np.ndarray) -> float:
    """Return the mean squared difference of brightness between neighboring pixels that are both in the hole."""
    light, total, count = picture.mean(2) / 255, 0.0, 0
    for axis in (0, 1):
        both = np.logical_and(*(hole.take(range(k, hole.shape[axis] - 1 + k), axis) for k in (0, 1)))
        total += (np.diff(light, axis=axis)[both] ** 2).sum()
        count += both.sum()
    return float(total / max(count, 1))


def mean_scores(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each score, "psnr_error" (the standard error of PSNR) and "pictures" (their number)."""
    values = {column: float(np.mean([row[column] for row in rows])) for column in COLUMNS}
    spread = np.std([row["psnr"] for row in rows], ddof=1) / len(rows) ** 0.5 if len(rows) > 1 else 0.0
    return values | {"psnr_error": float(spread), "pictures": len(rows)}


def to_tensors(cases: list[Case]) -> tuple[Tensor, Tensor]:
    """Convert cases to pictures [B, 3, H, W] in [-1, 1] and holes [B, 1, H, W], 1 = repaint."""
    pictures = torch.from_numpy(np.stack([case.truth for case in cases])).permute(0, 3, 1, 2).float() / 127.5 - 1
    return pictures, torch.from_numpy(np.stack([case.hole for case in cases]))[:, None].float()


def fill_holes(
    prior: Prior, cases: list[Case], seed: int, prompt: str = "", steps: int = SAMPLER_STEPS, start: float = 1.0
) -> list[np.ndarray]:
    """Fill the holes with the prior; return uint8 [H, W, 3] for each case.

    Outside the holes the new pictures equal the cases'. All priors get the same noise for the same seed.

    Args:
        steps: number of sampler steps from pure noise.
        start: noise level from which the harmonic extension into the hole is painted, in a proportional part of the
            steps, as `inpaint.paint` does. 1: pure noise.
    """
    done = []
    for first in range(0, len(cases), BATCH):
        pictures, holes = to_tensors(cases[first : first + BATCH])
        text = diffusion.embed_text(prior, [prompt]).detach().expand(len(pictures), -1, -1)
        noise = seeding.generator(seed, "sample", first)
        initial = harmonic_fill.harmonic_extension(pictures, holes)
        taken = max(1, round(steps * start))
        filled = diffusion.sample(prior, initial, holes, text, taken, noise, start=start)
        filled = ((pictures * (1 - holes) + filled * holes).permute(0, 2, 3, 1) + 1) * 127.5
        done += list(filled.round().clamp(0, 255).to(torch.uint8).numpy())
    return done


def save_row(path: Path, case: Case, pictures: list[np.ndarray]) -> None:
    """Save the picture with its hole in gray, the fillings and the truth side by side."""
    path.parent.mkdir(parents=True, exist_ok=True)
    hollow = np.where(case.hole[..., None], np.uint8(128), case.truth)
    save_image(path, np.concatenate([hollow, *pictures, case.truth], 1))
