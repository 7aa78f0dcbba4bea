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


class Params(Settings):
    start: Literal["reference", "lift", "random", "nothing"] = Field(
        "reference",
        description="content of the hole: the reference on its depth; or (baselines) the picture of the best view "
        "painted by the stage lift, random Gaussians, or nothing: the object is only removed",
    )
    depth: Depth = Depth()
    tidy: bool = Field(
        True,
        description="remove haze that mostly covers unobserved pixels; add a second surface where other views see past "
        "the new one into nothing",
    )
    # PAPER leaves open: the new Gaussians' view-dependent colour. The reference shows one side only.
    view_dependent_color: bool = Field(
        False, description="view-dependent colours like those of the surfaces around the hole"
    )
    # PAPER leaves open: what the reference's camera does not see of the hole.
    extra_views: int = Field(0, ge=0, description="maximum number of views completed besides the references")
    inpainter: Inpainter[ReferenceKind] = Field(
        Inpainter[ReferenceKind](kind="exemplar"), description="inpainter of the extra views"
    )
    refit_steps: int = Field(0, ge=0, description="reconstruction steps after filling; 0: none")
    device: Device = Field("cpu", description="device for rendering and the depth model")
