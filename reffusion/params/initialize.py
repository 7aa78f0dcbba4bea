"""Parameters of the stage `initialize`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from reffusion.params.base import Device, Settings, depth_model_field
from reffusion.params.inpainter import Inpainter, ReferenceKind


class Depth(Settings):
    """Settings of the depth that is estimated in the hole of a reference."""

    # PAPER leaves open: the depth model, and whether its alignment is plain or robust.
    model: str | None = depth_model_field()
    sweep: bool = Field(False, description="recompute depth around the hole by plane sweep stereo")
    # The paper aligns the model's depth and unprojects it in the whole hole.
    hints: bool = Field(
        True,
        description="in the hole, keep depth that other views confirm, and continue planes and mirror images; sharpen "
        "ramps to steps; off: the estimate holds in the whole hole",
    )


class Params(Settings):
    start: Literal["reference", "lift", "random", "nothing"] = Field(
        "reference",
        description="content of the hole: the reference on its depth; or (baselines) the picture of the best "
        "view of the stage lift, random Gaussians, as many as the reference gives, or nothing: the object is removed",
    )
    depth: Depth = Depth()
    # Not in the paper: it closes the seam around the hole, where photographs supervise these Gaussians, too.
    overlap: float = Field(
        0.006, ge=0, description="how far new Gaussians extend beyond the hole, as a fraction of the image's width"
    )
    tidy: bool = Field(
        True,
        description="remove haze that mostly covers unobserved pixels; add a second surface where other views see past "
        "the new one into nothing",
    )
    # PAPER leaves open: the new Gaussians' view-dependent color. The reference shows one side only.
    view_dependent_color: bool = Field(
        False, description="view-dependent colors like those of the surfaces around the hole"
    )
    # PAPER leaves open: what the reference's camera does not see of the hole.
    extra_views: int = Field(0, ge=0, description="maximum number of views completed besides the references")
    inpainter: Inpainter[ReferenceKind] = Field(
        Inpainter[ReferenceKind](kind="exemplar"), description="inpainter of the extra views"
    )
    refit_steps: int = Field(0, ge=0, description="reconstruction steps after filling; 0: none")
    device: Device = Field("cpu", description="device for rendering and the depth model")

    @property
    def uses_surfaces(self) -> bool:
        """Whether planes and mirrors around the object are used."""
        return self.depth.hints or self.depth.sweep or self.extra_views > 0
