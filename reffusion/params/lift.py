"""Parameters of the stage `lift`, a baseline."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from reffusion.params.base import Device, Settings, prior_field
from reffusion.params.inpainter import Inpainter

Kind = Literal["fsr", "lama", "migan", "diffusion"]


class Params(Settings):
    inpainter: Inpainter[Kind] = Inpainter[Kind](kind="fsr")
    prior: str = prior_field()
    prompt: str = Field("", description="prompt for the inpainted region, for text-conditioned priors")
    guidance: float = Field(0.0, ge=0, description="γ of (1 + γ) ε(cond) - γ ε(empty); no effect without a prompt")
    steps: int = Field(50, ge=1, description="sampler steps from pure noise")
    device: Device = "cpu"
