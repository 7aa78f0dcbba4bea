"""Parameters of the stage `finish`."""

from __future__ import annotations

from pydantic import Field

from reffusion.params.base import Device, Settings


class Params(Settings):
    backdrop: bool = Field(
        True,
        description="where no training view looked, continue planes and close the scene by a soft backdrop; remove the "
        "Gaussians that no training view supports",
    )
    device: Device = Field("cpu", description="where the training views are rendered")
