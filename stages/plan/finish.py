"""What can be told of `finish` before it runs."""

from reffusion.io import machine
from reffusion.params.finish import Params

__all__ = ["Params", "lacks"]


def lacks(params: Params) -> list[str]:
    """What this machine lacks and the stage needs on CUDA."""
    return machine.find_missing(machine.detect())
