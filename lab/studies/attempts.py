"""Settings of distillation, error against seconds: `python -m lab.studies.attempts --run runs/demo`.

Each setting in `ATTEMPTS` is distilled from the same initialization for 100 steps, as many as in the laptop profile.
After some steps, test views are rendered and scored in the mask's box; this time is not counted. The initialization is
that of the run. --start takes another folder with gaussians.ply and labels.npy, such as
runs/demo@lift_mse/initialize, whose renders are worse: the value of a prior depends on how much is left to improve.
Test views only measure; no setting is chosen by them. The study writes attempts.json and attempts.png to --out.
Settings that are already in the file are not run again, so another --start needs another --out.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch

from lab.studies import jobs
from lab.studies.scene_priors import run_study
from reffusion import trace
from reffusion.distill.inputs import load_adapted_prior, load_initialization, load_train_views
from reffusion.distill.loop import average, build_objective, masked_factors, take_step
from reffusion.distill.terms.term import TermInputs
from reffusion.gaussians.optimize import GaussianOptimizer
from reffusion.io.arrays import load_json, save_json
from reffusion.metrics import image_metrics
from reffusion.params.distill import Params
from reffusion.splat import rasterizer
from reffusion.workspace import Workspace
from report import charts

MEASURED_STEPS = (0, 5, 10, 20, 40, 70, 100)  # steps after which scores are measured
VIEWS = 10  # test views, evenly spread
SCORES = ("psnr_box", "ssim_box", "flip_box")
NEEDS = ("poses", "fit", "masks", "reference", "initialize")
BASE = "personalize"  # key of an attempt, not a parameter of `distill`: False uses the prior before personalization
# 3DGS's full step sizes for masked Gaussians, i.e. for those that the initialization added.
FREE = {"lr.epsilon": 1e-15, "lr.masked": 1.0, "lr.opacities": 1.0}
# Name of a setting -> its differences from the laptop profile.
ATTEMPTS: dict[str, dict] = {
    "the profile": {},
    "no SDS": {"sds.weight": 0},
    "prior not personalized": {BASE: False},
    "a tenth of the weight": {"sds.weight": 0.03},
    "ten times the weight": {"sds.weight": 3},
    "every view": {"sds.max_angle": 180},
    "contrast not kept": {"sds.keep_contrast": False},
    "two windows as well": {"sds.patches": 2},
    "two windows, a tenth of the weight": {"sds.patches": 2, "sds.weight": 0.03},
    "timesteps under 0.3": {"sds.t_high": 0.3},
    "all timesteps": {"sds.t_high": 0.98},
    "free steps": FREE,
    "free steps, all timesteps": FREE | {"sds.t_high": 0.98},
    "free steps, all timesteps, not personalized": FREE | {"sds.t_high": 0.98, BASE: False},
    "free steps, no SDS": FREE | {"sds.weight": 0},
}


def attempt_params(overrides: dict) -> Params:
    """Return the laptop profile's parameters of `distill` with SDS, changed by the overrides of an attempt."""
    changes = {name: value for name, value in overrides.items() if name != BASE}
    return jobs.profile_params("distill", "laptop", {"sds.run": "always", **changes})


def load_test_views(run: Path) -> list[tuple]:
    """Load `VIEWS` test views of a run as (camera, truth uint8 [H, W, 3], box of the mask); errors as of `jobs`."""
    return [(camera, truth, image_metrics.mask_box(mask)) for camera, truth, mask in jobs.load_test_views(run, VIEWS)]


