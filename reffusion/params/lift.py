"""Parameters of the stage `lift`, a baseline."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from reffusion.params.base import Device, Settings, prior_field


def inpainter_field() -> str:
    return Field("fsr", description="OpenCV's FSR, else Telea; or LaMa or MI-GAN fetched by `make weights`")


class Params(Settings):
    inpainter: Literal["fsr", "lama", "migan", "diffusion"] = inpainter_field()
    prior: str = prior_field()
    prompt: str = Field("", description="prompt for the inpainted region, for text-conditioned priors")
    steps: int = Field(50, ge=1, description="sampler steps from pure noise")
    device: Device = "cpu"
