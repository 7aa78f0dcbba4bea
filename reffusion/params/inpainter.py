"""The setting `inpainter` of the stages `reference`, `initialize`, `lift` and `evaluate`."""

from __future__ import annotations

import shlex
from typing import Any, Generic, Literal, TypeVar

from pydantic import Field, model_validator

from reffusion.params.base import PROGRAM, WEIGHTS, Settings

KindT = TypeVar("KindT", bound=str)
ReferenceKind = Literal[  # in `reference`, `initialize`
    "exemplar", "diffusion", "lama", "migan", "auto", "moebius", "pipeline", "command"
]
FEED_FORWARD = ("lama", "migan")  # the kinds whose network is read from a file
SEED_KINDS = (
    "moebius",
    "pipeline",
    "command",
)  # the kinds that draw a picture from a seed, in minutes rather than seconds
PLACEHOLDERS = ("{image}", "{mask}", "{out}")  # in a command: the files that the program reads and the one it writes
KINDS_OF_PARAMETER = {  # parameter -> the kinds that read it
    "weights": (*FEED_FORWARD, "moebius", "pipeline"),
    "command": ("command",),
    "steps": ("moebius", "pipeline"),
    "guidance_scale": ("moebius", "pipeline"),
    "strength": ("pipeline",),
}
REQUIRED = {"pipeline": "weights", "command": "command"}  # kind -> the parameter without which it cannot work


class Inpainter(Settings, Generic[KindT]):
    """The method that inpaints a view in 2D.

    The type parameter lists the kinds that a stage allows, as in `Inpainter[Literal["fsr", "lama"]]`. A plain string in
    a parameter file stands for the kind. The diffusion prior is not named here but by the parameter `prior` of
    `reference` and `lift`: a profile sets the model, which has to suit the machine, while a scene or a variant sets the
    kind.
    """

    kind: KindT = Field(
        description="exemplar: patches of the photographs, along surfaces: sharp, with nothing new; diffusion: the "
        "model `prior`; lama, migan: a feed-forward network; fsr: OpenCV's FSR, else Telea; auto: the first of LaMa, "
        "MI-GAN that is on this machine, else exemplar; moebius: a diffusion model without a prompt; pipeline: a "
        "diffusers pipeline; command: a program. With diffusion, moebius, pipeline and command the extra views of "
        "`initialize` are completed from patches"
    )
    weights: str | None = Field(
        None,
        description="of lama (.pt or .onnx) and migan (.onnx): a file, or a folder with one; of moebius: a folder; "
        "none: what `make weights` fetches. Of pipeline: a diffusers folder or a hub id",
        json_schema_extra=WEIGHTS,
    )
    command: str | None = Field(
        None,
        description="the program and its arguments, run without a shell: {image} and {mask} stand for PNG files (mask: "
        "white where to paint), {out} for the picture that it writes; {prompt} and {seed} may be used. No scene.yaml "
        "may set it",
        json_schema_extra=PROGRAM,
    )
    steps: int | None = Field(None, ge=1, description="sampler steps of moebius and pipeline; none: the model's own")
    guidance_scale: float | None = Field(
        None, ge=0, description="guidance of moebius and pipeline, as their authors count it; none: the model's own"
    )
    # Pipelines of plain text-to-image models repaint at .6 by default, which keeps the colors of what fills the hole.
    strength: float = Field(
        0.99,
        gt=0,
        le=1,
        description="of pipeline: initial noise level; 1 ignores what fills the hole before",
    )

    @model_validator(mode="before")
    @classmethod
    def _from_kind(cls, value: Any) -> Any:
        """Return {"kind": kind} for a kind as text, and an inpainter or a dict with a kind unchanged."""
        value = {"kind": value} if isinstance(value, str) else value
        if isinstance(value, Inpainter) or (isinstance(value, dict) and "kind" in value):
            return value
        raise ValueError("write a kind, such as lama, or {kind: lama, weights: FILE}")

    @model_validator(mode="after")
    def _has_what_its_kind_reads(self) -> Inpainter[KindT]:
        """Raise ValueError if a parameter is set that the kind does not read, or one is missing that it needs."""
        defaults = {name: field.default for name, field in type(self).model_fields.items()}
        for name, kinds in KINDS_OF_PARAMETER.items():
            if getattr(self, name) != defaults[name] and self.kind not in kinds:
                raise ValueError(
                    f"kind {self.kind} takes no `{name}`, only {', '.join(kinds)}; `prior` names the diffusion prior"
                )
        if (needed := REQUIRED.get(self.kind)) and not getattr(self, needed):
            example = "owner/model" if needed == "weights" else "'mytool {image} {mask} {out}'"
            raise ValueError(f"kind {self.kind} needs `{needed}`, such as {{kind: {self.kind}, {needed}: {example}}}")
        if self.command is not None:
            split_command(self.command)
        return self


def split_command(command: str) -> list[str]:
    """Split a command into the program and its arguments, as a shell does.

    Raises:
        ValueError: a quote is not closed, or no argument contains one of `PLACEHOLDERS`.
    """
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise ValueError(f"the command cannot be split into words: {error}") from None
    if missing := [each for each in PLACEHOLDERS if not any(each in word for word in words[1:])]:
        raise ValueError(f"the command lacks {' and '.join(missing)}: write 'mytool {{image}} {{mask}} {{out}}'")
    return words
