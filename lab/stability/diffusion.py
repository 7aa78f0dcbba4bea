"""Cases of the diffusion model and of score distillation, with the embedded prior.

Notation: z_t = a z_0 + s eps is the noised latent at timestep t, eps the noise, a² = alpha bar and s² = 1 - alpha bar.
T is the number of timesteps. Masks are 1 where the picture is repainted.
"""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from lab.stability.cases import EPS32, EXACT, UNCLEAR, Case, count_unclear_refusal, nan_safe_max
from lab.stability.splatting import camera, cloud
from reffusion import seeding
from reffusion.distill import sds
from reffusion.distill.terms.sds import evaluate_sds
from reffusion.distill.train_view import TrainView
from reffusion.params.distill import SdsTerm
from reffusion.prior import diffusion, levels, windows
from reffusion.prior.model import Prior, load_prior
from reffusion.types import PARAMETERS

TINY = Path(__file__).resolve().parents[2] / "priors" / "tiny"
SIZE = 32  # side of pictures, px; the UNet accepts any size that can be halved often enough
HALF = {torch.float16: 2.0**-11, torch.bfloat16: 2.0**-8}  # relative error of one rounding
LAYERS = 100  # upper bound of the number of consecutive layers of the UNet


@cache
def model(dtype: torch.dtype = torch.float32) -> Prior:
    """Load the embedded prior."""
    return load_prior(TINY, dtype=dtype)


@cache
def prompts() -> Tensor:
    """Return the hidden states [3, L, D] of the prompts for whole views and windows, and of the empty prompt."""
    with torch.no_grad():
        return diffusion.embed_text(model(), ["A photo of sks", "A photo of sks, cropped", ""])


def normal(*shape: int, label: str = "") -> Tensor:
    """Draw a standard normal tensor; `label` selects the seed."""
    return torch.randn(*shape, generator=seeding.generator(0, "stability", label))


def images(label: str = "") -> Tensor:
    """Draw a picture of uniform noise in [-1, 1], [1, 3, SIZE, SIZE]; `label` selects the seed."""
    return torch.rand(1, 3, SIZE, SIZE, generator=seeding.generator(0, "images", label)) * 2 - 1


