"""What a prior can do, in figures and pictures: `python benchmarks/prior.py --priors priors/tiny --run runs/demo`.

  inpainting    held-out pictures of 64 px, a silhouette cut out of each, against OpenCV's Telea and Navier-Stokes:
                PSNR, SSIM, FLIP and gradient energy inside the hole; every prior named, from the same noise
  personalize   the first prior on a scene's reference by the laptop profile: error against steps, then, before and
                after, by timestep: error of the clean latent in holes of unseen views and the variance of the SDS
                gradient over the noise; the same views, and the reference's own hole, filled from pure noise
Writes prior.json and rows of pictures to --out; `python -m report.prior` draws them (`make prior-report` does both).
Every draw is seeded. LPIPS is left out: its network's weights are not in the repository.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "priors" / "tiny")]

import images  # noqa: E402

from reffusion import diffusion, io, lora, metrics, trace  # noqa: E402
from reffusion.prior import Prior, load_prior  # noqa: E402
from reffusion.sds import window_around  # noqa: E402
from stages import evaluate  # noqa: E402
from stages import personalize as stage  # noqa: E402

SIDE = 64  # px, of the held-out pictures
SEED = 20  # of the held-out set; training and its own validation use others
COVER = (0.05, 0.4)  # share of a held-out picture that its hole takes
SAMPLER_STEPS = 12  # the laptop profile's, for its reference
BATCH = 16
TELEA_RADIUS = 5  # px, of both rivals
TIMESTEPS = (20, 100, 250, 400, 550, 700, 850, 980)
NOISES = 4  # draws for the variance of the SDS gradient
VIEWS = 6  # unseen views
SHOWN = 12  # held-out pictures on the sheet
COLUMNS = ("psnr", "ssim", "flip", "energy")


@dataclass(frozen=True)
class Case:
    """A picture to fill: uint8 [H, W, 3] truth, bool [H, W] hole, and its kind ("photograph" or "procedural")."""

    truth: np.ndarray
    hole: np.ndarray
    kind: str


def held_out(count: int, seed: int = SEED) -> list[Case]:
    """`count` pictures that no training has seen, each with a silhouette that covers `COVER` of it."""
    cases = []
    for index in range(count):
        picture, caption = images.image(seed, index, held_out=True)
        truth = cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        rng = np.random.default_rng(trace.seed_for(seed, "hole", index))
        hole = images.silhouettes(rng, SIDE)
        while not COVER[0] <= hole.mean() <= COVER[1]:
            hole = images.silhouettes(rng, SIDE)
        kind = "photograph" if caption.split()[-1] in images.HELD_OUT_PHOTOS else "procedural"
        cases.append(Case(truth, hole, kind))
    return cases


# ---------------------------------------------------------------------------------------------- scores


def hole_scores(picture: np.ndarray, truth: np.ndarray, hole: np.ndarray) -> dict[str, float]:
    """PSNR (dB), SSIM and FLIP, each its map's mean over the hole, and the gradient energy in units of the truth's.

    Args:
        picture, truth: uint8 [H, W, 3]; outside the hole the truth stands in for the picture.
        hole: bool [H, W], not empty.
    """
    if not hole.any():
        raise ValueError("the hole is empty: there is nothing to score")
    picture = np.where(hole[..., None], picture, truth)
    error = float(np.mean((picture[hole] / 255.0 - truth[hole] / 255.0) ** 2))
    return {
        "psnr": min(-10 * np.log10(error), metrics.PSNR_CAP) if error > 0 else metrics.PSNR_CAP,
        "ssim": float(ssim_map(picture, truth)[hole].mean()),
        "flip": float(flip_map(picture, truth)[hole].mean()),
        "energy": gradient_energy(picture, hole) / max(gradient_energy(truth, hole), 1e-9),
    }


def ssim_map(picture: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """[H, W], with the window of `metrics.ssim`, mean over RGB."""
    from skimage.metrics import structural_similarity

    _, values = structural_similarity(
        picture / 255.0,
        truth / 255.0,
        gaussian_weights=True,
        sigma=metrics.SSIM_SIGMA,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
        full=True,
    )
    return values.mean(2)


def flip_map(picture: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """[H, W] LDR-FLIP, with the viewing distance of `metrics.flip`."""
    import flip_evaluator

    pair = [np.ascontiguousarray(x / 255.0, np.float32) for x in (truth, picture)]
    settings = {"ppd": metrics.PIXELS_PER_DEGREE}
    values = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False, computeMeanError=False, parameters=settings)
    return values[0][..., 0]


def gradient_energy(picture: np.ndarray, hole: np.ndarray) -> float:
    """Mean squared step of brightness between neighbours that both lie in the hole."""
    light, total, count = picture.mean(2) / 255, 0.0, 0
    for axis in (0, 1):
        both = np.logical_and(*(hole.take(range(k, hole.shape[axis] - 1 + k), axis) for k in (0, 1)))
        total += (np.diff(light, axis=axis)[both] ** 2).sum()
        count += both.sum()
    return float(total / max(count, 1))


def means(rows: list[dict[str, float]]) -> dict[str, float]:
    """The mean of each column, and of PSNR also its standard error."""
    values = {column: float(np.mean([row[column] for row in rows])) for column in COLUMNS}
    spread = np.std([row["psnr"] for row in rows], ddof=1) / len(rows) ** 0.5 if len(rows) > 1 else 0.0
    return values | {"psnr_error": float(spread), "pictures": len(rows)}


# ---------------------------------------------------------------------------------------------- inpainting


def tensors(cases: list[Case]) -> tuple[Tensor, Tensor]:
    """[B, 3, H, W] in [-1, 1] and [B, 1, H, W], 1 = repaint."""
    pictures = torch.from_numpy(np.stack([case.truth for case in cases])).permute(0, 3, 1, 2).float() / 127.5 - 1
    return pictures, torch.from_numpy(np.stack([case.hole for case in cases]))[:, None].float()


def painted(prior: Prior, cases: list[Case], seed: int, prompt: str = "") -> list[np.ndarray]:
    """The holes filled from pure noise: uint8 [H, W, 3] each."""
    done = []
    for first in range(0, len(cases), BATCH):
        pictures, holes = tensors(cases[first : first + BATCH])
        text = diffusion.embed_text(prior, [prompt]).detach().expand(len(pictures), -1, -1)
        noise = trace.generator(seed, "sample", first)
        filled = diffusion.sample(prior, pictures * (1 - holes), holes, text, SAMPLER_STEPS, noise)
        filled = ((pictures * (1 - holes) + filled * holes).permute(0, 2, 3, 1) + 1) * 127.5
        done += list(filled.round().clamp(0, 255).to(torch.uint8).numpy())
    return done


def inpainting(priors: list[str], count: int, out: Path) -> dict:
    """Method -> kind -> means; and the first `SHOWN` cases as rows of pictures."""
    cases = held_out(count)
    ways = {
        name: [cv2.inpaint(case.truth, case.hole.astype(np.uint8), TELEA_RADIUS, flag) for case in cases]
        for name, flag in (("Telea", cv2.INPAINT_TELEA), ("Navier-Stokes", cv2.INPAINT_NS))
    }
    for name in priors:
        ways[name] = painted(load_prior(name), cases, SEED)
    for index, case in enumerate(cases[:SHOWN]):
        save_row(out / "inpainting" / f"{index:02d}.png", case, [pictures[index] for pictures in ways.values()])
    result = {}
    for name, pictures in ways.items():
        scored = [(c.kind, hole_scores(p, c.truth, c.hole)) for p, c in zip(pictures, cases, strict=True)]
        kinds = ["all", *sorted({kind for kind, _ in scored})]
        result[name] = {kind: means([row for own, row in scored if kind in ("all", own)]) for kind in kinds}
    return {"columns": ["hole", *ways, "truth"], "scores": result}


def save_row(path: Path, case: Case, pictures: list[np.ndarray]) -> None:
    """Hole, pictures and truth side by side."""
    path.parent.mkdir(parents=True, exist_ok=True)
    hollow = np.where(case.hole[..., None], np.uint8(128), case.truth)
    io.save_image(path, np.concatenate([hollow, *pictures, case.truth], 1))


# ---------------------------------------------------------------------------------------------- personalization


def scene_cases(run: Path, size: int, pictures: dict[str, np.ndarray] | None = None) -> dict[str, list[Case]]:
    """The first reference and its hole, `NOISES` times, and unseen views with ground truth, their test masks as holes:
    whole, reduced to `size`, and a window of each. `pictures`, view name -> uint8 [H, W, 3], stand for the truth.

    Raises:
        ValueError: the scene has no test view with a mask.
    """
    scene = io.load_scene(run / "poses")
    found = {}
    for name in scene.test:
        truth = evaluate.truth_of(scene.cameras[name], run / "poses")
        hole = evaluate.mask_of(scene.cameras[name], run / "poses", run / "masks")
        if truth is not None and hole.any():
            found[name] = Case(truth if pictures is None else pictures[name], hole, name)
    if not found:
        raise ValueError(f"{run / 'poses'}: no test view shows the scene without the object; take another scene")
    places = np.linspace(0, len(found) - 1, min(VIEWS, len(found))).round().astype(int)
    chosen = [list(found.values())[place] for place in places]
    given = io.load_references(run / "reference", scene)[0]
    own = _reduced(Case(given.image, given.mask, given.camera.name), size)
    whole, windows = [_reduced(case, size) for case in chosen], []
    for case in chosen:
        top, left = window_around(torch.from_numpy(case.hole), size, trace.generator(SEED, "window", case.kind))
        here = (slice(top, top + size), slice(left, left + size))
        windows.append(Case(np.ascontiguousarray(case.truth[here]), np.ascontiguousarray(case.hole[here]), case.kind))
    return {
        "reference": [replace(own, kind=f"{own.kind}-{k}") for k in range(NOISES)],
        "whole": whole,
        "window": windows,
    }


def _reduced(case: Case, size: int) -> Case:
    small = cv2.resize(case.truth, (size, size), interpolation=cv2.INTER_AREA)
    return Case(
        small, cv2.resize(case.hole.astype(np.float32), (size, size), interpolation=cv2.INTER_AREA) > 1e-4, case.kind
    )


def profile(prior: str, steps: int | None) -> stage.Params:
    """The laptop profile's parameters of `personalize`, for another prior and number of steps."""
    values = yaml.safe_load((ROOT / "pipeline.yaml").read_text())["profiles"]["laptop"]["personalize"]
    return stage.Params(**values | {"prior": prior} | ({"steps": steps} if steps else {}))


