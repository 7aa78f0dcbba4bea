"""Parameters of the stage `masks`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from reffusion.params.base import Device, Settings
from reffusion.params.clicks import Clicked


class Params(Settings):
    remove: list[str] | None = Field(
        None, min_length=1, description="objects to remove, each a folder of masks (masks/<object>/); None: all"
    )
    clicks: Clicked | None = Field(None, description="view -> clicks, from which masks are made if none are given")
    grow: float = Field(
        0.0,
        ge=0,
        le=0.1,
        description="share of the image's width by which given masks that leave out a rim are enlarged",
    )
    refine: bool = Field(
        False,
        description="draw the given masks anew by the segmentation network: for rough ones, up to 2 % of the image's "
        "larger side wide of the object, or missing in some views",
    )
    segmenter: str = Field(
        "auto",
        description="network that makes masks from clicks and refines masks: auto (that which `make weights` fetches, "
        "if it is on this machine), none, a folder with encoder.onnx and decoder.onnx, or a SAM of transformers",
    )
    vote: Literal["weight", "count"] = Field(
        "weight", description="value of a contribution: its blending weight, or 1 (the paper says 'count')"
    )
    tau: float = Field(1.0, gt=0, description="masked above this ratio of masked to unmasked contributions (paper: 1)")
    tau_rendered: float = Field(0.3, gt=0, lt=1, description="threshold of the rendered label for C (paper: 0.3)")
    tidy: bool = Field(
        True,
        description="Gaussians that hardly any view shows are labelled by their position; in masks, islands below 1 % "
        "of the image's width are removed and holes below 2 % closed",
    )
    inside_share: float = Field(
        0.9,
        ge=0,
        le=1,
        description="also mask Gaussians whose center is in C in more than this share of views; 1 = none",
    )
    debris: bool = Field(True, description="also mask Gaussians that the removal uncovers and no photograph supports")
    remnants: bool = Field(
        True,
        description="find parts of the object that the masks leave out: remove those that would float in the air, and "
        "warn of the others",
    )
    shadows: bool = Field(
        True,
        description="find the object's soft shadow, which no mask contains, and remove it from photographs and scene",
    )
    # PAPER leaves open: the paper always invents. If so few pixels are unobserved, they are rims of masks and crevices,
    # which are not worth a diffusion model.
    negligible: float = Field(
        0.005, ge=0, lt=1, description="share of C up to which unobserved pixels are not inpainted"
    )
    invent: Literal["auto", "unobserved", "consistent"] = Field(
        "auto", description="pixels to inpaint; auto: unobserved pixels and those the scene asks to fill"
    )
    device: Device = Field("cpu", description="device for rendering and votes")

    @model_validator(mode="after")
    def _refining_needs_a_network(self) -> Params:
        """Raise ValueError if masks are to be refined and the segmenter is "none"."""
        if self.refine and self.segmenter == "none":
            raise ValueError("refine needs a segmentation network: leave out segmenter: none")
        return self
