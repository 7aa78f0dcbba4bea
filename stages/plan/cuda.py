"""What this machine lacks for a stage on CUDA; imports nothing heavy."""

from __future__ import annotations

from reffusion.io import machine
from reffusion.params.base import Settings

WITHOUT_GAUSSIANS = ("lift", "personalize", "reference")  # stages that render no Gaussians, and need no gsplat


def find_missing(stage: str, params: Settings) -> list[str]:
    """Return what the stage needs on CUDA and this machine lacks, one line each with the remedy."""
    limit = getattr(params, "memory_gb", 0.0)
    return machine.find_missing(
        machine.detect(), limit, stage not in WITHOUT_GAUSSIANS, memory_param=f"{stage}.memory_gb"
    )
