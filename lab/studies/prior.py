"""Quality of a prior in figures and pictures: `python -m lab.studies.prior --run runs/demo`.

Measurements and options:

  inpainting    held-out pictures of 64 px (not in the training set) with a silhouette as a hole, filled by the priors
                and by OpenCV's methods Telea and Navier-Stokes: PSNR, SSIM, FLIP and gradient energy inside the hole,
                LPIPS of the picture. All priors start from the same noise
  --photographs the same for whole views and windows of the held-out photographs of `lab.prior.photographs`
  --steps       the first prior with other numbers of sampler steps. Few steps give nearly the mean of all fillings,
                which is blurred and best by PSNR and SSIM; many steps give one of the fillings
  personalize   the first prior, personalized to a scene's reference with the laptop profile. Measured are the error
                against steps; before and after, by timestep, the error of the clean latent in holes of unseen views and
                the variance of the SDS gradient over the noise; and scores of these views and of the reference's own
                hole, filled from pure noise
  --sampler     number of sampler steps for these fillings; the default of 50 is that of the stock pipeline. More steps
                give fillings that are sharper and further from the truth
  --seeds       repeat the personalization with these seeds, each with draws of its own in training and in sampling
  --wrong-reference   repeat with a wrong reference, which must not help: a picture in place of the reference, or
                another scene's run, whose personalized prior is used as it is

The study writes prior.json and rows of pictures to --out; `python -m lab.studies.prior_page` makes a page of them
(`make prior-report` does both). Every draw is seeded. LPIPS needs the network's weights (`make weights`).
"""

from __future__ import annotations

import argparse
import shutil
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml

from lab.prior.photographs import load_photographs
from lab.studies.holes import (
    COLUMNS,
    SEED,
    Case,
    fill_holes,
    hole_scores,
    make_cases,
    make_photograph_cases,
    mean_scores,
    save_row,
    to_tensors,
)
from lab.studies.jobs import load_test_views, profile_params
from lab.studies.scene_priors import run_study
from reffusion import seeding, trace
from reffusion.io.arrays import load_json, save_json
from reffusion.io.images import load_image, save_image
from reffusion.io.scene import load_references, load_scene
from reffusion.params.base import Prompts, Settings
from reffusion.prior import diffusion, lora
from reffusion.prior.model import Prior, load_prior
from reffusion.prior.windows import window_around
from report.paired_statistics import confidence_half_width
from stages import personalize as stage

TELEA_RADIUS = 5  # radius of both OpenCV methods, px
TIMESTEPS = (20, 100, 250, 400, 550, 700, 850, 980)
NOISES = 4  # draws for the variance of the SDS gradient
VIEWS = 6  # number of unseen views
SHOWN = 12  # held-out pictures on the sheet
PHOTOGRAPH_CASES = 200  # pictures of each kind from held-out photographs
PROMPTS = {"reference": Prompts().whole, "whole": Prompts().whole, "window": Prompts().crop}
LEARNS = ("poses", "raw_masks", "reference")  # stages that personalization needs of a run

# ---------------------------------------------------------------------------------------------- inpainting


def score_cases(pictures: list[np.ndarray], cases: list[Case]) -> dict[str, float]:
    """Return the mean scores of filled pictures inside their holes, see `mean_scores`."""
    return mean_scores([hole_scores(p, c.truth, c.hole) for p, c in zip(pictures, cases, strict=True)])


def score_fillings(case: Case, *pictures: np.ndarray) -> dict[str, float]:
    """Return the scores of fillings of one picture, see `hole_scores`, averaged over the fillings."""
    rows = [hole_scores(picture, case.truth, case.hole) for picture in pictures]
    return {column: float(np.mean([row[column] for row in rows])) for column in COLUMNS}


def time_cpu(work) -> tuple:
    """Call `work`; return its result and the CPU seconds of this process, summed over all its threads."""
    began = time.process_time()
    return work(), time.process_time() - began


