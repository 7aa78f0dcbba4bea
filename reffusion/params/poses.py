"""Parameters of the stage `poses`."""

from __future__ import annotations

from pydantic import Field

from reffusion.params.capture import SceneKeys


class Params(SceneKeys):
    longest: int = Field(1600, ge=16, description="larger image side in px; smaller pictures are not enlarged")
    # PAPER leaves open: pictures that are blurred or were enlarged. The paper takes 1600 px; of such pictures half that
    # size may show as much.
    min_detail: float = Field(
        0.0, ge=0, description="pictures with less detail (reffusion.capture.image_detail) are halved; 0: never"
    )
    refine: bool = Field(
        False, description="adjust poses and principal points of views to optical flow, where they disagree with it"
    )
    trust: bool = Field(False, description="use the poses that come with photographs even where they contradict these")
