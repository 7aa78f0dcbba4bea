"""2D inpainting by Moebius, a diffusion model of fixed size without a prompt, from ONNX files on this machine.

Values that no comment explains are those of the published sampler: DDIM, 20 steps from the noise level of .99 of the
schedule, guidance 2.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from reffusion.inpaint.feedforward import run_network
from reffusion.inpaint.onnx_model import Network, describe, one_line
from reffusion.io.images import to_uint8
from reffusion.onnx import open_session
from reffusion.prior.model import library_class
from reffusion.seeding import generator as seeded
from reffusion.weights.published import MOEBIUS

SIDE, LATENT_SIDE = 512, 64  # px; the cross-attention of the network holds a position embedding of this size
STEPS, GUIDANCE, STRENGTH = 20, 2.0, 0.99
SCALING = 0.13025  # of the latents of its VAE
NOISE_OFFSET = 0.0357  # standard deviation of the noise that all pixels of a latent channel share
PROMPT, EMPTY = range(10), range(10, 20)  # rows of the table of embeddings that stands for a text encoder
FLOAT, LONG = "tensor(float)", "tensor(int64)"
INTERFACE: dict[str, dict[str, tuple[str, list[int]]]] = {  # file -> input -> type, shape after the batch
    MOEBIUS.encoder: {"image": (FLOAT, [3, SIDE, SIDE])},
    MOEBIUS.unet: {
        "latent": (FLOAT, [9, LATENT_SIDE, LATENT_SIDE]),
        "timesteps": (LONG, []),
        "input_ids": (LONG, [len(PROMPT)]),
    },
    MOEBIUS.decoder: {"latent": (FLOAT, [4, LATENT_SIDE, LATENT_SIDE])},
}
ANSWERS = {  # file -> shape of its output after the batch; the encoder gives means and logarithms of variances
    MOEBIUS.encoder: [8, LATENT_SIDE, LATENT_SIDE],
    MOEBIUS.unet: [4, LATENT_SIDE, LATENT_SIDE],
    MOEBIUS.decoder: [3, SIDE, SIDE],
}


def load(
    folder: Path, steps: int | None = None, guidance: float | None = None
) -> Callable[[np.ndarray, np.ndarray, int], np.ndarray]:
    """Load Moebius, and return a function that paints into the hole of a view, from a square around the hole.

    Args:
        folder: holds `MOEBIUS.files`.
        steps: number of steps of the sampler; None for the published number.
        guidance: g of ε(empty) + g (ε(prompt) - ε(empty)); None for the published value.

    Returns:
        Function (image uint8 [H, W, 3], hole bool [H, W], seed) -> uint8 [H, W, 3]. Pixels outside the hole are
        unchanged. The function raises ValueError if a network fails, or if an output has another shape than published
        or is not finite.

    Raises:
        ValueError: onnxruntime is missing, or a file has other inputs than those published. The message is one line
            that names the file.
    """
    sessions = {name: _open(folder / name) for name in MOEBIUS.files}
    run = lambda name, **inputs: _run(sessions[name], folder / name, inputs)
    options = (steps or STEPS, GUIDANCE if guidance is None else guidance)

    def paint(image: np.ndarray, hole: np.ndarray, seed: int) -> np.ndarray:
        network = Network(SIDE, lambda picture, mask: _sample(run, picture, mask, seeded(seed, "moebius"), *options))
        return run_network(network, image, hole)

    return paint


def _sample(
    run: Callable[..., Tensor],
    picture: np.ndarray,
    hole: np.ndarray,
    random: torch.Generator,
    steps: int,
    guidance: float,
) -> np.ndarray:
    """Return the network's painting of a whole picture, uint8 [512, 512, 3]; it starts from the content of the hole."""
    image = torch.from_numpy(picture).permute(2, 0, 1)[None] / 127.5 - 1
    mask = torch.from_numpy(hole)[None, None].float()
    clean, known = (SCALING * run(MOEBIUS.encoder, image=each)[:, :4] for each in (image, image * (1 - mask)))
    condition = torch.cat([interpolate(mask, size=(LATENT_SIDE, LATENT_SIDE)), known], 1)
    scheduler = library_class("DDIMScheduler")(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", clip_sample=False
    )
    scheduler.set_timesteps(steps)
    times = scheduler.timesteps[steps - max(1, int(steps * STRENGTH)) :]
    noise = torch.randn(clean.shape, generator=random)
    noise += NOISE_OFFSET * torch.randn((1, clean.shape[1], 1, 1), generator=random)
    noisy = scheduler.add_noise(clean, noise, times[:1])
    ids = torch.tensor([[*EMPTY], [*PROMPT]])
    for time in times:
        inputs = torch.cat([noisy, condition], 1).expand(2, -1, -1, -1)
        empty, prompted = run(MOEBIUS.unet, latent=inputs, timesteps=time.expand(2), input_ids=ids).split(1)
        noisy = scheduler.step(empty + guidance * (prompted - empty), time, noisy).prev_sample
    (painted,) = run(MOEBIUS.decoder, latent=noisy / SCALING)
    return to_uint8((painted.permute(1, 2, 0).numpy() + 1) / 2)


def _open(file: Path) -> Any:
    """Open a file of the model; raises ValueError unless it has the published inputs and one output."""
    session = open_session(file, str(file))
    inputs = {each.name: (each.type, list(each.shape)) for each in session.get_inputs()}
    expected = INTERFACE[file.name]
    # The batch is a name or None where it is free; a fixed one would exclude guidance.
    fits = inputs.keys() == expected.keys() and all(
        inputs[name] == (kind, [inputs[name][1][0], *shape]) and not isinstance(inputs[name][1][0], int)
        for name, (kind, shape) in expected.items()
        if inputs[name][1] or shape
    )
    if not fits or len(session.get_outputs()) != 1:
        wanted = ", ".join(f"{name} {describe(kind, ['B', *shape])}" for name, (kind, shape) in expected.items())
        found = ", ".join(f"{name} {describe(*each)}" for name, each in inputs.items())
        raise ValueError(f"{file}: expected {wanted} and one output; it takes {found}: take {MOEBIUS.repo}")
    return session


def _run(session: Any, file: Path, inputs: dict[str, Tensor]) -> Tensor:
    """Run a file of the model on a batch; raises ValueError if it fails or its answer is not as published."""
    batch = len(next(iter(inputs.values())))
    try:
        (answer,) = session.run(None, {name: each.contiguous().numpy() for name, each in inputs.items()})
    except Exception as error:  # onnxruntime's exceptions have no common base class
        raise ValueError(f"{file}: failed on a batch of {batch} ({one_line(error)})") from None
    expected = [batch, *ANSWERS[file.name]]
    if list(answer.shape) != expected or not np.isfinite(answer).all():
        raise ValueError(f"{file}: its answer is {list(answer.shape)}, not {expected}, or not finite")
    return torch.from_numpy(answer)