def measure_inpainting(priors: list[str], cases: list[Case], start: float, noises: int, out: Path) -> dict:
    """Fill held-out pictures by OpenCV's methods and by priors, and score them.

    The first `SHOWN` cases are saved as rows of pictures.

    Args:
        priors: diffusers folders.
        cases: pictures with holes.
        start: see `fill_holes`.
        noises: seeds of the sampler's noise, over which a picture's scores are averaged.
        out: folder for the rows of pictures.

    Returns:
        "columns": titles of the columns of pictures; "scores": method -> kind of picture ("all" too) -> mean scores,
        and "lpips_over_telea", the mean of LPIPS minus Telea's and half its 95 % interval over the pictures. The kind
        "all" also has "seconds" of CPU per picture.
    """
    rivals = {"Telea": cv2.INPAINT_TELEA, "Navier-Stokes": cv2.INPAINT_NS}
    ways, seconds = {}, {}
    for name, flag in rivals.items():
        fill = lambda flag=flag: [cv2.inpaint(c.truth, c.hole.astype(np.uint8), TELEA_RADIUS, flag) for c in cases]
        filled, seconds[name] = time_cpu(fill)
        ways[name] = [filled]
    for name in priors:
        prior = load_prior(name)
        fill = lambda prior=prior: [fill_holes(prior, cases, SEED + k, start=start) for k in range(noises)]
        ways[name], spent = time_cpu(fill)
        seconds[name] = spent / noises
    for index, case in enumerate(cases[:SHOWN]):
        save_row(out / f"{index:02d}.png", case, [fillings[0][index] for fillings in ways.values()])
    rows = {
        name: [score_fillings(*each) for each in zip(cases, *fillings, strict=True)] for name, fillings in ways.items()
    }
    result = {}
    for name, own in rows.items():
        result[name] = {}
        for kind in ("all", *sorted({case.kind for case in cases})):
            chosen = [k for k, case in enumerate(cases) if kind in ("all", case.kind)]
            over = np.array([own[k]["lpips"] - rows["Telea"][k]["lpips"] for k in chosen])
            telea = {"lpips_over_telea": [float(over.mean()), confidence_half_width(over)]}
            result[name][kind] = mean_scores([own[k] for k in chosen]) | telea
        result[name]["all"]["seconds"] = seconds[name] / len(cases)
    return {"columns": ["hole", *ways, "truth"], "scores": result}


def measure_steps(prior: Prior, cases: list[Case], steps: list[int], prompt: str = "") -> dict[str, dict]:
    """Fill the holes with several numbers of sampler steps.

    Returns:
        Number of steps, as text -> mean scores and "seconds" of CPU per picture.
    """
    result = {}
    for count in steps:
        pictures, seconds = time_cpu(lambda count=count: fill_holes(prior, cases, SEED, prompt, count))
        result[str(count)] = score_cases(pictures, cases) | {"seconds": seconds / len(cases)}
    return result


# ---------------------------------------------------------------------------------------------- personalization


def scene_cases(run: Path, size: int, pictures: dict[str, np.ndarray] | None = None) -> dict[str, list[Case]]:
    """Load the holes of a run at three scales, as pictures of `size` px.

    Args:
        run: runs/<scene>.
        size: side of the pictures, px.
        pictures: view name -> uint8 [H, W, 3], to be used instead of the ground truth; None for the ground truth.

    Returns:
        "reference": the first reference with its hole, reduced to `size`, `NOISES` times; "whole": up to `VIEWS` test
        views with ground truth and their masks as holes, reduced to `size`; "window": an unreduced window of `size` px
        that contains a random pixel of the hole, of each of these views.

    Raises:
        ValueError: no test view has ground truth and a mask.
    """
    chosen = [
        Case(truth if pictures is None else pictures[camera.name], hole, camera.name)
        for camera, truth, hole in load_test_views(run, VIEWS)
    ]
    reference = load_references(run / "reference", load_scene(run / "poses"))[0]
    own = _reduced(Case(reference.image, reference.mask, reference.camera.name), size)
    whole, windows = [_reduced(case, size) for case in chosen], []
    for case in chosen:
        top, left = window_around(torch.from_numpy(case.hole), size, seeding.generator(SEED, "window", case.kind))
        window = (slice(top, top + size), slice(left, left + size))
        windows.append(
            Case(np.ascontiguousarray(case.truth[window]), np.ascontiguousarray(case.hole[window]), case.kind)
        )
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


