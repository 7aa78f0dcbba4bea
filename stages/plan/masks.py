"""What `plan` reports of the stage `masks` before it runs."""

from reffusion.io import machine
from reffusion.params.masks import Params

__all__ = ["Params", "lacks"]


def lacks(params: Params) -> list[str]:
    """What the stage needs on CUDA and this machine lacks."""
    return machine.find_missing(machine.detect())
