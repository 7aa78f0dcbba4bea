"""Parameters of the stage `poses`."""

from __future__ import annotations

from pydantic import Field

from reffusion.params.capture import SceneKeys


class Params(SceneKeys):
    longest: int = Field(1600, ge=16, description="larger image side in px; smaller pictures stay as they are")
    # PAPER leaves open: pictures that are blurred or were enlarged. It takes 1600 px; half of them may show as much.
    detail: float = Field(
        0.0, ge=0, description="pictures of less are halved, see reffusion.capture.image_detail; 0: never"
    )
    refine: bool = Field(False, description="adjust cameras, the principal point of each view too, that flow belies")
