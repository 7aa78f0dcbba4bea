"""The keys of scene.yaml about files and views, which the stages `poses` and `raw_masks` read."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from reffusion.params.base import UNKEYED, Settings, to_slashes
from reffusion.params.clicks import Clicked
from reffusion.params.reference import ReferenceSpec

Side = Annotated[float, Field(gt=0)]


class RegionSpec(Settings):
    """The key `region`: an axis-aligned box or a sphere, in the frame and units of the scene's own files."""

    center: tuple[float, float, float] | None = Field(None, description="its middle")
    view: str | None = Field(None, description="instead of center: a view on whose optical axis the middle lies")
    distance: Side | None = Field(None, description="with view: distance from its camera")
    size: tuple[Side, Side, Side] | None = Field(None, description="side lengths of a box")
    radius: Side | None = Field(None, description="instead of size: radius of a sphere")
    outside: bool = Field(False, description="everything beyond the sphere is masked in every view")

    @model_validator(mode="after")
    def _whole(self) -> Self:
        """Raise ValueError unless the region has one size and one place, and a radius if it is `outside`."""
        if (self.size is None) == (self.radius is None):
            raise ValueError("give either the size of a box, or the radius of a sphere")
        if (self.center is None) == (self.view is None) or (self.view is None) != (self.distance is None):
            raise ValueError("give either its center, or a view and a distance along that view's optical axis")
        if self.outside and self.radius is None:
            raise ValueError("outside needs a sphere: give its radius")
        return self


class MaskSpec(Settings):
    """The key `masks` in its long form: the folder of the masks, and the values of a pixel that mean the object."""

    folder: str | None = Field(None, description="relative to the scene; None: the usual folders")
    id: int | list[int] | None = Field(
        None, description="in maps of object numbers, and in palettes: the numbers that are the object"
    )
    _slashes = field_validator("folder")(to_slashes)

    @property
    def numbers(self) -> tuple[int, ...]:
        """The pixel values that mean the object, as a tuple; empty if `id` is None: the object is then white."""
        return () if self.id is None else (self.id,) if isinstance(self.id, int) else tuple(self.id)


class SceneKeys(Settings):
    """The keys of scene.yaml that the stages `poses` and `raw_masks` read.

    Keys about masks do not themselves enter the hash by which a stage's result is cached. The views and files that
    these keys select do enter the hash (`scene_facts` in `stages.plan`).
    """

    layout: (
        Literal["llff", "colmap", "transforms", "polycam", "realitycapture", "opensfm", "bundler", "3dgs", "photos"]
        | None
    ) = Field(None, description="None: detected")
    images: str | None = Field(None, description="folder of pictures, relative to the scene; None: the usual folders")
    masks: str | MaskSpec | None = Field(
        None,
        description='folder of masks, or {folder, id}; "none": the scene has none; None: the usual folders',
        json_schema_extra=UNKEYED,
    )
    test_masks: str | None = Field(
        None, description="folder of masks of test views, by name or in their order", json_schema_extra=UNKEYED
    )
    ignore: str | None = Field(
        None,
        description='folder of masks of what neither trains nor is filled, all.png for every view; "none": there are '
        "none; None: the folder `ignore`, if there is one",
        json_schema_extra=UNKEYED,
    )
    train: list[str] | str | None = Field(None, description='view names, or "every N"; None: all that are not test')
    test: list[str] | str | None = Field(None, description='view names, or "every N"; None: those of the test masks')
    clean: list[str] = Field([], description="training views in which the object is absent")
    cameras_only: list[str] | str | None = Field(
        None, description='views whose pixels are not used: names, "every N", or "others" than train and test'
    )
    exclude: list[str] = Field([], description="views to leave out of the scene")
    keep: list[str] = Field([], description="views that stay, even where their photographs contradict their poses")
    gaussians: str | None = Field(
        None, description="a fitted scene of Gaussians in its own frame: .ply, .spz, .splat, .glb, .sog"
    )
    cleaned: str | None = Field(None, description="the same file after splats were deleted: these are the object")
    region: RegionSpec | None = Field(
        None, description="box or sphere that holds the object, or is to be filled", json_schema_extra=UNKEYED
    )
    fill: str | None = Field(
        None, description="instead of a region: folder of masks of what is to be filled", json_schema_extra=UNKEYED
    )
    clicks: Clicked | None = Field(
        None, description="read by the stage `masks`; here only checked", json_schema_extra=UNKEYED
    )
    remove: list[str] | None = Field(
        None, description="read by the stage `masks`; here only checked", json_schema_extra=UNKEYED
    )
    reference: ReferenceSpec | list[ReferenceSpec] | None = Field(
        None,
        description="read by the stage `reference`; here only checked against the views",
        json_schema_extra=UNKEYED,
    )

    _slashes = field_validator("images", "masks", "test_masks", "ignore", "gaussians", "cleaned", "fill")(to_slashes)

    @property
    def has_masks(self) -> bool:
        """Whether the scene may have masks: False only if scene.yaml says `masks: none`."""
        return (self.mask_folder or "").lower() != "none"

    @property
    def mask_folder(self) -> str | None:
        """The folder of masks that scene.yaml names; "none" if the scene has no masks; None for the usual folders."""
        return self.masks.folder if isinstance(self.masks, MaskSpec) else self.masks
