"""Parameters of the stage `initialize`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from reffusion.params.base import Device, Settings, depth_model_field


class Depth(Settings):
    """How the depth of a reference's hole is found."""

    # PAPER leaves open: the depth model, and whether its alignment is plain or robust.
    model: str | None = depth_model_field()
    sweep: bool = Field(False, description="depth around the hole is found anew by comparing the photographs")


class Params(Settings):
    start: Literal["reference", "lift", "random", "nothing"] = Field(
        "reference",
        description="what fills the hole: the reference on its depth; instead (baselines) the picture that the stage "
        "lift painted of the best view, Gaussians at random (initialize.scatter), or nothing: it only removes",
    )
    depth: Depth = Depth()
    tidy: bool = Field(
        True,
        description="haze goes that shows mostly where nobody saw; where other views see past the new surface into "
        "nothing, there is a second",
    )
    # PAPER leaves open: the new Gaussians' view-dependent colour. The reference shows one side only.
    view_dependent_color: bool = Field(
        False, description="they change with the direction as the surfaces around them do"
    )
    # PAPER leaves open: what the reference's camera does not see of the hole.
    extra_views: int = Field(
        0, ge=0, description="most views completed beside the references, until nothing is uncovered"
    )
    inpainter: Literal["exemplar", "diffusion", "lama", "migan", "auto"] = Field(
        "exemplar",
        description="what completes them, as `reference.inpainter`; diffusion: patches of the photographs too",
    )
    refit_steps: int = Field(0, ge=0, description="steps of reconstruction after filling; 0: none")
    device: Device = Field("cpu", description="where Gaussians are drawn and the depth model is asked")
