"""Parameters of the stage `evaluate`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from reffusion.params.base import Device, Settings
from reffusion.params.inpainter import Inpainter

Kind = Literal["fsr", "lama", "migan"]


class Params(Settings):
    # PAPER leaves open: at which size pictures are scored. SPIn-NeRF's masks are of 1008 px, and LPIPS depends on the
    # size.
    longest: int | None = Field(
        None,
        ge=0,
        description="the box is also scored with pictures reduced to this larger side, px; None: that of the test "
        "masks' files; 0: not",
    )
    inpaint: bool = Field(False, description="a baseline: each rendered view is inpainted in 2D inside its mask")
    inpainter: Inpainter[Kind] = Inpainter[Kind](kind="fsr")
    device: Device = Field("cpu", description="where the views are rendered")
