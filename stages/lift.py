"""The stage `lift`: the hole of each view is inpainted in 2D, independently, as NeRF-In and SPIn-NeRF do.

Only baselines use this stage; it is not part of the method.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from reffusion import seeding, trace
from reffusion.inpaint import feedforward
from reffusion.io.arrays import save_json
from reffusion.io.images import load_image, replace_image
from reffusion.io.scene import save_references
from reffusion.params.base import REFINED_FROM
from reffusion.params.lift import Params
from reffusion.prior import inpaint
from reffusion.prior.model import load_prior
from reffusion.types import Reference
from reffusion.workspace import Workspace

SEED = 0
DTYPE = torch.float32


def run(params: Params, out: Path, *, poses: Path, fit: Path, masks: Path) -> None:
    """Run the stage: inpaint the invent mask I of each view in which it is not empty.

    The views are training views and views without a photograph. Clean views (photographed without the object) are left
    out, except the best view, which is never left out. Writes images/<view>.png, the best view also as a reference (as
    the stage `reference` does), and facts.json. Views that an interrupted run finished are not inpainted again.

    Args:
        out: folder of this stage.
        poses, fit, masks: folders of the stages of these names.

    Raises:
        ValueError: only views without a photograph have pixels to invent.
    """
    space = Workspace(poses, fit, masks)
    scene, sets, best_view = space.scene, space.mask_sets, space.facts["best_reference"]
    if best_view is None:
        raise ValueError("only views without a photograph have pixels to invent; lift needs a photograph that has some")
    names = sorted({best_view} | ({*space.facts["invent_views"]} - scene.clean))
    painter, paint = load_painter(params)
    print(f"2D inpainter: {painter}", flush=True)
    for k in trace.progress(len(names), "lift"):
        name, path = names[k], out / "images" / f"{names[k]}.png"
        if path.exists():
            continue
        replace_image(path, paint(space.remove_object(name), sets[name].invent, name))
    image, mask = load_image(out / "images" / f"{best_view}.png"), sets[best_view].invent
    save_references(out, [Reference(scene.cameras[best_view], image, mask)])
    save_json(out / "facts.json", {"inpainter": painter, "views": len(names)})


def load_painter(params: Params) -> tuple[str, Callable[[np.ndarray, np.ndarray, str], np.ndarray]]:
    """Load the 2D inpainter that the parameters name.

    Returns:
        Its name, and a function that inpaints a view: (image uint8 [H, W, 3], hole bool [H, W], view name) -> uint8
        [H, W, 3]. The view's name determines the random numbers of the diffusion prior.
    """
    if painter := feedforward.load_inpainter(params.inpainter, params.device):
        return painter.name, lambda image, hole, _: painter.paint(image, hole)
    prior = load_prior(params.prior, device=params.device, dtype=DTYPE)

    def paint(image: np.ndarray, hole: np.ndarray, name: str) -> np.ndarray:
        (picture,) = inpaint.paint(
            prior,
            inpaint.to_input(image),
            torch.from_numpy(hole),
            prompt=params.prompt,
            seeds=[seeding.seed_for(SEED, "lift", name)],
            steps=params.steps,
            guidance=params.guidance,
            start=1.0,
            finest=REFINED_FROM,
        )
        return inpaint.to_picture(picture)

    return f"diffusion by {params.prior}, {params.steps} steps", paint
