"""Upper bound of the gain of one SDS step: `python -m lab.studies.distillation --run runs/demo`.

The prior gets a picture x whose error e = x - truth in a hole is known. The holes are those of test views, in whole
views and in windows. The study measures the SDS gradient g = E[z - x0(z_t)], the mean over the noise, in pixels. If c
is the cosine of g and e, a step of the best length along -g leaves the squared error |e|^2 (1 - c^2). So the gain is at
most -10 log10(1 - c^2) dB (none for c <= 0). The pictures are holes filled by Telea's method and mixed with the truth
in several ratios, and the renders of the run's initialization and result. The chart shows up to which quality of the
picture a prior can improve the picture, if the noise of single draws is left out. The truth only measures; no setting
is chosen by it. The study writes distillation.json and distillation.png to --out.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from lab.studies.holes import Case, to_tensors
from lab.studies.prior import scene_cases
from lab.studies.scene_priors import run_study
from reffusion import seeding
from reffusion.io.arrays import save_json
from reffusion.io.images import load_image
from reffusion.io.scene import load_scene
from reffusion.prior import diffusion, lora
from reffusion.prior.model import Prior, load_prior
from report import charts

TIMESTEPS = (20, 100, 300, 600, 850)
NOISES = 4  # draws of the noise; two estimates of g use half of the draws each, so that their noise is independent
MIXES = (1.0, 0.85, 0.7, 0.55, 0.4, 0.2)  # share of Telea's filling in the picture
RENDERS = {"initialization": "renders_initialize", "result": "renders"}
SCALES = {"whole": "A photo of sks", "window": "A photo of sks, cropped"}


def degraded_pictures(run: Path, cases: dict[str, list[Case]], renders: dict[str, dict[str, list[Case]]]):
    """Return the pictures to measure: Telea's fillings mixed with the truth, then the run's renders.

    Outside the holes all pictures equal the truth.

    Args:
        run: runs/<scene>.
        cases: scale -> views with the truth, see `scene_cases`.
        renders: "initialization" or "result" -> result of `rendered_cases`.

    Returns:
        Name of the picture -> scale -> [B, 3, H, W] in [-1, 1].
    """
    pictures: dict[str, dict[str, Tensor]] = {}
    for scale in SCALES:
        truth, hole = to_tensors(cases[scale])
        filled = [cv2.inpaint(c.truth, c.hole.astype(np.uint8), 5, cv2.INPAINT_TELEA) for c in cases[scale]]
        telea = to_tensors([replace(c, truth=f) for c, f in zip(cases[scale], filled, strict=True)])[0]
        for mix in MIXES:
            pictures.setdefault(f"{mix:g} Telea", {})[scale] = truth + mix * hole * (telea - truth)
        for name, crops in renders.items():
            pictures.setdefault(name, {})[scale] = truth + hole * (to_tensors(crops[scale])[0] - truth)
    return pictures


@torch.no_grad()
def sds_gradient(prior, pictures: Tensor, holes: Tensor, timestep: int, text: Tensor) -> tuple[Tensor, Tensor]:
    """Estimate the SDS gradient E[z - x0(z_t)] in pixels twice, from two disjoint halves of the draws of the noise.

    The gradient in pixels is the difference of the decoded latents z and x0.

    Args:
        pictures: [B, 3, H, W] in [-1, 1].
        holes: [B, 1, H, W], 1 = repaint.
        timestep: t.
        text: [B, L, D], embedded prompt.

    Returns:
        Two estimates, [B, 3, H, W] each. A step against the gradient moves a picture towards the prior's prediction.
    """
    levels = diffusion.measure_levels(prior, pictures, holes)
    shown = levels.normalize(pictures)
    latents, condition = diffusion.encode(prior, shown), diffusion.conditioning(prior, shown, holes)
    t, halves = torch.full((len(pictures),), timestep), []
    for half in range(2):
        guesses = torch.zeros_like(latents)
        for k in range(NOISES // 2):
            noise = torch.randn(latents.shape, generator=seeding.generator(0, "distillation", timestep, half, k))
            noisy = diffusion.add_noise(prior, latents, noise, t)
            guesses += diffusion.predict(prior, noisy, t, condition, text)[1] / (NOISES // 2)
        difference = diffusion.decode(prior, latents) - diffusion.decode(prior, guesses)
        halves.append(difference / levels.gain)
    return halves[0], halves[1]


def possible_gain(halves: tuple[Tensor, Tensor], error: Tensor, holes: Tensor) -> dict[str, float]:
    """Return the cosine of gradient g and error e in the holes, over all pictures together, and the largest gain in dB.

    |g|^2 is estimated by the inner product of the two estimates. The square of a single estimate would be too large by
    the noise of the estimate; the noises of the two estimates are independent.

    Args:
        halves: two estimates of g, [B, 3, H, W] each.
        error: e, [B, 3, H, W].
        holes: [B, 1, H, W], 1 in the holes.

    Returns:
        "cosine", at most 0.9999, and "gain", dB.
    """
    first, second = (half * holes for half in halves)
    along = float(((first + second) / 2 * error).sum())
    square = max(float((first * second).sum()), 1e-12)
    cosine = min(along / (square * float(error.square().sum())) ** 0.5, 0.9999)
    return {"cosine": cosine, "gain": float(-10 * np.log10(1 - max(cosine, 0.0) ** 2))}


def measure(models: dict[str, Prior], run: Path) -> list[dict]:
    """Measure cosine and largest gain for each prior, scale, picture and timestep.

    Args:
        models: name -> prior, e.g. before and after personalization.
        run: runs/<scene>.

    Returns:
        One row each, with "model", "scale", "picture", "psnr" (of the picture in the holes, dB), "timestep", "cosine"
        and "gain" (dB, from `possible_gain`).
    """
    first = next(iter(models.values()))
    cases = scene_cases(run, first.native_size)
    renders = {name: rendered_cases(run, folder, first.native_size) for name, folder in RENDERS.items()}
    pictures, rows = degraded_pictures(run, cases, renders), []
    for model, prior in models.items():
        for scale, prompt in SCALES.items():
            truth, hole = to_tensors(cases[scale])
            text = diffusion.embed_text(prior, [prompt]).detach().expand(len(truth), -1, -1)
            for name, by_scale in pictures.items():
                error = (by_scale[scale] - truth) * hole
                psnr = -10 * np.log10(float(error.square().sum() / hole.sum() / 3 / 4))
                for timestep in TIMESTEPS:
                    halves = sds_gradient(prior, by_scale[scale], hole, timestep, text)
                    row = {"model": model, "scale": scale, "picture": name, "psnr": psnr, "timestep": timestep}
                    rows.append(row | possible_gain(halves, error, hole))
                best = max(rows[-len(TIMESTEPS) :], key=lambda row: row["gain"])
                print(f"{model:12} {scale:7} {name:16} {psnr:5.2f} dB: {best['gain']:.3f} at t={best['timestep']}")
    return rows


def rendered_cases(run: Path, folder: str, size: int) -> dict[str, list[Case]]:
    """Return the same views as `scene_cases`, with renders of the stage `evaluate` instead of the truth.

    The scale "reference" is as in `scene_cases`, without renders.

    Args:
        run: runs/<scene>.
        folder: folder of the renders, in `evaluate`.
        size: side to which views are reduced, px.

    Raises:
        ValueError: the renders are missing.
    """
    scene = load_scene(run / "poses")
    source = run / "evaluate" / folder
    if not source.is_dir():
        raise ValueError(f"{source} is missing: run `make scene={run.name} all` first")
    renders = {name: load_image(source / f"{name}.png") for name in scene.test}
    return scene_cases(run, size, renders)


def draw(rows: list[dict], path: Path) -> None:
    """Draw the largest gain over all timesteps against the picture's PSNR before, for each prior and scale.

    Args:
        rows: result of `measure` for priors named "unadapted" and "personalized"; others are not drawn.
        path: PNG to write.
    """
    figure, grid = charts.new_figure(3.8, 1, 2, sharey=True)
    for axes, scale in zip(grid[0], SCALES, strict=True):
        for model, style in (("unadapted", ("tab:grey", "--")), ("personalized", ("tab:blue", "-"))):
            best: dict[str, dict] = {}
            for row in rows:
                if (row["model"], row["scale"]) == (model, scale):
                    best[row["picture"]] = max(best.get(row["picture"], row), row, key=lambda r: r["gain"])
            mixes = [row for name, row in best.items() if name not in RENDERS]
            axes.plot(
                [r["psnr"] for r in mixes], [r["gain"] for r in mixes], style[1] + "o", color=style[0], label=model
            )
            for name, marker in zip(RENDERS, "s^", strict=True):
                if name in best:
                    axes.plot(
                        best[name]["psnr"], best[name]["gain"], marker, color=style[0], ms=9, label=f"{model}: {name}"
                    )
        axes.set(title=f"{scale} views" if scale == "whole" else "windows", xlabel="PSNR in the hole before (dB)")
        axes.set_yscale("symlog", linthresh=0.01)
    grid[0, 0].set(ylabel="greatest gain of one exact step (dB)")
    grid[0, 1].legend(fontsize=8)
    charts.save_chart(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prior", default="priors/tiny", help="a diffusers folder")
    parser.add_argument("--run", type=Path, required=True, help="runs/<scene>, finished, with ground truth")
    parser.add_argument("--out", type=Path, default=Path("runs/distillation"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    models = {
        "unadapted": load_prior(arguments.prior),
        "personalized": lora.merge(load_prior(arguments.prior), arguments.run / "personalize"),
    }
    rows = measure(models, arguments.run)
    save_json(arguments.out / "distillation.json", rows)
    draw(rows, arguments.out / "distillation.png")
    print(arguments.out / "distillation.png")


if __name__ == "__main__":
    run_study(main)