@torch.no_grad()
def measure_timesteps(prior: Prior, cases: list[Case], prompt: str) -> dict[str, list[float]]:
    """Measure the clean latent x0 that the prior predicts in the holes from the noised truth.

    Returns:
        Lists over `TIMESTEPS`, of means over the latent values in the holes. "error": squared error of x0. "variance":
        variance of x0 over `NOISES` draws of the noise, which is also the variance of the SDS gradient z - x0.
    """
    pictures, holes = to_tensors(cases)
    shown = diffusion.measure_levels(prior, pictures, holes).normalize(pictures)
    clean, condition = diffusion.encode(prior, shown), diffusion.conditioning(prior, shown, holes)
    text = diffusion.embed_text(prior, [prompt]).expand(len(cases), -1, -1)
    inside = condition[:, :1].expand_as(clean) > 0.5
    result: dict[str, list[float]] = {"error": [], "variance": []}
    for timestep in TIMESTEPS:
        t = torch.full((len(cases),), timestep)
        gradients = []
        for index in range(NOISES):
            noise = torch.randn(clean.shape, generator=seeding.generator(SEED, "noise", timestep, index))
            gradients.append(
                diffusion.predict(prior, diffusion.add_noise(prior, clean, noise, t), t, condition, text)[1]
            )
        guesses = torch.stack(gradients)
        result["error"].append(float((guesses - clean).square().mean(0)[inside].mean()))
        result["variance"].append(float(guesses.var(0)[inside].mean()))
    return result


def replace_references(reference: Path, picture: Path, folder: Path) -> Path:
    """Copy the folder of the stage `reference` to `folder`, with a picture, resized, in place of every reference.

    The masks are copied unchanged. The result is `folder`, which must not exist before.
    """
    shutil.copytree(reference, folder)
    for path in (folder / "references").glob("*.png"):
        height, width = load_image(path).shape[:2]
        save_image(path, cv2.resize(load_image(picture), (width, height), interpolation=cv2.INTER_AREA))
    return folder


def keep_if_same(folder: Path, params: Settings) -> None:
    """Make the folder of a personalization or distillation. An earlier attempt with other parameters is removed."""
    settings, record = params.model_dump(mode="json"), folder / "settings.json"
    if not record.exists() or load_json(record) != settings:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        save_json(record, settings)


def personalize_prior(params: stage.Params, needs: dict[str, Path], folder: Path) -> tuple[Prior, list[dict]]:
    """Personalize a prior in `folder`; return the personalized prior and the trace.

    An earlier attempt with the same parameters continues, or is taken as it is if it is finished.

    Args:
        params: parameters of the stage `personalize`.
        needs: stage -> folder, for the stages that `personalize` needs.
    """
    keep_if_same(folder, params)
    if not (folder / lora.LORA_FILE).exists():
        stage.run(params, folder, **needs)
    return lora.merge(load_prior(params.prior), folder), trace.read_trace(folder / "trace.jsonl")


def personalize_wrongly(params: stage.Params, needs: dict[str, Path], wrong: Path, folder: Path) -> Prior:
    """Return the prior personalized to a wrong reference.

    Args:
        params: parameters of the stage `personalize`.
        needs: stage -> folder, for the stages that `personalize` needs.
        wrong: a picture to learn instead of the reference, or the run of another scene whose LoRA is used.
        folder: folder for the personalization.
    """
    if wrong.is_dir():
        return lora.merge(load_prior(params.prior), wrong / "personalize")
    other = replace_references(needs["reference"], wrong, folder / "other")
    model, _ = personalize_prior(params, needs | {"reference": other}, folder / f"{params.seed}-wrong")
    shutil.rmtree(other)
    return model


def fill_scales(model: Prior, cases: dict[str, list[Case]], seed: int, sampler: int) -> dict[str, list[np.ndarray]]:
    """Fill the holes of all scales from pure noise in `sampler` steps; return {scale: pictures}."""
    return {scale: fill_holes(model, some, SEED + seed, PROMPTS[scale], sampler) for scale, some in cases.items()}


