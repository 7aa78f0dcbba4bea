"""Distillation with an exact denoiser: `python -m lab.studies.control data/demo-mono-5 ... --runs runs`.

The embedded prior is small, so a result with it judges the prior as much as the method. Here the same code distils an
exact prior instead (`exact_prior`): the posterior mean over fillings of the training views, which recognises view and
window by their known pixels, as any inpainting model could. The personalized prior knows only the fillings that agree
with the reference; the prior without personalization, and the empty prompt, know all. With --embedded the embedded
prior is distilled, for comparison.

The stages up to `initialize` run in the profile `paper-terms`. Then each of the `METHODS` distils from the same start.
Scored are test views, in the box of the object: LPIPS (vgg) and PSNR, and PSNR outside. The study prints and writes
control.md (differences to `full`, means over scenes with 95 % intervals; then each scene), control.json and sheet.png
to --out. A scene's line has the share of known pixels in windows, and how far the estimated depth displaces the
reference's pixels in other views. Scenes are those of the kind `mono`, which hold the truth of the training views.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lab.studies import scene_priors
from lab.studies.exact_prior import make_fillings, make_prior
from lab.studies.jobs import ROOT, run_job
from lab.studies.prior import keep_if_same
from reffusion import geometry
from reffusion.distill import depth_estimator
from reffusion.distill.inputs import load_adapted_prior, load_initialization, load_train_views
from reffusion.distill.loop import distill
from reffusion.distill.terms.term import TermInputs
from reffusion.distill.train_view import TrainView
from reffusion.io.arrays import save_json, save_text
from reffusion.io.ground_truth import load_ground_truth, load_object_mask
from reffusion.io.images import load_exr, load_image, save_image
from reffusion.io.scene import load_references
from reffusion.metrics import lpips
from reffusion.metrics import rows as scores
from reffusion.metrics.view_renders import ViewRenderer
from reffusion.params.distill import Params
from reffusion.prior import windows
from reffusion.prior.model import Prior
from reffusion.seeding import generator
from reffusion.splat import rasterizer
from reffusion.types import Gaussians
from reffusion.workspace import Workspace
from report import page
from report.paired_statistics import confidence_half_width
from report.sheet import compose_sheet
from runner.resolve import Request, resolve

# Method -> variant of pipeline.yaml. "start" is the initialization. The next two have the true views in place of SDS.
METHODS = {
    "start": "",
    "l1_and_ssim": "",
    "squared_error": "",
    "full": "",
    "no_sds": "no_sds",
    "no_local_sds": "no_local_sds",
    "no_personalization": "no_personalization",
    "no_splitting": "no_splitting",
    "no_reference_init": "no_reference_init",
    "no_adversarial": "no_adversarial",
    "no_depth": "no_depth",
}
SCORES = {"lpips_vgg_box": 4, "psnr_box": 2, "psnr_outside": 2}  # column of per_view.csv -> decimals
NO_PRIOR: dict[str, Any] = {"sds.weight": 0, "depth.weight": 0, "adversarial.weight": 0}
# Method -> its parameters of `distill`: the true views supervise all Gaussians, or the masked ones in the hole.
TRUE_VIEWS = {"l1_and_ssim": NO_PRIOR, "squared_error": NO_PRIOR | {"lift.weight": 1, "lift.loss": "mse"}}
SHEET_SCALE = 3


# ---------------------------------------------------------------------------------------------- one scene


def run_stages(scene: Path, runs: Path, method: str, more: str, stages: Sequence[str]) -> tuple[Path, Params]:
    """Run stages, with those they need, for a method. Return its folder and the parameters of `distill`.

    Raises:
        ValueError: a stage failed.
    """
    profile, variant = "paper-terms", METHODS[method]
    for stage in stages:
        run = run_job(scene, runs, stage, profile, variant, more)
    request = Request(ROOT, runs, str(scene), profile=profile, variant=variant or None, set=more)
    return run, Params(**resolve(request).params["distill"])


def load_truth(scene: Path, views: Sequence[TrainView]) -> list[Tensor]:
    """Load the training views without the object, [3, H, W] in [-1, 1] each.

    Raises:
        ValueError: the scene does not hold them.
    """
    folder = scene / "truth" / "without_object"
    if not folder.is_dir():
        raise ValueError(f"{folder} is missing: make the scene by `reffusion demo --kind mono --out {scene}`")
    pictures = [load_image(folder / f"{view.camera.name}.png") for view in views]
    return [torch.from_numpy(picture).permute(2, 0, 1) / 127.5 - 1 for picture in pictures]


def show_truth(view: TrainView, truth: Tensor, method: str) -> TrainView:
    """Return a training view that shows the truth [3, H, W] in [-1, 1], as one of the `TRUE_VIEWS`."""
    picture = (truth.permute(1, 2, 0) + 1) / 2
    if method == "squared_error":
        return replace(view, lifted=picture)
    nothing = torch.zeros_like(view.repaint)
    return replace(view, photo=picture, supervises=~nothing, repaint=nothing, clean=True)


def measure_displacement(run: Path, scene: Path, size: int) -> float:
    """Return the median displacement of the reference's pixels in other views by the error of its estimated depth.

    Only pixels of the hole count. The unit is a pixel of a whole view as the prior sees it.

    Args:
        size: side in pixels of such a view.
    """
    space = Workspace(run / "poses", run / "fit", run / "masks")
    (reference,) = load_references(run / "reference", space.scene)
    camera, hole = reference.camera, reference.mask
    estimate = load_exr(run / "initialize" / "depth" / f"{camera.name}.exr").astype(np.float64)
    true = np.load(scene / "truth" / "depth" / f"{camera.name}.npy").astype(np.float64)
    rendered = rasterizer.render(space.remaining, camera).depth.double().numpy()
    true *= np.median((rendered / true)[~hole & (rendered > 0)])
    found = []
    for name in space.scene.train:
        other = space.scene.cameras[name]
        ends = [geometry.project(geometry.unproject(depth, camera)[hole], other)[0] for depth in (estimate, true)]
        found.append(np.linalg.norm(ends[0] - ends[1], axis=1) * size / other.width)
    return float(np.median(np.concatenate(found)))


def measure_known_share(views: Sequence[TrainView], size: int) -> tuple[float, float]:
    """Return the median and the smallest share of known pixels in the windows that distillation draws."""
    shares = []
    for view in views:
        for seed in range(8 if view.repaint.any() else 0):
            top, left = windows.window_around(view.repaint, size, generator(seed, view.camera.name))
            shares.append(1 - float(view.repaint[top : top + size, left : left + size].float().mean()))
    return float(np.median(shares)), min(shares)


@torch.no_grad()
def score(gaussians: Gaussians, run: Path, models: dict[str, lpips.Lpips]) -> tuple[dict[str, float], np.ndarray]:
    """Return the mean `SCORES` over the test views, and the middle test view as rendered."""
    space, scored, pictures = Workspace(run / "poses", run / "fit", run / "masks"), [], []
    renderer = ViewRenderer({"distill": gaussians}, "distill", None, {})
    for name in space.scene.test:
        camera = space.scene.cameras[name]
        picture = load_ground_truth(camera, run / "poses")
        view = renderer.render(camera, load_object_mask(camera, run / "raw_masks", run / "masks"), picture).result
        scored.append(scores.score_row(view, None, scores.GroundTruth(picture, False, None), models))
        pictures.append(view.picture)
    mean = scores.summarize(scored)["mean"]
    return {name: mean[name] for name in SCORES}, pictures[len(pictures) // 2]


class Measured(NamedTuple):
    """What the study measures of a scene.

    Attributes:
        scores: method -> `SCORES`.
        facts: as of `Exact`.
        pictures: the middle test view by each method.
    """

    scores: dict[str, dict[str, float]]
    facts: dict[str, float]
    pictures: list[np.ndarray]


class Exact(NamedTuple):
    """The truth of a scene, the exact prior, and facts of the scene as this prior sees it.

    Attributes:
        truth: the training views without the object, [3, H, W] in [-1, 1] each.
        prior: as of `make_prior`.
        text: [3, L, D], as of `make_prior`.
        facts: displacement (px of the prior), and the median and the smallest share of known pixels in windows.
    """

    truth: list[Tensor]
    prior: Prior
    text: Tensor
    facts: dict[str, float]


def prepare(scene: Path, run: Path, views: Sequence[TrainView], donors: Sequence[Tensor]) -> Exact:
    """Load the truth of a scene, and make its exact prior."""
    truth, random = load_truth(scene, views), np.random.default_rng(0)
    fillings = [make_fillings(each, view.repaint, donors, random) for each, view in zip(truth, views, strict=True)]
    prior, text = make_prior(torch.stack(fillings))
    size = prior.native_size
    middle, least = measure_known_share(views, size)
    facts = {"displacement": measure_displacement(run, scene, size), "known_median": middle, "known_least": least}
    return Exact(truth, prior, text, facts)


def measure_scene(
    scene: Path, runs: Path, donors: Sequence[Tensor], methods: Sequence[str], more: str, embedded: bool, out: Path
) -> Measured:
    """Distil a scene by each method.

    Args:
        donors: pictures [3, H, W] in [-1, 1] of other scenes.
        embedded: whether the embedded prior is distilled, not the exact one.
        more: parameters, as `set=` of the command line.
        out: folder for checkpoints.

    Raises:
        ValueError: the weights of LPIPS are missing, or as for `run_stages` and `load_truth`.
    """
    network, reason = lpips.load("vgg")
    if network is None:
        raise ValueError(f"LPIPS cannot be measured: {reason}")
    home, exact, found, pictures = runs / scene.name, None, {}, []
    for method in methods:
        run, params = run_stages(scene, runs, method, more, ["initialize"] + ["personalize"] * embedded)
        # A variant shares what it does not change.
        part = lambda stage, run=run: next(place / stage for place in (run, home) if (place / stage).is_dir())
        space = Workspace(part("poses"), part("fit"), part("masks"))
        gaussians, masked, references = load_initialization(params, space.scene, part("reference"), part("initialize"))
        if method != "start":
            views = load_train_views(params, space, part("initialize"))
            exact = exact or prepare(scene, home, views, donors)
            exact.prior.unet.personalized = method != "no_personalization"
            if method in TRUE_VIEWS:
                views = [show_truth(view, each, method) for view, each in zip(views, exact.truth, strict=True)]
                params = params.changed(TRUE_VIEWS[method])
            estimator = depth_estimator.build_estimator(params, space.scene.points) if params.depth.weight else None
            adapted = None if method == "no_personalization" else part("personalize") if embedded else None
            prior, text = load_adapted_prior(params, adapted) if embedded else (exact.prior, exact.text)
            inputs = TermInputs(views, references, gaussians.means[masked], prior, text, estimator, None)
            folder = out / scene.name / method
            keep_if_same(folder, params)
            gaussians, _ = distill(gaussians, masked, inputs, params, folder)
        found[method], picture = score(gaussians, home, {"vgg": network})
        pictures.append(picture)
        print(f"{scene.name}, {method}: " + ", ".join(f"{name} {value:.4f}" for name, value in found[method].items()))
    return Measured(found, exact.facts if exact else {}, pictures)


def tabulate_scenes(measured: Mapping[str, Measured]) -> str:
    """Return a Markdown table of the scenes: their facts, and LPIPS (vgg) by each method."""
    methods = list(next(iter(measured.values())).scores)
    rows = [
        [scene, *(f"{value:.2f}" for value in each.facts.values())]
        + [f"{each.scores[method]['lpips_vgg_box']:.4f}" for method in methods]
        for scene, each in measured.items()
    ]
    return page.markdown_table(["scene", "displaced, px", "known, median", "known, least", *methods], rows)


def tabulate(found: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Return a Markdown table of each method minus `full`: means over scenes and their 95 % intervals."""
    table = []
    for method in next(iter(found.values())):
        cells = [f"`{method}`"]
        for column, digits in SCORES.items():
            values = np.array([each[method][column] for each in found.values()])
            if method != "full":
                values = values - np.array([each["full"][column] for each in found.values()])
            half = confidence_half_width(values)
            sign = "" if method == "full" else "+"
            cells.append(f"{values.mean():{sign}.{digits}f}" + (f"±{half:.{digits}f}" if half is not None else ""))
        table.append(cells)
    return page.markdown_table(["minus `full`", "LPIPS (vgg)", "PSNR, dB", "outside, dB"], table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, help="folders of scenes of the kind `mono`, two or more")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of runs")
    parser.add_argument("--out", type=Path, default=Path("runs/control"))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--embedded", action="store_true", help="distil the embedded prior, personalized by its stage")
    parser.add_argument("--set", default="", help="parameters, as in `make set=...`")
    arguments = parser.parse_args()
    scenes, out = [scene.resolve() for scene in arguments.scenes], arguments.out.resolve()
    if len(scenes) < 2 or "full" not in arguments.methods:
        raise ValueError("fillings need the pictures of another scene, and the table needs `full`: name both")
    measured: dict[str, Measured] = {}
    sheet: dict[str, list[np.ndarray]] = {}
    truth = {s: [load_image(p) for p in sorted((s / "truth/without_object").glob("*.png"))] for s in scenes}
    for scene in scenes:
        others = [picture for other, pictures in truth.items() if other != scene for picture in pictures]
        donors = [torch.from_numpy(picture).permute(2, 0, 1) / 127.5 - 1 for picture in others]
        runs, more, embedded = arguments.runs.resolve(), arguments.set, arguments.embedded
        done = measure_scene(scene, runs, donors, arguments.methods, more, embedded, out)
        measured[scene.name] = done
        sheet[scene.name] = [picture.repeat(SHEET_SCALE, 0).repeat(SHEET_SCALE, 1) for picture in done.pictures]
        save_json(out / "control.json", {name: {"facts": e.facts} | e.scores for name, e in measured.items()})
        save_image(out / "sheet.png", compose_sheet([*sheet.values()], [*arguments.methods], [*sheet]))
    tables = "\n".join([tabulate({name: each.scores for name, each in measured.items()}), tabulate_scenes(measured)])
    save_text(out / "control.md", tables)
    print(tables)


if __name__ == "__main__":
    scene_priors.run_study(main)
