"""The setting `inpainter` of the stages `reference`, `initialize`, `lift` and `evaluate`."""

from __future__ import annotations

from typing import Any, Generic, Literal, TypeVar

from pydantic import Field, model_validator

from reffusion.params.base import WEIGHTS, Settings

KindT = TypeVar("KindT", bound=str)
ReferenceKind = Literal["exemplar", "diffusion", "lama", "migan", "auto"]  # in `reference`, `initialize`
FEED_FORWARD = ("lama", "migan")  # the kinds whose network is read from a file


class Inpainter(Settings, Generic[KindT]):
    """The method that inpaints a view in 2D.

    The type parameter lists the kinds that a stage allows, as in `Inpainter[Literal["fsr", "lama"]]`. A plain string in
    a parameter file stands for the kind. The diffusion model is not named here but by the parameter `prior` of
    `reference` and `lift`: a profile sets the model, which has to suit the machine, while a scene or a variant sets the
    kind.
    """

    kind: KindT = Field(
        description="exemplar: patches of the photographs, along surfaces: sharp, with nothing new; diffusion: the "
        "model `prior` (for the extra views of `initialize` patches, too); lama, migan: a feed-forward network; fsr: "
        "OpenCV's FSR, else Telea; auto: the first of LaMa, MI-GAN that is on this machine, else exemplar"
    )
    weights: str | None = Field(
        None,
        description="of lama (.pt or .onnx) and migan (.onnx): a file, or a folder with one; none: the file that "
        "`make weights` fetches",
        json_schema_extra=WEIGHTS,
    )

    @model_validator(mode="before")
    @classmethod
    def _from_kind(cls, value: Any) -> Any:
        value = {"kind": value} if isinstance(value, str) else value
        if isinstance(value, Inpainter) or (isinstance(value, dict) and "kind" in value):
            return value
        raise ValueError("write a kind, such as lama, or {kind: lama, weights: FILE}")

    @model_validator(mode="after")
    def _has_weights(self) -> Inpainter[KindT]:
        if self.weights and self.kind not in FEED_FORWARD:
            raise ValueError(
                f"kind {self.kind} takes no `weights`, {' and '.join(FEED_FORWARD)} do; `prior` names a diffusion model"
            )
        return self
