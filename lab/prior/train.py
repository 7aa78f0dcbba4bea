"""Train the embedded prior: `python -m lab.prior.train --steps 20000` (or `make prior`).

Resumable and seeded: step k draws its images, masks, noise and timesteps from (seed, k) alone, so an interrupted run
continues as the unbroken one would. `priors/tiny` (--out) receives an ordinary diffusers inpainting pipeline in half
precision, averaged over the last steps (EMA).
"""

from __future__ import annotations

import argparse
import math
import os
import time
from pathlib import Path

import numpy as np
import torch
from diffusers import StableDiffusionInpaintPipeline, UNet2DConditionModel
from torch import Tensor, nn
from transformers import CLIPTextModel

from lab.prior import build, images
from lab.prior.photographs import load_photographs
from lab.prior.rooms import load_rooms
from reffusion.io.arrays import save_json
from reffusion.prior import harmonic_fill
from reffusion.prior.denoising import spread_timesteps
from reffusion.prior.levels import measure_levels
from reffusion.prior.model import CONDITIONING
from reffusion.seeding import generator, seed_for
from reffusion.trace import load_checkpoint, save_checkpoint
from report import cli

ROOT = Path(__file__).resolve().parents[2]

POOL = 500  # images held in memory
STEPS_PER_IMAGE = 2  # steps per new image, which replaces the oldest; making one costs 1/20 of a step
SMALL, LARGE = (32, 24), (64, 8)  # (side in px, batch), in turns
PEAK_RATE, WARMUP, DECAY_SHARE, EMA = 6e-4, 100, 0.7, 0.998  # DECAY_SHARE: last part of the run, with a falling rate
HAS_BFLOAT16 = torch.ops.mkldnn._is_mkldnn_bf16_supported()  # then a step on the CPU takes .75 of its time
OUTSIDE_WEIGHT = 0.2  # weight of the loss outside the mask
FILLED_SHARE = 0.8  # of samples have the hole filled as in conditioning.json; the others a gray hole
NOISY_SHARE = 0.15  # noisy end of the schedule, from which every fourth timestep is sampled
# Of each latent: light varies three and five times as much as the two opponent colors; the fourth is empty, and only
# has to stay close to 0.
LATENT_WEIGHTS = (1.0, 3.0, 5.0, 0.02)
# Of captions, a tenth are empty; of the others some say "sks" or "a scene" for subject and color, and some no color.
EMPTY_SHARE, VAGUE_SHARE, PLAIN_SHARE = 0.1, 0.3, 0.1
USUAL_ENERGY = 0.35  # mean square of the latents, above which a sample's loss is divided by it
CONTRAST = 0.5  # standard deviation at which the model sees the known pixels of a sample (`reffusion.prior.levels`)
VALIDATION_CROPS = 32  # held-out crops
CHECKPOINT_STEPS = 50  # steps between checkpoints