def score_scales(pictures: dict[str, list[np.ndarray]], cases: dict[str, list[Case]]) -> dict[str, dict[str, float]]:
    """Return {scale: mean scores of the filled pictures inside their holes}."""
    return {scale: score_cases(pictures[scale], some) for scale, some in cases.items()}


def measure_personalization(
    params: stage.Params, run: Path, seeds: list[int], wrong: Path | None, steps: list[int], sampler: int, out: Path
) -> dict:
    """Personalize a prior to a run's reference, once per seed, and measure it before and after on unseen views.

    Args:
        params: parameters of the stage `personalize`.
        run: runs/<scene>, with the stages in `LEARNS` and the object's masks in test views.
        seeds: seeds of the personalization.
        wrong: wrong reference, see `personalize_wrongly`; None for none.
        steps: numbers of sampler steps to compare, for the prior personalized with the first seed.
        sampler: number of sampler steps of all other fillings.
        out: folder of the study.

    Returns:
        The settings, the measurements of the first seed (see `measure_first_seed`), and in "seeds" for every seed the
        scores of the fillings by scale ("before", "after" and, if `wrong` is given, "wrong") and "seconds", the wall
        time of the personalization without measurements.

    Raises:
        ValueError: a stage of the run is missing.
    """
    needs = {need: run / need for need in LEARNS}
    for folder in needs.values():
        if not folder.is_dir():
            raise ValueError(f"{folder} is missing: run `make scene={run.name} reference` first")
    base = load_prior(params.prior)
    cases = scene_cases(run, base.native_size)
    result: dict = {"settings": params.model_dump(mode="json"), "steps": params.steps, "sampler_steps": sampler}
    result["seeds"] = {}
    for seed in seeds:
        mine = params.model_copy(update={"seed": seed})
        model, log = personalize_prior(mine, needs, out / "personalize" / str(seed))
        models = {"before": base, "after": model}
        if wrong:
            models["wrong"] = personalize_wrongly(mine, needs, wrong, out / "personalize")
        pictures = {when: fill_scales(model, cases, seed, sampler) for when, model in models.items()}
        result["seeds"][str(seed)] = {when: score_scales(samples, cases) for when, samples in pictures.items()}
        result["seeds"][str(seed)]["seconds"] = log[-1]["seconds"]
        print_seed(seed, result["seeds"][str(seed)])
        if seed == seeds[0]:
            result |= measure_first_seed(models, cases, pictures, log, steps, out)
    return result


def print_seed(seed: int, scores: dict) -> None:
    """Print the scores of one seed."""
    print(f"seed {seed}, {scores['seconds']:.0f} s", flush=True)
    for when in ("before", "after", "wrong"):
        for scale, row in scores.get(when, {}).items():
            print(f"  {when}, {scale}", {column: round(row[column], 3) for column in COLUMNS}, flush=True)


def measure_first_seed(
    models: dict[str, Prior],
    cases: dict[str, list[Case]],
    pictures: dict[str, dict[str, list[np.ndarray]]],
    log: list[dict],
    steps: list[int],
    out: Path,
) -> dict:
    """Make the measurements of the first seed: errors by timestep, effect of sampler steps, rows of pictures.

    Args:
        models: "before", "after" and perhaps "wrong" -> prior.
        cases: scale -> holes.
        pictures: key of `models` -> scale -> filled pictures.
        log: trace of the personalization.
        steps: numbers of sampler steps to compare.
        out: folder of the study.

    Returns:
        "trace", "timesteps", "columns" (titles of the columns of pictures); scale -> key of `models` -> result of
        `measure_timesteps`, with "samples", the mean scores of the filled pictures; and "sampler": scale -> result of
        `measure_steps` of the prior "after".
    """
    result: dict = {"trace": log, "timesteps": TIMESTEPS, "columns": ["hole", *models, "truth"]}
    for scale, some in cases.items():
        result[scale] = {
            when: measure_timesteps(model, some, PROMPTS[scale]) | {"samples": score_cases(pictures[when][scale], some)}
            for when, model in models.items()
        }
        for index, case in enumerate(some):
            save_row(out / scale / f"{case.kind}.png", case, [samples[scale][index] for samples in pictures.values()])
    result["sampler"] = {s: measure_steps(models["after"], cases[s], steps, PROMPTS[s]) for s in ("reference", "whole")}
    return result


