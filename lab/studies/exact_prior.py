"""An exact denoiser: the posterior mean over fillings of a scene's views, in place of a diffusion model's UNet.

The study `control` distils it. A few fillings agree with the reference: the truth, and two pictures close to it. All
others are the truth with the hole's content displaced, or hold content of other scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from reffusion.prior import diffusion, harmonic_fill, windows
from reffusion.prior.model import Prior, load_prior

TINY = Path(__file__).resolve().parents[2] / "priors" / "tiny"
FILLINGS, CLOSE = 50, 3  # fillings of a hole; the first `CLOSE` of them agree with the reference
DISPLACED = 24  # fillings whose content is displaced
DISPLACEMENT = (2.0, 10.0)  # px, smallest and largest displacement


# ---------------------------------------------------------------------------------------------- fillings


def displace(picture: Tensor, hole: Tensor, shift: tuple[float, float]) -> Tensor:
    """Return a picture [3, H, W] whose content in the hole is displaced by `shift` (x, y) px, and less near the border.

    Args:
        hole: bool [H, W].
        shift: displacement in the middle of the hole.
    """
    inside = cv2.distanceTransform(hole.numpy().astype(np.uint8), cv2.DIST_L2, 3)
    weight = np.clip(inside / max(np.hypot(*shift), 1), 0, 1).astype(np.float32)
    rows, columns = np.mgrid[: hole.shape[0], : hole.shape[1]]
    x, y = ((axis - weight * by).astype(np.float32) for axis, by in zip((columns, rows), shift, strict=True))
    source = np.ascontiguousarray(picture.permute(1, 2, 0).numpy())
    moved = cv2.remap(source, x, y, cv2.INTER_LINEAR, None, cv2.BORDER_REFLECT)
    return torch.from_numpy(moved).permute(2, 0, 1)


def transplant(picture: Tensor, donors: Tensor, hole: Tensor) -> Tensor:
    """Return pictures [N, 3, H, W] whose holes show the donors [N, 3, H, W], shifted smoothly to the known colors."""
    difference = picture - donors
    shift = harmonic_fill.harmonic_extension(difference, hole.float().expand(len(donors), 1, -1, -1))
    return picture + hole * (shift - difference)


def make_fillings(truth: Tensor, hole: Tensor, donors: Sequence[Tensor], random: np.random.Generator) -> Tensor:
    """Return the fillings of a view's hole, [FILLINGS, 3, H, W] in [-1, 1]; the first `CLOSE` agree with the reference.

    Args:
        truth: [3, H, W], the view without the object.
        hole: bool [H, W], the pixels to fill.
        donors: pictures [3, H, W] of other scenes.
        random: the source of randomness.
    """
    blurred = torch.from_numpy(cv2.GaussianBlur(truth.permute(1, 2, 0).numpy().copy(), (0, 0), 0.5)).permute(2, 0, 1)
    found = [truth, torch.where(hole, blurred, truth), displace(truth, hole, (0.3, 0.3))]
    for _ in range(DISPLACED):
        turn, length = random.uniform(0, 2 * np.pi), random.uniform(*DISPLACEMENT)
        found.append(displace(truth, hole, (length * np.cos(turn), length * np.sin(turn))))
    chosen = [donors[k] for k in random.integers(len(donors), size=FILLINGS - len(found))]
    flipped = [donor.flip(2) if random.random() < 0.5 else donor for donor in chosen]
    return torch.cat([torch.stack(found), transplant(truth, torch.stack(flipped), hole)]).clamp(-1, 1)


# ---------------------------------------------------------------------------------------------- denoiser


class Place(NamedTuple):
    """Where a sample was found: the view's number, and the window's corner, None for a whole view."""

    view: int
    corner: tuple[int, int] | None


class ExactDenoiser(nn.Module):
    """The posterior mean over fillings, in place of a UNet: it takes [z_t | mask | known latents] and predicts v.

    Attributes:
        personalized: whether a prompt other than the empty one selects the fillings that agree with the reference.
    """

    def __init__(self, fillings: Tensor, prior: Prior, empty: Tensor):
        """Prepare the denoiser.

        Args:
            fillings: [V, K, 3, H, W] in [-1, 1], of all views; the first `CLOSE` agree with the reference.
            prior: provides schedule, native size and VAE, whose latents are a linear map of pixels.
            empty: [L, D], the embedding of the empty prompt.
        """
        super().__init__()
        self.alphas, self.size = prior.alphas_cumprod, prior.native_size
        self.empty, self.personalized = empty, True
        with torch.no_grad():  # the VAE is linear, and slower than its matrix
            colors = torch.cat([torch.zeros(1, 3), torch.eye(3)])[..., None, None].expand(4, 3, 8, 8)
            black, *basis = diffusion.encode(prior, colors)[:, :, 4, 4]
            matrix = torch.stack(basis, 1) - black[:, None]
            latents = lambda images: torch.einsum("lc,vkchw->vklhw", matrix, images) + black[:, None, None]
            self.full = latents(fillings)
            self.small = latents(torch.stack([windows.resize(each, self.size, self.size) for each in fillings]))
        self.config = SimpleNamespace(sample_size=self.size, addition_embed_type=None)
        self.anchor = nn.Parameter(torch.zeros(()), requires_grad=False)  # by which the code finds the type of weights
        self.spectra = torch.fft.rfft2(torch.cat([self.full[:, 0], self.full[:, 0].square().sum(1, keepdim=True)], 1))

    def recognize(self, known: Tensor, mask: Tensor) -> Place:
        """Find the view and the window that the known pixels show.

        Args:
            known: [4, S, S], latents of the known pixels.
            mask: [1, S, S], 1 = hole.
        """
        seen = 1 - mask
        whole = ((self.small[:, 0] - known).square() * seen).sum((1, 2, 3))
        height, width = self.full.shape[-2:]
        kernel = torch.cat([-2 * known * seen, seen])
        transformed = torch.fft.rfft2(kernel, s=(height, width))
        error = torch.fft.irfft2((self.spectra * transformed.conj()).sum(1), s=(height, width))
        error = error[:, : height - self.size + 1, : width - self.size + 1] + (known * seen).square().sum()
        if whole.min() < error.min():
            return Place(int(whole.argmin()), None)
        view, top, left = np.unravel_index(int(error.argmin()), error.shape)
        return Place(int(view), (int(top), int(left)))

    def forward(self, sample: Tensor, t: Tensor, encoder_hidden_states: Tensor) -> SimpleNamespace:
        """Return v [B, 4, S, S] as `.sample`, for samples [B, 9, S, S], timesteps [B] and embeddings [B, L, D]."""
        predictions, places = [], {}
        for row, step, words in zip(sample, t, encoder_hidden_states, strict=True):
            noisy, mask, known = row[:4], row[4:5], row[5:]
            condition = row[4:].numpy().tobytes()  # guidance asks twice for each
            if condition not in places:
                places[condition] = self.recognize(known, mask)
            view, corner = places[condition]
            found = self.small[view]
            if corner:
                top, left = corner
                found = self.full[view, ..., top : top + self.size, left : left + self.size]
            if self.personalized and not torch.equal(words, self.empty):
                found = found[:CLOSE]
            abar = self.alphas[step].double()
            signal, spread = abar.sqrt(), (1 - abar).sqrt()
            distance = ((noisy - signal.float() * found) * mask).square().sum((1, 2, 3)).double()
            weight = torch.softmax(-distance / (2 * spread.square()), 0).float()
            clean = torch.einsum("k,kchw->chw", weight, found)
            eps = (noisy - signal * clean) / spread
            predictions.append((signal * eps - spread * clean).float())
        return SimpleNamespace(sample=torch.stack(predictions))


def make_prior(fillings: Tensor) -> tuple[Prior, Tensor]:
    """Return a prior with an exact denoiser, and the embeddings [3, L, D] of the global, local and empty prompt.

    Args:
        fillings: as of `ExactDenoiser`.
    """
    prior = replace(load_prior(TINY), fills=False, contrast=0.0)
    # Any embeddings that differ will do, and those of the prior's text encoder need not.
    text = torch.eye(3)[:, None]
    return replace(prior, unet=ExactDenoiser(fillings, prior, text[2]), text_encoder=None), text
