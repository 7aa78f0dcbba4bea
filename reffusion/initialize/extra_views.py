"""Extra views: views that are completed besides the references, because the filled scene still has gaps in them.

Each time, the view is selected that has the most uncovered pixels (next-best-view selection). These are the pixels of C
(the object's mask) that no opaque surface covers (`coverage.find_uncovered`). The draft is the scene that is being
filled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from reffusion import morphology
from reffusion.background.model import Background
from reffusion.initialize import coverage
from reffusion.initialize.draft import Draft
from reffusion.initialize.fill import fill_reference
from reffusion.inpaint import classical, exemplar
from reffusion.inpaint.classical import Painter
from reffusion.masks import voting
from reffusion.params.initialize import Params
from reffusion.prior import inpaint
from reffusion.types import Reference

STUCK = 0.9  # a completed view is not tried again if more than this share of its uncovered pixels remains uncovered
SEED = 0  # seed of the patch search


def complete_extra_views(
    params: Params, draft: Draft, background: Background, references: Sequence[Reference], painter: Painter | None
) -> tuple[Draft, list[Reference], dict[str, np.ndarray]]:
    """Complete the view with most uncovered pixels, add it to the draft, and repeat, up to `params.extra_views` times.

    Before the first view, floaters are removed: remaining Gaussians that are visible mostly in uncovered pixels. The
    loop ends early if no view has enough uncovered pixels (`coverage.least_covered_view`). A view whose depth cannot be
    estimated is left as it is. A line is printed for each view.

    Args:
        params: parameters of the stage `initialize`.
        draft: the scene after the references were added.
        background: the photographs and surfaces around the object.
        references: completed views; the patch search takes textures from them too.
        painter: the feed-forward inpainter that completes the views. None to complete them from patches of the
            photographs and the references.

    Returns:
        The draft with the extra views and without the floaters; the extra views in the order of completion, in which a
        view may occur again, with what it left uncovered as its mask; and view name -> [H, W], the depth at which each
        was last added.
    """
    extra: list[Reference] = []
    depths: dict[str, np.ndarray] = {}
    mirror_depth = coverage.expected_mirror_depth(background)
    find = lambda draft, cameras: coverage.find_uncovered(
        draft.gaussians, draft.is_new, background, cameras, mirror_depth
    )
    uncovered = find(draft, background.cameras)
    draft = draft.drop(voting.find_floaters(draft.gaussians, background.cameras, uncovered) & ~draft.is_new)
    completed = coverage.completed_views(references, draft.gaussians, background)
    sources = replace(background, completed=completed)
    cameras = coverage.cameras_near_photographs(background)
    while len(extra) < params.extra_views:
        camera = coverage.least_covered_view(cameras, background, uncovered)
        if camera is None:
            break
        hole, mask = uncovered[camera.name], background.masks[camera.name]
        picture = _complete_view(draft, camera, hole, sources, painter)
        reference = Reference(camera, picture, hole)
        print(f"extra view {camera.name}: {hole.sum() / mask.sum():.1%} of the mask is covered by nothing")
        try:
            filled = fill_reference(params, draft, reference, background, farthest=True)
        except ValueError as error:  # a sliver at the border of the image; other views may show it better
            print(f"left as it is: {error}")
            uncovered[camera.name] = np.zeros_like(hole)
            continue
        draft, depths[camera.name] = filled.draft, filled.depth
        extra.append(reference)
        uncovered |= find(draft, [each for each in cameras if uncovered[each.name].any()])
        if uncovered[camera.name].sum() > STUCK * hole.sum():  # a second try would cover as little as the first
            uncovered[camera.name] = np.zeros_like(hole)
    return draft, extra, depths


def _complete_view(draft: Draft, camera, hole: np.ndarray, sources: Background, painter: Painter | None) -> np.ndarray:
    """Return a view of the draft, uint8 [H, W, 3], whose uncovered pixels `hole` and their rim are completed in 2D."""
    mask = sources.masks[camera.name]
    # Just outside C a photograph may still show the object's rim; the inpainter would continue this rim into the hole.
    photo = sources.photos[camera.name]
    base = inpaint.composite_background(draft.gaussians, camera, photo, morphology.dilate(mask, exemplar.RIM_WIDTH))
    region = exemplar.add_rim(hole, mask)
    # Without a feed-forward inpainter, patches are taken from the photographs and completed views in `sources`.
    if painter is not None:
        return painter.paint(base, region)
    if coverage.is_narrow(hole):  # a narrow gap shows no texture; continuing the adjacent colors is enough
        return classical.telea(base, region)
    return next(exemplar.complete_view(base, region, camera, mask, sources, [SEED])).image