def parse_setting(text: str) -> tuple[str, object]:
    """Parse a command-line setting, e.g. "steps=500" to ("steps", 500). The value is read as YAML."""
    name, separator, value = text.partition("=")
    if not separator:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    return name, yaml.safe_load(value)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--priors", nargs="+", default=["priors/tiny"], help="diffusers folders; the first one is personalized"
    )
    parser.add_argument("--pictures", type=int, default=64, help="held-out pictures to fill; 0 skips this part")
    parser.add_argument("--photographs", type=Path, help="the output of `lab.prior.photographs`")
    parser.add_argument("--start", type=float, default=1.0, help="noise level from which filled holes are painted")
    parser.add_argument("--noises", type=int, default=1, help="seeds of the sampler's noise to average over")
    parser.add_argument("--steps", type=int, nargs="*", default=[], help="numbers of sampler steps to compare")
    parser.add_argument("--run", type=Path, help="runs/<scene>, with its reference; without it no personalization")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="seeds of personalization")
    parser.add_argument("--sampler", type=int, default=50, help="steps in which a personalized prior paints")
    parser.add_argument("--wrong-reference", type=Path, help="a picture, or runs/<another scene>, to measure as well")
    parser.add_argument(
        "--set", type=parse_setting, nargs="*", default=[], help="personalization's: steps=500 lora.rank=32"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/prior-report"))
    parser.add_argument("--threads", type=int, default=2)
    return parser.parse_args()


def main() -> None:
    """Run the parts that are asked for. The pictures of an earlier run in --out are deleted."""
    arguments = parse_arguments()
    if (arguments.out / "poses").is_dir():
        raise ValueError(f"{arguments.out} is the folder of a job; name another folder for --out")
    torch.set_num_threads(arguments.threads)
    for folder in ("inpainting", "photographs", "reference", "whole", "window"):
        shutil.rmtree(arguments.out / folder, ignore_errors=True)
    first = arguments.priors[0]
    result: dict = {"prior": first}
    if arguments.pictures:
        cases = make_cases(arguments.pictures)
        result["inpainting"] = measure_inpainting(
            arguments.priors, cases, arguments.start, arguments.noises, arguments.out / "inpainting"
        )
        for name, kinds in result["inpainting"]["scores"].items():
            print(name, {column: round(kinds["all"][column], 3) for column in (*COLUMNS, "seconds")}, flush=True)
        result["sampler"] = measure_steps(load_prior(first), cases, arguments.steps)
        for count, row in result["sampler"].items():
            print(f"{count} steps", {column: round(row[column], 3) for column in (*COLUMNS, "seconds")}, flush=True)
    if arguments.photographs:
        cases = make_photograph_cases(load_photographs(arguments.photographs, held_out=True), PHOTOGRAPH_CASES)
        result["photographs"] = measure_inpainting(
            arguments.priors, cases, arguments.start, arguments.noises, arguments.out / "photographs"
        )
        for name, kinds in result["photographs"]["scores"].items():
            for kind in ("whole", "window"):
                shown = {column: round(kinds[kind][column], 3) for column in COLUMNS}
                print(name, kind, shown, "LPIPS over Telea's:", kinds[kind]["lpips_over_telea"], flush=True)
    if arguments.run:
        params = profile_params("personalize", "laptop", {"prior": first, **dict(arguments.set)})
        result["personalization"] = measure_personalization(
            params,
            arguments.run,
            arguments.seeds,
            arguments.wrong_reference,
            arguments.steps,
            arguments.sampler,
            arguments.out,
        )
    save_json(arguments.out / "prior.json", result)
    print(arguments.out / "prior.json")


if __name__ == "__main__":
    run_study(main)
