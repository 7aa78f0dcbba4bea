"""Parameters of the stage `lift`, a baseline's."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from reffusion.params.base import WEIGHTS, Device, Settings, prior_field


def lama_field() -> str | None:
    return Field(
        None,
        description="folder with LaMa's TorchScript file, e.g. big-lama.pt; none: OpenCV's FSR, else Telea",
        json_schema_extra=WEIGHTS,
    )


class Params(Settings):
    inpainter: Literal["deterministic", "diffusion"] = Field(
        "deterministic", description="LaMa or its stand-in, or the prior, unadapted and with another seed in each view"
    )
    lama: str | None = lama_field()
    prior: str = prior_field()
    prompt: str = Field("", description="what the invented region shows, for a prior that reads")
    steps: int = Field(50, ge=1, description="sampler steps from pure noise")
    device: Device = "cpu"
