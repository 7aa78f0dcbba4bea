"""Parameters of the stage `masks`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from reffusion.params.base import Device, Settings
from reffusion.params.clicks import Clicked


class Params(Settings):
    remove: list[str] | None = Field(
        None, min_length=1, description="objects, each a folder of masks (masks/<object>/); None: all of them"
    )
    clicks: Clicked | None = Field(None, description="view -> clicks, from which masks are made where none are given")
    vote: Literal["weight", "count"] = Field(
        "weight", description="what a contribution counts: its blending weight, or 1 (the paper's word is 'count')"
    )
    tau: float = Field(1.0, gt=0, description="masked from this ratio of masked to unmasked contributions (paper: 1)")
    tau_rendered: float = Field(0.3, gt=0, lt=1, description="C is where the rendered label exceeds it (paper: 0.3)")
    tidy: bool = Field(
        True,
        description="what hardly any view shows votes by where it stands; of masks, islands below 1 % of the image's "
        "width go and holes below 2 % close",
    )
    hull: float = Field(
        0.9, ge=0, le=1, description="masked too: centres inside C in more than this share of the views; 1 = none"
    )
    debris: bool = Field(True, description="masked too: what the removal brings to light and no photograph supports")
    # PAPER leaves open: it always invents. So few pixels are rims of masks and crannies, not worth a diffusion model.
    negligible: float = Field(0.005, ge=0, lt=1, description="share of C up to which unobserved pixels are left alone")
    invent: Literal["auto", "unobserved", "consistent"] = Field(
        "auto", description="what is made up; auto = unobserved pixels, and what the scene says is to be filled"
    )
    device: Device = Field("cpu", description="where Gaussians are drawn and votes are counted")