@torch.no_grad()
def by_timestep(prior: Prior, cases: list[Case], prompt: str) -> dict[str, list[float]]:
    """For each of `TIMESTEPS`, means over the holes: the squared error of the clean latent predicted from the noised
    truth, and the variance of that prediction (so of z - x0, the SDS gradient) over `NOISES` draws of the noise."""
    pictures, holes = tensors(cases)
    clean, condition = diffusion.encode(prior, pictures), diffusion.conditioning(prior, pictures, holes)
    text = diffusion.embed_text(prior, [prompt]).expand(len(cases), -1, -1)
    inside = condition[:, :1].expand_as(clean) > 0.5
    result: dict[str, list[float]] = {"error": [], "variance": []}
    for timestep in TIMESTEPS:
        t = torch.full((len(cases),), timestep)
        drawn = []
        for index in range(NOISES):
            noise = torch.randn(clean.shape, generator=trace.generator(SEED, "noise", timestep, index))
            drawn.append(diffusion.predict(prior, diffusion.add_noise(prior, clean, noise, t), t, condition, text)[1])
        guesses = torch.stack(drawn)
        result["error"].append(float((guesses - clean).square().mean(0)[inside].mean()))
        result["variance"].append(float(guesses.var(0)[inside].mean()))
    return result


def personalization(prior: str, run: Path, steps: int | None, out: Path) -> dict:
    """Personalize on the run's reference, and measure before and after on views that were never seen."""
    needs = {need: run / need for need in ("poses", "fit", "masks", "reference")}
    for needed in needs:
        if not (run / needed).is_dir():
            raise ValueError(f"{run / needed} is missing: run `make scene={run.name} reference` first")
    folder = out / "personalize"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    params = profile(prior, steps)
    stage.run(params, folder, **needs)
    models = {
        "before": load_prior(prior),
        "after": lora.merged(load_prior(prior), folder),
    }
    prompts = {"reference": "A photo of sks", "whole": "A photo of sks", "window": "A photo of sks, cropped"}
    result: dict = {"steps": params.steps, "trace": trace.read_trace(folder / "trace.jsonl"), "timesteps": TIMESTEPS}
    for scale, cases in scene_cases(run, models["before"].native_size).items():
        pictures = {when: painted(model, cases, SEED, prompts[scale]) for when, model in models.items()}
        result[scale] = {
            when: by_timestep(model, cases, prompts[scale])
            | {"samples": means([hole_scores(p, c.truth, c.hole) for p, c in zip(pictures[when], cases, strict=True)])}
            for when, model in models.items()
        }
        for index, case in enumerate(cases):
            save_row(out / scale / f"{case.kind}.png", case, [pictures[when][index] for when in models])
    return result | {"columns": ["hole", *models, "truth"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--priors", nargs="+", default=["priors/tiny"], help="diffusers folders; the first is the one")
    parser.add_argument("--pictures", type=int, default=64, help="held-out pictures to fill")
    parser.add_argument("--run", type=Path, help="runs/<scene>, with its reference; without it no personalization")
    parser.add_argument("--steps", type=int, help="personalization steps (default: the laptop profile's)")
    parser.add_argument("--out", type=Path, default=Path("runs/prior-report"))
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    for folder in ("inpainting", "reference", "whole", "window"):
        shutil.rmtree(given.out / folder, ignore_errors=True)
    result = {"prior": given.priors[0], "inpainting": inpainting(given.priors, given.pictures, given.out)}
    for name, kinds in result["inpainting"]["scores"].items():
        print(name, {column: round(kinds["all"][column], 3) for column in COLUMNS}, flush=True)
    if given.run:
        result["personalization"] = personalization(given.priors[0], given.run, given.steps, given.out)
    io.save_json(given.out / "prior.json", result)
    print(given.out / "prior.json")


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"error: {error}")