@torch.no_grad()
def predict(t: int, guidance: float | None = None, empty: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Predict with the prior at one timestep; a square in the middle of the picture is repainted.

    Equal arguments give the same z_t and the same picture.

    Args:
        t: timestep.
        guidance: γ of (1 + γ) eps(prompt) - γ eps(empty prompt). None makes a single prediction with the prompt.
        empty: hidden states that replace those of the empty prompt.

    Returns:
        A random z_t, and the predicted eps and z_0.
    """
    mask = torch.zeros(1, 1, SIZE, SIZE)
    mask[..., 8:24, 8:24] = 1
    condition = diffusion.conditioning(model(), images(), mask)
    noisy, times = normal(1, condition.shape[1] - 1, *condition.shape[-2:]), torch.tensor([t])
    if guidance is None:
        return noisy, *diffusion.predict(model(), noisy, times, condition, prompts()[:1])
    empty = prompts()[2:] if empty is None else empty
    return noisy, *diffusion.predict_with_guidance(model(), noisy, times, condition, prompts()[:1], empty, guidance)


def reconstruction_error(t: int, guidance: float | None = None) -> float:
    """Return the largest error of a z_0 + s eps = z_t for the predicted z_0 and eps.

    The error is relative to the largest absolute value of z_t, eps and a z_0.

    Args:
        t: timestep; -1 is the last one.
        guidance: strength of guidance; None for none.
    """
    noisy, eps, clean = (x.double() for x in predict(t % model().timesteps, guidance))
    a = model().alphas_cumprod[t].double()
    size = max(noisy.abs().max(), eps.abs().max(), (a.sqrt() * clean).abs().max())
    return ((a.sqrt() * clean + (1 - a).sqrt() * eps - noisy).abs().max() / size).item()


def no_guidance_error() -> float:
    """Return the largest difference of eps and z_0 with guidance 0 from those without guidance.

    They must be equal bit for bit.
    """
    pairs = zip(predict(500, 0.0), predict(500), strict=True)
    return nan_safe_max(*((a - b).abs().max().item() for a, b in pairs))


def strong_guidance_error() -> float:
    """Return the largest error of eps with guidance 100, relative to the largest |eps| without guidance.

    The exact value is the weighted sum, in float64, of two separate predictions with prompt and empty prompt.
    """
    _, eps, _ = predict(500)
    other = predict(500, 0.0)
    with torch.no_grad():
        mask = torch.zeros(1, 1, SIZE, SIZE)
        mask[..., 8:24, 8:24] = 1
        condition = diffusion.conditioning(model(), images(), mask)
        empty, _ = diffusion.predict(model(), other[0], torch.tensor([500]), condition, prompts()[2:])
    exact = 101 * eps.double() - 100 * empty.double()
    return ((predict(500, 100.0)[1].double() - exact).abs().max() / eps.abs().max()).item()


def equal_prompts_error() -> float:
    """Return the largest change of eps by guidance 100 if the empty prompt equals the prompt.

    It is relative to the largest |eps| without guidance. Only rounding may change eps.
    """
    _, eps, _ = predict(500)
    return ((predict(500, 100.0, prompts()[:1])[1] - eps).abs().max() / eps.abs().max()).item()


def half_precision_error(dtype: torch.dtype) -> float:
    """Return the relative L2 difference of eps between half precision and float32, at the first or last timestep.

    The larger of the two counts.
    """
    mask, worst = torch.ones(1, 1, SIZE, SIZE), 0.0
    for t in (0, model().timesteps - 1):
        errors = []
        for kind in (torch.float32, dtype):
            with torch.no_grad():
                condition = diffusion.conditioning(model(kind), images(), mask)
                noisy = normal(1, condition.shape[1] - 1, *condition.shape[-2:])
                errors.append(diffusion.predict(model(kind), noisy, torch.tensor([t]), condition, prompts()[:1])[0])
        worst = nan_safe_max(worst, ((errors[1] - errors[0]).norm() / errors[0].norm()).item())
    return worst


def sds_error(t: int, dtype: torch.dtype) -> float:
    """Return the largest error of the SDS gradients of all weightings against float64.

    The data are normal with unit variance, so the exact prediction is known: eps = s z_t, z_0 = a z_t. A gradient is a
    difference of two terms, and its L2 error is relative to the size of these terms.

    Args:
        t: timestep; -1 is the last one.
        dtype: precision of the latents.
    """
    latents, noise = (normal(2, 4, 8, 8, label=name).to(dtype) for name in ("latents", "noise"))
    abar, times, worst = model().alphas_cumprod, torch.full((2,), t % model().timesteps), 0.0
    a, s = (x.double()[times[0]] for x in (abar.sqrt(), (1 - abar.double()).sqrt()))
    noisy = a * latents.double() + s * noise.double()
    factors = {"one": 1, "sigma2": s**2, "alpha_sigma2": a * s**2}
    exact = {"x0": (latents.double() - a * noisy, latents.double())}
    exact |= {name: (factor * (s * noisy - noise), factor * noise.double()) for name, factor in factors.items()}
    for weighting, (truth, size) in exact.items():
        gradient = sds.sds_gradient(
            latents, lambda z, _: (s.to(z) * z, a.to(z) * z), times, noise, abar, weighting=weighting
        )
        # The gradient is a difference of numbers of order one (at t = 0, or at T-1). Its error is relative to them.
        worst = nan_safe_max(worst, ((gradient.double() - truth).norm() / size.norm()).item())
    return worst


def levels_error(known_share: float) -> float:
    """Return the largest error of pictures at the model's levels, and of those restored, against float64.

    The pictures are dark, gray or bright, of contrasts from 1e-8 to 1. The error at the model's levels is relative to
    the largest possible gain.

    Args:
        known_share: share of the rows that are known.
    """
    hidden = torch.zeros(1, 1, SIZE, SIZE)
    hidden[:, :, round(known_share * SIZE) :] = 1
    worst = 0.0
    for mean in (-1.0, 0.0, 0.9):
        for contrast in (1e-8, 1e-5, 1e-2, 1.0):
            picture = mean + contrast * images()
            found = levels.measure_levels(picture, hidden, 0.5)
            truth = levels.measure_levels(picture.double(), hidden.double(), 0.5)
            shown = found.normalize(picture)
            error = (shown - truth.normalize(picture.double())).abs().max() / (0.5 / levels.LEAST_CONTRAST)
            worst = nan_safe_max(worst, error.item(), (found.restore(shown) - picture).abs().max().item())
    return worst


def empty_mask_gradient() -> float:
    """Return the largest absolute value of the SDS gradient with `keep_contrast` if the mask is empty. It must be 0."""
    latents, noise, abar = normal(2, 4, 8, 8), normal(2, 4, 8, 8, label="noise"), model().alphas_cumprod
    times, nothing = torch.tensor([3, 700]), torch.zeros(2, 1, 8, 8)
    gradient = sds.sds_gradient(latents, lambda z, _: (z, z), times, noise, abar, keep_contrast=True, mask=nothing)
    return gradient.abs().max().item()


def full_mask_leak() -> float:
    """Return the largest difference between the prior's conditioning on two pictures if all pixels are masked.

    The conditioning must not depend on masked pixels.
    """
    full = torch.ones(1, 1, SIZE, SIZE)
    one, other = (diffusion.conditioning(model(), images(name), full) for name in ("a", "b"))
    return (one - other).abs().max().item()


def empty_mask_error() -> float:
    """Return the largest deviation of the conditioning from (0, the picture's latents) if the mask is empty.

    The first channel of the conditioning is the mask. The deviation must be 0.
    """
    with torch.no_grad():
        condition = diffusion.conditioning(model(), images(), torch.zeros(1, 1, SIZE, SIZE))
        difference = condition[:, 1:] - diffusion.encode(model(), images())
    return nan_safe_max(condition[:, :1].abs().max().item(), difference.abs().max().item())


def refuse_window(masked: bool, cause: str) -> float:
    """Return 0 if a window in a view is refused with the cause, else 1.

    Args:
        masked: Whether all pixels of the view are masked; else none is.
        cause: words of the message.
    """
    mask = torch.full((20, 30), masked)
    return count_unclear_refusal(lambda: windows.window_around(mask, 8, seeding.generator(0)), cause)


def count_bad_gradients(low: float, high: float, guidance: float) -> float:
    """Count non-finite numbers in the SDS gradients of all Gaussians' parameters, for a view with one known row.

    Args:
        low: smallest timestep, as a fraction of the schedule.
        high: largest timestep, as a fraction of the schedule.
        guidance: strength of guidance.
    """
    view, gaussians = camera(24, 18), cloud().map(lambda p: p.clone().requires_grad_())
    hole = torch.ones(18, 24, dtype=torch.bool)
    hole[0] = False
    hidden = TrainView(view, torch.rand(18, 24, 3, generator=seeding.generator(0)), ~hole, hole, clean=False)
    chosen = SdsTerm(patches=1, t_high=high, guidance=guidance)
    masked = torch.ones(len(gaussians), dtype=torch.bool)
    loss, _ = evaluate_sds(gaussians, masked, hidden, model(), prompts(), chosen, seeding.generator(1), t_low=low)
    loss.backward()
    return float(sum((~torch.isfinite(getattr(gaussians, name).grad)).sum() for name in PARAMETERS))


def count_out_of_range() -> float:
    """Count values outside [-1, 1] or NaN after inpainting in one sampler step with guidance 100 and a full mask."""
    full, draws = torch.ones(1, 1, SIZE, SIZE), seeding.generator(0)
    sample = diffusion.sample(model(), images(), full, prompts()[:1], 1, draws, 100.0, prompts()[2:])
    return float((~(sample.abs() <= 1)).sum())


SDS = "numbers of the gradient that are not finite"
CASES = (
    *(Case(f"timestep {name}", "error of a z_0 + s eps = z_t, relative", 8 * EPS32, partial(reconstruction_error, t))
      for name, t in (("0", 0), ("T-1", -1))),
    # With guidance 100, eps and z_0 are 101 times one prediction minus 100 times another; each prediction is as exact
    # as without guidance.
    Case("timestep T-1, guidance 100", "error of a z_0 + s eps = z_t, relative", 201 * 8 * EPS32,
         partial(reconstruction_error, -1, 100.0)),
    *(Case(f"timestep {name}, score distillation", "relative L2 error against float64", 16 * EPS32,
           partial(sds_error, t, torch.float32)) for name, t in (("0", 0), ("T-1", -1))),
    *(Case(f"timestep {name}, half precision, score distillation", "relative L2 error against float64",
           16 * HALF[torch.float16], partial(sds_error, t, torch.float16)) for name, t in (("0", 0), ("T-1", -1))),
    # One rounding per layer, which later layers do not enlarge overall, as each layer is normalised.
    *(Case(f"{str(dtype)[6:]}, half precision of the prior", "relative L2 difference of eps from float32",
           LAYERS * epsilon, partial(half_precision_error, dtype)) for dtype, epsilon in HALF.items()),
    Case("guidance 0", "largest difference from no guidance", EXACT, no_guidance_error),
    # The sum weighs two predictions by 101 and 100. Each is rounded once per layer, and differs by such roundings
    # between batches of one and of two.
    Case("guidance 100", "error relative to eps", 201 * LAYERS * EPS32, strong_guidance_error),
    Case("guidance 100, equal prompts", "difference from no guidance, relative to eps", 201 * LAYERS * EPS32,
         equal_prompts_error),
    Case("mask empty, conditioning", "difference from the picture's latents", EXACT, empty_mask_error),
    Case("mask full, conditioning", "what of the picture is seen", EXACT, full_mask_leak),
    # The mean is a sum over a thousand pixels.
    *(Case(f"contrast 1e-8 to 1, {name} known", "error at the model's levels, and restored", 16 * EPS32,
           partial(levels_error, share)) for name, share in (("all", 1), ("one row", 1 / SIZE), ("nothing", 0))),
    Case("mask empty, gradient", "largest number", EXACT, empty_mask_gradient),
    Case("mask empty, window", UNCLEAR, EXACT, partial(refuse_window, False, "empty mask")),
    Case("mask full, window", UNCLEAR, EXACT, partial(refuse_window, True, "covers the whole view")),
    Case("one row known, timestep 0, guidance 100, scene", SDS, EXACT, partial(count_bad_gradients, 0.0, 1e-9, 100.0)),
    Case("one row known, timestep T-1, guidance 0, scene", SDS, EXACT,
         partial(count_bad_gradients, 1 - 1e-9, 1.0, 0.0)),
    Case("mask full, painted in one step, guidance 100", "pixels outside [-1, 1]", EXACT, count_out_of_range),
)  # fmt: skip
