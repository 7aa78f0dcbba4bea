"""Parameters of the stage `lift`, a baseline's."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from reffusion.params.base import Device, Settings, prior_field


def inpainter_field() -> str:
    return Field("fsr", description="OpenCV's FSR, else Telea; LaMa or MI-GAN, as `make weights` fetched them")


class Params(Settings):
    inpainter: Literal["fsr", "lama", "migan", "diffusion"] = inpainter_field()
    prior: str = prior_field()
    prompt: str = Field("", description="what the invented region shows, for a prior that reads")
    steps: int = Field(50, ge=1, description="sampler steps from pure noise")
    device: Device = "cpu"
