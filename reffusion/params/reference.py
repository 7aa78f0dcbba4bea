"""Parameters of the stage `reference`."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Field, field_validator

from reffusion.params.base import Device, Dtype, Sampler, Settings, memory_field, prior_field, to_slashes
from reffusion.params.inpainter import Inpainter, ReferenceKind


class ReferenceSpec(Settings):
    """An entry of the key `reference` of scene.yaml: a completed view that comes with the scene."""

    view: str = Field(description="name of the view it completes")
    image: str = Field(description="picture, relative to the scene; of another size or cropped a little is fine")
    depth: str | None = Field(None, description="its depth or disparity, any scale: 16-bit .png, .npy or .exr")
    trust: bool = Field(False, description="use it even though it does not seem to show its view")
    _slashes = field_validator("image", "depth")(to_slashes)


def reference_list(given: ReferenceSpec | Sequence[ReferenceSpec] | None) -> list[ReferenceSpec]:
    """Return the value of the key `reference`, which may be one entry, several or None, as a list."""
    return [] if given is None else [given] if isinstance(given, ReferenceSpec) else list(given)


class Params(Settings):
    reference: ReferenceSpec | list[ReferenceSpec] | None = Field(
        None, description="completed views that the scene brings"
    )
    # "Ours (LoRA)" of the paper's sparse-view experiment: pictures that are neither reconstructed nor unprojected.
    teach: list[str] = Field([], description="pictures of the scene that only personalize the prior; files")
    _slashes = field_validator("teach")(to_slashes)
    inpainter: Inpainter[ReferenceKind] = Inpainter[ReferenceKind](kind="diffusion")
    prior: str = prior_field()
    prompt: str = Field("", description="what the invented region shows, for a prior with a text encoder")
    candidates: int = Field(4, ge=1, description="pictures to choose from")
    choose: int | None = Field(None, ge=0, description="the candidate to take; None takes the one with the lowest seam")
    sampler: Sampler = Sampler()
    seed: int = Field(0, description="seed of the first candidate; the others count up")
    device: Device = "cpu"
    dtype: Dtype = "float32"
    memory_gb: float = memory_field()

    @property
    def candidate_numbers(self) -> list[int]:
        """Return the numbers of the candidates that an inpainter of the kinds `SEED_KINDS` paints.

        If `choose` is set, this is its number alone, because each candidate takes minutes. Otherwise the numbers go
        from 0 to `candidates` - 1, but a command without {seed} paints only number 0.
        """
        count = 1 if self.inpainter.command and "{seed}" not in self.inpainter.command else self.candidates
        return list(range(count)) if self.choose is None else [self.choose]
