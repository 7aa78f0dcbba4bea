"""Parameters of the stage `poses`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from reffusion.params.base import UNKEYED, Settings
from reffusion.params.reference import Given

Side = Annotated[float, Field(gt=0)]


class Region(Settings):
    center: tuple[float, float, float] = Field(description="of a box along the axes, in the scene's own frame")
    size: tuple[Side, Side, Side] = Field(description="side lengths in the scene's own units")


class Params(Settings):
    layout: Literal["llff", "colmap", "transforms", "photos"] | None = Field(None, description="None: recognised")
    images: str | None = Field(None, description="folder of pictures, relative to the scene; None: the usual ones")
    masks: str | None = Field(None, description='folder of masks; "none": the scene has none; None: the usual ones')
    test_masks: str | None = Field(None, description="folder of masks of test views, by name or in their order")
    train: list[str] | str | None = Field(None, description='view names, or "every N"; None: all that are not test')
    test: list[str] | str | None = Field(None, description='view names, or "every N"; None: those of the test masks')
    clean: list[str] = Field([], description="training views in which the object is absent")
    cameras_only: list[str] | str | None = Field(
        None, description='views whose pixels are not used: names, "every N", or "others" than train and test'
    )
    gaussians: str | None = Field(None, description=".ply the scene brings in its own frame, 3DGS layout")
    region: Region | None = Field(None, description="3D box that holds the object, or is to be filled")
    remove: list[str] | None = Field(
        None, description="read by the stage `masks`; here only checked", json_schema_extra=UNKEYED
    )
    reference: Given | list[Given] | None = Field(
        None,
        description="read by the stage `reference`; here only checked against the views",
        json_schema_extra=UNKEYED,
    )
    longest: int = Field(1600, ge=16, description="larger image side in px; smaller pictures stay as they are")
    # PAPER leaves open: pictures that are blurred or were enlarged. It takes 1600 px; half of them may show as much.
    detail: float = Field(0.0, ge=0, description="pictures of less are halved, see reffusion.capture.support; 0: never")
    refine: bool = Field(False, description="adjust cameras, the principal point of each view too, that flow belies")