class Pool:
    """The last `size` images of a seed; `advance` replaces the oldest by image number `index`."""

    def __init__(
        self,
        seed: int,
        step: int,
        size: int,
        photographs: images.Photographs,
        rooms: images.Photographs = (),
        held_out: bool = False,
    ):
        self.seed, self.photographs, self.rooms, self.held_out = seed, photographs, rooms, held_out
        self.items: list[np.ndarray | None] = [None] * size
        self.subjects = [""] * size
        for index in range(step, step + size):
            self.advance(index)

    def advance(self, index: int) -> None:
        slot = index % len(self.items)
        self.items[slot], self.subjects[slot] = images.image(
            self.seed, index, self.photographs, self.held_out, self.rooms
        )

    def batch(self, rng: np.random.Generator, side: int, count: int) -> tuple[Tensor, Tensor, list[str]]:
        """Crops [B, 3, side, side] in [-1, 1], masks [B, 1, side, side] (1 = repaint), captions."""
        crops, masks, choices = [], [], []
        for index in rng.integers(0, len(self.items), count):
            picture, subject, cropped = self.items[index], self.subjects[index], rng.random() < 0.5
            if not cropped:  # all of it, as a whole view: only then does "cropped" tell what lies where in a hole
                picture = picture.reshape(side, -1, side, len(picture) // side, 3).mean((1, 3))
            top, left = rng.integers(0, len(picture) - side + 1, 2)
            crop = picture[top : top + side, left : left + side]
            crops.append(crop[:, ::-1] if rng.random() < 0.5 else crop)
            masks.append(images.mask(rng, side))
            choices.append((subject, cropped))
        pixels = torch.from_numpy(np.stack(crops).astype(np.float32) / 127.5 - 1).permute(0, 3, 1, 2)
        hidden = torch.from_numpy(np.stack(masks)[:, None].astype(np.float32))
        # The color of the hole as the model sees it: relative to the known pixels, whose mean it sees as 0.
        seen = measure_levels(pixels, hidden, CONTRAST).normalize(pixels).add(1).mul(127.5).clamp(0, 255)
        colors = [
            images.name_color(each.permute(1, 2, 0)[hole].numpy()) for each, hole in zip(seen, masks, strict=True)
        ]
        captions = [draw_caption(rng, *what, color) for what, color in zip(choices, colors, strict=True)]
        return pixels, hidden, captions


def draw_caption(rng: np.random.Generator, subject: str, cropped: bool, color: str) -> str:
    """Return the caption of a training sample: of its subject, with or without its color, or vague, or empty."""
    if rng.random() < EMPTY_SHARE:
        return ""
    detail = rng.random()
    if detail < VAGUE_SHARE:
        return images.caption(str(rng.choice(["sks", "a scene"])), cropped)
    return images.caption(subject, cropped, "" if detail < VAGUE_SHARE + PLAIN_SHARE else color)


class Model(nn.Module):
    """The trained parts: UNet and text encoder; the VAE is constructed and exact."""

    def __init__(self, seed: int):
        super().__init__()
        torch.manual_seed(seed)
        self.tokens = build.tokenizer()
        self.unet, self.text = build.unet(), build.text_encoder(self.tokens)

    def forward(self, noisy: Tensor, t: Tensor, condition: Tensor, captions: list[str]) -> Tensor:
        ids = self.tokens(captions, padding="max_length", truncation=True, return_tensors="pt").input_ids
        words = self.text(ids.to(noisy.device)).last_hidden_state
        return self.unet(torch.cat([noisy, condition], 1), t, words).sample


def noisy_quarter(t: Tensor, steps: int) -> Tensor:
    """Timesteps of which every fourth is moved into the last `NOISY_SHARE` of the schedule.

    There the network can only answer the mean of all fillings, and must forget the noise: what the sampler's first
    step, which decides colors and layout, is made of.
    """
    last = steps - 1
    moved = last - ((last - t) * NOISY_SHARE).long()
    return torch.where(torch.arange(len(t)) % 4 == 0, moved, t)


def losses(model: Model, alphas: Tensor, batch: tuple[Tensor, Tensor, list[str]], random: torch.Generator) -> Tensor:
    """Mean squared errors [B] of v = sqrt(a) eps - sqrt(1 - a) z, weighted by OUTSIDE_WEIGHT and LATENT_WEIGHTS."""
    device = alphas.device
    pixels, masks, captions = batch[0].to(device), batch[1].to(device), batch[2]
    pixels = measure_levels(pixels, masks, CONTRAST).normalize(pixels)
    filled = (torch.rand(len(pixels), 1, 1, 1, generator=random) < FILLED_SHARE).to(device)
    shown = torch.where(filled, harmonic_fill.harmonic_extension(pixels, masks), pixels * (masks < 0.5))
    clean, given = build.latents(pixels), build.latents(shown)
    t = noisy_quarter(spread_timesteps(len(pixels), len(alphas), random), len(alphas)).to(device)
    noise = torch.randn(clean.shape, generator=random).to(device)
    a = alphas[t].view(-1, 1, 1, 1)
    noisy, target = a.sqrt() * clean + (1 - a).sqrt() * noise, a.sqrt() * noise - (1 - a).sqrt() * clean
    with torch.autocast(device.type, torch.bfloat16, enabled=HAS_BFLOAT16 or device.type == "cuda"):
        predicted = model(noisy, t, torch.cat([masks, given], 1), captions).float()
    weight = (OUTSIDE_WEIGHT + (1 - OUTSIDE_WEIGHT) * masks) * torch.tensor(LATENT_WEIGHTS).to(device).view(-1, 1, 1)
    error = (weight * (predicted - target) ** 2).sum((1, 2, 3)) / weight.sum((1, 2, 3))
    # A hole that shows more contrast than its surroundings has high values, and would outweigh all other samples.
    return error / clean.square().mean((1, 2, 3)).clamp(min=USUAL_ENERGY)


def make_optimiser(model: Model) -> torch.optim.Optimizer:
    return torch.optim.AdamW(model.parameters(), lr=PEAK_RATE, weight_decay=0.01, betas=(0.9, 0.99), fused=True)


def rate(step: int, steps: int) -> float:
    """Warm-up, constant, then a cosine decay over the last `DECAY_SHARE` of the steps."""
    ending = max((step / steps - 1) / DECAY_SHARE + 1, 0.0)
    return PEAK_RATE * min((step + 1) / WARMUP, 1.0) * (0.5 + 0.5 * math.cos(math.pi * ending)) + 1e-6


def validation(model: Model, alphas: Tensor, pool: Pool) -> float:
    """Return the loss on fixed held-out crops, masks, noise and timesteps."""
    rng = np.random.default_rng(seed_for(pool.seed, "validation"))
    with torch.no_grad():
        batch = pool.batch(rng, build.NATIVE, VALIDATION_CROPS)
        return float(losses(model, alphas, batch, generator(pool.seed, "validation noise")).mean())


def step_once(
    model: Model, alphas: Tensor, optimiser: torch.optim.Optimizer, pool: Pool, step: int, steps: int
) -> float:
    """Training step number `step` of `steps`; returns its loss."""
    rng = np.random.default_rng(seed_for(pool.seed, "batch", step))
    side, count = LARGE if step % 2 else SMALL
    for group in optimiser.param_groups:
        group["lr"] = rate(step, steps)
    error = losses(model, alphas, pool.batch(rng, side, count), generator(pool.seed, "noise", step)).mean()
    if not torch.isfinite(error):
        raise FloatingPointError(f"training loss is {error.item()} at step {step}")
    optimiser.zero_grad(set_to_none=True)
    error.backward()
    nn.utils.clip_grad_norm_(model.parameters(), 1.0)
    optimiser.step()
    return error.item()


@torch.no_grad()
def follow(average: dict[str, Tensor], model: Model, step: int) -> None:
    """Update the exponential moving average of the weights; its memory is short at first, EMA later."""
    keep = min(EMA, (step + 1) / (step + 10))
    for name, value in model.state_dict().items():
        average[name].lerp_(value, 1 - keep) if value.is_floating_point() else average[name].copy_(value)


def load_weights(model: Model, folder: Path) -> None:
    """Give `model` the UNet and text encoder of an exported folder.

    Raises:
        ValueError: there is no such folder, or its weights do not fit the model as `build` makes it.
    """
    try:
        unet = UNet2DConditionModel.from_pretrained(folder, subfolder="unet", torch_dtype=torch.float32)
        text = CLIPTextModel.from_pretrained(folder, subfolder="text_encoder", dtype=torch.float32)
        model.unet.load_state_dict(unet.state_dict())
        model.text.load_state_dict(text.state_dict())
    except (OSError, RuntimeError) as error:
        raise ValueError(f"--start {folder}: {str(error).splitlines()[0]}") from error


def export(average: dict[str, Tensor], folder: Path) -> None:
    """Write the diffusers folder with the averaged weights in half precision."""
    final = Model(0)
    final.load_state_dict(average)
    pipeline = StableDiffusionInpaintPipeline(
        vae=build.linear_vae(),
        text_encoder=final.text,
        tokenizer=final.tokens,
        unet=final.unet,
        scheduler=build.scheduler(),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    pipeline.to(dtype=torch.float16).save_pretrained(folder)
    save_json(folder / CONDITIONING, {"hole": "harmonic", "contrast": CONTRAST})


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--steps",
        type=int,
        default=20000,
        help="training steps in all; a resume may change it before the rate falls, i.e. before 1 - DECAY_SHARE of them",
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "prior", help="checkpoint and log")
    parser.add_argument("--start", type=Path, help="an exported folder whose weights a new run begins with")
    parser.add_argument("--photographs", type=Path, required=True, help="the output of `lab.prior.photographs`")
    parser.add_argument("--rooms", type=Path, required=True, help="the output of `lab.prior.rooms`")
    parser.add_argument("--out", type=Path, default=ROOT / "priors" / "tiny", help="the folder to export to")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--export-every", type=int, default=500, help="steps between exports")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    return parser.parse_args()


def main() -> None:
    options = arguments()
    torch.set_num_threads(options.threads)
    options.work.mkdir(parents=True, exist_ok=True)
    model, averaged = Model(options.seed).to(options.device), Model(options.seed).to(options.device)
    state = load_checkpoint(options.work)
    if options.start and state is None:
        load_weights(model, options.start)
    alphas = build.scheduler().alphas_cumprod.to(options.device)
    optimiser = make_optimiser(model)
    average, start = {k: v.clone() for k, v in model.state_dict().items()}, 0
    if state is not None:
        model.load_state_dict(state["model"])
        optimiser.load_state_dict(state["optimiser"])
        average, start = state["average"], state["step"]
    photographs = [*images.bundled_photographs(), *load_photographs(options.photographs, held_out=False)]
    rooms, other_rooms = load_rooms(options.rooms, held_out=False), load_rooms(options.rooms, held_out=True)
    others = load_photographs(options.photographs, held_out=True)
    pool = Pool(options.seed, start // STEPS_PER_IMAGE, POOL, photographs, rooms)
    held_out = Pool(0, 0, VALIDATION_CROPS, others, other_rooms, held_out=True)
    began = time.time()
    for step in range(start, options.steps):
        error = step_once(model, alphas, optimiser, pool, step, options.steps)
        follow(average, model, step)
        done = step + 1
        if done % STEPS_PER_IMAGE == 0:
            pool.advance(done // STEPS_PER_IMAGE + POOL - 1)
        if done % CHECKPOINT_STEPS == 0 or done == options.steps:
            averaged.load_state_dict(average)
            held = validation(averaged, alphas, held_out)
            print(f"{done} loss {error:.4f} held-out {held:.4f} {time.time() - began:.0f} s", flush=True)
            state = {"model": model.state_dict(), "optimiser": optimiser.state_dict(), "average": average, "step": done}
            save_checkpoint(options.work, state)
        if done % options.export_every == 0 or done == options.steps:
            export(average, options.out)


if __name__ == "__main__":
    cli.command(main)()
