"""Relighting of photographs that show the object's shadow, which the completed references no longer show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from reffusion.background.model import Background
from reffusion.background.visibility import with_photographed_depth
from reffusion.masks import reference_shadows
from reffusion.prior import inpaint
from reffusion.splat import rasterizer
from reffusion.types import Gaussians, Reference


def remove_shadows(
    references: Sequence[Reference], gaussians: Gaussians, background: Background
) -> tuple[list[Reference], Background, dict[str, np.ndarray]]:
    """Detect the object's cast shadow by comparing references with their photographs, and relight all photographs.

    Of a reference that also fills pixels outside C (the object's mask), only the differences inside C count as shadow:
    it shows an inserted object, which differs from the photograph, too.

    Args:
        references: completed views, without the object and its shadow.
        gaussians: of the filled scene.
        background: the photographs and where they show the object.

    Returns:
        A tuple of three results:

        - the references, each with the shadow that was detected in its own view added to its mask;
        - the background. Its photographs have the references' light where they showed the shadow. Pixels whose light
          is unknown are added to the masks of its views, and so do not supervise;
        - view name -> bool [H, W], the shadow in each view; an empty dictionary if no reference shows a shadow.
    """
    found = {camera.name: np.zeros((camera.height, camera.width), bool) for camera in background.cameras}
    unknown, photos = dict(found), dict(background.photos)
    extended = []
    for each in references:
        name = each.camera.name
        mask = background.masks[name]
        view = inpaint.composite_background(gaussians, each.camera, photos[name], mask)
        shadow = reference_shadows.detect_shadows(each.image, view, mask)
        if (each.mask & ~mask).any():  # an inserted object and its rim differ too, but are no shadow
            shadow &= mask
        extended.append(replace(each, mask=each.mask | shadow))
        if not shadow.any():
            continue
        print(f"reference {name}: beside the hole {shadow.sum()} px differ from what is seen, a shadow perhaps")
        depth = rasterizer.render(gaussians, each.camera, sh_degree=0).depth.double().cpu().numpy()
        depth = with_photographed_depth(depth, each.camera, background.views)
        light = reference_shadows.log_light(each.image, view)
        projected = reference_shadows.project_shadow(shadow, light, depth, each.camera, background.views)
        for other, (pixels, own_light) in projected.items():
            photos[other] = reference_shadows.relight(photos[other], own_light)
            found[other] = found[other] | pixels
            unknown[other] = unknown[other] | (pixels & np.isnan(own_light).any(-1))
    if not any(pixels.any() for pixels in found.values()):
        return list(references), background, {}
    views = [replace(view, masked=view.masked | unknown[view.camera.name]) for view in background.views]
    return extended, replace(background, views=views, photos=photos), found
