"""Switches of the study `parts`: how each part of the filling is left out, without a parameter of its own.

A switch replaces functions or constants of modules while the stages run in the study's own process. A parameter is
changed where the part has one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import numpy as np

from reffusion.background.mirrors import MirrorImage, render_mirrors
from reffusion.depth.completion import complete
from reffusion.inpaint import classical
from reffusion.inpaint.patchmatch.completion import Completion

INPAINT, BACKGROUND, INITIALIZE = (f"reffusion.{name}." for name in ("inpaint", "background", "initialize"))


@dataclass(frozen=True)
class Switch:
    """A part that is left out.

    Attributes:
        stage: the first stage that the part can change: "masks", "reference" or "initialize".
        settings: parameters that change, "stage.parameter" -> value.
        replaced: what is replaced, "module.attribute" -> function or value.
        files: files of `reffusion/` that only this part needs, whose lines of code are counted.
    """

    stage: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    replaced: Mapping[str, Any] = field(default_factory=dict)
    files: tuple[str, ...] = ()

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Replace the functions and values, and restore them in the end."""
        with ExitStack() as stack:
            for target, replacement in self.replaced.items():
                stack.enter_context(mock.patch(target, replacement))
            yield


def no_mirrors(mirrors: Any, *view: Any) -> MirrorImage:
    """Render no mirror image; stands for `render_mirrors`."""
    return render_mirrors((), *view)


def keep_shadows(trusted: Any, gaussians: Any, background: Any) -> tuple[Any, Any, dict[str, np.ndarray]]:
    """Find no shadow; stands for `remove_shadows`."""
    return trusted, background, {}


def paint_by(method: Any) -> Any:
    """Return a function that fills a view by a classical method alone; stands for `complete_view`."""
    return lambda image, hole, camera, hidden, around, seeds: (
        Completion(method(classical.blank_hole(image, hole), hole), 0.0) for _ in seeds
    )


MIRRORS = {INPAINT + "exemplar.render_mirrors": no_mirrors}
REPEATING = {INPAINT + "exemplar._symmetry_of": lambda *_: None}

TEXTURE = {  # judged first on the picture of the reference
    "mirror images in pictures": Switch("reference", replaced=MIRRORS),
    "repeating planes": Switch(
        "reference",
        replaced=REPEATING,
        files=("inpaint/shift_map/plane_motions.py", "inpaint/shift_map/plane_symmetry.py"),
    ),
    "patches of other photographs": Switch(
        "reference", replaced={INPAINT + "exemplar._choose_others": lambda own, views: []}
    ),
    "patches in perspective": Switch("reference", replaced={INPAINT + "exemplar._roughness": lambda *_: np.inf}),
    "patches blended by gradients": Switch(
        "reference",
        replaced={INPAINT + "patchmatch.completion.blend": lambda current, hole, right, below, own: own[hole]},
    ),
    "rim of the hole painted": Switch(
        "reference", replaced={INPAINT + "exemplar.mask_to_paint": lambda hidden, unknown: unknown}
    ),
    "three candidates": Switch("reference", {"reference.candidates": 1}),
    "all but PatchMatch": Switch("reference", replaced=MIRRORS | REPEATING),
    "all but Telea's method": Switch(
        "reference", replaced={INPAINT + "exemplar.complete_view": paint_by(classical.telea)}
    ),
    "all but FSR": Switch("reference", replaced={INPAINT + "exemplar.complete_view": paint_by(classical.fsr)}),
}

SURFACES = {
    "planes around the object": Switch("masks", replaced={BACKGROUND + "model.find_planes": lambda *_: []}),
    "third faces of corners": Switch(
        "masks",
        replaced={BACKGROUND + "continuation.find_third_faces": lambda *_: []},
        files=("background/corners.py",),
    ),
    "straight borders": Switch(
        "masks",
        replaced={BACKGROUND + "continuation.extend_borders": lambda unknown, *_: np.ones(unknown.shape)},
        files=("background/borders.py",),
    ),
    "symmetric things": Switch(
        "masks",
        replaced={BACKGROUND + "model.find_mirrors": lambda *_: []},
        files=("background/mirrors.py", "background/symmetry.py"),
    ),
    "remnants": Switch("masks", {"masks.remnants": False}, files=("masks/remnants.py",)),
    "debris": Switch("masks", {"masks.debris": False}, files=("masks/debris.py",)),
    "soft shadows": Switch(
        "masks", {"masks.shadows": False}, files=("shadows/soft_detection.py", "shadows/soft_shadow.py")
    ),
    "tidy masks": Switch("masks", {"masks.tidy": False}),
    "labels by position": Switch("masks", {"masks.inside_share": 1.0}),
}

FILLING = {
    "hints of depth": Switch("initialize", {"initialize.depth.hints": False}),
    "plane sweep": Switch("initialize", {"initialize.depth.sweep": False}, files=("initialize/sweep.py",)),
    "sharp steps of depth": Switch(
        "initialize",
        replaced={INITIALIZE + "fill.sharpen_steps": lambda depth, *_: depth},
        files=("depth/discontinuities.py",),
    ),
    "overlap": Switch("initialize", {"initialize.overlap": 0.0}),
    "tidy filling": Switch("initialize", {"initialize.tidy": False}),
    "shared surfaces": Switch(
        "initialize", replaced={INITIALIZE + "fill.share_surfaces": lambda *_: {}}, files=("initialize/sharing.py",)
    ),
    "gaps beside the hole": Switch(
        "initialize",
        replaced={
            INITIALIZE + "unprojection.find_gaps": lambda gaussians, camera, *_: np.zeros(
                (camera.height, camera.width), bool
            )
        },
    ),
    "view-dependent color": Switch(
        "initialize", {"initialize.view_dependent_color": False}, files=("initialize/view_dependent_color.py",)
    ),
    "matched colors": Switch(
        "initialize", replaced={INITIALIZE + "unprojection.match_colors": lambda gaussians, *_: gaussians}
    ),
    "hard shadows": Switch(
        "initialize",
        replaced={INITIALIZE + "filling.remove_shadows": keep_shadows},
        files=("shadows/reference_shadows.py",),
    ),
    "extra views": Switch("initialize", {"initialize.extra_views": 0}, files=("initialize/extra_views.py",)),
    "farthest surface in gaps": Switch(
        "initialize",
        replaced={
            "reffusion.depth.background_depth._complete_gaps": lambda view, surfaces, *known: complete(
                view.disparity, *known
            )
        },
    ),
    "warped references": Switch(
        "initialize",
        replaced={INITIALIZE + "filling.warp_references": lambda *_: []},
        files=("initialize/warped_views.py",),
    ),
    "refit": Switch("initialize", {"initialize.refit_steps": 0}, files=("initialize/refit.py",)),
}

PARTS = {**TEXTURE, **SURFACES, **FILLING}
