"""Parameters of the stage `evaluate`."""

from __future__ import annotations

from pydantic import Field

from reffusion.params.base import WEIGHTS, Device, Settings
from reffusion.params.lift import lama_field


class Params(Settings):
    lpips_weights: str | None = Field(
        None,
        description="folder with LPIPS weights, looked into before ~/.cache/reffusion/lpips and torch hub's cache",
        json_schema_extra=WEIGHTS,
    )
    inpaint: bool = Field(False, description="a baseline: each rendered view is inpainted in 2D inside its mask")
    lama: str | None = lama_field()
    beyond: bool = Field(True, description="what no training view saw is closed by a soft backdrop, scene.ply's too")
    device: Device = Field("cpu", description="where the views are rendered")
