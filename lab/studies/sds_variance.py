"""Variance of a scene's SDS gradient over noise and timesteps, before and after personalization.

`python -m lab.studies.sds_variance`, or `make scene=X sds-variance`, works for any scene, with or without ground
truth, after the stages `initialize` and `personalize`. Training views with pixels to invent are rendered from the
initialization and given to the prior as in distillation: whole views, and windows around the hole. The gradient is
g = z - x0(z_t), that of `weighting: x0`; any other weighting multiplies g by a function of t alone. The quantities are
means over the latents of the hole and over the views:

  noise            variance of g over draws of the noise, at each timestep
  pull             square of the mean of g over these draws, the part that remains after many steps (corrected for the
                   noise of the mean)
  over noise       mean of `noise` over the timesteps
  over timesteps   variance over the timesteps of the mean of g (corrected likewise)
  together         sum of the last two: the variance of the gradient of one step of distillation

Every draw is seeded and the same before and after, on any device. The study prints tables and the memory used, and
writes sds_variance.json to --out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lab.studies import scene_priors
from reffusion import seeding
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_mask_sets, load_scene
from reffusion.params.base import Prompts
from reffusion.prior import diffusion, windows
from reffusion.prior.model import Prior
from reffusion.splat import rasterizer
from report import page

VIEWS = 6  # largest number of training views
NOISES = 8  # draws of the noise per timestep
TIMESTEPS = (0.02, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9)  # as fractions of the schedule
SCALES = ("whole", "window")
SEED = 0


@torch.no_grad()
def load_inputs(run: Path, prior: Prior) -> dict[str, tuple[Tensor, Tensor]]:
    """Render up to `VIEWS` training views with pixels to invent from the initialization, as input of the prior.

    Returns:
        Scale ("whole" or "window") -> (pictures [B, 3, S, S] in [-1, 1], holes [B, 1, S, S], 1 = repaint). S is the
        prior's native size.

    Raises:
        ValueError: a stage is missing, or nothing is to be invented.
    """
    for stage in ("poses", "masks", "initialize"):
        if not (run / stage).is_dir():
            raise ValueError(f"{run / stage} is missing: run `make scene={run.name} initialize` first")
    scene, gaussians = load_scene(run / "poses"), load_ply(run / "initialize" / "gaussians.ply")
    sets = load_mask_sets(run / "masks", scene.train)
    names = [name for name in scene.train if sets[name].invent.any() and name not in scene.clean]
    if not names:
        raise ValueError(f"{run / 'masks'}: nothing is to be invented, so nothing is distilled")
    places = np.linspace(0, len(names) - 1, min(VIEWS, len(names))).round().astype(int)
    size, pictures, holes = prior.native_size, [], []
    for name in (names[place] for place in places):
        view = rasterizer.render(gaussians, scene.cameras[name]).color.clamp(0, 1).permute(2, 0, 1) * 2 - 1
        view = windows.enlarge_to_fit(view, size)
        hole = windows.enlarge_to_fit(torch.from_numpy(sets[name].invent).to(view)[None], size)[0] > 1e-4
        picked = [windows.window_around(hole, size, seeding.generator(SEED, "sds variance", name))]
        pictures.append(windows.two_scales(view, picked, size))
        holes.append(windows.two_scale_masks(hole, picked, size))
    pictures, holes = (torch.stack(each, 1).to(prior.device) for each in (pictures, holes))  # [scale, view, ...]
    return {scale: (pictures[k], holes[k]) for k, scale in enumerate(SCALES)}


@torch.no_grad()
def sds_gradients(prior: Prior, pictures: Tensor, holes: Tensor, prompt: str) -> Tensor:
    """Return SDS gradients z - x0(z_t), [T, K, M]: T `TIMESTEPS`, K = `NOISES` draws, M latent values in the holes."""
    levels = diffusion.measure_levels(prior, pictures, holes)
    shown = levels.normalize(pictures)
    latents, condition = diffusion.encode(prior, shown), diffusion.conditioning(prior, shown, holes)
    text = diffusion.embed_text(prior, [prompt]).expand(len(latents), -1, -1)
    inside, gradients = condition[:, :1].expand_as(latents) > 0.5, []
    for part in TIMESTEPS:
        t = torch.full((len(latents),), round(part * (prior.timesteps - 1)), device=prior.device)
        for k in range(NOISES):
            noise = torch.randn(latents.shape, generator=seeding.generator(SEED, "sds variance", int(t[0]), k))
            noise = noise.to(latents)
            clean = diffusion.predict(prior, diffusion.add_noise(prior, latents, noise, t), t, condition, text)[1]
            gradients.append(((latents - clean) / levels.gain)[inside])
    return torch.stack(gradients).view(len(TIMESTEPS), NOISES, -1)


def variances(samples: Tensor) -> dict:
    """Return the quantities of the module docstring for gradients [T, K, M], T and K at least 2.

    Returns:
        "noise" and "pull" are lists over the T timesteps; "over_noise", "over_timesteps" and "together" are numbers.
    """
    noise = samples.var(1)  # [T, M], unbiased
    mean = samples.mean(1)
    residual = noise / samples.shape[1]  # variance of the mean of K draws
    over_noise = noise.mean()
    over_timesteps = (mean.var(0) - residual.mean(0)).mean().clamp(min=0)
    return {
        "noise": noise.mean(1).tolist(),
        "pull": (mean.square() - residual).mean(1).clamp(min=0).tolist(),
        "over_noise": float(over_noise),
        "over_timesteps": float(over_timesteps),
        "together": float(over_noise + over_timesteps),
    }


def measure(models: dict[str, Prior], run: Path) -> dict[str, dict[str, dict]]:
    """Return {scale: {name of a prior: result of `variances`}}, with the same inputs for all priors.

    Args:
        models: "before" and "after" personalization -> prior.
        run: runs/<scene>.
    """
    inputs = load_inputs(run, next(iter(models.values())))
    return {
        scale: {when: variances(sds_gradients(model, *inputs[scale], prompt)) for when, model in models.items()}
        for scale, prompt in zip(SCALES, Prompts().texts, strict=False)
    }


def table(results: dict[str, dict[str, dict]]) -> str:
    """Return Markdown tables, one per scale, with the variances before and after personalization and their ratio.

    A table has a row for each timestep, with the pull before and after too, then the rows `over noise`, `over
    timesteps` and `together`.
    """
    tables = []
    for scale, by_time in results.items():
        before, after = by_time["before"], by_time["after"]
        rows = []
        for k, part in enumerate(TIMESTEPS):
            pulls = [f"{each['pull'][k]:.4f}" for each in (before, after)]
            rows.append([f"t = {part:g}", *_pair(before["noise"][k], after["noise"][k]), *pulls])
        for name in ("over_noise", "over_timesteps", "together"):
            rows.append([name.replace("_", " "), *_pair(before[name], after[name]), "", ""])
        header = ["", "before", "after", "after / before", "pull before", "pull after"]
        tables.append(f"{scale}: squared latents\n\n{page.markdown_table(header, rows)}")
    return "\n".join(tables)


def _pair(before: float, after: float) -> list[str]:
    return [f"{before:.4f}", f"{after:.4f}", f"{after / max(before, 1e-12):.2f}"]


def main() -> None:
    arguments = scene_priors.study_parser(__doc__, "initialize and personalize", "sds-variance").parse_args()
    models, base = scene_priors.load_priors(arguments)
    results, out = measure(models, arguments.run), arguments.out or arguments.run / "sds-variance"
    out.mkdir(parents=True, exist_ok=True)
    print(table(results))
    scene_priors.save_results(arguments, out, "sds_variance.json", {"prior": base, "timesteps": TIMESTEPS} | results)
    print(out / "sds_variance.json")


if __name__ == "__main__":
    scene_priors.run_study(main)
