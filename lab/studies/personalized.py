"""What personalization teaches the prior of views that it did not see.

`python -m lab.studies.personalized data/demo-mono-5 data/demo-mono-6 ... --runs runs` needs scenes of the kind
`mono`, which hold the truth of the training views, with finished stages `masks` and `personalize`.

The prior denoises each training view except the reference, as a whole view and in windows, from noise at half the
schedule. Measured is the root mean square of the error of the clean latent in the hole, relative to that of the prior
as it is: after personalization to the scene, and to the next scene of the list. The study prints and writes
personalized.md (a row for each scene, and means with 95 % intervals) to --out.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lab.studies import scene_priors
from lab.studies.control import ROOT, load_truth
from reffusion.distill.inputs import load_adapted_prior, load_train_views
from reffusion.distill.train_view import TrainView
from reffusion.io.arrays import save_text
from reffusion.io.scene import load_references
from reffusion.params.distill import Params
from reffusion.prior import denoising, windows
from reffusion.prior.crops import GLOBAL, LOCAL, Batch, make_picture
from reffusion.prior.model import Prior
from reffusion.seeding import generator
from reffusion.workspace import Workspace
from report import page
from report.paired_statistics import confidence_half_width
from runner.resolve import Request, resolve

DRAWS = 4  # noises, and windows, of each view


@torch.no_grad()
def measure_errors(prior: Prior, text: Tensor, views: Sequence[tuple[TrainView, Tensor]]) -> np.ndarray:
    """Return the root mean square of the clean latent's error in the hole, [2]: of whole views, and of windows.

    Args:
        prior: the prior.
        text: [3, L, D], the embeddings of the global, the local and the empty prompt.
        views: training views, and the truth [3, H, W] in [-1, 1] of each.
    """
    size, squares = prior.native_size, []
    for view, truth in views:
        picture = make_picture((truth.permute(1, 2, 0) + 1) * 127.5, view.repaint, size)
        draws = generator(0, "personalized", view.camera.name)
        for _ in range(DRAWS):
            corners = [windows.window_around(picture.region, size, draws)]
            masks = windows.two_scale_masks(picture.region, corners, size)
            batch = Batch(windows.two_scales(picture.image, corners, size), masks, torch.tensor([GLOBAL, LOCAL]))
            noise = torch.randn(2, *denoising.latent_shape(prior, size), generator=draws)
            timesteps = torch.full((2,), prior.timesteps // 2)
            squares.append(denoising.denoising_error(prior, batch, text, timesteps, noise, outside_weight=0)[1])
    return torch.stack(squares).mean(0).sqrt().numpy()


def measure_scene(scene: Path, other: Path, runs: Path) -> np.ndarray:
    """Return the errors [2, 2] of `measure_errors`, each relative to those of the prior as it is.

    The first row is that of the prior personalized to the scene, the second that of the prior personalized to `other`.

    Raises:
        ValueError: a stage is missing.
    """
    run = runs / scene.name
    for needed in (run / "masks", run / "personalize", runs / other.name / "personalize"):
        if not needed.is_dir():
            raise ValueError(f"{needed} is missing: run `reffusion run {needed.name}` in the profile paper-terms first")
    space = Workspace(run / "poses", run / "fit", run / "masks")
    request = lambda variant: Request(ROOT, runs, str(scene), profile="paper-terms", variant=variant)
    params, plain = (Params(**resolve(request(each)).params["distill"]) for each in (None, "no_personalization"))
    views = load_train_views(params, space)
    references = {each.camera.name for each in load_references(run / "reference", space.scene)}
    pairs = [
        (view, truth)
        for view, truth in zip(views, load_truth(scene, views), strict=True)
        if view.camera.name not in references and view.repaint.any()
    ]

    def errors(params: Params, personalize: Path | None) -> np.ndarray:
        prior, text = load_adapted_prior(params, personalize)
        assert prior is not None and text is not None
        return measure_errors(prior, text, pairs)

    after = [errors(params, runs / each.name / "personalize") for each in (scene, other)]
    return np.stack(after) / errors(plain, None)


def tabulate(errors: dict[str, np.ndarray]) -> str:
    """Return a Markdown table of the relative errors [2, 2] of scenes, and of their means with 95 % intervals."""
    rows = [[scene, *(f"{value:.3f}" for value in each.ravel())] for scene, each in errors.items()]
    values = np.stack([each.ravel() for each in errors.values()])
    means = []
    for column in values.T:
        half = confidence_half_width(column)
        means.append(f"{column.mean():.3f}" + ("" if half is None else f"±{half:.3f}"))
    header = ["scene", "whole views", "windows", "whole views, other scene's", "windows, other scene's"]
    return page.markdown_table(header, [*rows, ["mean", *means]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, help="folders of scenes of the kind `mono`, two or more")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of runs")
    parser.add_argument("--out", type=Path, default=Path("runs/personalized"))
    arguments = parser.parse_args()
    scenes = [scene.resolve() for scene in arguments.scenes]
    if len(scenes) < 2:
        raise ValueError("the prior of another scene is measured, too: name two scenes or more")
    others = scenes[1:] + scenes[:1]
    table = tabulate(
        {
            scene.name: measure_scene(scene, other, arguments.runs.resolve())
            for scene, other in zip(scenes, others, strict=True)
        }
    )
    save_text(arguments.out / "personalized.md", table)
    print(table)


if __name__ == "__main__":
    scene_priors.run_study(main)