@torch.no_grad()
def score_views(gaussians, views: list[tuple]) -> dict[str, float]:
    """Return the means of `SCORES` over 8-bit renders of the test views, computed as in the stage `evaluate`."""
    rows = []
    for camera, truth, box in views:
        picture = (rasterizer.render(gaussians, camera).color.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        rows.append(image_metrics.score(box.crop(picture), box.crop(truth)))
    return {name: float(np.mean([row[name.removesuffix("_box")] for row in rows])) for name in SCORES}


def run_attempt(overrides: dict, run: Path, start: Path, views: list[tuple]) -> list[dict[str, float]]:
    """Distil with one setting and return the measurements, one dictionary per measured step.

    Args:
        overrides: the setting, a value of `ATTEMPTS`.
        run: runs/<scene>.
        start: folder of the initialization.
        views: result of `load_test_views`.

    Returns:
        {"seconds", "iteration", scores...} after each of `MEASURED_STEPS`. The seconds are the wall time since the
        first step began, without the measurements.
    """
    params = attempt_params(overrides)
    space = Workspace(run / "poses", run / "fit", run / "masks")
    initial, masked, holes = load_initialization(params, space.scene, run / "reference", start)
    adapted = run / "personalize" if overrides.get(BASE, True) else None
    prior, text = load_adapted_prior(params, adapted)
    seen = load_train_views(params, space)
    objective = build_objective(TermInputs(seen, holes, initial.means[masked], prior, text), params)
    optimizer = GaussianOptimizer(initial, masked, None, masked_factors(params.lr), epsilon=params.lr.epsilon)
    rasterizer.render(
        optimizer.gaussians, holes[0][0]
    ).color.sum().backward()  # compiles the kernels, so that compilation is not timed
    optimizer.forget_gradients()
    with tempfile.TemporaryDirectory() as folder:
        log = trace.Trace(Path(folder))
        for step in range(max(MEASURED_STEPS) + 1):
            if step in MEASURED_STEPS:
                with log.pause():
                    log.log(step, **score_views(optimizer.gaussians, views))
            if step < max(MEASURED_STEPS):
                take_step(optimizer, step, objective)
                average(optimizer, params, step + 1)
        return trace.read_trace(log.path)


def draw(curves: dict[str, list[dict]], path: Path, title: str) -> None:
    """Draw PSNR and FLIP in the mask's box against seconds, one line per setting.

    Args:
        curves: setting -> result of `run_attempt`.
        path: PNG to write.
        title: title of the chart.
    """
    figure, grid = charts.new_figure(4.6, 1, 2)
    for axes, (name, label) in zip(grid[0], (("psnr_box", "PSNR, dB ↑"), ("flip_box", "FLIP ↓")), strict=True):
        for index, (attempt, lines) in enumerate(curves.items()):
            style = "--" if "no SDS" in attempt else ":" if attempt.startswith("free") else "-"
            color = f"C{index % 10}" if index < 10 or style != "-" else charts.INK  # there are ten colors
            look = {"color": color, "linestyle": style, "linewidth": 1.5}
            points = np.array([(line["seconds"], line[name]) for line in lines])
            axes.plot(*points.T, label=attempt, **look)
        axes.set(xlabel="seconds", title=label)
    named = grid[0, 0].get_legend_handles_labels()
    figure.legend(*named, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=9)
    charts.save_chart(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, help="runs/<scene>, personalized and initialized")
    parser.add_argument("--start", type=Path, help="a folder with another initialization of the same scene")
    parser.add_argument("--only", nargs="+", choices=list(ATTEMPTS), help="these attempts")
    parser.add_argument("--out", type=Path, default=Path("runs/attempts"))
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    for need in (*NEEDS, "personalize"):
        if not (arguments.run / need).is_dir():
            raise ValueError(f"{arguments.run / need} is missing: run `make scene={arguments.run.name} all` first")
    arguments.out.mkdir(parents=True, exist_ok=True)
    file, views = arguments.out / "attempts.json", load_test_views(arguments.run)
    curves = load_json(file) if file.exists() else {}
    for name in arguments.only or ATTEMPTS:
        if name not in curves:
            curves[name] = run_attempt(
                ATTEMPTS[name], arguments.run, arguments.start or arguments.run / "initialize", views
            )
            save_json(file, curves)
        last = curves[name][-1]
        print(f"{name:44}", {s: round(last[s], 4) for s in SCORES}, f"{last['seconds']:.0f} s", flush=True)
    draw(curves, arguments.out / "attempts.png", str(arguments.start or arguments.run))
    print(arguments.out / "attempts.png")


if __name__ == "__main__":
    run_study(main)
