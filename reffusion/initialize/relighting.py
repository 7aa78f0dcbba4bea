"""Shadows of the object, that references no longer show: photographs in the light that is left without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from reffusion.background.visibility import with_photographed_depth
from reffusion.initialize.unprojection import Surroundings
from reffusion.masks import shadows
from reffusion.prior import inpaint
from reffusion.splat import rasterizer
from reffusion.types import Gaussians, Reference


def without_shadows(
    true: Sequence[Reference], gaussians: Gaussians, around: Surroundings
) -> tuple[list[Reference], Surroundings, dict[str, np.ndarray]]:
    """The references, standing also for what the object had tainted; the surroundings with photographs in their light,
    which say nothing where it is not known; and view name -> bool [H, W], what was tainted, empty where nothing was."""
    marks = {camera.name: np.zeros((camera.height, camera.width), bool) for camera in around.cameras}
    silent, photos = dict(marks), dict(around.photos)
    pictures = []
    for each in true:
        name = each.camera.name
        hidden = around.hidden[name]
        shown = inpaint.background(gaussians, each.camera, photos[name], hidden)
        found = shadows.tainted(each.image, shown, hidden)
        if (each.mask & ~hidden).any():  # it draws something over what stays, which is no shadow, nor is its rim
            found &= hidden
        pictures.append(replace(each, mask=each.mask | found))
        if not found.any():
            continue
        print(f"reference {name}: beside the hole {found.sum()} px differ from what is seen, a shadow perhaps")
        depth = rasterizer.render(gaussians, each.camera, sh_degree=0).depth.double().cpu().numpy()
        depth = with_photographed_depth(depth, each.camera, around.views)
        brighter = shadows.light(each.image, shown)
        for view, (mask, light) in shadows.carried(found, brighter, depth, each.camera, around.views).items():
            photos[view] = shadows.relit(photos[view], light)
            marks[view], silent[view] = marks[view] | mask, silent[view] | (mask & np.isnan(light).any(-1))
    if not any(mask.any() for mask in marks.values()):
        return list(true), around, {}
    views = [replace(view, hidden=view.hidden | silent[view.camera.name]) for view in around.views]
    return pictures, replace(around, views=views, photos=photos), marks
