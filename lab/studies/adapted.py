"""The paper's Figure 2: views of a scene inpainted by the prior before and after personalization.

`python -m lab.studies.adapted --run runs/demo`, or `make scene=X adapted`; needs the stages up to `personalize`.
The study takes evenly spread training views with pixels to invent. Where other views show the background behind the
object, the background is filled in first. The remaining hole is inpainted from pure noise, with the whole view reduced
to the prior's native size, as in SDS. Views, noise and sampler are the same for all columns. The prior before
personalization runs twice: with the empty prompt, and with the prompt of the personalized prior, which may have a
meaning for the prior even before.
The study writes sheet.png, each picture as <view>/<column>.png, and adapted.json to --out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from lab.studies import scene_priors
from reffusion import seeding
from reffusion.fit import exposure
from reffusion.io.arrays import load_labels
from reffusion.io.images import save_image
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_mask_sets, load_references, load_scene
from reffusion.params.base import Prompts, Sampler
from reffusion.prior import diffusion, inpaint
from reffusion.prior.model import Prior
from reffusion.references import view_ranking
from report.sheet import compose_sheet, enlarge, pick_evenly

VIEWS = 5
SEED = 0
WIDTH = 400  # approximate width of a picture on the sheet, px
COLUMNS = {  # column -> prior ("before" or "after" personalization), prompt
    "as it is, no prompt": ("before", ""),
    "as it is": ("before", Prompts().whole),
    "adapted": ("after", Prompts().whole),
}


def load_holes(run: Path, count: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Load up to `count` evenly spread training views with pixels to invent, except the views of the references.

    Returns:
        View -> (picture, hole). The picture, uint8 [H, W, 3], has the object replaced by the remaining Gaussians (those
        that the stage `masks` keeps), which show the background as far as it is known. The hole, bool [H, W], is True
        for the pixels to invent.

    Raises:
        ValueError: a stage is missing, or nothing is to be invented outside the references' views.
    """
    for stage in ("poses", "fit", "masks", "reference"):
        if not (run / stage).is_dir():
            raise ValueError(f"{run / stage} is missing: run `make scene={run.name} personalize` first")
    scene = load_scene(run / "poses")
    sets = load_mask_sets(run / "masks", scene.train)
    learnt = {each.camera.name for each in load_references(run / "reference", scene)}
    names = [name for name in scene.train if sets[name].invent.any() and name not in scene.clean | learnt]
    if not names:
        raise ValueError(f"{run / 'masks'}: nothing is to be invented but in the reference")
    keep = ~load_labels(run / "masks" / "labels.npy")
    remaining = load_ply(run / "fit" / "gaussians.ply").map(lambda p: p[keep])
    chosen = pick_evenly(names, count)
    photos = exposure.load_photos_in_scene_exposure(run / "poses", run / "fit", chosen)
    known = lambda n: inpaint.composite_background(remaining, scene.cameras[n], photos[n], sets[n].consistent)
    return {name: (known(name), sets[name].invent) for name in chosen}


@torch.no_grad()
def paint_hole(prior: Prior, picture: np.ndarray, hole: np.ndarray, prompt: str, steps: int) -> np.ndarray:
    """Inpaint the hole of a picture from pure noise of the seed `SEED`; return the whole new picture, uint8 [H, W, 3].

    Args:
        picture: uint8 [H, W, 3].
        hole: bool [H, W], True for the pixels to inpaint.
        prompt: prompt of the prior.
        steps: number of sampler steps.
    """
    inside = torch.from_numpy(hole)
    painting = inpaint.repaint(
        prior,
        inpaint.to_input(picture) * ~inside,
        inside,
        diffusion.embed_text(prior, [prompt, prompt, ""]),
        seeding.generator(SEED, "adapted"),
        start=1.0,
        finest=1.0,
        levels=0,
        steps=steps,
        guidance=0.0,
    )
    return inpaint.to_picture(painting)


def save_sheet(models: dict[str, Prior], run: Path, count: int, steps: int, out: Path) -> list[str]:
    """Inpaint the holes with all priors and prompts, write the pictures and sheet.png; return the views' names.

    Args:
        models: "before" and "after" personalization -> prior.
        run: runs/<scene>.
        count: largest number of views.
        steps: number of sampler steps.
        out: folder to write to.
    """
    views, rows = load_holes(run, count), []
    for name, (picture, hole) in views.items():
        row = {"to paint": view_ranking.painting_template(picture, hole)}
        for column, (when, prompt) in COLUMNS.items():
            row[column] = paint_hole(models[when], picture, hole, prompt, steps)
        for column, cell in row.items():
            save_image(out / name / f"{column.replace(', ', '-').replace(' ', '-')}.png", cell)
        scale = max(1, round(WIDTH / picture.shape[1]))
        rows.append([enlarge(cell, scale) for cell in row.values()])
        print(f"{name}: painted by {len(COLUMNS)}", flush=True)
    save_image(out / "sheet.png", compose_sheet(rows, ["to paint", *COLUMNS], list(views)))
    return list(views)


def main() -> None:
    parser = scene_priors.study_parser(__doc__, "the stages up to personalize", "adapted")
    parser.add_argument("--views", type=int, default=VIEWS)
    parser.add_argument("--steps", type=int, default=Sampler().steps, help="sampler steps from pure noise")
    arguments = parser.parse_args()
    models, base = scene_priors.load_priors(arguments)
    out = arguments.out or arguments.run / "adapted"
    views = save_sheet(models, arguments.run, arguments.views, arguments.steps, out)
    scene_priors.save_results(
        arguments, out, "adapted.json", {"prior": base, "seed": SEED, "steps": arguments.steps, "views": views}
    )
    print(out / "sheet.png")


if __name__ == "__main__":
    scene_priors.run_study(main)
