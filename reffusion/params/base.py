"""The base class of all parameters, and fields that the parameters of several stages share."""

from __future__ import annotations

from collections.abc import Mapping
from types import UnionType
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

Decay = Annotated[float, Field(ge=0, lt=1)]  # decay rate of a running mean
Device = Literal["cpu", "cuda"]
Dtype = Literal["float32", "bfloat16", "float16"]
MeansUnit = Literal["distance", "cameras"]

# Marks for json_schema_extra of a Field; the key is the hash by which a stage's result is cached. A parameter with
# WEIGHTS names a folder of weights, whose content enters the key. A parameter with UNKEYED does not enter the key,
# because it does not change the result. A parameter with PROGRAM names a program to run, so that a scene, which people
# get from others, may not set it.
WEIGHTS: dict[str, Any] = {"weights": True}
UNKEYED: dict[str, Any] = {"keyed": False}
PROGRAM: dict[str, Any] = {"program": True}

PRIOR = "sd2-community/stable-diffusion-2-inpainting"


def _kinds(annotation: Any) -> set[Any]:
    """Return the types that an annotation allows: the members of a union, or the annotation itself."""
    return set(get_args(annotation)) if isinstance(annotation, UnionType) else {annotation}


class Settings(BaseModel):
    """A set of parameters, which is immutable. Unknown names of parameters, infinity and NaN are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _as_meant(cls, value: Any, field: ValidationInfo) -> Any:
        """Return the value; raise ValueError for a boolean or a number in a field whose type does not allow it."""
        info = cls.model_fields[field.field_name]
        # YAML reads an unquoted `on` as true, which pydantic would silently turn into 1.
        if isinstance(value, bool) and bool not in _kinds(info.annotation):
            advice = "write it in quotes" if str in _kinds(info.annotation) else "give a number"
            raise ValueError(f"yes, no, on, off, true and false are truth values; {advice}")
        if isinstance(value, int | float) and _kinds(info.annotation) <= {str, type(None)}:
            raise ValueError(f"read as the number {value}; write it in quotes")
        return value

    def changed(self, values: Mapping[str, Any]) -> Self:
        """Return a copy in which some values are replaced; all values are validated again.

        Args:
            values: dotted name of a parameter -> its new value, such as `{"sh.degree": 2}`.

        Raises:
            KeyError: a group in a dotted name does not exist.
            ValueError: a parameter does not exist, or a value is not allowed (pydantic's ValidationError).
        """
        nested = self.model_dump()
        for name, value in values.items():
            *parents, key = name.split(".")
            node = nested
            for step in parents:
                node = node[step]
            node[key] = value
        return type(self).model_validate(nested)


def to_slashes(value: Any) -> Any:
    """Return a string, or a list with each string in it, with slashes for backslashes; other values are unchanged."""
    if isinstance(value, list):
        return [to_slashes(each) for each in value]
    return value.replace("\\", "/") if isinstance(value, str) else value


def prior_field() -> Any:
    """Return the field of a parameter that names the inpainting prior, whose weights enter the key."""
    return Field(PRIOR, description="inpainting prior: a diffusers folder or a hub id", json_schema_extra=WEIGHTS)


def depth_model_field() -> Any:
    """Return the field of a parameter that names the depth model; None by default."""
    return Field(
        None,
        description="depth model: a transformers folder or a hub id; none: depth is continued from the surroundings",
        json_schema_extra=WEIGHTS,
    )


def memory_field() -> Any:
    """Return the field of the memory limit of the prior in GB; 0, the default, for no limit."""
    return Field(0.0, ge=0, description="memory limit of the prior in GB; batches are split to fit; 0: no limit")


def means_unit_field() -> Any:
    """Return the field of the unit of a learning rate of positions."""
    return Field(
        "distance",
        description="unit of that learning rate: the cameras' distance from the scene, or, as in the code of 3DGS, 1.1 "
        "times the radius of the cameras around their mean",
    )


def seconds_field() -> Any:
    """Return the field of the time budget of a stage in seconds; 0, the default, for none."""
    return Field(0.0, ge=0, description="time budget of the stage in seconds: as many steps as fit; 0: all steps")


def checkpoint_field() -> Any:
    """Return the field of the seconds of work between two checkpoints, which does not enter the key."""
    return Field(10.0, gt=0, description="seconds of work between checkpoints", json_schema_extra=UNKEYED)


class Prompts(Settings):
    """The prompts with which a prior is adapted to a reference, and with which it then repaints views (section 4).

    The default prompts stand for the reference only after the adaptation. A variant without an adaptation describes the
    scene in plain words.
    """

    whole: str = Field("A photo of sks", description="prompt of whole views")
    crop: str = Field("A photo of sks, cropped", description="prompt of windows")

    @property
    def texts(self) -> list[str]:
        """The prompts of whole views and of windows, and the empty prompt, in the order of `crops.GLOBAL` and so on."""
        return [self.whole, self.crop, ""]


# PAPER leaves open: the noise level at which the refinement of a finer level starts; 1 = pure noise.
REFINED_FROM = 0.6


class Sampler(Settings):
    """Settings of the sampler with which the diffusion prior inpaints a view (`reffusion.prior.inpaint`)."""

    steps: int = Field(50, ge=1, description="sampler steps from pure noise")
    guidance: float = Field(
        0.0,
        ge=0,
        description="γ of (1 + γ) ε(cond) - γ ε(empty); libraries' scale is 1 + γ; no effect without a prompt",
    )
    # PAPER leaves open: the noise level. SDXL's authors advise against pure noise: diffusers starts just below it.
    start: float = Field(
        1.0,
        gt=0,
        le=1,
        description="initial noise level, as a fraction of the schedule; below 1 the sampler starts from the hole "
        "filled with the colors around it",
    )
