"""What can be told of `masks` before it runs."""

from reffusion.io import machine
from reffusion.params.masks import Params

__all__ = ["Params", "lacks"]


def lacks(params: Params) -> list[str]:
    """What this machine has not, and the stage needs on CUDA."""
    return machine.lacks(machine.machine())
