"""Facts about the stage `finish` that the runner needs before the stage runs; imports nothing heavy."""

from reffusion.io import machine
from reffusion.params.finish import Params

__all__ = ["Params", "lacks"]


def lacks(params: Params) -> list[str]:
    """Return what the stage needs on CUDA and this machine lacks, one line each with the remedy."""
    return machine.find_missing(machine.detect())
