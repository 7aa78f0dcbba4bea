"""What a stage takes on a card: operations and bytes counted at full size (counts.py), over the card's peaks.

Of each peak two fifths are reached, and computing and moving do not overlap: so it was on the one kind of card that was
timed, an H200, to a tenth to a fifth (docs/production.md). What the numbers stand for otherwise, where a plan cannot
know it yet: `BASIS`. The CPU's part of a stage is left out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from reffusion.cost.counts import COUNTS
from reffusion.io.machine import machine
from reffusion.params.base import PRIOR, REFINED_FROM
from reffusion.params.distill import Params as Distill
from reffusion.params.fit import Params as Fit
from reffusion.params.personalize import Params as Personalize
from reffusion.params.reference import Params as Reference

REACHED = 0.4  # of a card's peaks
VIEWS, WIDTH, HEIGHT, GAUSSIANS = 60, 1600, 1200, 1_000_000
GROWING = 0.6  # of the Gaussians that a fit ends with, that it has on the mean
HOLE = 0.2  # of a view
BASIS = (
    f"counted operations, {REACHED:.0%} of the card's peak as timed on an H200; {VIEWS} views of {WIDTH} x "
    f"{HEIGHT} px, {GAUSSIANS:,} Gaussians"
)
# Floats of a Gaussian of degree 3; of these it, its gradient and Adam's two moments are kept.
FLOATS, KEPT = 59, 4
# Bytes that gsplat moves for a Gaussian there and back (its own, its footprint, 10 tiles' lists), and for a pixel.
# Operations of a Gaussian in a pixel, of which the demo's views blend 36, and three times as many are looked at.
SPLAT_BYTES, PIXEL_BYTES, SPLAT_FLOPS = 3000, 200, 3 * 36 * 100
# GB: `python -m benchmarks.gpu.full_size --count`, SD2 in half precision at 512 px
WEIGHTS, PAINTED, DISTILLED, TRAINED = 2.7, 0.8, 3.3, 3.9
SDXL = "diffusers/stable-diffusion-xl-1.0-inpainting-0.1"
PRIORS = {PRIOR: ("SD2", 512), SDXL: ("SDXL", 1024)}  # name: that of the counts, native size in pixels


@dataclass(frozen=True)
class Card:
    """Peaks as its maker states them: half, single: 1e12 operations a second of products in half precision and in
    float32 (TF32 where it has it, which torch's convolutions take); plain: of float32 elsewhere; memory moves
    `bandwidth` 1e12 bytes a second, and holds `gigabytes`."""

    half: float
    single: float
    plain: float
    bandwidth: float
    gigabytes: float


CARDS = {
    "rtx-3090": Card(71, 35.6, 35.6, 0.936, 24),
    "rtx-4090": Card(165, 82.6, 82.6, 1.008, 24),
    "a100": Card(312, 156, 19.5, 2.0, 80),
    "h100": Card(989, 494, 67, 3.35, 80),
    "h200": Card(989, 494, 67, 4.8, 141),
}


def card_of(name: str) -> str | None:
    """The card that is named; of this machine where none is. None: it has none, or one that is not in the table.

    Raises ValueError for a name that is not in the table."""
    plain = lambda text: re.sub(r"[^a-z0-9]", "", text.lower())
    asked = name or machine().card or ""
    found = next((card for card in CARDS if asked and plain(card) in plain(asked)), None)
    if name and not found:
        raise ValueError(f"card {name!r} is none of {', '.join(CARDS)}")
    return found


@dataclass(frozen=True)
class Work:
    """Operations in half precision, in float32 and beside products, and bytes, 1e12 each."""

    half: float = 0.0
    single: float = 0.0
    plain: float = 0.0
    moved: float = 0.0

    def __add__(self, other: Work) -> Work:
        return Work(*(getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__))

    def times(self, count: float) -> Work:
        return Work(*(getattr(self, name) * count for name in self.__dataclass_fields__))

    def seconds(self, card: Card) -> float:
        computing = self.half / card.half + self.single / card.single + self.plain / card.plain
        return (computing + self.moved / card.bandwidth) / REACHED


def network(name: str, half: bool = False) -> Work:
    """A part of the table, once."""
    tera = COUNTS[name]["tflop"]
    return Work(tera * half, tera * (not half), 0.0, COUNTS[name]["gb"] / 1e3)


def drawing(pixels: float, gaussians: float) -> Work:
    """A view drawn, and the way back."""
    return Work(plain=SPLAT_FLOPS * pixels / 1e12, moved=(SPLAT_BYTES * gaussians + PIXEL_BYTES * pixels) / 1e12)


def reconstruction(gaussians: float) -> Work:
    """A view drawn and compared with its photograph, without Adam."""
    return drawing(WIDTH * HEIGHT, gaussians) + network("loss, a million pixels").times(WIDTH * HEIGHT / 1e6)


def adam(gaussians: float) -> Work:
    return network("Adam, a million Gaussians").times(gaussians / 1e6)


def answering(prior: str, half: bool, steps: float, guided: bool) -> Work:
    """A picture of the native size painted from `steps` answers: its latents and the picture again."""
    known = network(f"{prior} encode").times(2) + network(f"{prior} decode")
    return known + network(f"{prior} unet", half).times(steps * (1 + guided))


def fit(params: Fit) -> tuple[Work, float]:
    number = min(GAUSSIANS, params.densify.cap_max)
    step = reconstruction(GROWING * number) + adam(GROWING * number)
    return step.times(params.iterations), _scene(number)


def reference(params: Reference) -> tuple[Work, float] | None:
    if params.prior not in PRIORS or params.inpainter != "diffusion":
        return None
    prior, size = PRIORS[params.prior]
    finer, side = 0.0, 2 * size
    while side < 2 * HEIGHT:  # windows of three quarters of the native size over the hole, at sizes up to the view's
        shorter = min(side, HEIGHT)
        finer += max(1.0, HOLE * shorter * shorter * WIDTH / HEIGHT / (0.75 * size) ** 2)
        side *= 2
    sampler, half = params.sampler, params.dtype != "float32"
    guided = sampler.guidance > 0
    whole = answering(prior, half, sampler.steps, guided)
    window = answering(prior, half, REFINED_FROM * sampler.steps, guided)
    return (whole + window.times(finer)).times(params.candidates), WEIGHTS * (2.6 if prior == "SDXL" else 1) + PAINTED


def personalize(params: Personalize) -> tuple[Work, float] | None:
    if params.prior != PRIOR:
        return None
    rate = (params.samples.size or 512) / 512
    sample = network("SD2 personalize a sample", params.dtype != "float32").times(rate**2)
    samples = _at_once(params.memory_gb, TRAINED * rate**2, params.optimizer.batch)
    again = 4 / 3 if samples < params.optimizer.batch or params.checkpointing else 1  # activations twice
    return sample.times(params.steps * params.optimizer.batch * again), WEIGHTS + samples * TRAINED * rate**2


def distill(params: Distill) -> tuple[Work, float] | None:
    if params.prior != PRIOR:
        return None
    half, samples = params.dtype != "float32", 1 + params.sds.patches
    view, sds = drawing(WIDTH * HEIGHT, GAUSSIANS), Work()
    step = adam(GAUSSIANS)
    if params.reconstruction.every:
        step += reconstruction(GAUSSIANS).times(1 / params.reconstruction.every)
    if params.sds.weight:
        unet = network("SD2 unet", half).times(1 + (params.sds.guidance > 0))
        sds = (network("SD2 encode and back") + network("SD2 encode") + unet).times(samples) + view
    if params.depth.weight:
        painted = answering("SD2", half, params.depth.steps / 2, params.sds.guidance > 0)
        sds += (painted + view + network("depth network")).times(1 / params.depth.every)
    if params.adversarial.weight:
        sds += view + _critic(params.adversarial.width, params.adversarial.patches * params.adversarial.size**2)
    taken = WEIGHTS + _at_once(params.memory_gb, DISTILLED, samples) * DISTILLED + _scene(GAUSSIANS)
    photos = VIEWS * WIDTH * HEIGHT * 3 * 4 / 1e9
    return (step + sds).times(params.iterations), taken + photos


def _critic(width: int, pixels: int) -> Work:
    """Counted at two widths; between and beyond them in proportion."""
    low, high = network("critic 256"), network("critic 512")
    share = (width - 256) / 256
    there = max(share, -0.95)
    return (low + (high + low.times(-1)).times(there)).times(pixels / (64 * 64**2))


def _scene(gaussians: float) -> float:
    """GB of the Gaussians, their gradients and moments, and of a view on its way back."""
    return gaussians * FLOATS * KEPT * 4 / 1e9 + WIDTH * HEIGHT * PIXEL_BYTES / 1e9


def _at_once(memory_gb: float, sample: float, most: int) -> int:
    if not memory_gb:
        return most
    return max(1, min(most, int((0.9 * memory_gb - WEIGHTS) / sample)))


def said(name: str, device: str, found: tuple[Work, float] | None) -> Mapping[str, object] | None:
    """What a plan prints of it: seconds, gigabytes, the card and what the figures stand for; None: not on a card."""
    card = card_of(name)
    if card is None or device != "cuda" or found is None:
        return None
    work, gigabytes = found
    return {"card": card, "seconds": work.seconds(CARDS[card]), "gb": gigabytes, "basis": BASIS}
